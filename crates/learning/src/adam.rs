//! Adam (Kingma and Ba 2015, algorithm 1).

use serde::{Deserialize, Serialize};

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// State of the optimiser for a vector of parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Adam {
    /// Number of steps so far.
    pub steps: u32,
    /// Mean of the gradient.
    pub first: Vec<f32>,
    /// Mean of the squared gradient.
    pub second: Vec<f32>,
}

impl Adam {
    /// Creates the state for `len` parameters.
    pub fn new(len: usize) -> Self {
        Self { steps: 0, first: vec![0.0; len], second: vec![0.0; len] }
    }

    /// Moves `parameters` against `scale · gradient`.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32], scale: f32, learning_rate: f32) {
        self.steps += 1;
        let correction = |beta: f32| 1.0 - f64::from(beta).powi(self.steps as i32);
        let rate = learning_rate * (correction(BETA_2).sqrt() / correction(BETA_1)) as f32;
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((parameter, gradient), (first, second)) in parameters.iter_mut().zip(gradient).zip(moments) {
            let gradient = scale * gradient;
            *first = BETA_1 * *first + (1.0 - BETA_1) * gradient;
            *second = BETA_2 * *second + (1.0 - BETA_2) * gradient * gradient;
            *parameter -= rate * *first / (second.sqrt() + EPSILON);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_step_is_the_learning_rate_against_the_sign_of_the_gradient() {
        let (mut adam, mut parameters) = (Adam::new(3), vec![1.0, 1.0, 1.0]);
        adam.step(&mut parameters, &[5.0, -0.01, 0.0], 1.0, 0.1);
        for (parameter, expected) in parameters.iter().zip([0.9, 1.1, 1.0]) {
            assert!((parameter - expected).abs() < 1e-4, "{parameters:?}");
        }
    }

    #[test]
    fn quadratic_bowl_is_descended() {
        let (mut adam, mut parameters) = (Adam::new(2), vec![3.0f32, -2.0]);
        for _ in 0..2000 {
            let gradient = [2.0 * (parameters[0] - 1.0), 20.0 * parameters[1]];
            adam.step(&mut parameters, &gradient, 1.0, 0.01);
        }
        assert!((parameters[0] - 1.0).abs() < 1e-3 && parameters[1].abs() < 1e-3, "{parameters:?}");
    }
}
