//! The equations of one time step, factored along the tree.
//!
//! Unknowns are the velocity changes over one step: of a free base (angular, then linear of its origin, in base axes) and of the
//! joints. With M = Lᵀ L, where L is lower triangular and has an entry for two joints only if one moves the other (Featherstone 2008,
//! chapter 6.5), a solution in whitened coordinates u is `Δq̇ = L⁻¹ u`. A row `J Δq̇` that acts on one body is `y·u` with `y = L⁻ᵀ Jᵀ`,
//! which is not zero only for the base and for the joints of the body's branch. Two rows are coupled through `y·y'`.

use crate::{Cholesky, JointForces, spatial_matrix};
use twinstep_simd::SimdFloat;

use super::motion::{BodyMotion, Spatial, TreeMotion, times};
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
    /// Whitened velocity change of a free base; zero for a fixed one.
    pub base_u: [T; 6],
    /// Whitened velocity changes of the joints.
    pub u: Vec<T>,
}

impl<T: SimdFloat> FactoredTree<T> {
    /// Returns a placeholder for [`FactoredTree::set_up`], to be used in every step.
    pub fn empty(parameters: &TreeParameters<T>) -> Self {
        let structure = &*parameters.structure;
        let (zero, joints) = (T::splat(0.0), structure.num_joints());
        Self {
            base: Cholesky::empty(),
            to_base: vec![[zero; 6]; joints],
            rows: vec![zero; structure.branches.iter().map(Vec::len).sum()],
            starts: starts(structure),
            inverses: vec![zero; joints],
            base_u: [zero; 6],
            u: vec![zero; joints],
        }
    }

    /// Sets up a step of `dt` [s]. [`FactoredTree::u`] is then the solution without constraints.
    ///
    /// Inertias and forces of the bodies in `motion` become those of all bodies that they move.
    #[inline(always)]
    pub fn set_up(
        &mut self,
        parameters: &TreeParameters<T>,
        motion: &mut TreeMotion<T>,
        state: &TreeState<T>,
        forces: &JointForces<Vec<T>>,
        dt: T,
    ) {
        let (structure, zero) = (&*parameters.structure, T::splat(0.0));
        self.rows.fill(zero);
        self.to_base.fill([zero; 6]);
        self.u.fill(zero);
        // What the elimination of the joints adds to the block and the right-hand side of the base.
        let (mut block, mut rhs) = ([[zero; 6]; 6], [zero; 6]);
        // From the tips to the base. Joints below have eliminated themselves from a row before its own entries are added.
        for joint in (0..structure.num_joints()).rev() {
            self.add_entries(parameters, motion, joint, dt * forces.damping[joint]);
            let body = &motion.bodies[joint + 1];
            let bias = body.axis.dot(body.force);
            self.u[joint] += (forces.tau[joint] - bias - forces.damping[joint] * state.dq[joint]) * dt;
            add_to_parent(motion, structure.parents[joint], joint + 1);
            self.eliminate(structure, joint, &mut block, &mut rhs);
        }
        if structure.is_free {
            let BodyMotion { inertia, force: Spatial { angular, linear }, .. } = &motion.bodies[0];
            let (own, [a, b, c], [d, e, f]) = (spatial_matrix(inertia), angular.0, linear.0);
            let damping = parameters.base_damping;
            let velocity = state.base_velocity();
            for (i, force) in [a, b, c, d, e, f].into_iter().enumerate() {
                rhs[i] -= (force + damping * velocity[i]) * dt;
                for j in 0..=i {
                    block[i][j] += own[i][j];
                }
                block[i][i] += parameters.base_armature + damping * dt;
            }
            self.base = Cholesky::new(block);
            self.base_u = self.base.forward(rhs);
        }
    }

    /// Adds the entries of the mass matrix to the row of a joint, and `damping` to its diagonal.
    #[inline(always)]
    fn add_entries(&mut self, parameters: &TreeParameters<T>, motion: &TreeMotion<T>, joint: usize, damping: T) {
        let (structure, bodies) = (&*parameters.structure, &motion.bodies);
        let unit = times(&bodies[joint + 1].inertia, bodies[joint + 1].axis);
        let branch = &structure.branches[joint + 1];
        let row = &mut self.rows[self.starts[joint]..][..branch.len()];
        for (entry, other) in row.iter_mut().zip(branch) {
            *entry += unit.dot(bodies[other + 1].axis);
        }
        row[branch.len() - 1] += parameters.armature[joint] + damping;
        if structure.is_free {
            let ([a, b, c], [d, e, f]) = (unit.angular.0, unit.linear.0);
            for (entry, own) in self.to_base[joint].iter_mut().zip([a, b, c, d, e, f]) {
                *entry += own;
            }
        }
    }

    /// Divides the row of a joint by the root of its diagonal entry, and eliminates it from the rows above.
    #[inline(always)]
    fn eliminate(&mut self, structure: &TreeStructure, joint: usize, block: &mut [[T; 6]; 6], rhs: &mut [T; 6]) {
        let branch = &structure.branches[joint + 1];
        let above = branch.len() - 1;
        // Joints above have smaller indices.
        let (earlier, row) = self.rows.split_at_mut(self.starts[joint]);
        let row = &mut row[..branch.len()];
        let inverse = T::splat(1.0) / row[above].sqrt();
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
        if !structure.is_free {
            return;
        }
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
            if structure.is_free {
                for i in 0..6 {
                    base[i] -= self.to_base[joint][i] * entry;
                }
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

/// Adds inertia and force of a body to those of its parent.
#[inline(always)]
fn add_to_parent<T: SimdFloat>(motion: &mut TreeMotion<T>, parent: usize, child: usize) {
    let (earlier, own) = motion.bodies.split_at_mut(child);
    let (parent, child) = (&mut earlier[parent], &own[0]);
    parent.inertia = parent.inertia.combined(&child.inertia);
    parent.force = parent.force.plus(child.force);
}

/// Returns the index of the first entry of each joint's row, if one row follows the other.
fn starts(structure: &TreeStructure) -> Vec<usize> {
    let lengths = structure.branches[1..].iter().map(Vec::len);
    lengths.scan(0, |next, length| Some(std::mem::replace(next, *next + length))).collect()
}
