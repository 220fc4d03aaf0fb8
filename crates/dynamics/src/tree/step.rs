//! The equations of a tree as the engine uses them.

use std::sync::Arc;

use glam::DVec3;
use twinstep_model::TreeModel;
use twinstep_simd::SimdFloat;

use super::parameters::batch_from_bodies;
use super::{FactoredTree, TreeMotion, TreeParameters, TreeState, TreeStructure};
use crate::{JointForces, StepEquations, Vec3};

/// Motion and factored equations of a batch of robots of any tree.
pub struct TreeEquations<T> {
    structure: Arc<TreeStructure>,
    motion: TreeMotion<T>,
    factored: FactoredTree<T>,
}

impl<T: SimdFloat> StepEquations<T> for TreeEquations<T> {
    type Robot = TreeModel;
    type Parameters = TreeParameters<T>;
    type Joints = Vec<T>;
    type Branch = Vec<T>;

    fn parameters(robot: &TreeModel) -> TreeParameters<T> {
        TreeParameters::splat(&robot.tree)
    }

    fn set_robot(parameters: &mut TreeParameters<T>, lane: usize, robot: &TreeModel) {
        parameters.set(lane, &robot.tree);
    }

    fn armature(parameters: &mut TreeParameters<T>) -> &mut Vec<T> {
        &mut parameters.armature
    }

    fn visit(parameters: &mut TreeParameters<T>, mut visit: impl FnMut(&mut T)) {
        let TreeParameters { bodies, places, armature, base_armature, base_damping, .. } = parameters;
        for body in bodies {
            visit(&mut body.mass);
            body.moment.0.iter_mut().chain(&mut body.about_origin).for_each(&mut visit);
        }
        for place in places {
            place.axes.iter_mut().chain([&mut place.origin]).flat_map(|vector| &mut vector.0).for_each(&mut visit);
        }
        armature.iter_mut().chain([base_armature, base_damping]).for_each(visit);
    }

    fn point_of_body(robot: &TreeModel, body: usize, point: DVec3) -> DVec3 {
        batch_from_bodies(&robot.tree)[body] * point
    }

    fn empty(parameters: &TreeParameters<T>) -> Self {
        let structure = parameters.structure.clone();
        let motion = TreeMotion::empty(parameters);
        let factored = FactoredTree::empty(parameters);
        Self { structure, motion, factored }
    }

    #[inline(always)]
    fn set_up(
        &mut self,
        parameters: &TreeParameters<T>,
        state: &TreeState<T>,
        forces: &JointForces<Vec<T>>,
        dt: T,
        gravity: T,
        is_floating: T,
    ) {
        let Self { motion, factored, .. } = self;
        motion.set(parameters, state, gravity);
        factored.set_up(parameters, motion, state, forces, dt);
        for value in &mut factored.base_u {
            *value = *value * is_floating;
        }
    }

    #[inline(always)]
    fn solution(&self, joints: &mut Vec<T>) -> [T; 6] {
        self.factored.solution(&self.structure, joints)
    }

    #[inline(always)]
    fn point(&self, body: usize, point: Vec3<T>) -> Vec3<T> {
        let place = &self.motion.bodies[body].place;
        place.origin + place.turned(point)
    }

    #[inline(always)]
    fn branch_len(&self, body: usize) -> usize {
        self.structure.branches[body].len()
    }

    fn zero_branch(&self, body: usize) -> Vec<T> {
        vec![T::splat(0.0); self.branch_len(body)]
    }

    #[inline(always)]
    fn branch_joint(&self, body: usize, index: usize) -> usize {
        self.structure.branches[body][index]
    }

    #[inline(always)]
    fn row_of_joint(&self, joint: usize) -> (usize, usize) {
        (joint + 1, self.structure.branches[joint + 1].len() - 1)
    }

    #[inline(always)]
    fn write_jacobian(&self, body: usize, place: Vec3<T>, direction: Vec3<T>, branch: &mut Vec<T>) {
        let turning = place.cross(direction);
        for (value, joint) in branch.iter_mut().zip(&self.structure.branches[body]) {
            let axis = &self.motion.bodies[joint + 1].axis;
            *value = axis.angular.dot(turning) + axis.linear.dot(direction);
        }
    }

    #[inline(always)]
    fn whiten(&self, body: usize, base: [T; 6], branch: &mut Vec<T>) -> [T; 6] {
        self.factored.whiten(&self.structure, body, base, branch)
    }

    #[inline(always)]
    fn velocity_change(&self, body: usize, y: &[T; 6], z: &Vec<T>) -> T {
        // Two sums, because the latency of one limits a sweep of the solver.
        let (mut even, mut odd) = (T::splat(0.0), T::splat(0.0));
        let mut rest = z.as_slice();
        for run in &self.structure.runs[body] {
            let (z, later) = rest.split_at(run.len());
            let (z_pairs, z_last) = z.as_chunks::<2>();
            let (u_pairs, u_last) = self.factored.u[run.clone()].as_chunks::<2>();
            for ([z, z_next], [u, u_next]) in z_pairs.iter().zip(u_pairs) {
                even += *z * *u;
                odd += *z_next * *u_next;
            }
            if let ([z], [u]) = (z_last, u_last) {
                even += *z * *u;
            }
            rest = later;
        }
        if self.structure.is_free {
            let u = &self.factored.base_u;
            even += (y[0] * u[0] + y[1] * u[1]) + (y[2] * u[2] + y[3] * u[3]);
            odd += y[4] * u[4] + y[5] * u[5];
        }
        even + odd
    }

    #[inline(always)]
    fn velocity_changes(&self, body: usize, y: [&[T; 6]; 3], z: [&Vec<T>; 3]) -> [T; 3] {
        let mut sums = [T::splat(0.0); 3];
        let mut start = 0;
        for run in &self.structure.runs[body] {
            let rows = [&z[0][start..], &z[1][start..], &z[2][start..]];
            for (((u, a), b), c) in self.factored.u[run.clone()].iter().zip(rows[0]).zip(rows[1]).zip(rows[2]) {
                sums[0] += *a * *u;
                sums[1] += *b * *u;
                sums[2] += *c * *u;
            }
            start += run.len();
        }
        if self.structure.is_free {
            for (index, u) in self.factored.base_u.iter().enumerate() {
                for (sum, y) in sums.iter_mut().zip(y) {
                    *sum += y[index] * *u;
                }
            }
        }
        sums
    }

    #[inline(always)]
    fn add_impulse(&mut self, body: usize, y: &[T; 6], z: &Vec<T>, impulse: T) {
        let mut start = 0;
        for run in &self.structure.runs[body] {
            for (u, z) in self.factored.u[run.clone()].iter_mut().zip(&z[start..]) {
                *u += *z * impulse;
            }
            start += run.len();
        }
        if self.structure.is_free {
            for (u, y) in self.factored.base_u.iter_mut().zip(y) {
                *u += *y * impulse;
            }
        }
    }

    #[inline(always)]
    fn add_impulses(&mut self, body: usize, y: [&[T; 6]; 3], z: [&Vec<T>; 3], impulses: [T; 3]) {
        let mut start = 0;
        for run in &self.structure.runs[body] {
            let rows = [&z[0][start..], &z[1][start..], &z[2][start..]];
            for (((u, a), b), c) in self.factored.u[run.clone()].iter_mut().zip(rows[0]).zip(rows[1]).zip(rows[2]) {
                *u += (*a * impulses[0] + *b * impulses[1]) + *c * impulses[2];
            }
            start += run.len();
        }
        if self.structure.is_free {
            for (index, u) in self.factored.base_u.iter_mut().enumerate() {
                *u += (y[0][index] * impulses[0] + y[1][index] * impulses[1]) + y[2][index] * impulses[2];
            }
        }
    }
}
