//! Scan for torque ripple: the number of cycles, amplitude and phase that explain most of the position errors.
//!
//! A ripple with many cycles is stiffer than the loop of its joint: the simulated joint rests at another angle than the measured
//! one, and a simulation of nearly the true ripple gains nothing. Here the ripple's torque follows from the measured position.
//! The position error is the response of the loop to this torque, which is linear in the sine and cosine of the phase.

use std::f64::consts::TAU;

use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use twinstep_dynamics::quadruped::{KinematicTree, mass_matrix};
use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_identify::experiment::ResidualChannel;
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, Joint, NUM_JOINTS, RobotModel, Rollout};

use super::hypothesis::{Hypothesis, OF_ONE_EFFECT, ScoredHypothesis, selection_penalty};
use super::residual_data::ResidualData;
use super::residual_rows::MODEL_ERROR_RAD;

/// The effect that is scanned here.
pub const EFFECT: &str = "torque_ripple";
/// Numbers of cycles per revolution. Joints move within 0.6 rad of their mean position, so the phase error is at most 0.3 rad.
const FIRST_CYCLES: usize = 6;
const NUM_CYCLES: usize = 145;
/// Least number of periods within the motion of one of its joints: a part of one may be any constant torque or spring.
const LEAST_PERIODS: f64 = 1.5;
/// Longest time step of the loop's response [s].
const TIME_STEP: f64 = 0.00125;
/// Standard deviation of the sine and cosine amplitudes: half the prior range [N·m].
const AMPLITUDE_STD: f64 = 0.2;

/// Returns true for other effects, and for a ripple with [`LEAST_PERIODS`] periods within the motion of one of its joints.
pub fn repeats(logs: &[Log], hypothesis: &Hypothesis) -> bool {
    let joints = Joint::ALL.into_iter().filter(|joint| hypothesis.scope.contains(*joint)).map(Joint::index);
    hypothesis.effect.name != EFFECT || hypothesis.values[1] >= least_cycles(logs, joints)
}

/// Returns the number of cycles per revolution with [`LEAST_PERIODS`] periods within the widest motion of these joints.
fn least_cycles(logs: &[Log], joints: impl Iterator<Item = usize>) -> f64 {
    let range = |joint: usize| {
        let q = logs.iter().filter_map(|log| log.q(JOINT_NAMES[joint])).flatten();
        let [low, high] =
            q.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], q| [f64::min(low, *q), f64::max(high, *q)]);
        high - low
    };
    // The range of a joint that is in no log is not finite.
    LEAST_PERIODS * TAU / joints.map(range).filter(|range| range.is_finite()).fold(0.0, f64::max)
}

/// Scans the rows with a fixed base, if there are any. Returns the best hypotheses with the best first.
pub fn scan_ripples(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> Vec<ScoredHypothesis> {
    let (Some(effect), Ok(robot)) = (Effect::named(EFFECT), model.robot_model()) else { return Vec::new() };
    let rows = evidence.fixed_base_rows().or((!evidence.has_free_parts()).then_some(&evidence.fit_rows));
    let Some(rows) = rows.filter(|_| evidence.has_required_torque(effect)) else { return Vec::new() };
    let mut sums = vec![JointSums::default(); NUM_JOINTS];
    for ((log, split), experiment) in evidence.logs().iter().zip(evidence.splits()).zip(&rows.experiments) {
        let (errors, starts) = (experiment.position_errors(simulator, &robot), experiment.window_starts());
        let of_joint = |(joint, sums): (usize, &mut JointSums)| {
            let Some(motion) = Motion::new(log, &robot, joint) else { return };
            // The error is that of the simulation; the ripple is the robot's.
            let measured = errors[joint].iter().filter_map(|(row, error)| Some((*row, split.fold(*row)?, -error)));
            let sigma = experiment.sigma(ResidualChannel::Position(joint)).hypot(MODEL_ERROR_RAD);
            sums.add(&motion, &starts, measured.filter(|(_, _, error)| error.is_finite()), sigma);
        };
        sums.par_iter_mut().enumerate().for_each(|(joint, sums)| of_joint((joint, sums)));
    }
    let length = |joint: usize| evidence.correlation_rows(joint);
    let mut scored: Vec<ScoredHypothesis> = Scope::of_joints()
        .into_par_iter()
        .filter_map(|scope| {
            let joints = Joint::ALL.into_iter().filter(|joint| scope.contains(*joint));
            let joints: Vec<usize> = joints.map(Joint::index).collect();
            // A joint has one ripple.
            if joints.iter().any(|joint| robot.joints[*joint].actuator.ripple.amplitude > 0.0) {
                return None;
            }
            let least = least_cycles(evidence.logs(), joints.iter().copied());
            let (score, values) = best_ripple(&sums, &joints, least, &length)?;
            let hypothesis = Hypothesis { effect, scope, values };
            Some(ScoredHypothesis { hypothesis, score: score - selection_penalty(scope) })
        })
        .collect();
    scored.retain(|scored| scored.score.is_finite());
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

    /// Advances the responses from a row to the next.
    fn advance(&self, responses: &mut [Response], row: usize) {
        let steps = (self.period / TIME_STEP).ceil().max(1.0);
        let [from, to] = [self.q[row], self.q[row + 1]];
        let loop_gains = [self.kp[row], self.kd[row]].map(|gain| gain / self.inertia);
        for step in 0..steps as usize {
            let q = from + (step as f64 + 0.5) / steps * (to - from);
            advance(responses, q, loop_gains, self.inertia, self.period / steps);
        }
    }
}

/// Sums over the rows of a fold: products of the responses to sine and cosine, and of these with the error, in units of the
/// variance of noise and model error.
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
    /// Adds rows, each with its fold and position error [rad]. As the simulation, the response starts at rest in the first row of
    /// each window. Rows after a row without position gain are left out until the next window.
    fn add(&mut self, motion: &Motion, starts: &[usize], rows: impl Iterator<Item = (usize, usize, f64)>, sigma: f64) {
        let mut responses = vec![Response::default(); NUM_CYCLES];
        let (mut window, mut last, mut is_held) = (usize::MAX, 0, true);
        for (row, fold, error) in rows {
            let start = starts[..starts.partition_point(|start| *start < row)].last().copied().unwrap_or(row);
            if start != window {
                responses.fill(Response::default());
                (window, last, is_held) = (start, start, true);
            }
            is_held &= motion.kp[last..row].iter().all(|kp| *kp > 0.0);
            if !is_held {
                continue;
            }
            (last..row).for_each(|row| motion.advance(&mut responses, row));
            last = row;
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
    fn gain(&self, cycles: usize, fold: usize, ripple: &Vector2<f64>, length: f64) -> f64 {
        let Sums { products, cross } = &self.of_cycles[cycles][fold];
        let [count, before] = self.before[fold];
        let after = before - 2.0 * ripple.dot(cross) + ripple.dot(&(products * ripple));
        if count > 0.0 { 0.5 * count / length * ((before + 1e-9) / (after.max(0.0) + 1e-9)).ln() } else { 0.0 }
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
    least_cycles: f64,
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
        joints.iter().map(|joint| sums[*joint].gain(cycles, fold, ripple, length(*joint))).sum()
    };
    let best = |folds: &[usize]| {
        let periodic = (0..NUM_CYCLES).filter(|cycles| (FIRST_CYCLES + cycles) as f64 >= least_cycles);
        let ripples = periodic.filter_map(|cycles| Some((cycles, fitted(cycles, folds)?)));
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
    use twinstep_model::{BaseMount, Leg};

    use super::*;

    const RATE: f64 = 500.0;
    const INERTIA: f64 = 0.03;
    const GAINS: [f64; 2] = [25.0, 0.6];
    const NOISE: f64 = 0.001;

    /// Rows of a window, and those before the first that is compared.
    const WINDOW: usize = 1000;
    const SETTLING: usize = 100;

    /// Returns positions [rad] and velocities [rad/s] of a joint with a ripple by row, from its state in the row `first`.
    fn states([amplitude, cycles, phase]: [f64; 3], first: usize, state: [f64; 2], rows: usize) -> Vec<[f64; 2]> {
        let ([mut q, mut dq], dt) = (state, 0.1 / RATE);
        let step = |step: usize| {
            let state = [q, dq];
            let target = -1.8 + 0.5 * (2.0 * (10 * first + step) as f64 * dt).sin();
            let torque = GAINS[0] * (target - q) - GAINS[1] * dq + amplitude * (cycles * q + phase).sin();
            dq += dt * torque / INERTIA;
            q += dt * dq;
            state
        };
        (0..10 * rows).map(step).collect::<Vec<_>>().into_iter().step_by(10).collect()
    }

    /// Scans 12 s of a joint with this ripple, in windows that are simulated from their first measured state.
    fn found(ripple: [f64; 3]) -> (f64, Vec<f64>) {
        let rows = 6 * WINDOW;
        let noise = |row: usize| 3.46 * NOISE * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
        let truth = states(ripple, 0, [-1.8, 0.0], rows);
        let measured: Vec<f64> = truth.iter().enumerate().map(|(row, [q, _])| q + noise(row)).collect();
        let starts: Vec<usize> = (0..rows).step_by(WINDOW).collect();
        let simulated = starts.iter().flat_map(|start| states([0.0; 3], *start, truth[*start], WINDOW));
        let errors: Vec<f64> = measured.iter().zip(simulated).map(|(measured, [q, _])| measured - q).collect();
        let [kp, kd] = GAINS.map(|gain| vec![gain; rows]);
        let motion = Motion { q: measured, kp, kd, inertia: INERTIA, period: 1.0 / RATE };
        let compared = errors.iter().enumerate().filter(|(row, _)| row % WINDOW >= SETTLING);
        let mut sums = JointSums::default();
        sums.add(&motion, &starts, compared.map(|(row, error)| (row, row / WINDOW % 2, *error)), NOISE);
        best_ripple(&[sums], &[0], 6.0, &|_| 0.2 * RATE).expect("a ripple")
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

    #[test]
    fn part_of_a_period_is_no_ripple() {
        let log = crate::test_data::data(|_| 0.4, None).logs()[0].clone();
        let effect = Effect::named(EFFECT).expect("in the catalogue");
        let ripple = |cycles| Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.3, cycles, 0.0] };
        // The joint moves within 0.04 rad and noise.
        assert!(!repeats(std::slice::from_ref(&log), &ripple(100.0)));
        assert!(repeats(std::slice::from_ref(&log), &ripple(300.0)));
        // The calf moves twice as far as the hip. A ripple of the leg repeats if it does at one of its joints.
        let coupled = crate::test_data::coupled_with_calf_friction(BaseMount::Fixed, 3.0);
        let calf = coupled.logs()[0].q("FL_calf").expect("a joint of the log");
        let range =
            calf.iter().fold(f64::MIN, |most, q| most.max(*q)) - calf.iter().fold(f64::MAX, |least, q| least.min(*q));
        let cycles = 1.4 * LEAST_PERIODS * TAU / range;
        assert!(!repeats(coupled.logs(), &ripple(cycles)));
        assert!(repeats(coupled.logs(), &Hypothesis { scope: Scope::Leg(Leg::FL), ..ripple(cycles) }));
        // The log has no other joint.
        let of_all = Hypothesis { scope: Scope::All, ..ripple(300.0) };
        assert!(repeats(std::slice::from_ref(&log), &of_all));
    }
}
