//! Kinematic tree of the Go2: inertial parameters, geometry, state and poses of its bodies.

use twinstep_model::{LegModel, RobotModel};
use twinstep_simd::SimdFloat;

use crate::{Inertia, Vec3};

/// Inertial parameters and geometry of a batch of robots, one per lane.
///
/// Hips rotate about x; thighs and calves about y. The origin of a thigh is on the y axis of its hip.
#[derive(Clone, Debug)]
pub struct KinematicTree<T> {
    /// Inertia of the trunk about the base frame's origin.
    pub trunk: Inertia<T>,
    /// Inertia of the links about the origins of their joints, by leg and joint.
    pub bodies: [[Inertia<T>; 3]; 4],
    /// Origin of the hip in the base frame [m].
    pub hip: [Vec3<T>; 4],
    /// Origin of the thigh in the hip frame [m]; on the y axis.
    pub thigh: [Vec3<T>; 4],
    /// Origin of the calf in the thigh frame [m].
    pub calf: [Vec3<T>; 4],
    /// Rotor inertia reflected to the joint [kg·m²].
    pub armature: [T; 12],
}

impl<T: SimdFloat> KinematicTree<T> {
    /// Returns the tree of `robot` in every lane.
    pub fn splat(robot: &RobotModel) -> Self {
        let legs = &robot.legs;
        Self {
            trunk: Inertia::splat(&robot.trunk),
            bodies: legs.map(|leg| leg.bodies.map(|body| Inertia::splat(&body))),
            hip: legs.map(|leg| Vec3::splat(leg.origins[0])),
            thigh: legs.map(|leg| Vec3::splat(leg.origins[1])),
            calf: legs.map(|leg| Vec3::splat(leg.origins[2])),
            armature: robot.joints.map(|joint| T::splat(joint.armature)),
        }
    }

    /// Sets the robot of one lane.
    pub fn set(&mut self, lane: usize, robot: &RobotModel) {
        self.trunk.set(lane, &robot.trunk);
        for (leg, LegModel { bodies, origins }) in robot.legs.iter().enumerate() {
            for (ours, body) in self.bodies[leg].iter_mut().zip(bodies) {
                ours.set(lane, body);
            }
            self.hip[leg].set(lane, origins[0]);
            self.thigh[leg].set(lane, origins[1]);
            self.calf[leg].set(lane, origins[2]);
        }
        for (armature, joint) in self.armature.iter_mut().zip(&robot.joints) {
            armature.set(lane, joint.armature);
        }
    }
}

/// Poses of the bodies of a leg.
#[derive(Clone, Copy, Debug)]
pub struct LegFrames<T> {
    /// Joint axes in the base frame.
    pub axes: [Vec3<T>; 3],
    /// Joint origins in the base frame [m].
    pub origins: [Vec3<T>; 3],
    /// Vector from the thigh's to the calf's origin, in hip axes [m].
    pub(super) shank: Vec3<T>,
    /// Sine and cosine of the hip's angle, and of the thigh's and the calf's angles relative to the hip.
    pub(super) hip_angle: (T, T),
    thigh_angle: (T, T),
    calf_angle: (T, T),
}

impl<T: SimdFloat> LegFrames<T> {
    /// Returns a placeholder; overwritten before use.
    pub(super) fn empty() -> Self {
        let (zero, origin) = (T::splat(0.0), Vec3::zero());
        let angle = (zero, zero);
        Self {
            axes: [origin; 3],
            origins: [origin; 3],
            shank: origin,
            hip_angle: angle,
            thigh_angle: angle,
            calf_angle: angle,
        }
    }

    /// Computes the poses of leg `leg` for the joint positions `q` [rad] of the whole robot.
    #[inline(always)]
    pub fn new(tree: &KinematicTree<T>, q: &[T; 12], leg: usize) -> Self {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let hip_angle = q[3 * leg].sin_cos();
        let thigh_angle = q[3 * leg + 1].sin_cos();
        let calf_angle = (q[3 * leg + 1] + q[3 * leg + 2]).sin_cos();
        let shank = tree.calf[leg].rotate_y(thigh_angle);
        let pitch = Vec3([zero, hip_angle.1, hip_angle.0]);
        let thigh = tree.hip[leg] + tree.thigh[leg].rotate_x(hip_angle);
        Self {
            axes: [Vec3([one, zero, zero]), pitch, pitch],
            origins: [tree.hip[leg], thigh, thigh + shank.rotate_x(hip_angle)],
            shank,
            hip_angle,
            thigh_angle,
            calf_angle,
        }
    }

    /// Returns the inertias of hip, thigh and calf in hip axes, each about the origin of its joint.
    #[inline(always)]
    pub(super) fn bodies(&self, [hip, thigh, calf]: &[Inertia<T>; 3]) -> [Inertia<T>; 3] {
        [*hip, thigh.turned_y(self.thigh_angle), calf.turned_y(self.calf_angle)]
    }

    /// Returns the position in the base frame of a point given in the calf frame, such as the foot [m].
    #[inline(always)]
    pub fn calf_point(&self, point: Vec3<T>) -> Vec3<T> {
        self.origins[2] + point.rotate_y(self.calf_angle).rotate_x(self.hip_angle)
    }

    /// Returns the position in the base frame of a point given in the frame of hip (0), thigh (1) or calf (2) [m].
    #[inline(always)]
    pub fn point(&self, body: usize, point: Vec3<T>) -> Vec3<T> {
        match body {
            0 => self.origins[0] + point.rotate_x(self.hip_angle),
            1 => self.origins[1] + point.rotate_y(self.thigh_angle).rotate_x(self.hip_angle),
            _ => self.calf_point(point),
        }
    }

    /// Returns the columns of the Jacobian [m/rad], in base axes, of the calf's point at `point` [m, base frame].
    #[inline(always)]
    pub fn calf_jacobian(&self, point: Vec3<T>) -> [Vec3<T>; 3] {
        [
            self.axes[0].cross(point - self.origins[0]),
            self.axes[1].cross(point - self.origins[1]),
            self.axes[2].cross(point - self.origins[2]),
        ]
    }
}

/// Poses of the bodies of all legs.
#[derive(Clone, Copy, Debug)]
pub struct Frames<T> {
    /// Legs, in the order of [`twinstep_model::Leg::ALL`].
    pub legs: [LegFrames<T>; 4],
}

impl<T: SimdFloat> Frames<T> {
    /// Computes the poses for joint positions `q` [rad].
    #[inline(always)]
    pub fn new(tree: &KinematicTree<T>, q: &[T; 12]) -> Self {
        Self {
            legs: [
                LegFrames::new(tree, q, 0),
                LegFrames::new(tree, q, 1),
                LegFrames::new(tree, q, 2),
                LegFrames::new(tree, q, 3),
            ],
        }
    }
}
