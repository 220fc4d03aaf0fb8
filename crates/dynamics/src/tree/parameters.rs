//! Numbers of a batch of robots that have the same structure.

use std::sync::Arc;

use crate::{Inertia, Vec3};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use twinstep_model::{RigidBody, RobotTree};
use twinstep_simd::SimdFloat;

use super::structure::{JointAxis, TreeStructure};

/// Place of a frame in another one.
#[derive(Clone, Copy, Debug)]
pub struct Place<T> {
    /// Axes of the frame.
    pub axes: [Vec3<T>; 3],
    /// Origin of the frame [m].
    pub origin: Vec3<T>,
}

impl<T: SimdFloat> Place<T> {
    /// Returns the place of the reference frame itself.
    pub fn identity() -> Self {
        Self { axes: [DVec3::X, DVec3::Y, DVec3::Z].map(Vec3::splat), origin: Vec3::zero() }
    }

    /// Turns a vector of the frame into the other one.
    #[inline(always)]
    pub fn turned(&self, v: Vec3<T>) -> Vec3<T> {
        let [x, y, z] = self.axes;
        x.scaled(v.0[0]) + y.scaled(v.0[1]) + z.scaled(v.0[2])
    }

    /// Returns the place of a frame that has place `inner` in this one.
    #[inline(always)]
    pub fn after(&self, inner: &Self) -> Self {
        let [x, y, z] = inner.axes;
        Self { axes: [self.turned(x), self.turned(y), self.turned(z)], origin: self.origin + self.turned(inner.origin) }
    }

    /// Returns the place of a frame that is parallel to this one, with its origin at `origin` of this one.
    #[inline(always)]
    pub fn moved(&self, origin: Vec3<T>) -> Self {
        Self { axes: self.axes, origin: self.origin + self.turned(origin) }
    }

    /// Turns the frame about one of its axes by the angle with this sine and cosine.
    #[inline(always)]
    pub fn turn(&mut self, axis: usize, sine: T, cosine: T) {
        let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
        let (a, b) = (self.axes[next], self.axes[last]);
        self.axes[next] = a.scaled(cosine) + b.scaled(sine);
        self.axes[last] = b.scaled(cosine) - a.scaled(sine);
    }

    fn set(&mut self, lane: usize, pose: DAffine3) {
        let columns = [pose.matrix3.x_axis, pose.matrix3.y_axis, pose.matrix3.z_axis];
        for (axis, column) in self.axes.iter_mut().zip(columns) {
            axis.set(lane, column);
        }
        self.origin.set(lane, pose.translation);
    }
}

/// Parameters of a batch of robots, one per lane.
#[derive(Clone, Debug)]
pub struct TreeParameters<T> {
    /// Which body is where in the tree.
    pub structure: Arc<TreeStructure>,
    /// Inertia of each body about the origin of its frame.
    pub bodies: Vec<Inertia<T>>,
    /// Place of the frame of each joint's body in that of its parent, at position 0. The frames of the robot are made parallel first.
    pub places: Vec<Place<T>>,
    /// Rotor inertia reflected to each joint [kg·m² or kg].
    pub armature: Vec<T>,
    /// Inertia without weight of a free base [kg and kg·m²].
    pub base_armature: T,
    /// Coefficient of viscous friction of a free base [N·s/m and N·m·s/rad].
    pub base_damping: T,
}

impl<T: SimdFloat> TreeParameters<T> {
    /// Returns the parameters of `robot` in every lane.
    pub fn splat(robot: &RobotTree) -> Self {
        let empty = RigidBody { mass: 0.0, com: DVec3::ZERO, inertia: DMat3::ZERO };
        let joints = robot.joints.len();
        let mut parameters = Self {
            structure: Arc::new(TreeStructure::new(robot)),
            bodies: vec![Inertia::splat(&empty); joints + 1],
            places: vec![Place::identity(); joints],
            armature: vec![T::splat(0.0); joints],
            base_armature: T::splat(0.0),
            base_damping: T::splat(0.0),
        };
        for lane in 0..T::LANES {
            parameters.set(lane, robot);
        }
        parameters
    }

    /// Sets the robot of one lane. It has the structure of the others.
    pub fn set(&mut self, lane: usize, robot: &RobotTree) {
        let robot = robot.with_parallel_frames();
        let turns = turns(&robot);
        self.base_armature.set(lane, robot.free_joint.armature);
        self.base_damping.set(lane, robot.free_joint.damping);
        for (body, (ours, turn)) in robot.bodies.iter().zip(self.bodies.iter_mut().zip(&turns)) {
            let RigidBody { mass, com, inertia } = body.inertia;
            let back = turn.transpose();
            ours.set(lane, &RigidBody { mass, com: back * com, inertia: back * inertia * *turn });
        }
        for (index, joint) in robot.joints.iter().enumerate() {
            let parent = DAffine3::from_mat3(turns[joint.parent].transpose());
            self.places[index].set(lane, parent * joint.parent_from_child * DAffine3::from_mat3(turns[index + 1]));
            self.armature[index].set(lane, joint.armature);
        }
    }
}

/// Returns the rotation from the frame of each body in the robot to its frame in the batch.
pub fn batch_from_bodies(robot: &RobotTree) -> Vec<DMat3> {
    let mut parallel = vec![DMat3::IDENTITY];
    for joint in &robot.joints {
        parallel.push(parallel[joint.parent] * joint.parent_from_child.matrix3);
    }
    let turns = turns(&robot.with_parallel_frames());
    turns.iter().zip(parallel).map(|(turn, parallel)| turn.transpose() * parallel).collect()
}

/// Returns the rotation from the frame of each body in the batch to its frame in the robot: see [`JointAxis`].
fn turns(robot: &RobotTree) -> Vec<DMat3> {
    let of_joints = robot.joints.iter().map(|joint| match JointAxis::of(joint.axis) {
        JointAxis::Along(..) => DMat3::IDENTITY,
        JointAxis::Turned => DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, joint.axis)),
    });
    std::iter::once(DMat3::IDENTITY).chain(of_joints).collect()
}
