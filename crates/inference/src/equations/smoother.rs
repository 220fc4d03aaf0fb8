//! Positions and velocities of a joint with less noise, by the smoother of a motion whose jerk is white (Rauch, Tung and Striebel 1965).
//!
//! The noise of the readings and the intensity of the jerk in each block of rows are those of highest likelihood. What a log states of its
//! noise, or what is usual, is where their search begins: a drive that filters or differentiates has another noise of velocity.
//!
//! The error of a smoothed motion is not correlated with it, so that it may be in a residual and in its columns.

use std::ops::Range;

use nalgebra::{Matrix3, Vector3};

/// Intensities of the jerk that are compared [rad²/s⁵]: from a joint at rest to impacts.
const INTENSITIES: [f64; 9] = [1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8];
/// Noise of the readings that is compared, relative to the usual one, where the log states none.
const NOISES: [f64; 5] = [0.3, 1.0, 3.0, 10.0, 30.0];
/// The same relative to what the log states. White jerk is not the law of a motion with impacts, which would pass for noise.
const NEAR: [f64; 3] = [0.6, 1.0, 1.6];
/// Rows of a block, and most rows with which noises are compared.
const BLOCK: usize = 250;
const MOST_ROWS: usize = 5000;
/// Standard deviations of velocity [rad/s] and acceleration [rad/s²] before the first row: nothing is known.
const START: [f64; 2] = [10.0, 1000.0];

/// How a joint moves, and how it is measured.
struct Model<'a> {
    /// Intensity of the jerk in each block [rad²/s⁵]; that of the last holds for all that follow.
    intensities: &'a [f64],
    /// Variances of the readings of position and velocity.
    variance: [f64; 2],
}

impl Model<'_> {
    /// Returns the intensity of the jerk before a row.
    fn intensity(&self, row: usize) -> f64 {
        self.intensities[(row / BLOCK).min(self.intensities.len() - 1)]
    }
}

/// Readings of a joint in one contiguous range.
#[derive(Clone, Copy)]
struct Readings<'a> {
    t: &'a [f64],
    q: &'a [f64],
    dq: &'a [f64],
}

/// Returns positions [rad] and velocities [rad/s] without most of their noise, given that of the readings, and whether the log states it.
pub fn smoothed(t: &[f64], [q, dq]: [&[f64]; 2], noise: [(f64, bool); 2], ranges: &[Range<usize>]) -> [Vec<f64>; 2] {
    let part = |range: &Range<usize>| {
        let [t, q, dq] = [t, q, dq].map(|series| &series[range.clone()]);
        Readings { t, q, dq }
    };
    let variance = likeliest_noise(&ranges.iter().map(part).collect::<Vec<_>>(), noise);
    let mut smooth = [q.to_vec(), dq.to_vec()];
    for range in ranges {
        let intensities: Vec<f64> = part(range).blocks().map(|block| block.likeliest_motion(variance).1).collect();
        let model = Model { intensities: &intensities, variance };
        for (row, state) in range.clone().zip(part(range).smoothed(&model)) {
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

/// Returns the variances of the readings of highest likelihood, from some blocks.
fn likeliest_noise(parts: &[Readings], noise: [(f64, bool); 2]) -> [f64; 2] {
    let blocks: Vec<Readings> = parts.iter().flat_map(Readings::blocks).collect();
    let step = (blocks.len() * BLOCK).div_ceil(MOST_ROWS).max(1);
    let likelihood =
        |variance: [f64; 2]| blocks.iter().step_by(step).map(|block| block.likeliest_motion(variance).0).sum::<f64>();
    let [of_q, of_dq] = noise.map(|(noise, is_stated)| {
        let relative: &[f64] = if is_stated { &NEAR } else { &NOISES };
        relative.iter().map(|relative| (relative * noise).powi(2)).collect::<Vec<f64>>()
    });
    let variances = of_q.iter().flat_map(|q| of_dq.iter().map(|dq| [*q, *dq]));
    let scored = variances.map(|variance| (likelihood(variance), variance));
    scored.max_by(|one, other| one.0.total_cmp(&other.0)).expect("some variances").1
}

/// Mean and covariance of position, velocity and acceleration.
type Belief = (Vector3<f64>, Matrix3<f64>);

impl<'a> Readings<'a> {
    fn blocks(&self) -> impl Iterator<Item = Readings<'a>> + use<'a> {
        let cells = self.t.chunks(BLOCK).zip(self.q.chunks(BLOCK)).zip(self.dq.chunks(BLOCK));
        cells.map(|((t, q), dq)| Readings { t, q, dq })
    }

    /// Returns the highest log-likelihood over the intensities of the jerk, and that intensity.
    fn likeliest_motion(&self, variance: [f64; 2]) -> (f64, f64) {
        let of = |intensity: f64| (self.filtered(&Model { intensities: &[intensity], variance }).1, intensity);
        let scored = INTENSITIES.into_iter().map(of);
        scored.max_by(|one, other| one.0.total_cmp(&other.0)).expect("some intensities")
    }

    /// Returns the beliefs before and after the readings of each row, and the log-likelihood.
    fn filtered(&self, model: &Model) -> (Vec<[Belief; 2]>, f64) {
        let first = self.q.iter().copied().find(|q| q.is_finite()).unwrap_or(0.0);
        let mut mean = Vector3::new(first, 0.0, 0.0);
        let mut covariance = Matrix3::from_diagonal(&Vector3::new(1.0, START[0] * START[0], START[1] * START[1]));
        let (mut beliefs, mut likelihood) = (Vec::with_capacity(self.q.len()), 0.0);
        for row in 0..self.q.len() {
            if row > 0 {
                let (turn, spread) = motion(self.t[row] - self.t[row - 1], model.intensity(row));
                mean = turn * mean;
                covariance = turn * covariance * turn.transpose() + spread;
            }
            let before = (mean, covariance);
            for (index, reading) in
                [self.q[row], self.dq[row]].into_iter().enumerate().filter(|(_, one)| one.is_finite())
            {
                let innovation = covariance[(index, index)] + model.variance[index];
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
    fn smoothed(&self, model: &Model) -> Vec<Vector3<f64>> {
        let (beliefs, _) = self.filtered(model);
        let mut states: Vec<Vector3<f64>> = beliefs.iter().map(|[_, (mean, _)]| *mean).collect();
        for row in (0..states.len().saturating_sub(1)).rev() {
            let (turn, _) = motion(self.t[row + 1] - self.t[row], model.intensity(row + 1));
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

    /// Returns the errors of smoothed readings relative to their noise, at a rate, given the noise that the log states.
    fn errors(frequency: f64, noise: [f64; 2], stated: Option<[f64; 2]>, rate_hz: f64) -> [f64; 2] {
        let mut seed = 7_u64;
        let mut normal = || {
            let mut uniform = || {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                (seed >> 11) as f64 / (1_u64 << 53) as f64
            };
            (0..12).map(|_| uniform()).sum::<f64>() - 6.0
        };
        let t: Vec<f64> = (0..2000).map(|row| f64::from(row) / rate_hz).collect();
        let turn = std::f64::consts::TAU * frequency;
        let truth = [
            t.iter().map(|t| 0.3 * (turn * t).sin()).collect::<Vec<_>>(),
            t.iter().map(|t| 0.3 * turn * (turn * t).cos()).collect(),
        ];
        let mut read =
            |index: usize| -> Vec<f64> { truth[index].iter().map(|value| value + noise[index] * normal()).collect() };
        let readings = [read(0), read(1)];
        let given = stated.map_or([(1e-4, false), (0.01, false)], |stated| stated.map(|noise| (noise, true)));
        let smooth = smoothed(&t, [&readings[0], &readings[1]], given, &[0..900, 900..t.len()]);
        [0, 1].map(|index| {
            let squares = smooth[index].iter().zip(&truth[index]).map(|(one, other)| (one - other).powi(2));
            (squares.sum::<f64>() / t.len() as f64).sqrt() / noise[index]
        })
    }

    #[test]
    fn slow_motions_lose_most_of_their_noise_and_fast_ones_keep_their_size() {
        let noise = [1e-3, 0.05];
        let slow = errors(1.0, noise, Some(noise), 200.0);
        assert!(slow[0] < 0.5 && slow[1] < 0.5, "{slow:?}");
        // A parabola through seven rows takes 0.85 % of such a motion away: 1.8 times the noise of the position.
        let fast = errors(12.0, noise, Some(noise), 200.0);
        assert!(fast[0] < 1.0 && fast[1] < 1.5, "{fast:?}");
        let quick = errors(3.0, noise, Some(noise), 4000.0);
        assert!(quick[0] < 0.3 && quick[1] < 0.3, "{quick:?}");
    }

    #[test]
    fn noise_that_a_log_does_not_state_is_found() {
        for noise in [[1e-4, 0.3], [3e-3, 0.01], [2e-3, 0.2]] {
            let smooth = errors(1.0, noise, None, 500.0);
            assert!(smooth[0] < 0.9 && smooth[1] < 0.9, "{noise:?}: {smooth:?}");
        }
    }
}
