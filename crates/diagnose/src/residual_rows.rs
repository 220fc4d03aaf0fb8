//! Residuals of rows of logs, with the channel and fold of each.

use std::collections::BTreeSet;

use rayon::prelude::*;
use twinstep_effects::Target;
use twinstep_model::{NUM_JOINTS, Precision, RobotModel, Rollout};

use super::data_split::DataSplit;
use super::residual_power::{CHANNELS, DYNAMIC, GYRO_AT_REST, ResidualPower, STANCE, TORQUE, TRUNK, WRENCH};
use twinstep_identify::experiment::{Experiment, Regime, ResidualChannel};
use twinstep_identify::least_squares::append;
use twinstep_identify::nuisance::NuisanceModel;

/// Precision of the simulations.
pub const PRECISION: Precision = Precision::Single;
/// Number of candidates that are simulated at once, which limits memory.
const BATCH_SIZE: usize = 32;
/// Standard deviation of the model error of joint positions [rad].
pub const MODEL_ERROR_RAD: f64 = 0.001;
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
    /// Fold of every residual, also of those that only take part in fits.
    folds: Vec<Option<usize>>,
    /// Block of every residual, counted over all logs.
    blocks: Vec<Option<usize>>,
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
        let (mut cells, mut folds, mut blocks, mut dynamic) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let (mut stance, mut balanced) = (Vec::new(), Vec::new());
        let mut first_block = 0;
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
            let block = |row: usize| split.block(row).map(|block| first_block + block);
            blocks.extend(experiment.residual_index().map(|(_, row)| block(row)));
            folds.extend(experiment.residual_index().map(|(_, row)| split.fold(row)));
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
            first_block += split.num_blocks();
        }
        Self { experiments, tolerances: None, cells, folds, blocks, dynamic, stance, balanced, hangs }
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

    /// Returns the weight of a residual in a fit to one fold: 1 for a row of the fold, 0 for another, and one half for the
    /// penalty of a nuisance parameter, which follows the rows and belongs to both folds.
    pub fn weight_in_fold(&self, residual: usize, fold: usize) -> f64 {
        self.folds.get(residual).map_or(0.5, |of| f64::from(*of == Some(fold)))
    }

    /// Returns the residuals of joint positions with a fixed base in the first and in the second half of their blocks.
    pub fn halves_in_air(&self) -> [Vec<usize>; 2] {
        let blocks = self
            .cells
            .iter()
            .zip(&self.blocks)
            .map(|((channel, fold, _), block)| block.filter(|_| fold.is_some() && *channel < TORQUE));
        let shown: Vec<(usize, usize)> =
            blocks.enumerate().filter_map(|(residual, block)| Some((residual, block?))).collect();
        let numbers: BTreeSet<usize> = shown.iter().map(|(_, block)| *block).collect();
        let middle = numbers.iter().nth(numbers.len() / 2).copied().unwrap_or(0);
        let (first, second): (Vec<_>, Vec<_>) = shown.into_iter().partition(|(_, block)| *block < middle);
        [first, second].map(|half| half.into_iter().map(|(residual, _)| residual).collect())
    }

    /// Returns the residuals of joint positions with a fixed base, outside held-out blocks: number of the residual, log, joint
    /// and row.
    pub fn positions_in_air(&self) -> Vec<(usize, usize, usize, usize)> {
        let experiments = self.experiments.iter().enumerate();
        let rows =
            experiments.flat_map(|(log, experiment)| experiment.residual_index().map(move |(_, row)| (log, row)));
        let cells = self.cells.iter().zip(rows).enumerate();
        let shown = cells.filter(|(_, ((channel, fold, _), _))| fold.is_some() && *channel < TORQUE);
        shown.map(|(residual, ((channel, ..), (log, row)))| (residual, log, *channel, row)).collect()
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

    /// Returns the residuals of each candidate after elimination of the nuisance parameters.
    pub fn nuisance_corrected(&self, simulator: &mut dyn Rollout, robots: &[RobotModel]) -> Vec<Vec<f64>> {
        let mut residuals = self.residuals(simulator, robots);
        if let Some(tolerances) = &self.tolerances {
            residuals.par_iter_mut().for_each(|residuals| tolerances.project_out(residuals));
        }
        residuals
    }

    /// Calls `each` with candidate, channel, block, residual of the first robot, and the difference of the candidate's
    /// from it, both in units of noise and model error.
    pub fn differences(
        &self,
        simulator: &mut dyn Rollout,
        robot: &RobotModel,
        candidates: &[RobotModel],
        mut each: impl FnMut(usize, usize, usize, [f64; 2]),
    ) {
        let reference = self.nuisance_corrected(simulator, std::slice::from_ref(robot)).remove(0);
        for (batch, candidates) in candidates.chunks(BATCH_SIZE).enumerate() {
            for (index, residuals) in self.nuisance_corrected(simulator, candidates).iter().enumerate() {
                let pairs = reference.iter().zip(residuals).zip(self.cells.iter().zip(&self.blocks));
                for ((reference, residual), ((channel, fold, weight), block)) in pairs {
                    if let (Some(_), Some(block)) = (fold, block) {
                        let pair = [weight * reference, weight * (residual - reference)];
                        each(batch * BATCH_SIZE + index, *channel, *block, pair);
                    }
                }
            }
        }
    }

    /// Returns the residuals of the first log in the two folds after elimination of the nuisance parameters, by channel and
    /// row, in units of noise and model error; NaN where there is none.
    pub fn tables(&self, simulator: &mut dyn Rollout, robot: &RobotModel, rows: usize) -> Vec<Vec<f64>> {
        let mut tables = vec![vec![f64::NAN; rows]; CHANNELS];
        let corrected = self.nuisance_corrected(simulator, std::slice::from_ref(robot)).remove(0);
        let index = self.experiments[0].residual_index();
        for (((_, row), residual), (channel, fold, weight)) in index.zip(corrected).zip(&self.cells) {
            if fold.is_some() {
                tables[*channel][row] = residual * weight;
            }
        }
        tables
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
