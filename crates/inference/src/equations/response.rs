//! How the joints of a robot with a fixed base move under additional torques: the linear response of its controlled limbs.
//!
//! Around a simulated motion, a change `τ` of the torques moves the joints of a limb by `δ`: `M δ'' + C δ' + K δ = τ + u`. `C` and `K` have the
//! slopes of friction, springs and gravity. `u` is what the drives answer: `-P δ - D δ'` of the start of their period, held for the
//! period. Steps of the links are implicit, so that they are stable however steep dry friction is.

use std::ops::Range;

use nalgebra::DMatrix;
use rayon::prelude::*;

/// Longest step of the links [s].
const LINK_STEP_S: f64 = 0.001;

/// Matrices of a limb at a point of the grid.
pub struct LimbMatrices {
    /// Mass.
    pub mass: DMatrix<f64>,
    /// Damping and stiffness of the links.
    pub links: [DMatrix<f64>; 2],
    /// Velocity and position gain of the drives.
    pub drives: [DMatrix<f64>; 2],
}

/// Response of all limbs on the grid of a simulation.
pub struct Response {
    /// Joints of each limb.
    limbs: Vec<Vec<usize>>,
    /// Ranges of points, each of which begins in the measured state.
    ranges: Vec<Range<usize>>,
    /// By limb, point after point, row by row: positions and velocities of the next point, given those of the point, and given torques.
    steps: Vec<Vec<[Vec<f64>; 2]>>,
    /// By limb and point: the mass, row by row.
    masses: Vec<Vec<Vec<f64>>>,
}

impl Response {
    /// Prepares the steps: `periods` of the drives of a length [s] from point to point. `at` returns the matrices of a limb at a point.
    pub fn new(
        limbs: Vec<Vec<usize>>,
        ranges: Vec<Range<usize>>,
        (periods, length): (usize, f64),
        at: impl Fn(usize, usize) -> LimbMatrices + Sync,
    ) -> Self {
        let points = ranges.last().map_or(0, |range| range.end);
        let by_row = |matrix: DMatrix<f64>| matrix.transpose().as_slice().to_vec();
        let prepared = |limb: usize, point: usize| {
            let matrices = at(limb, point);
            (step(&matrices, periods, length).map(by_row), by_row(matrices.mass))
        };
        let of_limb = |limb: usize| -> (Vec<_>, Vec<_>) {
            (0..points).into_par_iter().map(|point| prepared(limb, point)).unzip()
        };
        let (steps, masses) = (0..limbs.len()).map(of_limb).unzip();
        Self { limbs, ranges, steps, masses }
    }

    /// Returns the torques of a limb's joints that accelerations of one of them need: joint and torques by point.
    pub fn inertial(&self, limb: usize, place: usize, accelerations: &[f64]) -> Vec<(usize, Vec<f64>)> {
        let joints = &self.limbs[limb];
        let of = |(row, joint): (usize, &usize)| {
            let masses = self.masses[limb].iter().map(|mass| mass[row * joints.len() + place]);
            (*joint, masses.zip(accelerations).map(|(mass, acceleration)| mass * acceleration).collect())
        };
        joints.iter().enumerate().map(of).collect()
    }

    /// Returns how the joints of a limb move, given the additional torques of its joints by point; empty where there is none.
    pub fn positions(&self, limb: usize, torques: &[&[f64]]) -> Vec<Vec<f64>> {
        let size = self.limbs[limb].len();
        let mut positions = vec![Vec::with_capacity(self.steps[limb].len()); size];
        let (mut state, mut next, mut inputs) = (vec![0.0; 2 * size], vec![0.0; 2 * size], vec![0.0; size]);
        for range in &self.ranges {
            state.fill(0.0);
            for point in range.clone() {
                positions.iter_mut().zip(&state).for_each(|(cells, value)| cells.push(*value));
                for (input, cells) in inputs.iter_mut().zip(torques) {
                    *input = cells.get(point).copied().unwrap_or(0.0);
                }
                let [of_state, of_torque] = &self.steps[limb][point];
                for (row, cell) in next.iter_mut().enumerate() {
                    *cell = dot(&of_state[2 * row * size..2 * (row + 1) * size], &state)
                        + dot(&of_torque[row * size..(row + 1) * size], &inputs);
                }
                std::mem::swap(&mut state, &mut next);
            }
        }
        positions
    }
}

/// Returns what a step from point to point makes of the state, and of torques in it.
fn step(matrices: &LimbMatrices, periods: usize, length: f64) -> [DMatrix<f64>; 2] {
    let LimbMatrices { mass, links: [damping, stiffness], drives: [velocity_gain, position_gain] } = matrices;
    let size = mass.nrows();
    let count = (length / LINK_STEP_S).ceil().max(1.0);
    let dt = length / count;
    let implicit = mass + dt * damping + dt * dt * stiffness;
    let inverse = implicit.try_inverse().unwrap_or_else(|| DMatrix::zeros(size, size));
    // Columns: the positions, the velocities, and the torques of the start.
    let mut position = DMatrix::zeros(size, 3 * size);
    let mut velocity = DMatrix::zeros(size, 3 * size);
    position.view_mut((0, 0), (size, size)).fill_with_identity();
    velocity.view_mut((0, size), (size, size)).fill_with_identity();
    let mut torque = DMatrix::zeros(size, 3 * size);
    torque.view_mut((0, 2 * size), (size, size)).fill_with_identity();
    for _ in 0..periods {
        let held = &torque - position_gain * &position - velocity_gain * &velocity;
        for _ in 0..count as usize {
            velocity = &inverse * (mass * &velocity + dt * (&held - stiffness * &position));
            position += dt * &velocity;
        }
    }
    let mut all = DMatrix::zeros(2 * size, 3 * size);
    all.rows_mut(0, size).copy_from(&position);
    all.rows_mut(size, size).copy_from(&velocity);
    [all.columns(0, 2 * size).into_owned(), all.columns(2 * size, size).into_owned()]
}

fn dot(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(one, other)| one * other).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damped_oscillator_follows_a_step_of_torque() {
        let (inertia, damping, stiffness) = (0.02, 0.8, 30.0);
        let matrix = |entry| DMatrix::from_element(1, 1, entry);
        let at = |_, _| LimbMatrices {
            mass: matrix(inertia),
            links: [0.5 * damping, 0.5 * stiffness].map(matrix),
            drives: [0.5 * damping, 0.5 * stiffness].map(matrix),
        };
        let response = Response::new(vec![vec![0]], vec![0..2000, 2000..2400], (1, 0.0005), at);
        let found = response.positions(0, &[&vec![3.0; 2400]]);
        let (decay, rate) = (damping / (2.0 * inertia), (stiffness / inertia - 20.0f64.powi(2)).sqrt());
        for point in [40, 200, 1500, 2040] {
            let t = 0.0005 * (point % 2000) as f64;
            let envelope = (-decay * t).exp() * ((rate * t).cos() + decay / rate * (rate * t).sin());
            let expected = 3.0 / stiffness * (1.0 - envelope);
            assert!((found[0][point] - expected).abs() < 0.002, "{point}: {} for {expected}", found[0][point]);
        }
    }
}
