//! What a log shows of two models: the one that was given, and the one that the findings extend.

use twinstep_effects::ModelFile;
use twinstep_effects::{CATALOGUE, EffectEntry, EntryError, Target, apply_effects};
use twinstep_identify::{
    Evaluation, ExperimentError, InverseDynamicsResidual, JointSeries, JointTrajectory, evaluate, position_errors,
};
use twinstep_logs::replay::{JointCommands, ReplayError, joint_commands};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{Joint, NUM_JOINTS, RobotModel, Rollout, go2};

use crate::residual_plot::{ResidualPlot, Residuals};
use crate::time_series::TimeSeries;

/// Why there is no evidence.
#[derive(Debug, thiserror::Error)]
pub enum EvidenceError {
    /// Entries of a model do not go together.
    #[error(transparent)]
    Model(#[from] EntryError),
    /// The log cannot be simulated.
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
    /// The log's commands cannot be given to the robot.
    #[error(transparent)]
    Motion(#[from] ReplayError),
}

/// Where a report comes from.
#[derive(Clone, Debug, PartialEq)]
pub struct Provenance {
    /// As it was typed.
    pub command: String,
    /// When.
    pub date: String,
    /// The model that was given.
    pub model: String,
    /// What was diagnosed; the first is in the pictures.
    pub logs: Vec<LogFacts>,
}

/// A log in a line.
#[derive(Clone, Debug, PartialEq)]
pub struct LogFacts {
    /// Its path.
    pub name: String,
    /// Its rows.
    pub rows: usize,
    /// Recorded time [s].
    pub duration_s: f64,
    /// Rows a second [Hz].
    pub rate_hz: f64,
    /// Its parts, by name.
    pub segments: Vec<String>,
}

impl LogFacts {
    /// Those of `log`.
    pub fn of(name: &str, log: &Log) -> Self {
        Self {
            name: name.to_owned(),
            rows: log.rows(),
            duration_s: log.duration_s(),
            rate_hz: log.meta().rate_hz,
            segments: log.meta().segments.iter().map(|segment| segment.name.clone()).collect(),
        }
    }
}

/// What the pictures of a report show; of all rows of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct ReportData {
    /// Errors of the model that was given.
    pub before: Evaluation,
    /// Errors of the extended model.
    pub after: Evaluation,
    /// The worst joint over time: position, and torque where it was measured.
    pub strips: Vec<TimeSeries>,
    /// One for each entry that the extended model has more, where the log shows it.
    pub laws: Vec<ResidualPlot>,
    /// Where it all comes from.
    pub provenance: Provenance,
}

impl ReportData {
    /// Simulates `log` under both models, and under the extended one without each of its findings where the log's
    /// torques do not show them.
    pub fn gather(
        log: &Log,
        given: &ModelFile,
        extended: &ModelFile,
        simulator: &mut dyn Rollout,
        provenance: Provenance,
    ) -> Result<Self, EvidenceError> {
        let [before, after] = [given.robot_model()?, extended.robot_model()?];
        let mut bench =
            LogEvaluator { log, joints: joint_commands(log)?, kinematics: JointTrajectory::of(log)?, simulator };
        let [first, second] = [bench.trial(&before)?, bench.trial(&after)?];
        let laws = (0..extended.effects.len())
            .filter(|index| !given.effects.contains(&extended.effects[*index]))
            .map(|index| bench.law(&extended.effects[index], &without(given, extended, index)?, &after, &second))
            .filter_map(Result::transpose)
            .collect::<Result<_, _>>()?;
        Ok(Self {
            strips: TimeSeries::of(log, [&first, &second]),
            before: first.evaluation,
            after: second.evaluation,
            laws,
            provenance,
        })
    }
}

/// The extended model without one of its entries: what was given stands in its place again.
fn without(given: &ModelFile, extended: &ModelFile, index: usize) -> Result<RobotModel, EntryError> {
    let left_out = &extended.effects[index];
    let same = |entry: &&EffectEntry| entry.effect == left_out.effect && entry.scope == left_out.scope;
    let mut entries = extended.effects.clone();
    match given.effects.iter().find(same) {
        Some(entry) if entries.iter().filter(same).count() == 1 => entries[index] = entry.clone(),
        _ => drop(entries.remove(index)),
    }
    apply_effects(&go2(), &entries)
}

/// A model on a log.
pub struct ModelEvaluation {
    /// By joint.
    pub evaluation: Evaluation,
    /// Simulated less measured position [rad], by row.
    pub position: JointSeries,
    /// Torques of the measured motion.
    pub balance: InverseDynamicsResidual,
}

/// A log, and what simulates it.
struct LogEvaluator<'a> {
    log: &'a Log,
    joints: Vec<JointCommands<'a>>,
    kinematics: JointTrajectory,
    simulator: &'a mut dyn Rollout,
}

impl LogEvaluator<'_> {
    fn trial(&mut self, robot: &RobotModel) -> Result<ModelEvaluation, EvidenceError> {
        Ok(ModelEvaluation {
            evaluation: evaluate(self.log, robot, self.simulator, |_| true)?,
            position: self.position(robot)?,
            balance: InverseDynamicsResidual::of(self.log, robot)?,
        })
    }

    /// Simulated less measured position [rad].
    fn position(&mut self, robot: &RobotModel) -> Result<JointSeries, EvidenceError> {
        let mut cells = [const { Vec::new() }; NUM_JOINTS];
        let errors = position_errors(self.log, robot, self.simulator, |_| true)?;
        for (cells, errors) in cells.iter_mut().zip(&errors).filter(|(_, errors)| !errors.is_empty()) {
            *cells = vec![f64::NAN; self.log.rows()];
            for (row, error) in errors {
                cells[*row] = *error;
            }
        }
        Ok(cells)
    }

    /// The law of `entry` in the residual that shows it best.
    fn law(
        &mut self,
        entry: &EffectEntry,
        without: &RobotModel,
        robot: &RobotModel,
        with: &ModelEvaluation,
    ) -> Result<Option<ResidualPlot>, EvidenceError> {
        let (y_label, residuals) = match best_residual(self.log, entry) {
            Residual::Torque => {
                let of = |balance: &InverseDynamicsResidual| less(&self.measured_torque(), &balance.estimated_torque);
                (
                    "measured − model's torque [N·m]",
                    [of(&InverseDynamicsResidual::of(self.log, without)?), of(&with.balance)],
                )
            }
            Residual::Unexplained => {
                let balance = InverseDynamicsResidual::of(self.log, without)?;
                ("unexplained torque [N·m]", [balance.torque, with.balance.torque.clone()])
            }
            Residual::Position => ("position error [rad]", [self.position(without)?, with.position.clone()]),
        };
        let [without, with] = &residuals;
        let (log, joints, kinematics) = (self.log, &self.joints, &self.kinematics);
        Ok(Residuals { log, robot, joints, kinematics, y_label, without, with }.law(entry))
    }

    fn measured_torque(&self) -> JointSeries {
        std::array::from_fn(|joint| self.log.tau_measured(Joint::ALL[joint].name()).map_or(Vec::new(), <[f64]>::to_vec))
    }
}

enum Residual {
    /// Of the measured torque.
    Torque,
    /// Of the torque that the measured motion needs.
    Unexplained,
    /// Of the simulated position.
    Position,
}

/// Where `entry` shows best: before the torque's sensor in the torque, behind it in the motion.
fn best_residual(log: &Log, entry: &EffectEntry) -> Residual {
    let chain = |name: &str| CATALOGUE.iter().position(|effect| effect.name == name);
    let at_motor = chain(entry.effect.name) <= chain("torque_sensor_delay");
    let held = log.segments().all(|(segment, _)| segment.base == twinstep_model::BaseMount::Fixed);
    let of_joints = matches!(entry.effect.target, Target::Joints | Target::Supply);
    if !of_joints || matches!(entry.effect.name, "backlash" | "joint_elasticity") {
        return Residual::Position;
    }
    let sensor = log.meta().tau_sensor;
    let measured = log.joints().iter().any(|joint| log.tau_measured(joint).is_some());
    match (measured, sensor) {
        (true, TorqueSensor::JointOutput) if entry.effect.name != "joint_spring" => Residual::Torque,
        (true, TorqueSensor::MotorCurrent) if at_motor => Residual::Torque,
        _ if held => Residual::Unexplained,
        _ => Residual::Position,
    }
}

/// Differences, where there are both.
fn less(one: &JointSeries, other: &JointSeries) -> JointSeries {
    std::array::from_fn(|joint| one[joint].iter().zip(&other[joint]).map(|(one, other)| one - other).collect())
}
