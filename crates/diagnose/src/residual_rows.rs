//! Residuals of rows of logs, with the channel and fold of each.

use rayon::prelude::*;
use twinstep_effects::Target;
use twinstep_model::{NUM_JOINTS, Precision, RobotModel, Rollout};

use super::data_split::DataSplit;
use super::residual_power::{DYNAMIC, GYRO_AT_REST, ResidualPower, STANCE, TRUNK, WRENCH};
use twinstep_identify::experiment::{Experiment, Regime, ResidualChannel};
use twinstep_identify::least_squares::append;
use twinstep_identify::nuisance::NuisanceModel;

/// Precision of the simulations.
pub const PRECISION: Precision = Precision::Single;
/// Number of candidates that are simulated at once, which limits memory.
const BATCH_SIZE: usize = 32;
/// Standard deviation of the model error of joint positions [rad].
const MODEL_ERROR_RAD: f64 = 0.001;
/// Standard deviation of the model error of base motion [noise std].
const MODEL_ERROR_BASE: f64 = 1.0;
/// Standard deviation of the model error of the gyroscope [noise std].
const MISFIT_OF_GYRO: f64 = 1.0 / 3.0;
/// Standard deviation of the model error of joint positions of a standing robot whose wrench on the base is known [rad].
///
/// Two engines differ by as much, in the same direction for a whole window. The wrench has no error of contact.
const STANCE_ERROR_RAD: f64 = 0.003;
/// Factor on the scale of all simulated residuals of a standing robot beside residuals without errors of contact: the wrench,
/// or positions with a fixed base. Its errors last about ten times as long as theirs.
const STANCE_SCALE: f64 = 3.0;
/// Scale of a residual that takes no part in a fit.
const IGNORED: f64 = 1e6;

/// Residuals of rows of all logs.
pub struct ResidualRows {
    /// The logs, each restricted to these rows.
    pub experiments: Vec<Experiment>,
    /// Nuisance parameters; `None` if they are not set, or the robot diverges.
    pub tolerances: Option<NuisanceModel>,
    /// Channel, fold and weight of every residual.
    cells: Vec<(usize, Option<usize>, f64)>,
    /// True for the residuals of a robot that walks or jumps.
    dynamic: Vec<bool>,
    /// True for the simulated residuals of a standing robot.
    stance: Vec<bool>,
    /// True for the residuals of logs in which the wrench on the base is known.
    balanced: Vec<bool>,
    /// True if there are residuals of a robot with a fixed base.
    hangs: bool,
}

impl ResidualRows {
    /// Creates the residuals of `experiments`, one for each log, which is divided as in `splits`.
    pub fn new(splits: &[DataSplit], experiments: Vec<Experiment>) -> Self {
        let (mut cells, mut dynamic, mut stance, mut balanced) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let hangs = experiments.iter().any(Experiment::has_fixed_base);
        for (split, experiment) in splits.iter().zip(&experiments) {
            dynamic.extend(experiment.dynamic_residuals());
            let is_wrench = |quantity| matches!(quantity, ResidualChannel::BaseWrench(_));
            let has_wrench = experiment.residual_index().any(|(quantity, _)| is_wrench(quantity));
            stance.extend(
                experiment.residual_index().zip(experiment.groups()).map(|((quantity, _), group)| {
                    !is_wrench(quantity) && Experiment::regime(group) == Regime::Floating
                }),
            );
            balanced.resize(stance.len(), has_wrench);
            cells.extend(experiment.residual_index().zip(experiment.groups()).map(|((quantity, row), group)| {
                // Torques are evaluated without simulation.
                let regime = Experiment::regime(group);
                let base = if regime == Regime::Dynamic { DYNAMIC + NUM_JOINTS } else { TRUNK };
                let (channel, misfit) = match quantity {
                    ResidualChannel::Position(joint) => {
                        let first = match regime {
                            Regime::Fixed => 0,
                            Regime::Floating => STANCE,
                            Regime::Dynamic => DYNAMIC,
                        };
                        let error =
                            if has_wrench && regime == Regime::Floating { STANCE_ERROR_RAD } else { MODEL_ERROR_RAD };
                        (first + joint, error / experiment.sigma(quantity))
                    }
                    ResidualChannel::Velocity(_) | ResidualChannel::Torque(_) => return (0, None, 0.0),
                    ResidualChannel::BasePosition(axis) => (base + axis, MODEL_ERROR_BASE),
                    ResidualChannel::BaseOrientation(axis) => (base + 3 + axis, MODEL_ERROR_BASE),
                    ResidualChannel::BaseVelocity(axis) => (base + 6 + axis, MODEL_ERROR_BASE),
                    ResidualChannel::BaseRate(axis) if regime == Regime::Fixed => (GYRO_AT_REST + axis, MISFIT_OF_GYRO),
                    ResidualChannel::BaseRate(axis) => (base + 9 + axis, MISFIT_OF_GYRO),
                    ResidualChannel::BaseWrench(axis) => (WRENCH + axis, MODEL_ERROR_BASE),
                };
                (channel, split.fold(row), 1.0 / misfit.hypot(1.0))
            }));
        }
        Self { experiments, tolerances: None, cells, dynamic, stance, balanced, hangs }
    }

    /// Raises the scales of residuals with errors of contact in a fit of effects on `targets`.
    ///
    /// The rows of a robot that walks or jumps take no part in a fit, unless it is one of the ground. Their derivatives are
    /// those of contact events: large, local, and of no use for a step. Positions with a fixed base show effects on joints only.
    pub fn raise_scales_on_ground(&self, scale: &mut [f64], targets: &[Target]) {
        let on_ground = targets.contains(&Target::Ground);
        let of_joints = targets.iter().all(|target| matches!(target, Target::Joints | Target::Supply));
        let ignored = scale.iter_mut().zip(&self.dynamic).filter(|(_, dynamic)| **dynamic && !on_ground);
        ignored.for_each(|(scale, _)| *scale = IGNORED);
        let uncertain = |balanced: bool| balanced || (self.hangs && of_joints);
        let stance = scale.iter_mut().zip(self.stance.iter().zip(&self.balanced));
        let stance = stance.filter(|(_, (stance, balanced))| **stance && uncertain(**balanced));
        stance.for_each(|(scale, _)| *scale *= STANCE_SCALE);
    }

    /// Returns the standard deviation of noise and model error of a joint's position [rad].
    pub fn position_std(&self, joint: usize) -> f64 {
        MODEL_ERROR_RAD.hypot(self.experiments[0].sigma(ResidualChannel::Position(joint)))
    }

    /// Returns the residual power of the motion of each candidate.
    pub fn residual_powers(&self, simulator: &mut dyn Rollout, robots: &[RobotModel]) -> Vec<ResidualPower> {
        let of_batch = |robots: &[RobotModel]| -> Vec<ResidualPower> {
            let residuals = self.residuals(simulator, robots);
            residuals.into_par_iter().map(|residuals| self.residual_power(residuals)).collect()
        };
        robots.chunks(BATCH_SIZE).flat_map(of_batch).collect()
    }

    /// Returns the residuals of each candidate, before elimination of the nuisance parameters.
    fn residuals(&self, simulator: &mut dyn Rollout, robots: &[RobotModel]) -> Vec<Vec<f64>> {
        let mut whole = vec![Vec::new(); robots.len()];
        for experiment in &self.experiments {
            let residuals = experiment.residuals(simulator, robots, PRECISION);
            whole.iter_mut().zip(residuals).for_each(|(whole, residuals)| append(whole, residuals));
        }
        whole
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
