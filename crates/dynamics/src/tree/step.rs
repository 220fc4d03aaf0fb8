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
        let TreeParameters { bodies, places, armature, .. } = parameters;
        for body in bodies {
            visit(&mut body.mass);
            body.moment.0.iter_mut().chain(&mut body.about_origin).for_each(&mut visit);
        }
        for place in places {
            place.axes.iter_mut().chain([&mut place.origin]).flat_map(|vector| &mut vector.0).for_each(&mut visit);
        }
        armature.iter_mut().for_each(visit);
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
        motion.set(parameters, state);
        factored.set_up(parameters, motion, state, forces, dt, gravity);
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
        let place = &self.motion.places[body];
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
            let axis = &self.motion.axes[*joint];
            *value = axis.angular.dot(turning) + axis.linear.dot(direction);
        }
    }

    #[inline(always)]
    fn whiten(&self, body: usize, base: [T; 6], branch: &mut Vec<T>) -> [T; 6] {
        self.factored.whiten(&self.structure, body, base, branch)
    }

    #[inline(always)]
    fn velocity_change(&self, body: usize, y: &[T; 6], z: &Vec<T>) -> T {
        let u = &self.factored.base_u;
        let mut even = (y[0] * u[0] + y[1] * u[1]) + (y[2] * u[2] + y[3] * u[3]) + (y[4] * u[4] + y[5] * u[5]);
        // Two sums, because the latency of one limits a sweep of the solver.
        let (mut odd, branch) = (T::splat(0.0), &self.structure.branches[body]);
        for (index, (z, joint)) in z.iter().zip(branch).enumerate() {
            let product = *z * self.factored.u[*joint];
            if index % 2 == 0 { even += product } else { odd += product }
        }
        even + odd
    }

    #[inline(always)]
    fn add_impulse(&mut self, body: usize, y: &[T; 6], z: &Vec<T>, impulse: T) {
        for (u, y) in self.factored.base_u.iter_mut().zip(y) {
            *u += *y * impulse;
        }
        for (z, joint) in z.iter().zip(&self.structure.branches[body]) {
            self.factored.u[*joint] += *z * impulse;
        }
    }

    #[inline(always)]
    fn add_impulses(&mut self, body: usize, y: [&[T; 6]; 3], z: [&Vec<T>; 3], impulses: [T; 3]) {
        for i in 0..6 {
            self.factored.base_u[i] += (y[0][i] * impulses[0] + y[1][i] * impulses[1]) + y[2][i] * impulses[2];
        }
        for (index, joint) in self.structure.branches[body].iter().enumerate() {
            self.factored.u[*joint] +=
                (z[0][index] * impulses[0] + z[1][index] * impulses[1]) + z[2][index] * impulses[2];
        }
    }
}
