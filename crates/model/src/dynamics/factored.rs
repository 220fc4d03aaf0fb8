//! The equations of one time step, factored so that constraint rows are cheap.
//!
//! Unknowns are the velocity changes over one step: of the trunk (angular, then linear of its origin, in base axes) and
//! of each leg's joints. The mass matrix is block-arrowhead: trunk 6 × 6, legs 3 × 3, legs coupled only through the
//! trunk. With L = G Gᵀ (a leg's block), W = G⁻¹ Cᵀ (its coupling) and S = M − Σ Wᵀ W = B Bᵀ, a solution in whitened
//! coordinates (u, g) is `Δq̇ = G⁻ᵀ (g − W Δv)`, `Δv = B⁻ᵀ u`. A constraint row is then nine numbers, y and z, with
//! `J Δ = y·u + z·g`. Two rows are coupled through y·y' and, on the same leg, z·z'.

use super::equations::{Acceleration, LegForces, LegInertia, spatial_matrix};
use super::spatial::{Cholesky, Inertia, Vec3};
use super::tree::{KinematicTree, LegFrames, State};
use twinstep_simd::SimdFloat;

/// Torque and viscous friction at the joints.
#[derive(Clone, Copy, Debug)]
pub struct JointLoad<T> {
    /// Torque [N·m].
    pub tau: [T; 12],
    /// Coefficient of viscous friction [N·m·s/rad]. It is integrated implicitly, so any value is stable.
    pub damping: [T; 12],
}

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
    /// Legs, in the order of [`crate::Leg::ALL`].
    pub legs: [FactoredLeg<T>; 4],
    /// Whitened change of the trunk's velocity; [`FactoredDynamics::set_up`] writes the unconstrained solution.
    pub u: [T; 6],
    /// Whitened changes of the legs' velocities.
    pub g: [[T; 3]; 4],
}

impl<T: SimdFloat> FactoredDynamics<T> {
    /// Returns a placeholder for [`FactoredDynamics::set_up`]. Reuse it in every step, because it is large.
    pub fn empty() -> Self {
        let zero = T::splat(0.0);
        let leg = FactoredLeg { factor: Cholesky::empty(), coupling: [[zero; 6]; 3], frames: LegFrames::empty() };
        Self { trunk: Cholesky::empty(), legs: [leg; 4], u: [zero; 6], g: [[zero; 3]; 4] }
    }

    /// Sets up a step of `dt` [s] under gravity `gravity` [m/s²].
    ///
    /// `is_floating` is 1 for a floating base and 0 for a fixed base.
    #[inline(always)]
    pub fn set_up(
        &mut self,
        tree: &KinematicTree<T>,
        state: &State<T>,
        load: &JointLoad<T>,
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

    /// Sets up the equations of one leg. Returns its composite inertia and bias forces on the trunk.
    #[inline(always)]
    fn set_up_leg(
        &mut self,
        tree: &KinematicTree<T>,
        state: &State<T>,
        load: &JointLoad<T>,
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

    /// Returns the changes of the trunk's velocity (angular, linear; base axes) and of the joint velocities.
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

/// Computes forward dynamics: accelerations for joint torques `tau` [N·m] without contact.
#[inline(always)]
pub fn forward_dynamics<T: SimdFloat>(
    tree: &KinematicTree<T>,
    state: &State<T>,
    tau: &[T; 12],
    gravity: T,
) -> Acceleration<T> {
    let (one, zero) = (T::splat(1.0), T::splat(0.0));
    let load = JointLoad { tau: *tau, damping: [zero; 12] };
    let mut factored = FactoredDynamics::empty();
    factored.set_up(tree, state, &load, one, gravity, one);
    let ([ax, ay, az, lx, ly, lz], ddq) = factored.solution();
    Acceleration { angular: Vec3([ax, ay, az]), linear: Vec3([lx, ly, lz]), ddq }
}
