//! Positions and velocities of a joint with less noise: the smoother of a motion whose jerk is white, with the intensity of highest
//! likelihood (Rauch, Tung and Striebel 1965).

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

/// Intensities of the jerk that are compared [rad²/s⁵].
const INTENSITIES: [f64; 9] = [1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8];
/// Standard deviations of velocity [rad/s] and acceleration [rad/s²] before the first row.
const START: [f64; 2] = [10.0, 1000.0];

/// Readings of a joint in one contiguous range, with their noise.
struct Readings<'a> {
    t: &'a [f64],
    q: &'a [f64],
    dq: &'a [f64],
    /// Variances of position and velocity.
    variance: [f64; 2],
}

/// Returns positions [rad] and velocities [rad/s] without most of their noise, given that of the readings.
pub fn smoothed(t: &[f64], [q, dq]: [&[f64]; 2], noise: [f64; 2], ranges: &[Range<usize>]) -> [Vec<f64>; 2] {
    let variance = noise.map(|noise| noise * noise);
    let parts: Vec<(Range<usize>, Readings)> = ranges
        .iter()
        .map(|range| {
            let [t, q, dq] = [t, q, dq].map(|series| &series[range.clone()]);
            (range.clone(), Readings { t, q, dq, variance })
        })
        .collect();
    let likelihood = |intensity: f64| parts.iter().map(|(_, part)| part.filtered(intensity).1).sum::<f64>();
    let scored = INTENSITIES.map(|intensity| (intensity, likelihood(intensity)));
    let best = scored.into_iter().max_by(|one, other| one.1.total_cmp(&other.1)).expect("intensities").0;
    let mut smooth = [q.to_vec(), dq.to_vec()];
    for (range, part) in parts {
        for (row, state) in range.zip(part.smoothed(best)) {
            for (series, value) in smooth.iter_mut().zip([state.x, state.y]) {
                // A missing reading stays missing.
                if series[row].is_finite() {
                    series[row] = value;
                }
            }
        }
    }
    smooth
}

/// Mean and covariance of position, velocity and acceleration.
type Belief = (Vector3<f64>, Matrix3<f64>);

impl Readings<'_> {
    /// Returns the beliefs before and after the readings of each row, and the log-likelihood.
    fn filtered(&self, intensity: f64) -> (Vec<[Belief; 2]>, f64) {
        let first = self.q.iter().copied().find(|q| q.is_finite()).unwrap_or(0.0);
        let mut mean = Vector3::new(first, 0.0, 0.0);
        let mut covariance = Matrix3::from_diagonal(&Vector3::new(1.0, START[0] * START[0], START[1] * START[1]));
        let (mut beliefs, mut likelihood) = (Vec::with_capacity(self.q.len()), 0.0);
        for row in 0..self.q.len() {
            if row > 0 {
                let (turn, spread) = motion(self.t[row] - self.t[row - 1], intensity);
                mean = turn * mean;
                covariance = turn * covariance * turn.transpose() + spread;
            }
            let before = (mean, covariance);
            for (index, reading) in
                [self.q[row], self.dq[row]].into_iter().enumerate().filter(|(_, one)| one.is_finite())
            {
                let innovation = covariance[(index, index)] + self.variance[index];
                let gain = covariance.column(index) / innovation;
                let error = reading - mean[index];
                mean += gain * error;
                covariance -= gain * covariance.row(index);
                likelihood -= 0.5 * (error * error / innovation + innovation.ln());
            }
            beliefs.push([before, (mean, covariance)]);
        }
        (beliefs, likelihood)
    }

    /// Returns position, velocity and acceleration of each row, given all readings.
    fn smoothed(&self, intensity: f64) -> Vec<Vector3<f64>> {
        let (beliefs, _) = self.filtered(intensity);
        let mut states: Vec<Vector3<f64>> = beliefs.iter().map(|[_, (mean, _)]| *mean).collect();
        for row in (0..states.len().saturating_sub(1)).rev() {
            let (turn, _) = motion(self.t[row + 1] - self.t[row], intensity);
            let ([_, (mean, covariance)], [(predicted, spread), _]) = (beliefs[row], beliefs[row + 1]);
            let Some(inverse) = spread.try_inverse() else { continue };
            states[row] = mean + covariance * turn.transpose() * inverse * (states[row + 1] - predicted);
        }
        states
    }
}

/// Returns the transition of position, velocity and acceleration in a time, and the covariance that white jerk adds.
fn motion(dt: f64, intensity: f64) -> (Matrix3<f64>, Matrix3<f64>) {
    let turn = Matrix3::new(1.0, dt, 0.5 * dt * dt, 0.0, 1.0, dt, 0.0, 0.0, 1.0);
    let [a, b, c, d, e] = [dt.powi(5) / 20.0, dt.powi(4) / 8.0, dt.powi(3) / 6.0, dt.powi(3) / 3.0, dt * dt / 2.0];
    (turn, Matrix3::new(a, b, c, b, d, e, c, e, dt) * intensity)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the error of readings and of smoothed ones, relative to the noise of the readings, at 200 Hz.
    fn errors(frequency: f64, noise: [f64; 2]) -> [f64; 2] {
        let mut seed = 7_u64;
        let mut normal = || {
            let mut uniform = || {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (seed >> 11) as f64 / (1_u64 << 53) as f64
            };
            (0..12).map(|_| uniform()).sum::<f64>() - 6.0
        };
        let t: Vec<f64> = (0..2000).map(|row| 0.005 * f64::from(row)).collect();
        let turn = std::f64::consts::TAU * frequency;
        let truth = [
            t.iter().map(|t| 0.3 * (turn * t).sin()).collect::<Vec<_>>(),
            t.iter().map(|t| 0.3 * turn * (turn * t).cos()).collect(),
        ];
        let mut read =
            |index: usize| -> Vec<f64> { truth[index].iter().map(|value| value + noise[index] * normal()).collect() };
        let readings = [read(0), read(1)];
        let smooth = smoothed(&t, [&readings[0], &readings[1]], noise, &[0..900, 900..t.len()]);
        [0, 1].map(|index| {
            let squares = smooth[index].iter().zip(&truth[index]).map(|(one, other)| (one - other).powi(2));
            (squares.sum::<f64>() / t.len() as f64).sqrt() / noise[index]
        })
    }

    #[test]
    fn slow_motions_lose_most_of_their_noise_and_fast_ones_keep_their_size() {
        let slow = errors(1.0, [1e-3, 0.05]);
        assert!(slow[0] < 0.5 && slow[1] < 0.5, "{slow:?}");
        // A parabola through seven rows takes 0.85 % of such a motion away: 1.8 times the noise of the position.
        let fast = errors(12.0, [1e-3, 0.05]);
        assert!(fast[0] < 1.0 && fast[1] < 1.5, "{fast:?}");
    }
}
