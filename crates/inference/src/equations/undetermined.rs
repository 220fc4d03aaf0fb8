//! What a sample of a robot that stands does not determine: dry friction of joints at rest.
//!
//! Its torques are unknown, with a normal prior, and are integrated out: the balance of the base is weighted by the inverse square root of
//! its covariance, so that directions in which they act count less.

use nalgebra::Matrix6;

/// Standard deviation of the dry friction of a joint at rest [N·m], for a motor as strong as a Go2's.
const FRICTION_AT_REST: f64 = 0.3;

/// Weights of the balance of a base: moment and force, both in the frame of the base.
#[derive(Clone, Debug)]
pub struct Weighting {
    matrix: Matrix6<f64>,
    /// Weighted moment and force per torque of each joint.
    pub per_torque: Vec<[f64; 6]>,
}

impl Weighting {
    /// Computes the weights from moment and force per torque of each joint, the joints at rest with the strength of their motors, and the
    /// noise along each axis.
    pub fn new(per_torque: &[[f64; 6]], at_rest: &[(usize, f64)], sigma: [f64; 6]) -> Self {
        let of_friction =
            |(joint, strength): &(usize, f64)| per_torque[*joint].map(|per| per * FRICTION_AT_REST * strength);
        let mut covariance = Matrix6::from_diagonal(&sigma.map(|sigma| sigma * sigma).into());
        for direction in at_rest.iter().map(of_friction) {
            let direction = nalgebra::Vector6::from(direction);
            covariance += direction * direction.transpose();
        }
        let root = covariance.cholesky().expect("noise in every axis").l();
        let inverse = root.try_inverse().expect("a triangle with noise on its diagonal");
        let matrix = Matrix6::from_diagonal(&sigma.into()) * inverse;
        let weighted = |per: &[f64; 6]| (matrix * nalgebra::Vector6::from(*per)).into();
        Self { matrix, per_torque: per_torque.iter().map(weighted).collect() }
    }

    /// Returns the weighted force along an axis that joints do not give.
    pub fn along(&self, axis: usize, forces: &[f64], of_joints: &[f64]) -> f64 {
        let of_base: f64 = (0..6).map(|other| self.matrix[(axis, other)] * forces[other]).sum();
        let of_joints: f64 = self.per_torque.iter().zip(of_joints).map(|(per, torque)| per[axis] * torque).sum();
        of_base - of_joints
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_that_are_not_determined_count_less() {
        let free = Weighting::new(&[], &[], [2.0; 6]);
        let force = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        assert!((0..6).all(|axis| (free.along(axis, &force, &[]) - force[axis]).abs() < 1e-12));
        let upwards = [[0.0, 0.0, 0.0, 0.0, 0.0, 100.0]];
        let at_rest = Weighting::new(&upwards, &[(0, 1.0)], [2.0; 6]);
        assert!((at_rest.along(0, &force, &[0.0]) - 1.0).abs() < 1e-12);
        assert!(at_rest.along(5, &force, &[0.0]).abs() < 0.5);
    }

    #[test]
    fn what_is_integrated_out_has_the_variance_of_the_noise() {
        let (direction, sigma) = ([1.0, -2.0, 0.5, 3.0, 0.0, 1.0], [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]);
        let weighting = Weighting::new(&[direction], &[(0, 1.0 / FRICTION_AT_REST)], sigma);
        let covariance = Matrix6::from_diagonal(&sigma.map(|sigma| sigma * sigma).into())
            + nalgebra::Vector6::from(direction) * nalgebra::Vector6::from(direction).transpose();
        let weighted = weighting.matrix * covariance * weighting.matrix.transpose();
        let expected = Matrix6::from_diagonal(&sigma.map(|sigma| sigma * sigma).into());
        assert!((weighted - expected).norm() < 1e-9);
    }
}
