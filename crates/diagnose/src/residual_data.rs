//! Logs as evidence: what a candidate model leaves of each channel, in two folds of alternating seconds. Every fifth second is
//! set aside.

use rayon::prelude::*;
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel, Rollout};

use super::residual_power::{GYRO, ResidualPower, TORQUE, TRUNK};
use super::residual_rows::{ResidualRows, fold_of};
use twinstep_identify::experiment::{Experiment, ExperimentError};
use twinstep_identify::nuisance::NuisanceModel;
use twinstep_identify::torque::MeasuredTorque;
use twinstep_identify::window::WindowConfig;

/// Errors of a torque of this size, beside the noise, are any simulator's [N·m].
const MISFIT_NM: f64 = 0.02;
/// Share of a joint's motion that a model may miss before it is lost.
const MAX_UNTRACKED_VARIANCE: f64 = 0.1;
/// Rows this long apart [s] are independent: positions, torques, the trunk, and its gyroscope, which has more noise than error.
const INDEPENDENT_S: [f64; 4] = [0.2, 0.1, 0.5, 0.05];

/// Logs of one robot.
pub struct ResidualData {
    logs: Vec<Log>,
    /// All rows but those that are set aside.
    pub fit_rows: ResidualRows,
    /// One half of them and the other.
    pub folds: [ResidualRows; 2],
    /// Of all of them those with the trunk held, if there are any: joints hardly disturb each other there.
    fixed_base_rows: ResidualRows,
    torques: Vec<MeasuredTorque>,
}

impl ResidualData {
    /// `logs` of a robot with the gains and rates of `robot`, in windows of `horizon`.
    pub fn new(logs: Vec<Log>, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let experiments: Vec<Experiment> =
            logs.iter().map(|log| Experiment::new(log, robot, horizon)).collect::<Result<_, _>>()?;
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
            logs,
        })
    }

    /// From here on, errors that any robot has are not evidence; `robot` is the model.
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

    /// Whether some joint is not followed at all by what leaves so much: by a third of its motion or more.
    pub fn fails_to_track(&self, left: &ResidualPower) -> bool {
        let log = &self.logs[0];
        (0..NUM_JOINTS).any(|joint| {
            let rows: f64 = left.counts[joint].iter().sum();
            let sigma = self.fit_rows.position_std(joint);
            let error = left.sums[joint].iter().sum::<f64>() / rows.max(1.0) * sigma * sigma;
            log.q(JOINT_NAMES[joint]).is_some_and(|q| error > MAX_UNTRACKED_VARIANCE * variance(q))
        })
    }

    /// The logs.
    pub fn logs(&self) -> &[Log] {
        &self.logs
    }

    /// Whether a base was floating somewhere.
    pub fn has_free_parts(&self) -> bool {
        self.fit_rows.experiments.iter().any(Experiment::has_floating_base)
    }

    /// What candidates leave; with `quick` only where the base was fixed, if it was.
    pub fn residual_powers(
        &self,
        simulator: &mut dyn Rollout,
        robots: &[RobotModel],
        quick: bool,
    ) -> Vec<ResidualPower> {
        let rows = if quick { &self.fixed_base_rows } else { &self.fit_rows };
        let mut residual_powers = rows.residual_powers(simulator, robots);
        for (log, torques) in self.logs.iter().zip(&self.torques) {
            // Most effects are behind the torque's sensor: what it shows of robots that follow one another is the same.
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

    /// What one candidate leaves of everything.
    pub fn residual_power(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> ResidualPower {
        self.residual_powers(simulator, std::slice::from_ref(robot), false).remove(0)
    }

    /// Returns the highest rate of the logs [Hz].
    fn max_rate_hz(&self) -> f64 {
        self.logs.iter().map(|log| log.meta().rate_hz).fold(0.0, f64::max)
    }

    /// Rows of a channel that count as one.
    pub fn correlation_rows(&self, channel: usize) -> f64 {
        let kind = [TORQUE, TRUNK, GYRO].into_iter().filter(|first| channel >= *first).count();
        (INDEPENDENT_S[kind] * self.max_rate_hz()).max(1.0)
    }

    /// Measured torques of the first log.
    pub fn torques(&self) -> &MeasuredTorque {
        &self.torques[0]
    }
}

fn variance(values: &[f64]) -> f64 {
    let finite = || values.iter().filter(|value| value.is_finite());
    let count = finite().count().max(1) as f64;
    let mean = finite().sum::<f64>() / count;
    finite().map(|value| (value - mean).powi(2)).sum::<f64>() / count
}

/// Noise of the torques that measured states make, beside the sensor's own and any simulator's misfit [N·m].
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
