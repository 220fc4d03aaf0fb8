//! Residuals of motion and torque of logs, in two folds; the rest is held out ([`DataSplit`]).

use rayon::prelude::*;
use twinstep_effects::{DataRequirement, Effect, EffectEntry, ModelFile};
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, NUM_JOINTS, RobotModel, Rollout};

use super::data_split::DataSplit;
use super::hypothesis::Hypothesis;
use super::residual_power::{CHANNELS, DYNAMIC, GYRO, GYRO_AT_REST, ResidualPower, STANCE, TORQUE, TRUNK, WRENCH};
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
    /// One experiment per log, with all rows.
    experiments: Vec<Experiment>,
    /// All rows except held-out blocks.
    pub fit_rows: ResidualRows,
    /// Rows of `fit_rows` with a fixed base, in which the joints are nearly decoupled; `None` if these are all, or none.
    fixed_base_rows: Option<ResidualRows>,
    torques: Vec<MeasuredTorque>,
    /// True if the robot walks, trots or jumps in windows that are compared.
    pub is_dynamic: bool,
}

impl ResidualData {
    /// Creates the data from `logs` of a robot with the gains and rates of `robot`, in windows of `horizon`.
    pub fn new(logs: Vec<Log>, robot: &RobotModel, horizon: WindowConfig) -> Result<Self, ExperimentError> {
        let experiment = |log| Ok(Experiment::new(log, robot, horizon)?.without_velocities());
        let experiments: Vec<Experiment> = logs.iter().map(experiment).collect::<Result<_, ExperimentError>>()?;
        let (experiments, is_dynamic) = with_dynamic_windows_apart(&logs, experiments);
        let splits: Vec<DataSplit> = logs.iter().map(DataSplit::new).collect();
        let of_folds = |(split, experiment): (&DataSplit, &Experiment)| {
            experiment.clone().filter_rows(|row| split.fold(row).is_some())
        };
        let whole: Vec<Experiment> = splits.iter().zip(&experiments).map(of_folds).collect();
        let has_both = whole.iter().any(Experiment::has_fixed_base) && whole.iter().any(Experiment::has_floating_base);
        let fixed_base_rows = has_both
            .then(|| ResidualRows::new(&splits, whole.iter().cloned().map(Experiment::only_fixed_base).collect()));
        Ok(Self {
            torques: logs.iter().map(|log| MeasuredTorque::new(log, robot)).collect::<Result<_, _>>()?,
            fit_rows: ResidualRows::new(&splits, whole),
            fixed_base_rows,
            is_dynamic,
            experiments,
            splits,
            logs,
        })
    }

    /// Sets the nuisance parameters, linearised at `robot`.
    ///
    /// With a fixed base alone, it is the lead of the encoder positions.
    pub fn set_nuisance_model(&mut self, robot: &RobotModel, simulator: &mut dyn Rollout) {
        self.fit_rows.tolerances = self.nuisance_model(&self.fit_rows.experiments, robot, simulator);
        if let Some(rows) = &mut self.fixed_base_rows {
            rows.tolerances = NuisanceModel::of_encoder_lead(&rows.experiments, robot, simulator);
        }
    }

    /// Returns the rows with a fixed base, with the lead of the encoder positions as nuisance parameter, if there are others, too.
    ///
    /// They rank candidates by joint, for which penalties of links have no share.
    pub fn fixed_base_rows(&self) -> Option<&ResidualRows> {
        self.fixed_base_rows.as_ref()
    }

    /// Returns all rows, held-out blocks included, with the nuisance parameters of `model`.
    pub fn all_rows(&self, model: &ModelFile, simulator: &mut dyn Rollout) -> ResidualRows {
        let mut rows = ResidualRows::new(&self.splits, self.experiments.clone());
        let robot = model.robot_model().ok();
        rows.tolerances = robot.and_then(|robot| self.nuisance_model(&rows.experiments, &robot, simulator));
        rows
    }

    /// Returns the nuisance parameters of these rows of the logs.
    fn nuisance_model(
        &self,
        experiments: &[Experiment],
        robot: &RobotModel,
        simulator: &mut dyn Rollout,
    ) -> Option<NuisanceModel> {
        let new = if self.has_free_parts() { NuisanceModel::new } else { NuisanceModel::of_encoder_lead };
        new(experiments, robot, simulator)
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

    /// Returns how each log is divided into folds and held-out blocks.
    pub fn splits(&self) -> &[DataSplit] {
        &self.splits
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
        let rows = self.fixed_base_rows().filter(|_| quick).unwrap_or(&self.fit_rows);
        let mut residual_powers = rows.residual_powers(simulator, robots);
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
        self.residual_powers(simulator, std::slice::from_ref(robot), false).remove(0)
    }

    /// Returns the products of the residuals of `robot` with the differences of those of `candidates`, by block.
    pub fn block_products(
        &self,
        simulator: &mut dyn Rollout,
        robot: &RobotModel,
        candidates: &[RobotModel],
    ) -> BlockProducts {
        let num_blocks = self.splits.iter().map(DataSplit::num_blocks).sum();
        let mut products = BlockProducts::new(num_blocks, candidates.len());
        let mut first_block = 0;
        for split in &self.splits {
            let blocks = split.num_blocks();
            (0..blocks).for_each(|block| products.fold_of_block[first_block + block] = block % 2);
            first_block += blocks;
        }
        let given = self.residual_power(simulator, robot);
        for (reference, (sums, counts)) in products.reference.iter_mut().zip(given.sums.iter().zip(&given.counts)) {
            *reference = [0, 1].map(|fold| [counts[fold], sums[fold]]);
        }
        self.fit_rows.differences(simulator, robot, candidates, |index, channel, block, [residual, difference]| {
            products.add(index, channel, block, [residual, difference]);
        });
        first_block = 0;
        for ((log, split), torques) in self.logs.iter().zip(&self.splits).zip(&self.torques) {
            let sigma = torque_sigma(log, robot);
            let reference = torques.error_table(robot);
            let changed = candidates.par_iter().enumerate();
            let changed = changed.filter(|(_, one)| !torques.predict_same_torque(robot, one));
            let tables: Vec<_> = changed.map(|(index, one)| (index, torques.error_table(one))).collect();
            for (index, table) in tables {
                for (row, (before, after)) in reference.iter().zip(&table).enumerate() {
                    let Some(block) = split.block(row) else { continue };
                    for joint in (0..NUM_JOINTS).filter(|joint| before[*joint].is_finite()) {
                        let pair = [before[joint], after[joint] - before[joint]].map(|one| one / sigma[joint]);
                        products.add(index, TORQUE + joint, first_block + block, pair);
                    }
                }
            }
            first_block += split.num_blocks();
        }
        products
    }

    /// Returns true if `hypothesis`, added to `model`, changes the torque at a sensor of the logs.
    pub fn torque_sensor_shows(&self, model: &ModelFile, hypothesis: &Hypothesis) -> bool {
        let mut changed = model.clone();
        let entry = EffectEntry::new(hypothesis.effect, hypothesis.scope, hypothesis.values.clone());
        changed.effects.extend(entry.ok());
        let (Ok(before), Ok(after)) = (model.robot_model(), changed.robot_model()) else { return false };
        let mut logs = self.logs.iter().zip(&self.torques).filter(|(log, _)| has_torque(log));
        logs.any(|(_, torques)| !torques.predict_same_torque(&before, &after))
    }

    /// Returns false if the effect is not identifiable without a torque sensor and the logs have none.
    ///
    /// Such effects imitate others in the motion: at one kd, a wrong velocity gain is viscous friction.
    pub fn has_required_torque(&self, effect: &Effect) -> bool {
        let is_fast_enough = self.logs.iter().any(|log| !log.is_too_slow_for(effect));
        is_fast_enough && (!effect.needs.contains(&DataRequirement::TorqueMeasured) || self.logs.iter().any(has_torque))
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

    /// Returns the measured torques of each log.
    pub fn measured_torques(&self) -> &[MeasuredTorque] {
        &self.torques
    }

    /// Returns the measured torques of the first log.
    pub fn torques(&self) -> &MeasuredTorque {
        &self.torques[0]
    }
}

/// Products of residuals with their differences in several directions, by channel and block.
pub struct BlockProducts {
    /// Number of blocks of all logs.
    pub num_blocks: usize,
    /// Fold of each block.
    pub fold_of_block: Vec<usize>,
    /// Number and sum of squares of the residuals, by channel and fold.
    pub reference: [[[f64; 2]; 2]; CHANNELS],
    /// Product of residual and difference, and square of the difference, by direction, channel and block.
    pub directions: Vec<Vec<Vec<[f64; 2]>>>,
    /// Sum of squares of the differences, by direction, channel and fold.
    pub slopes: Vec<[[f64; 2]; CHANNELS]>,
}

impl BlockProducts {
    fn new(num_blocks: usize, directions: usize) -> Self {
        Self {
            num_blocks,
            fold_of_block: vec![0; num_blocks],
            reference: [[[0.0; 2]; 2]; CHANNELS],
            directions: vec![vec![vec![[0.0; 2]; num_blocks]; CHANNELS]; directions],
            slopes: vec![[[0.0; 2]; CHANNELS]; directions],
        }
    }

    fn add(&mut self, direction: usize, channel: usize, block: usize, [residual, difference]: [f64; 2]) {
        let [product, square] = &mut self.directions[direction][channel][block];
        *product += residual * difference;
        *square += difference * difference;
        self.slopes[direction][channel][self.fold_of_block[block]] += difference * difference;
    }
}

/// Returns the experiments with the windows in which the robot walks or jumps marked, if the others last
/// [`LEAST_QUIET_S`].
///
/// Also returns whether the robot walks or jumps in windows that are not marked.
fn with_dynamic_windows_apart(logs: &[Log], experiments: Vec<Experiment>) -> (Vec<Experiment>, bool) {
    let marked: Vec<Experiment> = experiments.iter().cloned().map(Experiment::mark_dynamic_windows).collect();
    let quiet = |(log, marked): (&Log, &Experiment)| marked.num_quiet_rows() as f64 / log.meta().rate_hz;
    if logs.iter().zip(&marked).map(quiet).sum::<f64>() >= LEAST_QUIET_S {
        return (marked, false);
    }
    let is_dynamic = experiments.iter().zip(&marked).any(|(all, marked)| marked.num_quiet_rows() < all.num_rows());
    (experiments, is_dynamic)
}

/// Returns true if a log has the measured torque of a joint.
fn has_torque(log: &Log) -> bool {
    log.joints().iter().any(|joint| log.tau_measured(joint).is_some())
}

/// Returns the variance of the finite values.
pub fn variance(values: &[f64]) -> f64 {
    let finite = || values.iter().filter(|value| value.is_finite());
    let count = finite().count().max(1) as f64;
    let mean = finite().sum::<f64>() / count;
    finite().map(|value| (value - mean).powi(2)).sum::<f64>() / count
}

/// Returns the standard deviation of torque residuals by joint [N·m].
///
/// It includes noise of the torque sensor, noise of positions and velocities in the PD loop, and model error.
pub fn torque_sigma(log: &Log, robot: &RobotModel) -> [f64; NUM_JOINTS] {
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
