//! The equations of one time step, factored along the tree.
//!
//! Unknowns are the velocity changes over one step: of a free base (angular, then linear of its origin, in base axes) and of the
//! joints. With M = Lᵀ L, where L is lower triangular and has an entry for two joints only if one moves the other (Featherstone 2008,
//! chapter 6.5), a solution in whitened coordinates u is `Δq̇ = L⁻¹ u`. A row `J Δq̇` that acts on one body is `y·u` with `y = L⁻ᵀ Jᵀ`,
//! which is not zero only for the base and for the joints of the body's branch. Two rows are coupled through `y·y'`.

use crate::{Cholesky, Inertia, JointForces, Vec3, spatial_matrix};
use twinstep_simd::SimdFloat;

use super::equations::force;
use super::motion::{Spatial, TreeMotion, times};
use super::{TreeParameters, TreeState, TreeStructure};

/// Factored equations of one time step.
#[derive(Clone, Debug)]
pub struct FactoredTree<T> {
    /// Factor of the base's block.
    base: Cholesky<T, 6>,
    /// Entries of L in the columns of the base, by joint.
    to_base: Vec<[T; 6]>,
    /// Entries of L in the columns of each joint's branch, in the order of the branch; that of the joint itself is the last. One row
    /// after the other.
    rows: Vec<T>,
    /// Index of the first entry of each joint's row.
    starts: Vec<usize>,
    /// Reciprocal of each joint's diagonal entry.
    inverses: Vec<T>,
    composites: Vec<Inertia<T>>,
    accelerations: Vec<Spatial<T>>,
    forces: Vec<Spatial<T>>,
    /// Whitened velocity change of a free base; zero for a fixed one.
    pub base_u: [T; 6],
    /// Whitened velocity changes of the joints.
    pub u: Vec<T>,
}

impl<T: SimdFloat> FactoredTree<T> {
    /// Returns a placeholder for [`FactoredTree::set_up`], to be used in every step.
    pub fn empty(parameters: &TreeParameters<T>) -> Self {
        let structure = &*parameters.structure;
        let (zero, one, joints) = (T::splat(0.0), T::splat(1.0), structure.num_joints());
        let mut identity = [[zero; 6]; 6];
        (0..6).for_each(|index| identity[index][index] = one);
        Self {
            base: Cholesky::new(identity),
            to_base: vec![[zero; 6]; joints],
            rows: vec![zero; structure.branches.iter().map(Vec::len).sum()],
            starts: starts(structure),
            inverses: vec![zero; joints],
            composites: parameters.bodies.clone(),
            accelerations: vec![Spatial::zero(); joints + 1],
            forces: vec![Spatial::zero(); joints + 1],
            base_u: [zero; 6],
            u: vec![zero; joints],
        }
    }

    /// Sets up a step of `dt` [s] under gravity [m/s²]. [`FactoredTree::u`] is then the solution without constraints.
    #[inline(always)]
    pub fn set_up(
        &mut self,
        parameters: &TreeParameters<T>,
        motion: &TreeMotion<T>,
        state: &TreeState<T>,
        forces: &JointForces<Vec<T>>,
        dt: T,
        gravity: T,
    ) {
        let structure = &*parameters.structure;
        self.set_bias(structure, motion, state, gravity);
        self.composites.copy_from_slice(&motion.inertias);
        for joint in (0..structure.num_joints()).rev() {
            let unit = times(&self.composites[joint + 1], motion.axes[joint]);
            let branch = &structure.branches[joint + 1];
            let row = &mut self.rows[self.starts[joint]..][..branch.len()];
            for (entry, other) in row.iter_mut().zip(branch) {
                *entry = unit.dot(motion.axes[*other]);
            }
            let damping = forces.damping[joint];
            row[branch.len() - 1] += parameters.armature[joint] + dt * damping;
            let ([a, b, c], [d, e, f]) = (unit.angular.0, unit.linear.0);
            self.to_base[joint] = [a, b, c, d, e, f];
            let parent = structure.parents[joint];
            let composite = self.composites[parent].combined(&self.composites[joint + 1]);
            self.composites[parent] = composite;
            let bias = motion.axes[joint].dot(self.forces[joint + 1]);
            let sum = self.forces[parent].plus(self.forces[joint + 1]);
            self.forces[parent] = sum;
            self.u[joint] = (forces.tau[joint] - bias - damping * state.dq[joint]) * dt;
        }
        self.factor(structure, dt);
    }

    /// Computes the force on each body without its joints.
    #[inline(always)]
    fn set_bias(&mut self, structure: &TreeStructure, motion: &TreeMotion<T>, state: &TreeState<T>, gravity: T) {
        self.accelerations[0] = Spatial { angular: Vec3::zero(), linear: state.world_axes()[2].scaled(gravity) };
        self.forces[0] = force(&motion.inertias[0], motion.velocities[0], self.accelerations[0]);
        for joint in 0..structure.num_joints() {
            let parent = structure.parents[joint];
            let turning = motion.velocities[parent].cross(motion.axes[joint]).scaled(state.dq[joint]);
            let own = self.accelerations[parent].plus(turning);
            self.accelerations[joint + 1] = own;
            self.forces[joint + 1] = force(&motion.inertias[joint + 1], motion.velocities[joint + 1], own);
        }
    }

    /// Factors the matrix from the tips to the base, and whitens the right-hand side on the way.
    #[inline(always)]
    fn factor(&mut self, structure: &TreeStructure, dt: T) {
        let zero = T::splat(0.0);
        let mut block = spatial_matrix(&self.composites[0]);
        let Spatial { angular, linear } = self.forces[0];
        let ([a, b, c], [d, e, f]) = (angular.0, linear.0);
        let mut rhs = [a, b, c, d, e, f];
        for value in &mut rhs {
            *value = -(*value * dt);
        }
        for joint in (0..structure.num_joints()).rev() {
            let branch = &structure.branches[joint + 1];
            let above = branch.len() - 1;
            // Joints above have smaller indices.
            let (earlier, row) = self.rows.split_at_mut(self.starts[joint]);
            let row = &mut row[..branch.len()];
            let root = row[above].sqrt();
            let inverse = T::splat(1.0) / root;
            row[above] = root;
            self.inverses[joint] = inverse;
            let u = self.u[joint] * inverse;
            self.u[joint] = u;
            for index in 0..above {
                let entry = row[index] * inverse;
                row[index] = entry;
                let other = branch[index];
                let changed = &mut earlier[self.starts[other]..][..=index];
                for (value, inner) in changed.iter_mut().zip(&row[..=index]) {
                    *value -= entry * *inner;
                }
                self.u[other] -= entry * u;
            }
            if structure.is_free {
                let (earlier, own) = self.to_base.split_at_mut(joint);
                let own = &mut own[0];
                for i in 0..6 {
                    own[i] = own[i] * inverse;
                    rhs[i] -= own[i] * u;
                    for j in 0..=i {
                        block[i][j] -= own[i] * own[j];
                    }
                }
                for (entry, other) in row[..above].iter().zip(branch) {
                    for (value, to_base) in earlier[*other].iter_mut().zip(&*own) {
                        *value -= *entry * *to_base;
                    }
                }
            }
        }
        if structure.is_free {
            self.base = Cholesky::new(block);
            self.base_u = self.base.forward(rhs);
        } else {
            self.base_u = [zero; 6];
        }
    }

    /// Whitens a row that acts on the base and on the joints of the branch of `body`: `along` has an entry for each joint of the branch.
    #[inline(always)]
    pub fn whiten(&self, structure: &TreeStructure, body: usize, mut base: [T; 6], along: &mut [T]) -> [T; 6] {
        let branch = &structure.branches[body];
        for index in (0..branch.len()).rev() {
            let joint = branch[index];
            let entry = along[index] * self.inverses[joint];
            along[index] = entry;
            let row = &self.rows[self.starts[joint]..][..index];
            for (value, factor) in along.iter_mut().zip(row) {
                *value -= *factor * entry;
            }
            for i in 0..6 {
                base[i] -= self.to_base[joint][i] * entry;
            }
        }
        if structure.is_free { self.base.forward(base) } else { [T::splat(0.0); 6] }
    }

    /// Returns the velocity changes of the base (angular, linear; base axes) and writes those of the joints.
    #[inline(always)]
    pub fn solution(&self, structure: &TreeStructure, joints: &mut [T]) -> [T; 6] {
        let zero = T::splat(0.0);
        let base = if structure.is_free { self.base.backward(self.base_u) } else { [zero; 6] };
        for joint in 0..structure.num_joints() {
            let branch = &structure.branches[joint + 1];
            let mut rest = self.u[joint];
            if structure.is_free {
                for i in 0..6 {
                    rest -= self.to_base[joint][i] * base[i];
                }
            }
            let row = &self.rows[self.starts[joint]..][..branch.len() - 1];
            for (factor, other) in row.iter().zip(branch) {
                rest -= *factor * joints[*other];
            }
            joints[joint] = rest * self.inverses[joint];
        }
        base
    }
}

/// Returns the index of the first entry of each joint's row, if one row follows the other.
fn starts(structure: &TreeStructure) -> Vec<usize> {
    let lengths = structure.branches[1..].iter().map(Vec::len);
    lengths.scan(0, |next, length| Some(std::mem::replace(next, *next + length))).collect()
}
