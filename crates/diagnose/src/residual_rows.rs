//! Rows of logs as residuals, and to which channel and fold each belongs. Every fifth second is in none.

use rayon::prelude::*;
use twinstep_logs::Log;
use twinstep_model::{Precision, RobotModel, Rollout};

use super::residual_power::{GYRO, ResidualPower, TRUNK};
use twinstep_identify::experiment::{Experiment, ResidualChannel};
use twinstep_identify::nuisance::NuisanceModel;

/// What evidence is simulated in.
pub const PRECISION: Precision = Precision::Single;
/// Candidates that are simulated at once, which bounds memory.
const BATCH_SIZE: usize = 64;
/// Errors of this size, beside the noise, are any simulator's: of a joint's position [rad]; of the trunk's motion and of its
/// gyroscope [noise].
const MODEL_ERROR_RAD: f64 = 0.001;
const MODEL_ERROR_BASE: f64 = 1.0;
const MISFIT_OF_GYRO: f64 = 1.0 / 3.0;
/// Length of a block [s]; blocks go to the two folds in turn.
const BLOCK_S: f64 = 1.0;

/// Rows of all logs.
pub struct ResidualRows {
    /// The logs, each with these rows alone.
    pub experiments: Vec<Experiment>,
    /// Errors of any robot, in these rows; none where every base was fixed.
    pub tolerances: Option<NuisanceModel>,
    /// For every residual its channel, its fold, and what it is multiplied by.
    cells: Vec<(usize, Option<usize>, f64)>,
}

impl ResidualRows {
    /// `experiments` on `logs`, of which they may have a part of the rows.
    pub fn new(logs: &[Log], experiments: Vec<Experiment>) -> Self {
        let mut cells = Vec::new();
        for (log, experiment) in logs.iter().zip(&experiments) {
            cells.extend(experiment.residual_index().map(|(quantity, row)| {
                // A velocity says what the position does, with more noise; torques are judged without a simulation.
                let (channel, misfit) = match quantity {
                    ResidualChannel::Position(joint) => (joint, MODEL_ERROR_RAD / experiment.sigma(quantity)),
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

    /// What a joint's position is in units of [rad]: noise and misfit.
    pub fn position_std(&self, joint: usize) -> f64 {
        MODEL_ERROR_RAD.hypot(self.experiments[0].sigma(ResidualChannel::Position(joint)))
    }

    /// What candidates leave of the motion.
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

    /// Residuals of a candidate less what tolerated errors explain.
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

/// The fold of a row; none where it is set aside: every fifth block takes no part in any choice or fit, and tells the gain.
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
    fn every_fifth_second_takes_no_part_in_choice_or_fit() {
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
