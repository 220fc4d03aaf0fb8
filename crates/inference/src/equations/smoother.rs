//! Positions and velocities of a joint with less noise, by the smoother of a motion whose jerk is white (de Jong 1989).
//!
//! The noise of the readings and the intensity of the jerk in each block of rows are those of highest likelihood. What a log states of its
//! noise, or what is usual, is where their search begins: a drive that filters or differentiates has another noise of velocity.
//!
//! Impacts are few rows of far more jerk than the rows around. Therefore the jerk of a row has Student's t-distribution, and with it an intensity of
//! its own, by expectation maximisation (Lange, Little and Taylor 1989).
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
/// Degrees of freedom of the jerk, and steps in which the intensities of rows are found. Twice the freedom, or three times the steps, changes the
/// evidence of a walk by 0.4 %, and none of its causes.
const FREEDOM: f64 = 1.0;
const STEPS: usize = 5;
/// Rows of a block, and most rows with which noises are compared.
const BLOCK: usize = 250;
const MOST_ROWS: usize = 5000;
/// Standard deviations of velocity [rad/s] and acceleration [rad/s²] before the first row: nothing is known.
const START: [f64; 2] = [10.0, 1000.0];

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
        for (row, state) in range.clone().zip(part(range).smoothed(variance)) {
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

/// Position, velocity and acceleration of a row, given the readings before, and what its readings change.
struct Prediction {
    mean: Vector3<f64>,
    covariance: Matrix3<f64>,
    updates: [Option<Update>; 2],
}

/// Change by the reading of a position or velocity.
#[derive(Clone, Copy)]
struct Update {
    gain: Vector3<f64>,
    /// The reading minus its prediction, and the variance of that.
    error: f64,
    variance: f64,
}

impl<'a> Readings<'a> {
    fn blocks(&self) -> impl Iterator<Item = Readings<'a>> + use<'a> {
        let cells = self.t.chunks(BLOCK).zip(self.q.chunks(BLOCK)).zip(self.dq.chunks(BLOCK));
        cells.map(|((t, q), dq)| Readings { t, q, dq })
    }

    /// Returns the highest log-likelihood over the intensities of the jerk, and that intensity.
    fn likeliest_motion(&self, variance: [f64; 2]) -> (f64, f64) {
        let of = |intensity: f64| (self.filtered(|_| intensity, variance).1, intensity);
        let scored = INTENSITIES.into_iter().map(of);
        scored.max_by(|one, other| one.0.total_cmp(&other.0)).expect("some intensities")
    }

    /// Returns position, velocity and acceleration of each row, given all readings with these variances.
    fn smoothed(&self, variance: [f64; 2]) -> Vec<Vector3<f64>> {
        let mut of_blocks: Vec<f64> = self.blocks().map(|block| block.likeliest_motion(variance).1).collect();
        let mut relative = vec![1.0; self.t.len()];
        for _ in 0..STEPS {
            let (_, sizes) = self.smoothed_with(|row| of_blocks[row / BLOCK] * relative[row], variance);
            for (block, intensity) in of_blocks.iter_mut().enumerate() {
                let rows = block * BLOCK..((block + 1) * BLOCK).min(sizes.len());
                let mut sum = 0.0;
                for row in rows.clone() {
                    let size = sizes[row] * relative[row];
                    let weight = (FREEDOM + 3.0) / (FREEDOM + size);
                    sum += weight * size;
                    relative[row] = 1.0 / weight;
                }
                *intensity *= sum / (3.0 * rows.len() as f64);
            }
        }
        self.smoothed_with(|row| of_blocks[row / BLOCK] * relative[row], variance).0
    }

    /// Returns the predictions of each row, and the log-likelihood of the readings, given the intensity of the jerk before each row [rad²/s⁵].
    fn filtered(&self, intensity: impl Fn(usize) -> f64, variance: [f64; 2]) -> (Vec<Prediction>, f64) {
        let first = self.q.iter().copied().find(|q| q.is_finite()).unwrap_or(0.0);
        let mut mean = Vector3::new(first, 0.0, 0.0);
        let mut covariance = Matrix3::from_diagonal(&Vector3::new(1.0, START[0] * START[0], START[1] * START[1]));
        let (mut predictions, mut likelihood) = (Vec::with_capacity(self.q.len()), 0.0);
        for row in 0..self.q.len() {
            if row > 0 {
                let (turn, spread) = motion(self.t[row] - self.t[row - 1], intensity(row));
                mean = turn * mean;
                covariance = turn * covariance * turn.transpose() + spread;
            }
            let mut prediction = Prediction { mean, covariance, updates: [None; 2] };
            let readings = [self.q[row], self.dq[row]];
            for (index, reading) in readings.into_iter().enumerate().filter(|(_, one)| one.is_finite()) {
                let of_error = covariance[(index, index)] + variance[index];
                let gain = covariance.column(index) / of_error;
                let error = reading - mean[index];
                mean += gain * error;
                covariance -= gain * covariance.row(index);
                likelihood -= 0.5 * (error * error / of_error + of_error.ln());
                prediction.updates[index] = Some(Update { gain, error, variance: of_error });
            }
            predictions.push(prediction);
        }
        (predictions, likelihood)
    }

    /// Returns position, velocity and acceleration of each row, given all readings, and the expected square of the jerk before it, relative to
    /// its covariance.
    fn smoothed_with(&self, intensity: impl Fn(usize) -> f64, variance: [f64; 2]) -> (Vec<Vector3<f64>>, Vec<f64>) {
        let (predictions, _) = self.filtered(&intensity, variance);
        let (mut states, mut sizes) = (vec![Vector3::zeros(); predictions.len()], vec![3.0; predictions.len()]);
        // What the readings from a row on say of its prediction: in units of its inverse covariance, and the covariance of that.
        let (mut pull, mut certainty) = (Vector3::zeros(), Matrix3::zeros());
        for (row, prediction) in predictions.iter().enumerate().rev() {
            for (index, update) in prediction.updates.iter().enumerate().rev() {
                let Some(update) = update else { continue };
                let mut rest = Matrix3::identity();
                rest.column_mut(index).axpy(-1.0, &update.gain, 1.0);
                pull = rest.transpose() * pull;
                pull[index] += update.error / update.variance;
                certainty = rest.transpose() * certainty * rest;
                certainty[(index, index)] += 1.0 / update.variance;
            }
            states[row] = prediction.mean + prediction.covariance * pull;
            if row > 0 {
                let (turn, spread) = motion(self.t[row] - self.t[row - 1], intensity(row));
                sizes[row] = pull.dot(&(spread * pull)) + 3.0 - (certainty * spread).trace();
                pull = turn.transpose() * pull;
                certainty = turn.transpose() * certainty * turn;
            }
        }
        (states, sizes)
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
    use twinstep_model::{standard_normal, stream};

    use super::*;

    /// Returns the errors of smoothed readings of a motion relative to their noise, at a rate, given the noise that the log states.
    ///
    /// `truth` returns position and velocity at a time.
    fn errors(truth: impl Fn(f64) -> [f64; 2], noise: [f64; 2], stated: Option<[f64; 2]>, rate_hz: f64) -> [f64; 2] {
        let mut random = stream(7, "reading noise", 0);
        let t: Vec<f64> = (0..2000).map(|row| f64::from(row) / rate_hz).collect();
        let truth = [0, 1].map(|index| t.iter().map(|t| truth(*t)[index]).collect::<Vec<f64>>());
        let mut read = |index: usize| -> Vec<f64> {
            truth[index].iter().map(|value| value + noise[index] * standard_normal(&mut random)).collect()
        };
        let readings = [read(0), read(1)];
        let given = stated.map_or([(1e-4, false), (0.01, false)], |stated| stated.map(|noise| (noise, true)));
        let smooth = smoothed(&t, [&readings[0], &readings[1]], given, &[0..900, 900..t.len()]);
        [0, 1].map(|index| {
            let squares = smooth[index].iter().zip(&truth[index]).map(|(one, other)| (one - other).powi(2));
            (squares.sum::<f64>() / t.len() as f64).sqrt() / noise[index]
        })
    }

    /// Returns position and velocity of a sine with a frequency [Hz].
    fn sine(frequency: f64) -> impl Fn(f64) -> [f64; 2] {
        let turn = std::f64::consts::TAU * frequency;
        move |t| [0.3 * (turn * t).sin(), 0.3 * turn * (turn * t).cos()]
    }

    #[test]
    fn slow_motions_lose_most_of_their_noise_and_fast_ones_keep_their_size() {
        let noise = [1e-3, 0.05];
        let slow = errors(sine(1.0), noise, Some(noise), 200.0);
        assert!(slow[0] < 0.5 && slow[1] < 0.5, "{slow:?}");
        // A parabola through seven rows takes 0.85 % of such a motion away: 1.8 times the noise of the position.
        let fast = errors(sine(12.0), noise, Some(noise), 200.0);
        assert!(fast[0] < 1.0 && fast[1] < 1.5, "{fast:?}");
        let quick = errors(sine(3.0), noise, Some(noise), 4000.0);
        assert!(quick[0] < 0.3 && quick[1] < 0.3, "{quick:?}");
    }

    #[test]
    fn noise_that_a_log_does_not_state_is_found() {
        for noise in [[1e-4, 0.3], [3e-3, 0.01], [2e-3, 0.2]] {
            let smooth = errors(sine(1.0), noise, None, 500.0);
            assert!(smooth[0] < 0.9 && smooth[1] < 0.9, "{noise:?}: {smooth:?}");
        }
    }

    /// The velocity of a joint jumps whenever its foot touches down.
    #[test]
    fn impacts_are_kept_and_the_motion_between_them_loses_its_noise() {
        let bounces = |t: f64| {
            let [period, speed] = [0.3, 2.0];
            let phase = (t / period).rem_euclid(1.0) - 0.5;
            [speed * period * (0.25 - phase * phase) / 2.0, -speed * phase]
        };
        let noise = [5e-4, 0.02];
        let [position, _] = errors(bounces, noise, Some(noise), 500.0);
        // With one intensity for all rows it is 0.64.
        assert!(position < 0.45, "{position}");
    }
}
