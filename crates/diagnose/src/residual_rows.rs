//! Residuals of rows of logs, with the channel and fold of each. Every fifth second is a held-out block.

use rayon::prelude::*;
use twinstep_logs::Log;
use twinstep_model::{Precision, RobotModel, Rollout};

use super::residual_power::{GYRO, ResidualPower, STANCE, TRUNK};
use twinstep_identify::experiment::{Experiment, ResidualChannel};
use twinstep_identify::nuisance::NuisanceModel;

/// Precision of the simulations.
pub const PRECISION: Precision = Precision::Single;
/// Number of candidates that are simulated at once, which limits memory.
const BATCH_SIZE: usize = 64;
/// Standard deviation of the model error of joint positions [rad].
const MODEL_ERROR_RAD: f64 = 0.001;
/// Standard deviation of the model error of base motion [noise std].
const MODEL_ERROR_BASE: f64 = 1.0;
/// Standard deviation of the model error of the gyroscope [noise std].
const MISFIT_OF_GYRO: f64 = 1.0 / 3.0;
/// Length of a block [s]; blocks are assigned to the two folds alternately.
const BLOCK_S: f64 = 1.0;

/// Residuals of rows of all logs.
pub struct ResidualRows {
    /// The logs, each restricted to these rows.
    pub experiments: Vec<Experiment>,
    /// Nuisance parameters; `None` without a floating base.
    pub tolerances: Option<NuisanceModel>,
    /// Channel, fold and weight of every residual.
    cells: Vec<(usize, Option<usize>, f64)>,
}

impl ResidualRows {
    /// Creates the residuals of `experiments`, which contain some or all rows of `logs`.
    pub fn new(logs: &[Log], experiments: Vec<Experiment>) -> Self {
        let mut cells = Vec::new();
        for (log, experiment) in logs.iter().zip(&experiments) {
            cells.extend(experiment.residual_index().zip(experiment.groups()).map(|((quantity, row), group)| {
                // Velocities repeat the information of positions with more noise. Torques are evaluated without
                // simulation.
                let (channel, misfit) = match quantity {
                    ResidualChannel::Position(joint) => {
                        let first = if Experiment::is_held(group) { 0 } else { STANCE };
                        (first + joint, MODEL_ERROR_RAD / experiment.sigma(quantity))
                    }
                    ResidualChannel::Velocity(_) | ResidualChannel::Torque(_) => return (0, None, 0.0),
                    ResidualChannel::BasePosition(axis) => (TRUNK + axis, MODEL_ERROR_BASE),
                    ResidualChannel::BaseOrientation(axis) => (TRUNK + 3 + axis, MODEL_ERROR_BASE),
                    ResidualChannel::BaseVelocity(axis) => (TRUNK + 6 + axis, MODEL_ERROR_BASE),
                    ResidualChannel::BaseRate(axis) => (GYRO + axis, MISFIT_OF_GYRO),
                };
                (channel, fold_of(log, row), 1.0 / misfit.hypot(1.0))
            }));
        }
        Self { experiments, tolerances: None, cells }
    }

    /// Returns the standard deviation of noise and model error of a joint's position [rad].
    pub fn position_std(&self, joint: usize) -> f64 {
        MODEL_ERROR_RAD.hypot(self.experiments[0].sigma(ResidualChannel::Position(joint)))
    }

    /// Returns the residual power of the motion of each candidate.
    pub fn residual_powers(&self, simulator: &mut dyn Rollout, robots: &[RobotModel]) -> Vec<ResidualPower> {
        let mut whole = vec![Vec::new(); robots.len()];
        for experiment in &self.experiments {
            for (robots, whole) in robots.chunks(BATCH_SIZE).zip(whole.chunks_mut(BATCH_SIZE)) {
                let residuals = experiment.residuals(simulator, robots, PRECISION);
                whole.iter_mut().zip(residuals).for_each(|(whole, residuals)| whole.extend(residuals));
            }
        }
        whole.into_par_iter().map(|residuals| self.residual_power(residuals)).collect()
    }

    /// Returns the residuals of a candidate after elimination of the nuisance parameters.
    pub fn nuisance_corrected(&self, simulator: &mut dyn Rollout, robot: &RobotModel) -> Vec<f64> {
        let one = std::slice::from_ref(robot);
        let parts = self.experiments.iter().flat_map(|experiment| experiment.residuals(simulator, one, PRECISION));
        let mut residuals: Vec<f64> = parts.flatten().collect();
        if let Some(tolerances) = &self.tolerances {
            tolerances.project_out(&mut residuals);
        }
        residuals
    }

    fn residual_power(&self, mut residuals: Vec<f64>) -> ResidualPower {
        if let Some(tolerances) = &self.tolerances {
            tolerances.project_out(&mut residuals);
        }
        let tolerated = NuisanceModel::nats(&residuals[self.cells.len()..]);
        let mut left = ResidualPower { nuisance_cost: tolerated, ..ResidualPower::empty() };
        for (residual, (channel, fold, weight)) in residuals.iter().zip(&self.cells) {
            left.add(*channel, *fold, residual * weight);
        }
        left
    }
}

/// Returns the fold of a row. Returns `None` for held-out blocks: every fifth block takes no part in any selection or
/// fit.
pub fn fold_of(log: &Log, row: usize) -> Option<usize> {
    let block = (row as f64 / (BLOCK_S * log.meta().rate_hz)) as usize % 5;
    (block < 4).then_some(block % 2)
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::BaseMount;

    use super::*;

    #[test]
    fn every_fifth_second_is_held_out() {
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let column = |name: &str, value: fn(usize) -> f64| (name.to_owned(), (0..100).map(value).collect());
        let columns = [
            column("t", |row| row as f64 / 10.0),
            column("q_FL_hip", |_| 0.0),
            column("q_cmd_FL_hip", |_| 0.0),
            column("kp", |_| 20.0),
            column("kd", |_| 0.5),
        ];
        let log = Log::new(Meta::new(10.0, TorqueSensor::None, segments), columns).expect("a log");
        let folds: Vec<_> = (0..100).step_by(10).map(|row| fold_of(&log, row)).collect();
        let five = [Some(0), Some(1), Some(0), Some(1), None];
        assert_eq!(folds, [five, five].concat());
    }
}
