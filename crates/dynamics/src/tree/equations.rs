//! Equations of motion `M a + bias = τ`: recursive Newton–Euler algorithm and composite-rigid-body algorithm.

use crate::{Vec3, spatial_matrix};
use twinstep_simd::SimdFloat;

use super::motion::{Spatial, TreeMotion, times};
use super::{TreeParameters, TreeStructure};

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
/// Gravity is that of `motion`. The result is linear in the ten inertial parameters of each body.
#[inline(always)]
pub fn inverse_dynamics<T: SimdFloat>(
    structure: &TreeStructure,
    parameters: &TreeParameters<T>,
    motion: &TreeMotion<T>,
    acceleration: &TreeAcceleration<T>,
) -> TreeForces<T> {
    // The motion has the acceleration of gravity already.
    let of_base = Spatial { angular: acceleration.angular, linear: acceleration.linear };
    let mut accelerations = vec![of_base];
    for joint in 0..structure.num_joints() {
        let axis = motion.bodies[joint + 1].axis;
        accelerations.push(accelerations[structure.parents[joint]].plus(axis.scaled(acceleration.ddq[joint])));
    }
    let bodies = motion.bodies.iter().zip(&accelerations);
    let mut forces: Vec<_> =
        bodies.map(|(body, acceleration)| body.force.plus(times(&body.inertia, *acceleration))).collect();
    let mut tau = vec![T::splat(0.0); structure.num_joints()];
    for joint in (0..structure.num_joints()).rev() {
        let (parent, axis) = (structure.parents[joint], motion.bodies[joint + 1].axis);
        tau[joint] = axis.dot(forces[joint + 1]) + parameters.armature[joint] * acceleration.ddq[joint];
        forces[parent] = forces[parent].plus(forces[joint + 1]);
    }
    let of_free_joint = of_base.scaled(parameters.base_armature);
    let base = forces[0].plus(of_free_joint);
    TreeForces { moment: base.angular, force: base.linear, tau }
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
    let mut composites: Vec<_> = motion.bodies.iter().map(|body| body.inertia).collect();
    for joint in (0..structure.num_joints()).rev() {
        let unit = times(&composites[joint + 1], motion.bodies[joint + 1].axis);
        for other in &structure.branches[joint + 1] {
            let entry = unit.dot(motion.bodies[other + 1].axis);
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
        matrix[row][row] += parameters.base_armature;
    }
    matrix
}
