//! Residuals of motion and torque of logs, in two folds of alternating seconds. Every fifth second is held out.

use rayon::prelude::*;
use twinstep_effects::{DataRequirement, Effect};
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel, Rollout};

use super::residual_power::{GYRO, ResidualPower, STANCE, TORQUE, TRUNK};
use super::residual_rows::{ResidualRows, fold_of};
use twinstep_identify::ExperimentError;
use twinstep_identify::experiment::Experiment;
use twinstep_identify::nuisance::NuisanceModel;
use twinstep_identify::torque::MeasuredTorque;
use twinstep_identify::window::WindowConfig;

/// Standard deviation of the model error of torques, in addition to noise [N·m].
const MISFIT_NM: f64 = 0.02;
/// Mean squared position error, divided by the variance of the measured position, above which a joint is not tracked.
const MAX_UNTRACKED_VARIANCE: f64 = 0.1;
/// Correlation time of residuals [s]: positions with a fixed base, torques, base motion, gyroscope, whose noise exceeds
/// its model error, and positions with a floating base.
///
/// An error of contact or geometry moves the joints of a standing robot by the same angle in a whole window.
const INDEPENDENT_S: [f64; 5] = [0.2, 0.1, 0.5, 0.05, 1.0];

/// Duration of fixed, standing and slowly moving parts of the logs from which on the other parts are not simulated [s].
const LEAST_QUIET_S: f64 = 8.0;

/// Residual data of the logs of one robot.
pub struct ResidualData {
    logs: Vec<Log>,
    /// All rows except held-out blocks.
    pub fit_rows: ResidualRows,
    /// The two folds of `fit_rows`.
    pub folds: [ResidualRows; 2],
    /// Rows of `fit_rows` with a fixed base, in which the joints are nearly decoupled; all rows if there are none.
    fixed_base_rows: ResidualRows,
    torques: Vec<MeasuredTorque>,
    /// True if the robot walks, trots or jumps in windows that are compared.
    pub is_dynamic: bool,
}

impl ResidualData {
    /// Creates the data from `logs` of a robot with the gains and rates of `robot`, in windows of `horizon`.
    pub fn new(logs: Vec<Log>, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let experiments: Vec<Experiment> =
            logs.iter().map(|log| Experiment::new(log, robot, horizon)).collect::<Result<_, _>>()?;
        let (experiments, is_dynamic) = without_dynamic_windows(&logs, experiments);
        let only = |keep: &dyn Fn(Option<usize>) -> bool| -> Vec<Experiment> {
            let pairs = logs.iter().zip(&experiments);
            pairs.map(|(log, experiment)| experiment.clone().filter_rows(|row| keep(fold_of(log, row)))).collect()
        };
        let whole = only(&|fold| fold.is_some());
        let quick = whole.iter().cloned().map(Experiment::prefer_fixed_base).collect();
        Ok(Self {
            torques: logs.iter().map(|log| MeasuredTorque::new(log, robot)).collect::<Result<_, _>>()?,
            folds: [0, 1].map(|fold| ResidualRows::new(&logs, only(&|of| of == Some(fold)))),
            fit_rows: ResidualRows::new(&logs, whole),
            fixed_base_rows: ResidualRows::new(&logs, quick),
            is_dynamic,
            logs,
        })
    }

    /// Sets the nuisance parameters, linearised at `robot`, if a log has a floating base.
    pub fn set_nuisance_model(&mut self, robot: &RobotModel, simulator: &mut dyn Rollout) {
        if self.has_free_parts() {
            for rows in [&mut self.fit_rows].into_iter().chain(&mut self.folds) {
                rows.tolerances = NuisanceModel::new(&rows.experiments, robot, simulator);
            }
            if self.fixed_base_rows.experiments.iter().any(Experiment::has_floating_base) {
                self.fixed_base_rows.tolerances.clone_from(&self.fit_rows.tolerances);
            }
        }
    }

    /// Returns true if the mean squared position error of any joint exceeds 10 % of the variance of its measured
    /// position.
    pub fn fails_to_track(&self, left: &ResidualPower) -> bool {
        let log = &self.logs[0];
        (0..NUM_JOINTS).any(|joint| {
            let both = [joint, STANCE + joint];
            let rows: f64 = both.iter().flat_map(|channel| left.counts[*channel]).sum();
            let sigma = self.fit_rows.position_std(joint);
            let sum: f64 = both.iter().flat_map(|channel| left.sums[*channel]).sum();
            let error = sum / rows.max(1.0) * sigma * sigma;
            log.q(JOINT_NAMES[joint]).is_some_and(|q| error > MAX_UNTRACKED_VARIANCE * variance(q))
        })
    }

    /// Returns the logs.
    pub fn logs(&self) -> &[Log] {
        &self.logs
    }

    /// Returns true if a window has a floating base.
    pub fn has_free_parts(&self) -> bool {
        self.fit_rows.experiments.iter().any(Experiment::has_floating_base)
    }

    /// Returns the residual power of candidates; with `quick` only of rows with a fixed base, if there are any.
    pub fn residual_powers(
        &self,
        simulator: &mut dyn Rollout,
        robots: &[RobotModel],
        quick: bool,
    ) -> Vec<ResidualPower> {
        let rows = if quick { &self.fixed_base_rows } else { &self.fit_rows };
        let mut residual_powers = rows.residual_powers(simulator, robots);
        for (log, torques) in self.logs.iter().zip(&self.torques) {
            // Most effects act after the torque sensor, so consecutive candidates often predict the same torque.
            let alike: Vec<&[RobotModel]> =
                robots.chunk_by(|one, other| torques.predict_same_torque(one, other)).collect();
            let shown: Vec<ResidualPower> = alike
                .par_iter()
                .map(|robots| {
                    let mut left = ResidualPower::empty();
                    let sigma = torque_sigma(log, &robots[0]);
                    torques.differences(&robots[0], |joint, row, difference| {
                        left.add(TORQUE + joint, fold_of(log, row), difference / sigma[joint]);
                    });
                    left
                })
                .collect();
            let each = shown.iter().zip(&alike).flat_map(|(left, robots)| std::iter::repeat_n(left, robots.len()));
            residual_powers.iter_mut().zip(each).for_each(|(left, shown)| left.add_all(shown));
        }
        residual_powers
    }

    /// Returns the residual power of one candidate on all rows.
    pub fn residual_power(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> ResidualPower {
        self.residual_powers(simulator, std::slice::from_ref(robot), false).remove(0)
    }

    /// Returns false if the effect is not identifiable without a torque sensor and the logs have none.
    ///
    /// Such effects imitate others in the motion: at one kd, a wrong velocity gain is viscous friction.
    pub fn has_required_torque(&self, effect: &Effect) -> bool {
        let has_torque = |log: &Log| log.joints().iter().any(|joint| log.tau_measured(joint).is_some());
        !effect.needs.contains(&DataRequirement::TorqueMeasured) || self.logs.iter().any(has_torque)
    }

    /// Returns the highest rate of the logs [Hz].
    fn max_rate_hz(&self) -> f64 {
        self.logs.iter().map(|log| log.meta().rate_hz).fold(0.0, f64::max)
    }

    /// Returns the correlation length of a channel [rows].
    pub fn correlation_rows(&self, channel: usize) -> f64 {
        let kind = [TORQUE, TRUNK, GYRO, STANCE].into_iter().filter(|first| channel >= *first).count();
        (INDEPENDENT_S[kind] * self.max_rate_hz()).max(1.0)
    }

    /// Returns the measured torques of the first log.
    pub fn torques(&self) -> &MeasuredTorque {
        &self.torques[0]
    }
}

/// Returns the experiments without windows in which the robot walks or jumps, if the others last [`LEAST_QUIET_S`].
///
/// Also returns whether such windows are left.
fn without_dynamic_windows(logs: &[Log], experiments: Vec<Experiment>) -> (Vec<Experiment>, bool) {
    let quiet: Vec<Experiment> = experiments.iter().cloned().map(Experiment::without_dynamic_windows).collect();
    let rows = |experiments: &[Experiment]| experiments.iter().map(Experiment::num_rows).sum::<usize>();
    let seconds: f64 = logs.iter().zip(&quiet).map(|(log, quiet)| quiet.num_rows() as f64 / log.meta().rate_hz).sum();
    if seconds >= LEAST_QUIET_S {
        return (quiet, false);
    }
    let is_dynamic = rows(&quiet) < rows(&experiments);
    (experiments, is_dynamic)
}

fn variance(values: &[f64]) -> f64 {
    let finite = || values.iter().filter(|value| value.is_finite());
    let count = finite().count().max(1) as f64;
    let mean = finite().sum::<f64>() / count;
    finite().map(|value| (value - mean).powi(2)).sum::<f64>() / count
}

/// Returns the standard deviation of torque residuals by joint [N·m].
///
/// It includes noise of the torque sensor, noise of positions and velocities in the PD loop, and model error.
pub fn torque_sigma(log: &Log, robot: &RobotModel) -> [f64; NUM_JOINTS] {
    JOINT_NAMES.map(|name| {
        let noise = |channel: &str, assumed: f64| {
            log.noise(&format!("{channel}_{name}")).filter(|sigma| *sigma > 0.0).unwrap_or(assumed)
        };
        let known = log.joints().iter().any(|joint| joint == name);
        let gain = |gain: Option<f64>, nominal: f64| gain.filter(|_| known).unwrap_or(nominal);
        let kp = gain(log.kp(name, 0), robot.control.kp);
        let kd = gain(log.kd(name, 0), robot.control.kd);
        let measured = noise("tau_measured", 0.2).hypot(MISFIT_NM);
        measured.hypot(kp * noise("q", 0.002)).hypot(kd * noise("dq", 0.05))
    })
}
