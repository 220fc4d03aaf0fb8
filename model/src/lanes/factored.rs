//! The equations of one time step, factored so that constraint rows are cheap.
//!
//! Unknowns are the changes of velocity over one step: of the trunk (angular, then linear of its origin, in base axes)
//! and of each leg's joints. The mass matrix is an arrow: trunk 6 × 6, legs 3 × 3, legs coupled through the trunk
//! alone. With L = G Gᵀ (a leg's block), W = G⁻¹ Cᵀ (its coupling) and S = M − Σ Wᵀ W = B Bᵀ, a solution in whitened
//! coordinates (u, g) is `Δq̇ = G⁻ᵀ (g − W Δv)`, `Δv = B⁻ᵀ u`. A constraint row is then nine numbers, y and z, with
//! `J Δ = y·u + z·g`, and rows meet through y·y' and, on the same leg, z·z'.

use super::dynamics::{LegForces, LegInertia, spatial_matrix};
use super::lane::SimdFloat;
use super::spatial::{Cholesky, Inertia, Vec3};
use super::tree::{LegFrames, State, KinematicTree};

/// What acts at the joints.
#[derive(Clone, Copy, Debug)]
pub struct JointLoad<T> {
    /// Torque [N·m].
    pub tau: [T; 12],
    /// Viscous friction [N·m·s/rad], taken at the step's end: stable however large it is.
    pub damping: [T; 12],
}

/// A leg's part of the factored equations.
#[derive(Clone, Copy)]
pub struct FactoredLeg<T> {
    /// Factor G of the leg's block.
    pub factor: Cholesky<T, 3>,
    /// W, by joint.
    pub coupling: [[T; 6]; 3],
    /// Where its bodies are.
    pub frames: LegFrames<T>,
}

/// The factored equations of one step.
pub struct FactoredDynamics<T> {
    /// Factor B of the trunk's block.
    pub trunk: Cholesky<T, 6>,
    /// The legs.
    pub legs: [FactoredLeg<T>; 4],
    /// Whitened change of the trunk's velocity, without constraints at first.
    pub u: [T; 6],
    /// Whitened changes of the legs' velocities.
    pub g: [[T; 3]; 4],
}

impl<T: SimdFloat> FactoredDynamics<T> {
    /// Of nothing; [`Factored::set_up`] fills it. Kept from step to step, because it is large.
    pub fn empty() -> Self {
        let zero = T::splat(0.0);
        let leg = FactoredLeg { factor: Cholesky::empty(), coupling: [[zero; 6]; 3], frames: LegFrames::empty() };
        Self { trunk: Cholesky::empty(), legs: [leg; 4], u: [zero; 6], g: [[zero; 3]; 4] }
    }

    /// Sets up the step `dt` [s] under gravity `gravity` [m/s²]. `moving` is 1 where the trunk moves, 0 where it is held.
    #[inline(always)]
    pub fn set_up(&mut self, tree: &KinematicTree<T>, state: &State<T>, load: &JointLoad<T>, dt: T, gravity: T, is_floating: T) {
        let rising = state.world_axes()[2].scaled(gravity);
        let (mut force, mut moment) = tree.trunk.wrench(state.angular_velocity, Vec3::zero(), rising);
        let mut whole = tree.trunk;
        // What the legs take away from the trunk's block and its right side.
        let (mut less, mut rhs) = ([[T::splat(0.0); 6]; 6], [T::splat(0.0); 6]);
        for leg in 0..4 {
            let (composite, forces) = self.set_up_leg(tree, state, load, leg, dt, rising);
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
        // A held trunk takes no part: nothing that acts on it changes its velocity.
        for value in &mut self.u {
            *value = *value * is_floating;
        }
    }

    /// One leg's equations; what it adds to the trunk's.
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
        let mut wanted = [T::splat(0.0); 3];
        for i in 0..3 {
            let joint = 3 * leg + i;
            let damping = load.damping[joint];
            block[i][i] += dt * damping;
            wanted[i] = (load.tau[joint] - bias.tau[i] - damping * state.dq[joint]) * dt;
        }
        let factor = Cholesky::new(block);
        self.g[leg] = factor.forward(wanted);
        // W = G⁻¹ Cᵀ, column by column of the trunk's six.
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
