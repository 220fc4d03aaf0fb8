//! The Go2's tree: the numbers of its bodies, its state, and where everything is.

use super::lane::SimdFloat;
use super::spatial::{Inertia, Vec3};
use crate::{LegModel, RobotModel};

/// Bodies, geometry and joints of the robots.
///
/// Hips turn about x; thighs and calves about y. A thigh's origin lies on its hip's y axis.
#[derive(Clone, Debug)]
pub struct KinematicTree<T> {
    /// About the base frame's origin.
    pub trunk: Inertia<T>,
    /// By leg and joint, each about its joint's origin.
    pub bodies: [[Inertia<T>; 3]; 4],
    /// Hip's origin in the base frame [m].
    pub hip: [Vec3<T>; 4],
    /// Thigh's origin in the hip frame [m]; on the y axis.
    pub thigh: [Vec3<T>; 4],
    /// Calf's origin in the thigh frame [m].
    pub calf: [Vec3<T>; 4],
    /// Rotor inertia at the joint [kg·m²].
    pub armature: [T; 12],
}

impl<T: SimdFloat> KinematicTree<T> {
    /// Of a robot, the same in every lane.
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

    /// Puts a robot into one lane.
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

/// What moves.
#[derive(Clone, Copy, Debug)]
pub struct State<T> {
    /// Base origin in the world [m].
    pub position: Vec3<T>,
    /// World-from-base, w x y z.
    pub orientation: [T; 4],
    /// Velocity of the base origin in the world frame [m/s].
    pub linear_velocity: Vec3<T>,
    /// Angular velocity in the base frame [rad/s].
    pub angular_velocity: Vec3<T>,
    /// Joint positions [rad].
    pub q: [T; 12],
    /// Joint velocities [rad/s].
    pub dq: [T; 12],
}

impl<T: SimdFloat> State<T> {
    /// At the world's origin, upright and at rest, with all joints at 0.
    pub fn origin() -> Self {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        Self {
            position: Vec3::zero(),
            orientation: [one, zero, zero, zero],
            linear_velocity: Vec3::zero(),
            angular_velocity: Vec3::zero(),
            q: [zero; 12],
            dq: [zero; 12],
        }
    }

    /// The world's axes in base coordinates.
    #[inline(always)]
    pub fn world_axes(&self) -> [Vec3<T>; 3] {
        let [w, x, y, z] = self.orientation;
        let (one, two) = (T::splat(1.0), T::splat(2.0));
        [
            Vec3([one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)]),
            Vec3([two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)]),
            Vec3([two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)]),
        ]
    }
}

/// Where the bodies of a leg are.
#[derive(Clone, Copy, Debug)]
pub struct LegFrames<T> {
    /// Joint axes in the base frame.
    pub axes: [Vec3<T>; 3],
    /// Joint origins in the base frame [m].
    pub origins: [Vec3<T>; 3],
    /// Calf's origin from the thigh's, in hip axes [m].
    pub(super) shank: Vec3<T>,
    /// Sine and cosine of the hip's angle, and of the thigh's and the calf's in the hip's plane.
    pub(super) hip_angle: (T, T),
    thigh_angle: (T, T),
    calf_angle: (T, T),
}

impl<T: SimdFloat> LegFrames<T> {
    /// Of nothing, to be replaced.
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

    /// Of leg `leg` with all the robot's joints at `q` [rad].
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

    /// Hip, thigh and calf in hip axes, each about its joint's origin.
    #[inline(always)]
    pub(super) fn bodies(&self, [hip, thigh, calf]: &[Inertia<T>; 3]) -> [Inertia<T>; 3] {
        [*hip, thigh.turned_y(self.thigh_angle), calf.turned_y(self.calf_angle)]
    }

    /// A point of the calf, such as the foot, given in its frame, in the base frame [m].
    #[inline(always)]
    pub fn calf_point(&self, point: Vec3<T>) -> Vec3<T> {
        self.origins[2] + point.rotate_y(self.calf_angle).rotate_x(self.hip_angle)
    }

    /// Velocity in base axes that each joint's unit speed gives the point at `place` (base frame) of the calf: the
    /// columns of its Jacobian [m/rad].
    #[inline(always)]
    pub fn calf_jacobian(&self, place: Vec3<T>) -> [Vec3<T>; 3] {
        [
            self.axes[0].cross(place - self.origins[0]),
            self.axes[1].cross(place - self.origins[1]),
            self.axes[2].cross(place - self.origins[2]),
        ]
    }
}

/// Where the bodies of all legs are.
#[derive(Clone, Copy, Debug)]
pub struct Frames<T> {
    /// In the order of [`crate::Leg::ALL`].
    pub legs: [LegFrames<T>; 4],
}

impl<T: SimdFloat> Frames<T> {
    /// With the joints at `q` [rad].
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
