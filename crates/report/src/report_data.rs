//! Data of the report: errors of the given and the extended model on one log, and the law of each cause.

use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, EffectEntry, EntryError, Scope, Target, Visibility, apply_effects};
use twinstep_identify::{
    Evaluation, ExperimentError, InverseDynamicsResidual, JointSeries, JointTrajectory, evaluate, position_errors,
};
use twinstep_logs::replay::{JointCommands, ReplayError, joint_commands};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{Joint, NUM_JOINTS, RobotModel, Rollout};

use crate::model_evaluation::ModelEvaluation;
use crate::residual_plot::{ResidualPlot, Residuals};
use crate::time_series::TimeSeries;

/// Reason why the data of a report could not be computed.
#[derive(Debug, thiserror::Error)]
pub enum EvidenceError {
    /// Effect entries of a model conflict.
    #[error(transparent)]
    Model(#[from] EntryError),
    /// The log cannot be simulated.
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
    /// The log's commands cannot be simulated.
    #[error(transparent)]
    Motion(#[from] ReplayError),
}

/// Provenance of a report.
#[derive(Clone, Debug, PartialEq)]
pub struct Provenance {
    /// Command line.
    pub command: String,
    /// Date of the diagnosis.
    pub date: String,
    /// Name of the given model.
    pub model: String,
    /// Diagnosed logs. The first one is plotted.
    pub logs: Vec<LogFacts>,
    /// Pages beside the report that play the first log, with the simulation as the robot's ghost.
    pub motions: Vec<String>,
}

/// Summary of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogFacts {
    /// Path of the log.
    pub name: String,
    /// Number of rows.
    pub rows: usize,
    /// Recorded time [s].
    pub duration_s: f64,
    /// Rate of the rows [Hz].
    pub rate_hz: f64,
    /// Names of the segments.
    pub segments: Vec<String>,
}

impl LogFacts {
    /// Returns the summary of `log`.
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

/// Data of a report's figures, from all rows of one log.
#[derive(Clone, Debug, PartialEq)]
pub struct ReportData {
    /// Errors of the given model.
    pub before: Evaluation,
    /// Errors of the extended model.
    pub after: Evaluation,
    /// Worst joint over time: position, and torque if it was measured.
    pub strips: Vec<TimeSeries>,
    /// Residual plot of each entry that only the extended model has, if the log has the quantities for it.
    pub laws: Vec<ResidualPlot>,
    /// Provenance of the report.
    pub provenance: Provenance,
}

impl ReportData {
    /// Simulates `log` with both models, and with the extended model without single causes where a residual plot needs it.
    pub fn gather(
        log: &Log,
        given: &ModelFile,
        extended: &ModelFile,
        causes: &[(&'static Effect, Scope)],
        simulator: &mut dyn Rollout,
        provenance: Provenance,
    ) -> Result<Self, EvidenceError> {
        let [before, after] = [given.robot_model()?, extended.robot_model()?];
        let mut evaluator =
            LogEvaluator { log, joints: joint_commands(log)?, kinematics: JointTrajectory::of(log)?, simulator };
        let [first, second] = [evaluator.evaluate_model(&before)?, evaluator.evaluate_model(&after)?];
        let laws = causes
            .iter()
            .map(|cause| evaluator.law(*cause, &without(given, extended, *cause)?, &after, &second))
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

/// Returns the extended model without an effect on the parts of a scope, as the given model has them.
fn without(
    given: &ModelFile,
    extended: &ModelFile,
    (effect, scope): (&Effect, Scope),
) -> Result<RobotModel, EntryError> {
    let is_removed = |entry: &&EffectEntry| entry.effect == effect && entry.scope.is_within(scope);
    let kept = extended.effects.iter().filter(|entry| !is_removed(entry));
    let entries: Vec<EffectEntry> = kept.chain(given.effects.iter().filter(is_removed)).cloned().collect();
    apply_effects(&given.nominal.model, &entries)
}

/// Evaluates models on one log.
struct LogEvaluator<'a> {
    log: &'a Log,
    joints: Vec<JointCommands<'a>>,
    kinematics: JointTrajectory,
    simulator: &'a mut dyn Rollout,
}

impl LogEvaluator<'_> {
    fn evaluate_model(&mut self, robot: &RobotModel) -> Result<ModelEvaluation, EvidenceError> {
        Ok(ModelEvaluation {
            evaluation: evaluate(self.log, robot, self.simulator, |_| true)?,
            position: self.position(robot)?,
            balance: InverseDynamicsResidual::of(self.log, robot)?,
        })
    }

    /// Returns simulated minus measured position [rad], by joint and row.
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

    /// Returns the residual plot of a cause, in the residual of [`best_residual`].
    fn law(
        &mut self,
        (effect, scope): (&'static Effect, Scope),
        without: &RobotModel,
        robot: &RobotModel,
        with: &ModelEvaluation,
    ) -> Result<Option<ResidualPlot>, EvidenceError> {
        let (y_label, residuals) = match best_residual(self.log, effect) {
            Residual::Torque => {
                let of =
                    |balance: &InverseDynamicsResidual| difference(&self.measured_torque(), &balance.estimated_torque);
                (
                    "measured − modelled torque [N·m]",
                    [of(&InverseDynamicsResidual::of(self.log, without)?), of(&with.balance)],
                )
            }
            Residual::Unexplained => {
                let balance = InverseDynamicsResidual::of(self.log, without)?;
                ("inverse-dynamics residual [N·m]", [balance.torque, with.balance.torque.clone()])
            }
            Residual::Position => ("position error [rad]", [self.position(without)?, with.position.clone()]),
        };
        let [without, with] = &residuals;
        let (log, joints, kinematics) = (self.log, &self.joints, &self.kinematics);
        Ok(Residuals { log, robot, joints, kinematics, y_label, without, with }.law(effect, scope))
    }

    fn measured_torque(&self) -> JointSeries {
        std::array::from_fn(|joint| self.log.tau_measured(Joint::ALL[joint].name()).map_or(Vec::new(), <[f64]>::to_vec))
    }
}

enum Residual {
    /// Measured minus modelled torque.
    Torque,
    /// Inverse-dynamics residual.
    Unexplained,
    /// Simulated minus measured position.
    Position,
}

/// Returns the residual in which an effect is most visible: torque for effects before the torque sensor, else motion.
fn best_residual(log: &Log, effect: &Effect) -> Residual {
    let fixed_base = log.segments().all(|(segment, _)| segment.base == twinstep_model::BaseMount::Fixed);
    let of_joints = matches!(effect.target, Target::Joints | Target::Supply);
    let measured = log.joints().iter().any(|joint| log.tau_measured(joint).is_some());
    let sensor = if measured { log.meta().tau_sensor } else { TorqueSensor::None };
    match (effect.visibility, sensor) {
        (Visibility::Position, _) => Residual::Position,
        _ if !of_joints => Residual::Position,
        (Visibility::MotorTorque, TorqueSensor::MotorCurrent | TorqueSensor::JointOutput)
        | (Visibility::OutputTorque, TorqueSensor::JointOutput) => Residual::Torque,
        _ if fixed_base => Residual::Unexplained,
        _ => Residual::Position,
    }
}

/// Returns the differences in rows that both series have.
fn difference(one: &JointSeries, other: &JointSeries) -> JointSeries {
    std::array::from_fn(|joint| one[joint].iter().zip(&other[joint]).map(|(one, other)| one - other).collect())
}
