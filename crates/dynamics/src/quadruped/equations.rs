//! Equations of motion `M a + bias = τ` of the kinematic tree, computed leg by leg.
//!
//! Recursive Newton–Euler algorithm for forces, composite-rigid-body algorithm for the mass matrix (Featherstone,
//! "Rigid Body Dynamics Algorithms", 2008, chapters 5 and 6).

use twinstep_simd::SimdFloat;

use super::QuadrupedState;
use super::kinematics::{KinematicTree, LegFrames};
use crate::{Inertia, Vec3, spatial_matrix};

/// Accelerations of base and joints.
#[derive(Clone, Copy, Debug)]
pub struct Acceleration<T> {
    /// Angular acceleration of the base, in base axes [rad/s²].
    pub angular: Vec3<T>,
    /// Acceleration of the base's origin, in base axes, without gravity [m/s²]: the derivative of its world velocity.
    pub linear: Vec3<T>,
    /// Joint accelerations [rad/s²].
    pub ddq: [T; 12],
}

/// Force and moment at the base's origin in base axes.
#[derive(Clone, Copy, Debug)]
pub struct Wrench<T> {
    /// Force [N].
    pub force: Vec3<T>,
    /// Moment [N·m].
    pub moment: Vec3<T>,
}

/// Computes inverse dynamics: the wrench on the base and the joint torques [N·m] for an acceleration.
///
/// `gravity` [m/s²] acts along −z of the world frame. The result is linear in the ten inertial parameters of each body.
#[inline(always)]
pub fn inverse_dynamics<T: SimdFloat>(
    tree: &KinematicTree<T>,
    state: &QuadrupedState<T>,
    acceleration: &Acceleration<T>,
    gravity: T,
) -> (Wrench<T>, [T; 12]) {
    let proper_acceleration = state.world_axes()[2].scaled(gravity) + acceleration.linear;
    let (mut force, mut moment) = tree.trunk.wrench(state.angular_velocity, acceleration.angular, proper_acceleration);
    let mut tau = [T::splat(0.0); 12];
    for leg in 0..4 {
        let frames = LegFrames::new(tree, &state.q, leg);
        let bodies = frames.bodies(&tree.bodies[leg]);
        let forces = LegForces::new(tree, state, &frames, &bodies, leg, proper_acceleration, Some(acceleration));
        force = force + forces.force;
        moment = moment + forces.moment;
        for joint in 0..3 {
            let index = 3 * leg + joint;
            tau[index] = forces.tau[joint] + tree.armature[index] * acceleration.ddq[index];
        }
    }
    (Wrench { force, moment }, tau)
}

/// Returns the symmetric mass matrix, in the order angular and linear base velocity in base axes, joint velocities.
#[inline(always)]
pub fn mass_matrix<T: SimdFloat>(tree: &KinematicTree<T>, q: &[T; 12]) -> [[T; 18]; 18] {
    let mut matrix = [[T::splat(0.0); 18]; 18];
    let mut whole = tree.trunk;
    for leg in 0..4 {
        let frames = LegFrames::new(tree, q, leg);
        let inertia = LegInertia::new(tree, &frames, &frames.bodies(&tree.bodies[leg]), leg);
        whole = whole.combined(&inertia.composite);
        for i in 0..3 {
            let row = 6 + 3 * leg + i;
            for j in 0..=i {
                matrix[row][6 + 3 * leg + j] = inertia.block[i][j];
            }
            for k in 0..3 {
                matrix[row][k] = inertia.columns[i].1.0[k];
                matrix[row][3 + k] = inertia.columns[i].0.0[k];
            }
        }
    }
    let base = spatial_matrix(&whole);
    for i in 0..6 {
        matrix[i][..=i].copy_from_slice(&base[i][..=i]);
    }
    for i in 0..18 {
        for j in i + 1..18 {
            matrix[i][j] = matrix[j][i];
        }
    }
    matrix
}

/// Inverse dynamics of one leg: joint torques, and the leg's wrench on the base.
pub(super) struct LegForces<T> {
    /// Joint torques without rotor inertia [N·m].
    pub tau: [T; 3],
    /// Force in base axes [N].
    pub force: Vec3<T>,
    /// Moment about the base's origin in base axes [N·m].
    pub moment: Vec3<T>,
}

impl<T: SimdFloat> LegForces<T> {
    /// Computes the inverse dynamics of one leg.
    ///
    /// `proper_acceleration` is that of the base's origin: its acceleration minus gravity [m/s²]. `acceleration` is
    /// zero if `None`; the result is then the bias.
    #[inline(always)]
    pub fn new(
        tree: &KinematicTree<T>,
        state: &QuadrupedState<T>,
        frames: &LegFrames<T>,
        bodies: &[Inertia<T>; 3],
        leg: usize,
        proper_acceleration: Vec3<T>,
        acceleration: Option<&Acceleration<T>>,
    ) -> Self {
        let zero = T::splat(0.0);
        let joint = 3 * leg;
        let LegFrames { hip_angle, shank, .. } = *frames;
        let (hip, thigh) = (tree.hip[leg], tree.thigh[leg]);
        let omega = state.angular_velocity;
        let turning = omega.rotate_x_inverse(hip_angle);
        let spin = Vec3([state.dq[joint], zero, zero]);
        let pitch1 = Vec3([zero, state.dq[joint + 1], zero]);
        let pitch2 = Vec3([zero, state.dq[joint + 2], zero]);

        let (omega1, mut alpha1) = (turning + spin, turning.cross(spin));
        let mut proper_acceleration1 = proper_acceleration + omega.cross(omega.cross(hip));
        if let Some(Acceleration { angular, ddq, .. }) = acceleration {
            proper_acceleration1 = proper_acceleration1 + angular.cross(hip);
            alpha1 = alpha1 + angular.rotate_x_inverse(hip_angle) + Vec3([ddq[joint], zero, zero]);
        }
        let acceleration1 = proper_acceleration1.rotate_x_inverse(hip_angle);
        let (omega2, mut alpha2) = (omega1 + pitch1, alpha1 + omega1.cross(pitch1));
        if let Some(Acceleration { ddq, .. }) = acceleration {
            alpha2 = alpha2 + Vec3([zero, ddq[joint + 1], zero]);
        }
        let acceleration2 = acceleration1 + alpha1.cross(thigh) + omega1.cross(omega1.cross(thigh));
        let (omega3, mut alpha3) = (omega2 + pitch2, alpha2 + omega2.cross(pitch2));
        if let Some(Acceleration { ddq, .. }) = acceleration {
            alpha3 = alpha3 + Vec3([zero, ddq[joint + 2], zero]);
        }
        let acceleration3 = acceleration2 + alpha2.cross(shank) + omega2.cross(omega2.cross(shank));

        let [body1, body2, body3] = bodies;
        let (force3, moment3) = body3.wrench(omega3, alpha3, acceleration3);
        let (mut force2, mut moment2) = body2.wrench(omega2, alpha2, acceleration2);
        force2 = force2 + force3;
        moment2 = moment2 + moment3 + shank.cross(force3);
        let (mut force1, mut moment1) = body1.wrench(omega1, alpha1, acceleration1);
        force1 = force1 + force2;
        moment1 = moment1 + moment2 + thigh.cross(force2);
        let (force, moment) = to_base(force1, moment1, hip, hip_angle);
        Self { tau: [moment1.0[0], moment2.0[1], moment3.0[1]], force, moment }
    }
}

/// Part of the mass matrix of one leg.
pub(super) struct LegInertia<T> {
    /// Lower triangle of the block of its joints, with rotor inertia.
    pub block: [[T; 3]; 3],
    /// Force and moment on the base for a unit acceleration of each joint.
    pub columns: [(Vec3<T>, Vec3<T>); 3],
    /// Composite inertia of the leg in the base frame.
    pub composite: Inertia<T>,
}

impl<T: SimdFloat> LegInertia<T> {
    #[inline(always)]
    pub fn new(tree: &KinematicTree<T>, frames: &LegFrames<T>, bodies: &[Inertia<T>; 3], leg: usize) -> Self {
        let (zero, one) = (T::splat(0.0), T::splat(1.0));
        let LegFrames { hip_angle, shank, .. } = *frames;
        let (hip, thigh) = (tree.hip[leg], tree.thigh[leg]);
        let [body1, body2, body3] = bodies;
        let composite2 = body2.combined(&body3.shifted(shank));
        let composite1 = body1.combined(&composite2.shifted(thigh));
        let (ex, ey) = (Vec3([one, zero, zero]), Vec3([zero, one, zero]));
        let (push2, twist2) = (ey.cross(body3.moment), body3.times(ey));
        let twist2_thigh = twist2 + shank.cross(push2);
        let twist2_hip = twist2_thigh + thigh.cross(push2);
        let (push1, twist1) = (ey.cross(composite2.moment), composite2.times(ey));
        let twist1_hip = twist1 + thigh.cross(push1);
        let (push0, twist0) = (ex.cross(composite1.moment), composite1.times(ex));
        let [rotor0, rotor1, rotor2] = [tree.armature[3 * leg], tree.armature[3 * leg + 1], tree.armature[3 * leg + 2]];
        Self {
            block: [
                [twist0.0[0] + rotor0, zero, zero],
                [twist1_hip.0[0], twist1.0[1] + rotor1, zero],
                [twist2_hip.0[0], twist2_thigh.0[1], twist2.0[1] + rotor2],
            ],
            columns: [
                to_base(push0, twist0, hip, hip_angle),
                to_base(push1, twist1_hip, hip, hip_angle),
                to_base(push2, twist2_hip, hip, hip_angle),
            ],
            composite: composite1.turned_x(hip_angle).shifted(hip),
        }
    }
}

/// Transforms force and moment at the hip's origin in hip axes to the base's origin and base axes.
#[inline(always)]
fn to_base<T: SimdFloat>(force: Vec3<T>, moment: Vec3<T>, hip: Vec3<T>, hip_angle: (T, T)) -> (Vec3<T>, Vec3<T>) {
    let force = force.rotate_x(hip_angle);
    (force, moment.rotate_x(hip_angle) + hip.cross(force))
}
