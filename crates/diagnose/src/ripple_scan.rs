//! Scan for torque ripple: the number of cycles, amplitude and phase that explain most of the position errors.
//!
//! A ripple with many cycles is stiffer than the loop of its joint: the simulated joint rests at another angle than the measured
//! one, and a simulation of nearly the true ripple gains nothing. Here the ripple's torque follows from the measured position.
//! The position error is the response of the loop to this torque, which is linear in the sine and cosine of the phase.

use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_logs::Log;
use twinstep_model::dynamics::{KinematicTree, mass_matrix};
use twinstep_model::{JOINT_NAMES, Joint, NUM_JOINTS, RobotModel, Rollout};

use super::hypothesis::{Hypothesis, selection_penalty};
use super::residual_data::ResidualData;
use super::residual_power::log_likelihood_gain;
use super::scan::{OF_ONE_EFFECT, ScoredHypothesis};

/// The effect that is scanned here.
pub const EFFECT: &str = "torque_ripple";
/// Numbers of cycles per revolution. Joints move within 0.6 rad of their mean position, so the phase error is at most 0.3 rad.
const FIRST_CYCLES: usize = 6;
const NUM_CYCLES: usize = 145;
/// Longest time step of the loop's response [s].
const TIME_STEP: f64 = 0.00125;
/// Standard deviation of the sine and cosine amplitudes: half the prior range [N·m].
const AMPLITUDE_STD: f64 = 0.2;

/// Scans the rows with a fixed base, or all if there are none. Returns the best hypotheses with the best first.
pub fn scan_ripples(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> Vec<ScoredHypothesis> {
    let (Some(effect), Ok(robot)) = (Effect::named(EFFECT), model.robot_model()) else { return Vec::new() };
    if !evidence.has_required_torque(effect) {
        return Vec::new();
    }
    let rows = evidence.fixed_base_rows().unwrap_or(&evidence.fit_rows);
    let mut sums = vec![JointSums::default(); NUM_JOINTS];
    for ((log, split), experiment) in evidence.logs().iter().zip(evidence.splits()).zip(&rows.experiments) {
        let errors = experiment.position_errors(simulator, &robot);
        let of_joint = |(joint, sums): (usize, &mut JointSums)| {
            let Some(motion) = Motion::new(log, &robot, joint) else { return };
            // The error is that of the simulation; the ripple is the robot's.
            let measured = errors[joint].iter().filter_map(|(row, error)| Some((*row, split.fold(*row)?, -error)));
            sums.add(&motion, measured, evidence.fit_rows.position_std(joint));
        };
        sums.par_iter_mut().enumerate().for_each(|(joint, sums)| of_joint((joint, sums)));
    }
    let length = |joint: usize| evidence.correlation_rows(joint);
    let mut scored: Vec<ScoredHypothesis> = Scope::of_joints()
        .into_par_iter()
        .filter_map(|scope| {
            let joints: Vec<usize> =
                Joint::ALL.into_iter().filter(|joint| scope.contains(*joint)).map(Joint::index).collect();
            let (score, values) = best_ripple(&sums, &joints, &length)?;
            let hypothesis = Hypothesis { effect, scope, values };
            Some(ScoredHypothesis { hypothesis, score: score - selection_penalty(scope) })
        })
        .collect();
    scored.sort_by(|one, other| other.score.total_cmp(&one.score));
    scored.truncate(OF_ONE_EFFECT);
    scored
}

/// Measured motion of a joint and the coefficients of its loop.
struct Motion {
    /// Joint position [rad], and gains [N·m/rad, N·m·s/rad], by row.
    q: Vec<f64>,
    kp: Vec<f64>,
    kd: Vec<f64>,
    /// Inertia about the joint axis [kg·m²].
    inertia: f64,
    /// Time between rows [s].
    period: f64,
}

impl Motion {
    /// Returns `None` if the log has no gains or positions of the joint.
    fn new(log: &Log, robot: &RobotModel, joint: usize) -> Option<Self> {
        let q = log.q(JOINT_NAMES[joint])?.to_vec();
        let [kp, kd] = log.gains(JOINT_NAMES[joint]);
        let matrix = mass_matrix(&KinematicTree::<f64>::splat(robot), &robot.control.default_pose);
        let damping = robot.joints[joint].viscous_friction;
        let kd = kd?.into_iter().map(|kd| kd + damping).collect();
        Some(Self { q, kp: kp?, kd, inertia: matrix[6 + joint][6 + joint], period: 1.0 / log.meta().rate_hz })
    }
}

/// Sums over the rows of a fold: products of the responses to sine and cosine, of these with the error, and the error's
/// square, in units of the variance of noise and model error.
#[derive(Clone, Copy, Default)]
struct Sums {
    products: Matrix2<f64>,
    cross: Vector2<f64>,
}

/// Sums of one joint by number of cycles and fold.
#[derive(Clone)]
struct JointSums {
    of_cycles: Vec<[Sums; 2]>,
    /// Number of rows and sum of squares of the errors, by fold.
    before: [[f64; 2]; 2],
}

impl Default for JointSums {
    fn default() -> Self {
        Self { of_cycles: vec![Default::default(); NUM_CYCLES], before: Default::default() }
    }
}

/// Response of a loop to a torque that is the sine or cosine of a phase.
#[derive(Clone, Copy, Default)]
struct Response {
    /// Position error [rad] and its rate [rad/s], for sine and cosine.
    x: Vector2<f64>,
    v: Vector2<f64>,
}

impl JointSums {
    /// Adds rows, each with its fold and position error [rad]. The response starts at rest wherever a row is missing.
    fn add(&mut self, motion: &Motion, rows: impl Iterator<Item = (usize, usize, f64)>, sigma: f64) {
        let steps = (motion.period / TIME_STEP).ceil().max(1.0);
        let dt = motion.period / steps;
        let mut responses = vec![Response::default(); NUM_CYCLES];
        let mut last = None;
        for (row, fold, error) in rows {
            match last {
                Some(last) if last + 1 == row => {
                    let [from, to] = [motion.q[last], motion.q[row]];
                    let loop_gains = [motion.kp[last], motion.kd[last]].map(|gain| gain / motion.inertia);
                    (0..steps as usize).for_each(|step| {
                        let q = from + (step as f64 + 0.5) / steps * (to - from);
                        advance(&mut responses, q, loop_gains, motion.inertia, dt);
                    });
                }
                _ => responses.fill(Response::default()),
            }
            last = Some(row);
            for (sums, response) in self.of_cycles.iter_mut().zip(&responses) {
                let x = response.x / sigma;
                sums[fold].products += x * x.transpose();
                sums[fold].cross += x * (error / sigma);
            }
            let [count, square] = &mut self.before[fold];
            *count += 1.0;
            *square += (error / sigma).powi(2);
        }
    }

    /// Returns the log-likelihood gain of a ripple in a fold [nat].
    fn gain(&self, cycles: usize, fold: usize, ripple: &Vector2<f64>, channel: usize, length: f64) -> f64 {
        let Sums { products, cross } = &self.of_cycles[cycles][fold];
        let after = self.before[fold][1] - 2.0 * ripple.dot(cross) + ripple.dot(&(products * ripple));
        log_likelihood_gain(channel, self.before[fold], after.max(0.0), length)
    }
}

/// Advances the responses of all numbers of cycles by one step at position `q`, with the loop's gains per inertia.
fn advance(responses: &mut [Response], q: f64, [kp, kd]: [f64; 2], inertia: f64, dt: f64) {
    let (turn_sine, turn_cosine) = q.sin_cos();
    let (mut sine, mut cosine) = (FIRST_CYCLES as f64 * q).sin_cos();
    let implicit = 1.0 / (1.0 + dt * kd + dt * dt * kp);
    for Response { x, v } in responses {
        let torque = Vector2::new(sine, cosine) / inertia;
        *v = (*v + dt * (torque - kp * *x)) * implicit;
        *x += dt * *v;
        (sine, cosine) = (sine * turn_cosine + cosine * turn_sine, cosine * turn_cosine - sine * turn_sine);
    }
}

/// Returns the score [nat] of the best ripple of these joints, selected and fitted on one fold and evaluated on the other, and its
/// values: amplitude [N·m], cycles per revolution, and phase [rad].
fn best_ripple(
    sums: &[JointSums],
    joints: &[usize],
    length: &(dyn Fn(usize) -> f64 + Sync),
) -> Option<(f64, Vec<f64>)> {
    let fitted = |cycles: usize, folds: &[usize]| -> Option<Vector2<f64>> {
        let mut products = Matrix2::identity() * (folds.len() as f64 / 2.0 / AMPLITUDE_STD.powi(2));
        let mut cross = Vector2::zeros();
        for (joint, fold) in joints.iter().flat_map(|joint| folds.iter().map(move |fold| (*joint, *fold))) {
            let [count, square] = sums[joint].before[fold];
            let variance = (square / f64::max(count, 1.0)).max(1.0);
            let of_fold = &sums[joint].of_cycles[cycles][fold];
            products += of_fold.products / variance;
            cross += of_fold.cross / variance;
        }
        Some(products.cholesky()?.solve(&cross))
    };
    let gain = |cycles: usize, fold: usize, ripple: &Vector2<f64>| -> f64 {
        joints.iter().map(|joint| sums[*joint].gain(cycles, fold, ripple, *joint, length(*joint))).sum()
    };
    let best = |folds: &[usize]| {
        let ripples = (0..NUM_CYCLES).filter_map(|cycles| Some((cycles, fitted(cycles, folds)?)));
        let gains = ripples
            .map(|(cycles, ripple)| (folds.iter().map(|fold| gain(cycles, *fold, &ripple)).sum(), cycles, ripple));
        gains.max_by(|one: &(f64, _, _), other| one.0.total_cmp(&other.0))
    };
    let (_, first, of_first) = best(&[0])?;
    let (_, second, of_second) = best(&[1])?;
    let (_, cycles, ripple) = best(&[0, 1])?;
    let values = vec![ripple.norm(), (FIRST_CYCLES + cycles) as f64, ripple[1].atan2(ripple[0])];
    Some((gain(first, 1, &of_first) + gain(second, 0, &of_second), values))
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f64 = 500.0;
    const INERTIA: f64 = 0.03;
    const GAINS: [f64; 2] = [25.0, 0.6];
    const NOISE: f64 = 0.001;

    /// Returns the positions of a joint with a ripple, at the rate of the log [rad].
    fn positions([amplitude, cycles, phase]: [f64; 3], rows: usize) -> Vec<f64> {
        let (mut q, mut dq, dt) = (-1.8, 0.0, 0.1 / RATE);
        let step = |step: usize| {
            let target = -1.8 + 0.5 * (2.0 * step as f64 * dt).sin();
            let torque = GAINS[0] * (target - q) - GAINS[1] * dq + amplitude * (cycles * q + phase).sin();
            dq += dt * torque / INERTIA;
            q += dt * dq;
            q
        };
        (0..10 * rows).map(step).collect::<Vec<f64>>().into_iter().step_by(10).collect()
    }

    fn found(ripple: [f64; 3]) -> (f64, Vec<f64>) {
        let rows = 6000;
        let noise = |row: usize| 3.46 * NOISE * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
        let measured: Vec<f64> = positions(ripple, rows).iter().enumerate().map(|(row, q)| q + noise(row)).collect();
        let errors: Vec<f64> = measured.iter().zip(positions([0.0; 3], rows)).map(|(one, other)| one - other).collect();
        let [kp, kd] = GAINS.map(|gain| vec![gain; rows]);
        let motion = Motion { q: measured, kp, kd, inertia: INERTIA, period: 1.0 / RATE };
        let mut sums = JointSums::default();
        sums.add(&motion, errors.iter().enumerate().map(|(row, error)| (row, row / 1000 % 2, *error)), NOISE);
        best_ripple(&[sums], &[0], &|_| 0.2 * RATE).expect("a ripple")
    }

    /// The stiffness of the ripple is 39 N·m/rad, that of the loop 25 N·m/rad.
    #[test]
    fn ripple_that_is_stiffer_than_the_loop_is_found_with_its_number_of_cycles_amplitude_and_phase() {
        for truth in [[0.36, 109.0, -2.6], [0.2, 42.0, 1.0], [0.1, 7.0, 3.0]] {
            let (score, values) = found(truth);
            assert!(score > 30.0, "{score} nat");
            assert!((values[1] - truth[1]).abs() <= 1.0, "{values:?} for {truth:?}");
            assert!((values[0] / truth[0] - 1.0).abs() < 0.3, "{values:?} for {truth:?}");
            let at_mean = (values[1] - truth[1]) * -1.8 + values[2] - truth[2];
            assert!(at_mean.cos() > 0.8, "{values:?} for {truth:?}");
        }
    }

    #[test]
    fn joint_without_ripple_has_none() {
        let (score, values) = found([0.0, 42.0, 0.0]);
        assert!(score < 5.0, "{score} nat, {values:?}");
    }
}
