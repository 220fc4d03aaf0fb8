//! Residuals of joints by the state of the joint, with their derivative by the size of a cause.

use twinstep_identify::torque::MeasuredTorque;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{JOINT_NAMES, Joint, NUM_JOINTS, RobotModel, Rollout};

use super::cross_validation::FitProblem;
use super::residual_data::{ResidualData, torque_sigma};
use super::residual_rows::PRECISION;

/// Number of states of a joint: velocity, speed, size of the position error, and commanded position.
pub const STATES: usize = 4;
/// Place of the velocity among the states.
pub const VELOCITY: usize = 0;
const SPEED: usize = 1;
/// Place of the size of the position error. It has the same noise as the residual of the position, which it does not divide.
const POSITION_ERROR: usize = 2;
/// Speed below which the torque at the output of a joint says nothing about its law: dry friction at rest has any size
/// [rad/s].
const LEAST_SPEED: f64 = 0.1;
/// Step of a size for the derivative of torques, relative to the size.
const STEP: f64 = 0.05;

/// Residual of a joint in one row.
pub struct Sample {
    /// Index of the joint.
    pub joint: usize,
    /// States of the joint; NaN where unknown.
    pub states: [f64; STATES],
    /// Residual, in units of noise and model error.
    pub residual: f64,
    /// Its derivative by the size of the cause, in units of this size.
    pub slope: f64,
}

/// States of each joint by row.
pub type JointStates = Vec<Vec<[f64; STATES]>>;

/// Returns the samples of positions with a fixed base of the joints in the scope of each parameter of a fit.
pub fn position_samples(
    fit: &FitProblem,
    evidence: &ResidualData,
    states: &[JointStates],
    simulator: &mut dyn Rollout,
) -> Vec<Vec<Sample>> {
    let here = fit.with_problem(&evidence.fit_rows, simulator, PRECISION, |task, simulator| {
        task.linearise(simulator, &fit.initial_point)
    });
    let Some(here) = here else { return fit.unknowns.iter().map(|_| Vec::new()).collect() };
    let rows = evidence.fit_rows.positions_in_air();
    let of_unknown = |index: usize| {
        let unknown = &fit.unknowns[index];
        let size = (fit.initial_point[index] - unknown.coordinate(unknown.neutral)) / unknown.prior[1];
        let sample = |&(residual, log, joint, row): &(usize, usize, usize, usize)| {
            let mut states = states[log][joint][row];
            states[POSITION_ERROR] = f64::NAN;
            let [residual, slope] = [here.residuals[residual], here.jacobian[(residual, index)] * size];
            Sample { joint, states, residual, slope }
        };
        let own = rows.iter().filter(|(_, _, joint, _)| unknown.scope.contains(Joint::ALL[*joint]));
        own.map(sample).collect()
    };
    (0..fit.unknowns.len()).map(of_unknown).collect()
}

/// Returns the samples of torques of the joints in the scope of one parameter of a fit; none if the sensors do not measure what
/// it changes.
pub fn torque_samples(fit: &FitProblem, index: usize, evidence: &ResidualData, states: &[JointStates]) -> Vec<Sample> {
    let (mut smaller, unknown) = (fit.initial_point.clone(), &fit.unknowns[index]);
    smaller[index] -= STEP * (smaller[index] - unknown.coordinate(unknown.neutral));
    let robot = |point: &[f64]| fit.model(point).robot_model().ok();
    let (Some(robot), Some(smaller)) = (robot(&fit.initial_point), robot(&smaller)) else { return Vec::new() };
    let of_log = |(number, torques): (usize, &MeasuredTorque)| {
        let mut samples = Vec::new();
        if torques.predict_same_torque(&robot, &smaller) {
            return samples;
        }
        let (log, split) = (&evidence.logs()[number], &evidence.splits()[number]);
        let sigma = torque_sigma(log, &robot);
        let errors = [&robot, &smaller].map(|robot: &RobotModel| torques.error_table(robot));
        for (row, (error, of_smaller)) in errors[0].iter().zip(&errors[1]).enumerate() {
            let is_fitted = split.fold(row).is_some();
            let tells = |joint: usize| {
                let moves = states[number][joint][row][SPEED] > LEAST_SPEED;
                error[joint].is_finite() && (moves || log.meta().tau_sensor != TorqueSensor::JointOutput)
            };
            let own = (0..NUM_JOINTS).filter(|joint| unknown.scope.contains(Joint::ALL[*joint]));
            let known = own.filter(|joint| is_fitted && tells(*joint));
            samples.extend(known.map(|joint| Sample {
                joint,
                states: states[number][joint][row],
                residual: error[joint] / sigma[joint],
                slope: (error[joint] - of_smaller[joint]) / sigma[joint] / STEP,
            }));
        }
        samples
    };
    evidence.measured_torques().iter().enumerate().flat_map(of_log).collect()
}

/// Returns velocity, speed, size of the position error, and commanded position of each joint by row of a log; NaN where
/// unknown.
///
/// Without measured velocities they are differences of positions.
pub fn joint_states(log: &Log) -> JointStates {
    let last = log.rows() - 1;
    let of_joint = |name: &str| {
        let (q, dq, q_cmd) = (log.q(name), log.dq(name), log.q_cmd(name));
        let at = |cells: Option<&[f64]>, row: usize| cells.map_or(f64::NAN, |cells| cells[row]);
        let slope = |row: usize| {
            let (before, after) = (row.saturating_sub(1), (row + 1).min(last));
            (at(q, after) - at(q, before)) / (log.t()[after] - log.t()[before])
        };
        let states = |row: usize| {
            let dq = dq.map_or_else(|| slope(row), |dq| dq[row]);
            [dq, dq.abs(), (at(q_cmd, row) - at(q, row)).abs(), at(q_cmd, row)]
        };
        (0..=last).map(states).collect()
    };
    JOINT_NAMES.into_iter().map(of_joint).collect()
}
