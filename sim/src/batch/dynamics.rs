//! Equations of motion of a trunk with four legs of three joints, factored so that constraint rows are cheap.
//!
//! Unknowns are the changes of velocity over one step: of the trunk (angular, then linear of its origin, in base axes)
//! and of each leg's joints. The mass matrix is an arrow: trunk 6 × 6, legs 3 × 3, legs coupled through the trunk
//! alone. With L = G Gᵀ (a leg's block), W = G⁻¹ Cᵀ (its coupling) and S = M − Σ Wᵀ W = B Bᵀ, a solution in whitened
//! coordinates (u, g) is `Δq̇ = G⁻ᵀ (g − W Δv)`, `Δv = B⁻ᵀ u`. A constraint row is then nine numbers, y and z, with
//! `J Δ = y·u + z·g`, and rows meet through y·y' and, on the same leg, z·z'.

use super::lane::Lane;
use super::spatial::{Cholesky, Inertia, Vec3};

/// Numbers of the robots that do not change during a step.
#[derive(Clone, Debug)]
pub struct Parameters<T> {
    /// About the base frame's origin.
    pub trunk: Inertia<T>,
    /// By leg and joint, each about its joint's origin.
    pub bodies: [[Inertia<T>; 3]; 4],
    /// Hip's origin in the base frame [m].
    pub hip: [Vec3<T>; 4],
    /// Thigh's origin in the hip frame [m].
    pub thigh: [Vec3<T>; 4],
    /// Calf's origin in the thigh frame [m].
    pub calf: [Vec3<T>; 4],
    /// Rotor inertia at the joint [kg·m²].
    pub armature: [T; 12],
    /// Coefficient of friction at the ground.
    pub friction: T,
    /// 1 where the trunk moves, 0 where it is held.
    pub moving: T,
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

impl<T: Lane> State<T> {
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

/// A leg's part of the factored equations.
#[derive(Clone, Copy)]
pub struct Leg<T> {
    /// Factor G of the leg's block.
    pub factor: Cholesky<T, 3>,
    /// W, by joint.
    pub coupling: [[T; 6]; 3],
    /// Joint axes in the base frame.
    pub axes: [Vec3<T>; 3],
    /// Joint origins in the base frame [m].
    pub origins: [Vec3<T>; 3],
    hip_angle: (T, T),
    calf_angle: (T, T),
}

impl<T: Lane> Leg<T> {
    /// A point of the calf in the base frame.
    #[inline(always)]
    pub fn calf_point(&self, point: Vec3<T>) -> Vec3<T> {
        self.origins[2] + point.turned_y(self.calf_angle).turned_x(self.hip_angle)
    }
}

/// The factored equations of one step.
pub struct Factored<T> {
    /// Factor B of the trunk's block.
    pub trunk: Cholesky<T, 6>,
    /// The legs.
    pub legs: [Leg<T>; 4],
    /// Whitened change of the trunk's velocity, without constraints at first.
    pub u: [T; 6],
    /// Whitened changes of the legs' velocities.
    pub g: [[T; 3]; 4],
}

/// One leg before the trunk is solved: its equations, and what it adds to the trunk's.
struct LegTerms<T> {
    leg: Leg<T>,
    composite: Inertia<T>,
    force: Vec3<T>,
    moment: Vec3<T>,
    g: [T; 3],
}

impl<T: Lane> Factored<T> {
    /// Sets up the step `dt` [s] under the joint torques `tau` [N·m] and gravity `gravity` [m/s²].
    #[inline(always)]
    pub fn new(parameters: &Parameters<T>, state: &State<T>, tau: &[T; 12], dt: T, gravity: T) -> Self {
        let up = state.world_axes()[2];
        let rising = up.scaled(gravity);
        let terms = [
            leg_terms(parameters, state, tau, 0, dt, rising),
            leg_terms(parameters, state, tau, 1, dt, rising),
            leg_terms(parameters, state, tau, 2, dt, rising),
            leg_terms(parameters, state, tau, 3, dt, rising),
        ];
        let omega = state.angular_velocity;
        let (mut force, mut moment) = parameters.trunk.wrench(omega, Vec3::zero(), rising);
        let mut whole = parameters.trunk;
        for term in &terms {
            whole = whole.joined(&term.composite);
            force = force + term.force;
            moment = moment + term.moment;
        }
        let mut block = spatial_matrix(&whole);
        let mut rhs = [T::splat(0.0); 6];
        for i in 0..3 {
            (rhs[i], rhs[i + 3]) = (-(moment.0[i] * dt), -(force.0[i] * dt));
        }
        for term in &terms {
            for (row, g) in term.leg.coupling.iter().zip(term.g) {
                for i in 0..6 {
                    rhs[i] -= row[i] * g;
                    for j in 0..=i {
                        block[i][j] -= row[i] * row[j];
                    }
                }
            }
        }
        let trunk = Cholesky::new(block);
        // A held trunk takes no part: nothing that acts on it changes its velocity.
        let mut u = trunk.forward(rhs);
        for value in &mut u {
            *value = *value * parameters.moving;
        }
        let legs = [terms[0].leg, terms[1].leg, terms[2].leg, terms[3].leg];
        Self { trunk, u, g: [terms[0].g, terms[1].g, terms[2].g, terms[3].g], legs }
    }

    /// Changes of the trunk's velocity (angular, linear; base axes) and of the joints'.
    #[inline(always)]
    pub fn solution(&self) -> ([T; 6], [T; 12]) {
        let trunk = self.trunk.backward(self.u);
        let mut joints = [T::splat(0.0); 12];
        for (leg, (part, g)) in self.legs.iter().zip(&self.g).enumerate() {
            let mut rest = *g;
            for (value, row) in rest.iter_mut().zip(&part.coupling) {
                for i in 0..6 {
                    *value -= row[i] * trunk[i];
                }
            }
            joints[3 * leg..3 * leg + 3].copy_from_slice(&part.factor.backward(rest));
        }
        (trunk, joints)
    }
}

/// Kinematics, bias (recursive Newton-Euler) and inertia (composite bodies) of one leg, in the axes of its hip.
#[inline(always)]
fn leg_terms<T: Lane>(
    parameters: &Parameters<T>,
    state: &State<T>,
    tau: &[T; 12],
    leg: usize,
    dt: T,
    rising: Vec3<T>,
) -> LegTerms<T> {
    let zero = T::splat(0.0);
    let joint = 3 * leg;
    let [dq0, dq1, dq2] = [state.dq[joint], state.dq[joint + 1], state.dq[joint + 2]];
    let hip_angle = state.q[joint].sin_cos();
    let thigh_angle = state.q[joint + 1].sin_cos();
    let calf_angle = (state.q[joint + 1] + state.q[joint + 2]).sin_cos();
    let hip = parameters.hip[leg];
    let thigh = parameters.thigh[leg];
    let shank = parameters.calf[leg].turned_y(thigh_angle);

    // Velocities and the accelerations that would be without any acceleration of the unknowns.
    let omega = state.angular_velocity;
    let turning = omega.turned_back_x(hip_angle);
    let spin = Vec3([dq0, zero, zero]);
    let (pitch1, pitch2) = (Vec3([zero, dq1, zero]), Vec3([zero, dq2, zero]));
    let (omega1, alpha1) = (turning + spin, turning.cross(spin));
    let acceleration1 = (rising + omega.cross(omega.cross(hip))).turned_back_x(hip_angle);
    let (omega2, alpha2) = (omega1 + pitch1, alpha1 + omega1.cross(pitch1));
    let acceleration2 = acceleration1 + alpha1.cross(thigh) + omega1.cross(omega1.cross(thigh));
    let (omega3, alpha3) = (omega2 + pitch2, alpha2 + omega2.cross(pitch2));
    let acceleration3 = acceleration2 + alpha2.cross(shank) + omega2.cross(omega2.cross(shank));

    let [body1, body2, body3] = &parameters.bodies[leg];
    let (body2, body3) = (body2.turned_y(thigh_angle), body3.turned_y(calf_angle));
    let (force3, moment3) = body3.wrench(omega3, alpha3, acceleration3);
    let (mut force2, mut moment2) = body2.wrench(omega2, alpha2, acceleration2);
    force2 = force2 + force3;
    moment2 = moment2 + moment3 + shank.cross(force3);
    let (mut force1, mut moment1) = body1.wrench(omega1, alpha1, acceleration1);
    force1 = force1 + force2;
    moment1 = moment1 + moment2 + thigh.cross(force2);

    // Composite bodies, and the wrench that each joint's unit acceleration needs.
    let composite2 = body2.joined(&body3.shifted(shank));
    let composite1 = body1.joined(&composite2.shifted(thigh));
    let (ex, ey) = (Vec3([T::splat(1.0), zero, zero]), Vec3([zero, T::splat(1.0), zero]));
    let (push2, twist2) = (ey.cross(body3.moment), body3.times(ey));
    let twist2_thigh = twist2 + shank.cross(push2);
    let twist2_hip = twist2_thigh + thigh.cross(push2);
    let (push1, twist1) = (ey.cross(composite2.moment), composite2.times(ey));
    let twist1_hip = twist1 + thigh.cross(push1);
    let (push0, twist0) = (ex.cross(composite1.moment), composite1.times(ex));
    let armature = &parameters.armature;
    let block = [
        [twist0.0[0] + armature[joint], zero, zero],
        [twist1_hip.0[0], twist1.0[1] + armature[joint + 1], zero],
        [twist2_hip.0[0], twist2_thigh.0[1], twist2.0[1] + armature[joint + 2]],
    ];
    let factor = Cholesky::new(block);
    let bias = [moment1.0[0], moment2.0[1], moment3.0[1]];
    let mut wanted = [zero; 3];
    for i in 0..3 {
        wanted[i] = (tau[joint + i] - bias[i]) * dt;
    }
    let g = factor.forward(wanted);

    // To the base: W = G⁻¹ Cᵀ, column by column of the trunk's six.
    let columns = [
        to_base(push0, twist0, hip, hip_angle),
        to_base(push1, twist1_hip, hip, hip_angle),
        to_base(push2, twist2_hip, hip, hip_angle),
    ];
    let mut coupling = [[zero; 6]; 3];
    for i in 0..3 {
        let moments = factor.forward([columns[0].1.0[i], columns[1].1.0[i], columns[2].1.0[i]]);
        let forces = factor.forward([columns[0].0.0[i], columns[1].0.0[i], columns[2].0.0[i]]);
        for joint in 0..3 {
            (coupling[joint][i], coupling[joint][i + 3]) = (moments[joint], forces[joint]);
        }
    }
    let (force, moment) = to_base(force1, moment1, hip, hip_angle);
    let thigh_base = thigh.turned_x(hip_angle);
    let pitch = Vec3([zero, hip_angle.1, hip_angle.0]);
    LegTerms {
        leg: Leg {
            factor,
            coupling,
            axes: [ex, pitch, pitch],
            origins: [hip, hip + thigh_base, hip + thigh_base + shank.turned_x(hip_angle)],
            hip_angle,
            calf_angle,
        },
        composite: composite1.turned_x(hip_angle).shifted(hip),
        force,
        moment,
        g,
    }
}

/// Force and moment at the hip's origin in hip axes, as force and moment at the base's origin in base axes.
#[inline(always)]
fn to_base<T: Lane>(force: Vec3<T>, moment: Vec3<T>, hip: Vec3<T>, hip_angle: (T, T)) -> (Vec3<T>, Vec3<T>) {
    let force = force.turned_x(hip_angle);
    (force, moment.turned_x(hip_angle) + hip.cross(force))
}

/// Lower triangle of a body's 6 × 6 matrix: angular, then linear.
#[inline(always)]
fn spatial_matrix<T: Lane>(body: &Inertia<T>) -> [[T; 6]; 6] {
    let zero = T::splat(0.0);
    let [xx, yy, zz, xy, xz, yz] = body.about_origin;
    let ([hx, hy, hz], m) = (body.moment.0, body.mass);
    [
        [xx, zero, zero, zero, zero, zero],
        [xy, yy, zero, zero, zero, zero],
        [xz, yz, zz, zero, zero, zero],
        // Force of an angular acceleration: alpha × h.
        [zero, hz, -hy, m, zero, zero],
        [-hz, zero, hx, zero, m, zero],
        [hy, -hx, zero, zero, zero, m],
    ]
}
