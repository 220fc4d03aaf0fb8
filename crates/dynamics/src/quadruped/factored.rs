//! The equations of one time step, factored so that constraint rows are cheap.
//!
//! Unknowns are the velocity changes over one step: of the trunk (angular, then linear of its origin, in base axes) and
//! of each leg's joints. The mass matrix is block-arrowhead: trunk 6 × 6, legs 3 × 3, legs coupled only through the
//! trunk. With L = G Gᵀ (a leg's block), W = G⁻¹ Cᵀ (its coupling) and S = M − Σ Wᵀ W = B Bᵀ, a solution in whitened
//! coordinates (u, g) is `Δq̇ = G⁻ᵀ (g − W Δv)`, `Δv = B⁻ᵀ u`. A constraint row is then nine numbers, y and z, with
//! `J Δ = y·u + z·g`. Two rows are coupled through y·y' and, on the same leg, z·z'.

use glam::DVec3;
use twinstep_model::RobotModel;
use twinstep_simd::SimdFloat;

use super::QuadrupedState;
use super::equations::{Acceleration, LegForces, LegInertia};
use super::kinematics::{KinematicTree, LegFrames};
use crate::{Cholesky, Inertia, JointForces, StepEquations, Vec3, spatial_matrix};

/// Part of one leg in the factored equations.
#[derive(Clone, Copy)]
pub struct FactoredLeg<T> {
    /// Cholesky factor G of the leg's block.
    pub factor: Cholesky<T, 3>,
    /// Coupling W to the trunk, one row per joint.
    pub coupling: [[T; 6]; 3],
    /// Poses of the leg's bodies.
    pub frames: LegFrames<T>,
}

/// Factored equations of one time step.
pub struct FactoredDynamics<T> {
    /// Cholesky factor B of the trunk's Schur complement S.
    pub trunk: Cholesky<T, 6>,
    /// Legs, in the order of [`twinstep_model::Leg::ALL`].
    pub legs: [FactoredLeg<T>; 4],
    /// Whitened change of the trunk's velocity; [`FactoredDynamics::set_up`] writes the unconstrained solution.
    pub u: [T; 6],
    /// Whitened changes of the legs' velocities.
    pub g: [[T; 3]; 4],
}

/// Returns the leg of a body other than the trunk, and whether it is hip (0), thigh (1) or calf (2).
#[inline(always)]
fn leg_and_kind(body: usize) -> (usize, usize) {
    ((body - 1) / 3, (body - 1) % 3)
}

impl<T: SimdFloat> StepEquations<T> for FactoredDynamics<T> {
    type Robot = RobotModel;
    type Parameters = KinematicTree<T>;
    type Joints = [T; 12];
    /// The joints of the whole leg.
    type Branch = [T; 3];

    fn parameters(robot: &RobotModel) -> KinematicTree<T> {
        KinematicTree::splat(robot)
    }

    fn set_robot(parameters: &mut KinematicTree<T>, lane: usize, robot: &RobotModel) {
        parameters.set(lane, robot);
    }

    fn armature(parameters: &mut KinematicTree<T>) -> &mut [T; 12] {
        &mut parameters.armature
    }

    fn visit(parameters: &mut KinematicTree<T>, mut visit: impl FnMut(&mut T)) {
        let KinematicTree { trunk, bodies, hip, thigh, calf, armature } = parameters;
        for body in std::iter::once(trunk).chain(bodies.iter_mut().flatten()) {
            visit(&mut body.mass);
            body.moment.0.iter_mut().chain(&mut body.about_origin).for_each(&mut visit);
        }
        let origins = hip.iter_mut().chain(thigh).chain(calf);
        origins.flat_map(|origin| &mut origin.0).chain(armature).for_each(&mut visit);
    }

    fn point_of_body(_: &RobotModel, _: usize, point: DVec3) -> DVec3 {
        point
    }

    fn empty(_: &KinematicTree<T>) -> Self {
        let zero = T::splat(0.0);
        let leg = FactoredLeg { factor: Cholesky::empty(), coupling: [[zero; 6]; 3], frames: LegFrames::empty() };
        Self { trunk: Cholesky::empty(), legs: [leg; 4], u: [zero; 6], g: [[zero; 3]; 4] }
    }

    #[inline(always)]
    fn set_up(
        &mut self,
        tree: &Self::Parameters,
        state: &QuadrupedState<T>,
        load: &JointForces<[T; 12]>,
        dt: T,
        gravity: T,
        is_floating: T,
    ) {
        let proper_acceleration = state.world_axes()[2].scaled(gravity);
        let (mut force, mut moment) = tree.trunk.wrench(state.angular_velocity, Vec3::zero(), proper_acceleration);
        let mut whole = tree.trunk;
        // Schur complement: terms that elimination of the legs subtracts from the trunk's block and right-hand side.
        let (mut less, mut rhs) = ([[T::splat(0.0); 6]; 6], [T::splat(0.0); 6]);
        for leg in 0..4 {
            let (composite, forces) = self.set_up_leg(tree, state, load, leg, dt, proper_acceleration);
            whole = whole.combined(&composite);
            force = force + forces.force;
            moment = moment + forces.moment;
            for (row, g) in self.legs[leg].coupling.iter().zip(self.g[leg]) {
                for i in 0..6 {
                    rhs[i] -= row[i] * g;
                    for j in 0..=i {
                        less[i][j] += row[i] * row[j];
                    }
                }
            }
        }
        let mut block = spatial_matrix(&whole);
        for i in 0..6 {
            for j in 0..=i {
                block[i][j] -= less[i][j];
            }
        }
        for i in 0..3 {
            rhs[i] -= moment.0[i] * dt;
            rhs[i + 3] -= force.0[i] * dt;
        }
        self.trunk = Cholesky::new(block);
        self.u = self.trunk.forward(rhs);
        // The velocity of a fixed base does not change.
        for value in &mut self.u {
            *value = *value * is_floating;
        }
    }

    #[inline(always)]
    fn solution(&self, joints: &mut [T; 12]) -> [T; 6] {
        let trunk = self.trunk.backward(self.u);
        for (leg, (part, g)) in self.legs.iter().zip(&self.g).enumerate() {
            let mut rest = *g;
            for (value, row) in rest.iter_mut().zip(&part.coupling) {
                for i in 0..6 {
                    *value -= row[i] * trunk[i];
                }
            }
            joints[3 * leg..3 * leg + 3].copy_from_slice(&part.factor.backward(rest));
        }
        trunk
    }

    #[inline(always)]
    fn point(&self, body: usize, point: Vec3<T>) -> Vec3<T> {
        if body == 0 {
            return point;
        }
        let (leg, kind) = leg_and_kind(body);
        self.legs[leg].frames.point(kind, point)
    }

    #[inline(always)]
    fn branch_len(&self, body: usize) -> usize {
        if body == 0 { 0 } else { 3 }
    }

    fn zero_branch(&self, _: usize) -> [T; 3] {
        [T::splat(0.0); 3]
    }

    #[inline(always)]
    fn branch_joint(&self, body: usize, index: usize) -> usize {
        3 * leg_and_kind(body).0 + index
    }

    #[inline(always)]
    fn row_of_joint(&self, joint: usize) -> (usize, usize) {
        (joint / 3 * 3 + 3, joint % 3)
    }

    #[inline(always)]
    fn write_jacobian(&self, body: usize, place: Vec3<T>, direction: Vec3<T>, branch: &mut [T; 3]) {
        *branch = [T::splat(0.0); 3];
        if body > 0 {
            let (leg, kind) = leg_and_kind(body);
            let columns = self.legs[leg].frames.calf_jacobian(place);
            for index in 0..=kind {
                branch[index] = columns[index].dot(direction);
            }
        }
    }

    #[inline(always)]
    fn whiten(&self, body: usize, mut base: [T; 6], branch: &mut [T; 3]) -> [T; 6] {
        if body > 0 {
            let part = &self.legs[leg_and_kind(body).0];
            *branch = part.factor.forward(*branch);
            for (coupling, z) in part.coupling.iter().zip(branch) {
                for (entry, w) in base.iter_mut().zip(coupling) {
                    *entry -= *w * *z;
                }
            }
        }
        self.trunk.forward(base)
    }

    /// The products are summed in pairs, because the latency of the sum limits a sweep of the solver. A chain of additions takes twice as
    /// long.
    #[inline(always)]
    fn velocity_change(&self, body: usize, y: &[T; 6], z: &[T; 3]) -> T {
        let u = &self.u;
        let trunk = (y[0] * u[0] + y[1] * u[1]) + (y[2] * u[2] + y[3] * u[3]) + (y[4] * u[4] + y[5] * u[5]);
        if body == 0 {
            return trunk;
        }
        let g = &self.g[leg_and_kind(body).0];
        trunk + ((z[0] * g[0] + z[1] * g[1]) + z[2] * g[2])
    }

    #[inline(always)]
    fn velocity_changes(&self, body: usize, y: [&[T; 6]; 3], z: [&[T; 3]; 3]) -> [T; 3] {
        [
            self.velocity_change(body, y[0], z[0]),
            self.velocity_change(body, y[1], z[1]),
            self.velocity_change(body, y[2], z[2]),
        ]
    }

    #[inline(always)]
    fn add_impulse(&mut self, body: usize, y: &[T; 6], z: &[T; 3], impulse: T) {
        for (u, y) in self.u.iter_mut().zip(y) {
            *u += *y * impulse;
        }
        if body > 0 {
            for (g, z) in self.g[leg_and_kind(body).0].iter_mut().zip(z) {
                *g += *z * impulse;
            }
        }
    }

    #[inline(always)]
    fn add_impulses(&mut self, body: usize, y: [&[T; 6]; 3], z: [&[T; 3]; 3], impulses: [T; 3]) {
        for i in 0..6 {
            self.u[i] += (y[0][i] * impulses[0] + y[1][i] * impulses[1]) + y[2][i] * impulses[2];
        }
        if body > 0 {
            let g = &mut self.g[leg_and_kind(body).0];
            for i in 0..3 {
                g[i] += (z[0][i] * impulses[0] + z[1][i] * impulses[1]) + z[2][i] * impulses[2];
            }
        }
    }
}

impl<T: SimdFloat> FactoredDynamics<T> {
    /// Sets up the equations of one leg. Returns its composite inertia and bias forces on the trunk.
    #[inline(always)]
    fn set_up_leg(
        &mut self,
        tree: &KinematicTree<T>,
        state: &QuadrupedState<T>,
        load: &JointForces<[T; 12]>,
        leg: usize,
        dt: T,
        proper_acceleration: Vec3<T>,
    ) -> (Inertia<T>, LegForces<T>) {
        let frames = LegFrames::new(tree, &state.q, leg);
        let bodies = frames.bodies(&tree.bodies[leg]);
        let bias = LegForces::new(tree, state, &frames, &bodies, leg, proper_acceleration, None);
        let LegInertia { mut block, columns, composite } = LegInertia::new(tree, &frames, &bodies, leg);
        let mut rhs = [T::splat(0.0); 3];
        for i in 0..3 {
            let joint = 3 * leg + i;
            let damping = load.damping[joint];
            block[i][i] += dt * damping;
            rhs[i] = (load.tau[joint] - bias.tau[i] - damping * state.dq[joint]) * dt;
        }
        let factor = Cholesky::new(block);
        self.g[leg] = factor.forward(rhs);
        // W = G⁻¹ Cᵀ, by the trunk's six columns.
        let coupling = &mut self.legs[leg].coupling;
        for i in 0..3 {
            let moments = factor.forward([columns[0].1.0[i], columns[1].1.0[i], columns[2].1.0[i]]);
            let forces = factor.forward([columns[0].0.0[i], columns[1].0.0[i], columns[2].0.0[i]]);
            for joint in 0..3 {
                (coupling[joint][i], coupling[joint][i + 3]) = (moments[joint], forces[joint]);
            }
        }
        self.legs[leg].factor = factor;
        self.legs[leg].frames = frames;
        (composite, bias)
    }
}

/// Computes forward dynamics: accelerations for joint torques `tau` [N·m] without contact.
#[inline(always)]
pub fn forward_dynamics<T: SimdFloat>(
    tree: &KinematicTree<T>,
    state: &QuadrupedState<T>,
    tau: &[T; 12],
    gravity: T,
) -> Acceleration<T> {
    let (one, zero) = (T::splat(1.0), T::splat(0.0));
    let mut factored = FactoredDynamics::empty(tree);
    factored.set_up(tree, state, &JointForces::frictionless(*tau), one, gravity, one);
    let mut ddq = [zero; 12];
    let [ax, ay, az, lx, ly, lz] = factored.solution(&mut ddq);
    Acceleration { angular: Vec3([ax, ay, az]), linear: Vec3([lx, ly, lz]), ddq }
}
