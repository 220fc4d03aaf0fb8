//! Equations of motion `M a + bias = τ`: recursive Newton–Euler algorithm and composite-rigid-body algorithm.

use crate::{Inertia, Vec3, spatial_matrix};
use twinstep_simd::SimdFloat;

use super::motion::{Spatial, TreeMotion, times};
use super::{TreeParameters, TreeState, TreeStructure};

/// Accelerations of base and joints.
#[derive(Clone, Debug)]
pub struct TreeAcceleration<T> {
    /// Angular acceleration of the base, in base axes [rad/s²].
    pub angular: Vec3<T>,
    /// Acceleration of the base's origin, in base axes, without gravity [m/s²].
    pub linear: Vec3<T>,
    /// Joint accelerations [rad/s² or m/s²].
    pub ddq: Vec<T>,
}

/// Forces on base and joints.
#[derive(Clone, Debug)]
pub struct TreeForces<T> {
    /// Moment about the base's origin in base axes [N·m].
    pub moment: Vec3<T>,
    /// Force on the base in base axes [N].
    pub force: Vec3<T>,
    /// Force of each joint [N·m or N].
    pub tau: Vec<T>,
}

/// Computes inverse dynamics: the wrench on the base and the joint forces for an acceleration.
///
/// `gravity` [m/s²] acts along −z of the world frame. The result is linear in the ten inertial parameters of each body.
#[inline(always)]
pub fn inverse_dynamics<T: SimdFloat>(
    structure: &TreeStructure,
    parameters: &TreeParameters<T>,
    motion: &TreeMotion<T>,
    state: &TreeState<T>,
    acceleration: &TreeAcceleration<T>,
    gravity: T,
) -> TreeForces<T> {
    let proper = state.world_axes()[2].scaled(gravity) + acceleration.linear;
    let mut accelerations = vec![Spatial { angular: acceleration.angular, linear: proper }];
    let mut forces = vec![force(&motion.inertias[0], motion.velocities[0], accelerations[0])];
    for joint in 0..structure.num_joints() {
        let (parent, axis) = (structure.parents[joint], motion.axes[joint]);
        let turning = motion.velocities[parent].cross(axis).scaled(state.dq[joint]);
        let own = accelerations[parent].plus(turning).plus(axis.scaled(acceleration.ddq[joint]));
        forces.push(force(&motion.inertias[joint + 1], motion.velocities[joint + 1], own));
        accelerations.push(own);
    }
    let mut tau = vec![T::splat(0.0); structure.num_joints()];
    for joint in (0..structure.num_joints()).rev() {
        let parent = structure.parents[joint];
        tau[joint] = motion.axes[joint].dot(forces[joint + 1]) + parameters.armature[joint] * acceleration.ddq[joint];
        forces[parent] = forces[parent].plus(forces[joint + 1]);
    }
    TreeForces { moment: forces[0].angular, force: forces[0].linear, tau }
}

/// Returns the force on a body for its acceleration: the change of its momentum.
#[inline(always)]
pub fn force<T: SimdFloat>(body: &Inertia<T>, velocity: Spatial<T>, acceleration: Spatial<T>) -> Spatial<T> {
    let momentum = times(body, velocity);
    let turning = Spatial {
        angular: velocity.angular.cross(momentum.angular) + velocity.linear.cross(momentum.linear),
        linear: velocity.angular.cross(momentum.linear),
    };
    times(body, acceleration).plus(turning)
}

/// Returns the symmetric mass matrix, row by row, in the order angular and linear velocity of a free base in base axes, joint
/// velocities.
pub fn mass_matrix<T: SimdFloat>(
    structure: &TreeStructure,
    parameters: &TreeParameters<T>,
    motion: &TreeMotion<T>,
) -> Vec<Vec<T>> {
    let (base, size) = (structure.num_base_velocities(), structure.num_velocities());
    let mut matrix = vec![vec![T::splat(0.0); size]; size];
    let mut composites = motion.inertias.clone();
    for joint in (0..structure.num_joints()).rev() {
        let unit = times(&composites[joint + 1], motion.axes[joint]);
        for other in &structure.branches[joint + 1] {
            let entry = unit.dot(motion.axes[*other]);
            (matrix[base + joint][base + other], matrix[base + other][base + joint]) = (entry, entry);
        }
        matrix[base + joint][base + joint] += parameters.armature[joint];
        for (index, entry) in unit.angular.0.into_iter().chain(unit.linear.0).enumerate().take(base) {
            (matrix[base + joint][index], matrix[index][base + joint]) = (entry, entry);
        }
        let parent = structure.parents[joint];
        composites[parent] = composites[parent].combined(&composites[joint + 1]);
    }
    for (row, entries) in spatial_matrix(&composites[0]).into_iter().enumerate().take(base) {
        for (column, entry) in entries.into_iter().enumerate().take(row + 1) {
            (matrix[row][column], matrix[column][row]) = (entry, entry);
        }
    }
    matrix
}
