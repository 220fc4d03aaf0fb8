//! Residuals of motion and torque of logs, in two folds; the rest is held out ([`DataSplit`]).

use rayon::prelude::*;
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel, Rollout};

use super::data_split::DataSplit;
use super::residual_power::{DYNAMIC, GYRO, GYRO_AT_REST, ResidualPower, STANCE, TORQUE, TRUNK, WRENCH};
use super::residual_rows::ResidualRows;
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
/// its model error, positions with a floating base, force and moment on the base, gyroscope with a fixed base, which has
/// white noise, and a robot that walks or jumps.
///
/// An error of contact or geometry moves the joints of a standing robot by the same angle in a whole window.
const INDEPENDENT_S: [f64; 8] = [0.2, 0.1, 0.5, 0.05, 1.0, 1.0, 0.0, 0.3];

/// Duration of fixed, standing and slowly moving parts of the logs from which on the other parts have channels of their
/// own [s].
const LEAST_QUIET_S: f64 = 8.0;

/// Residual data of the logs of one robot.
pub struct ResidualData {
    logs: Vec<Log>,
    splits: Vec<DataSplit>,
    /// All rows except held-out blocks.
    pub fit_rows: ResidualRows,
    torques: Vec<MeasuredTorque>,
}

impl ResidualData {
    /// Creates the data from `logs` of a robot with the gains and rates of `robot`, in windows of `horizon`.
    pub fn new(logs: Vec<Log>, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let experiment = |log| Ok(Experiment::new(log, robot, horizon)?.without_velocities());
        let experiments: Vec<Experiment> = logs.iter().map(experiment).collect::<Result<_, ExperimentError>>()?;
        let experiments = with_dynamic_windows_apart(&logs, experiments);
        let splits: Vec<DataSplit> = logs.iter().map(DataSplit::new).collect();
        let of_folds = |(split, experiment): (&DataSplit, &Experiment)| {
            experiment.clone().filter_rows(|row| split.fold(row).is_some())
        };
        let whole: Vec<Experiment> = splits.iter().zip(&experiments).map(of_folds).collect();
        Ok(Self {
            torques: logs.iter().map(|log| MeasuredTorque::new(log, robot)).collect::<Result<_, _>>()?,
            fit_rows: ResidualRows::new(&splits, whole),
            splits,
            logs,
        })
    }

    /// Sets the nuisance parameters, linearised at `robot`.
    ///
    /// With a fixed base alone, it is the lead of the encoder positions.
    pub fn set_nuisance_model(&mut self, robot: &RobotModel, simulator: &mut dyn Rollout) {
        let new = if self.has_free_parts() { NuisanceModel::new } else { NuisanceModel::of_encoder_lead };
        self.fit_rows.tolerances = new(&self.fit_rows.experiments, robot, simulator);
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

    /// Returns the residual power of candidates.
    pub fn residual_powers(&self, simulator: &mut dyn Rollout, robots: &[RobotModel]) -> Vec<ResidualPower> {
        let mut residual_powers = self.fit_rows.residual_powers(simulator, robots);
        for ((log, split), torques) in self.logs.iter().zip(&self.splits).zip(&self.torques) {
            // Most effects act after the torque sensor, so consecutive candidates often predict the same torque.
            let alike: Vec<&[RobotModel]> =
                robots.chunk_by(|one, other| torques.predict_same_torque(one, other)).collect();
            let shown: Vec<ResidualPower> = alike
                .par_iter()
                .map(|robots| {
                    let mut left = ResidualPower::empty();
                    let sigma = torque_sigma(log, &robots[0]);
                    torques.differences(&robots[0], |joint, row, difference| {
                        left.add(TORQUE + joint, split.fold(row), difference / sigma[joint]);
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
        self.residual_powers(simulator, std::slice::from_ref(robot)).remove(0)
    }

    /// Returns the highest rate of the logs [Hz].
    fn max_rate_hz(&self) -> f64 {
        self.logs.iter().map(|log| log.meta().rate_hz).fold(0.0, f64::max)
    }

    /// Returns the correlation length of a channel [rows].
    pub fn correlation_rows(&self, channel: usize) -> f64 {
        let kind = [TORQUE, TRUNK, GYRO, STANCE, WRENCH, GYRO_AT_REST, DYNAMIC]
            .into_iter()
            .filter(|first| channel >= *first)
            .count();
        (INDEPENDENT_S[kind] * self.max_rate_hz()).max(1.0)
    }
}

/// Returns the experiments with the windows in which the robot walks or jumps marked, if the others last
/// [`LEAST_QUIET_S`].
fn with_dynamic_windows_apart(logs: &[Log], experiments: Vec<Experiment>) -> Vec<Experiment> {
    let marked: Vec<Experiment> = experiments.iter().cloned().map(Experiment::mark_dynamic_windows).collect();
    let quiet = |(log, marked): (&Log, &Experiment)| marked.num_quiet_rows() as f64 / log.meta().rate_hz;
    let is_long = logs.iter().zip(&marked).map(quiet).sum::<f64>() >= LEAST_QUIET_S;
    if is_long { marked } else { experiments }
}

/// Returns the variance of the finite values.
fn variance(values: &[f64]) -> f64 {
    let finite = || values.iter().filter(|value| value.is_finite());
    let count = finite().count().max(1) as f64;
    let mean = finite().sum::<f64>() / count;
    finite().map(|value| (value - mean).powi(2)).sum::<f64>() / count
}

/// Returns the standard deviation of torque residuals by joint [N·m].
///
/// It includes noise of the torque sensor, noise of positions and velocities in the PD loop, and model error.
fn torque_sigma(log: &Log, robot: &RobotModel) -> [f64; NUM_JOINTS] {
    std::array::from_fn(|joint| {
        let name = JOINT_NAMES[joint];
        let noise = |channel: &str, assumed: f64| {
            log.noise(&format!("{channel}_{name}")).filter(|sigma| *sigma > 0.0).unwrap_or(assumed)
        };
        let known = log.joints().iter().any(|joint| joint == name);
        let gain = |gain: Option<f64>, nominal: f64| gain.filter(|_| known).unwrap_or(nominal);
        let kp = gain(log.kp(name, 0), robot.control.kp[joint]);
        let kd = gain(log.kd(name, 0), robot.control.kd[joint]);
        let measured = noise("tau_measured", 0.2).hypot(MISFIT_NM);
        measured.hypot(kp * noise("q", 0.002)).hypot(kd * noise("dq", 0.05))
    })
}
