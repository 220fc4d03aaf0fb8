//! Diagnosis: identifies the effects of the catalogue that a model lacks, by comparison with logs.
//!
//! The causes are those of highest evidence in the equations of the logs ([`twinstep_inference::equations`]).
//!
//! - [`of_go2`]: logs of a Go2; [`of_tree`]: logs of a robot of any tree. [`explained`]: their [`findings`]; [`data_split`]: rows for fits, and
//!   held-out rows of another regime, on which errors are measured. [`promise`]: what they will be.
//! - [`discrimination`], [`experiment_design`]: choose an experiment that discriminates between ambiguous causes, by simulations of
//!   [`excitation`] trajectories; [`hypothesis`]: an effect on a scope, with values; [`fit_problem`]: its fit.
//! - [`true_law`]: how evident a known effect is in a log, by simulations. [`residual_rows`]: residuals of rows; [`residual_power`]: their sums of
//!   squares; [`residual_data`]: residuals of motion and torque together.

mod data_split;
mod discrimination;
mod excitation;
mod experiment_design;
mod explained;
mod findings;
mod fit_problem;
mod hypothesis;
mod of_go2;
mod of_tree;
mod promise;
mod residual_data;
mod residual_power;
mod residual_rows;
mod true_law;

use twinstep_effects::ModelFile;
use twinstep_identify::ExperimentError;
use twinstep_inference::InferenceError;
use twinstep_logs::{Log, TooSlowForMotion};

use data_split::DataSplit;
pub use discrimination::HypothesisPair;
pub use excitation::{EXCITATION_TRAJECTORIES, ExcitationTrajectory};
pub use experiment_design::ProposedExperiment;
pub use findings::{
    AlternativeCause, Cause, CorrelatedPair, Diagnosis, DiscriminatedPair, Estimate, LawTerm, LearnedResidual,
    NextExperiment, NotReported, ParameterValue, Promise, Reduction, RmsErrors, Unexplained, WeightedHypothesis,
};
pub use of_go2::diagnose;
pub use of_tree::{TreeDiagnosis, diagnose_tree};
pub use true_law::true_law_gain;

/// Reason why a diagnosis is impossible.
#[derive(Debug, thiserror::Error)]
pub enum DiagnoseError {
    /// A log cannot be used as an experiment.
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
    /// The given model cannot be simulated.
    #[error("the simulation of the given model diverges on this log: start from a model that does not diverge")]
    Diverges,
    /// The given model is not a valid robot.
    #[error(transparent)]
    Model(#[from] twinstep_effects::EntryError),
    /// The sensors of a log are too slow for its motion.
    #[error(transparent)]
    TooSlowForMotion(#[from] TooSlowForMotion),
    /// The logs differ.
    #[error(
        "the logs have other joints, torque sensors, rates or base orientations, or one states no gains: diagnose them one by one"
    )]
    Unlike,
    /// A log and a robot cannot be compared.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// `progress` returned false.
    #[error("interrupted before completion")]
    Interrupted,
}

/// Progress callback with a description of the current step. The diagnosis is interrupted if it returns false.
pub type DiagnoseProgress<'a> = dyn FnMut(&str) -> bool + 'a;

/// Result of a diagnosis, with the corrected model.
#[derive(Clone, Debug)]
pub struct DiagnosisOutput {
    /// The findings. The caller that writes the files sets `extended_model`.
    pub diagnosis: Diagnosis,
    /// The given model with the gains of the joints, if they differ, the causes and their intervals.
    pub extended: ModelFile,
    /// True if torques, or positions with a fixed base, have a residual above noise that the causes leave.
    pub lacks_torque: bool,
    /// For each log, which rows are held out.
    pub held_out: Vec<Vec<bool>>,
    /// Proposed experiment, if there are ambiguous causes.
    pub next: Option<ProposedExperiment>,
}

/// Returns for each row of a log whether it takes no part in the selections and fits of [`diagnose`], which measures its
/// errors on these rows.
pub fn held_out_rows(log: &Log) -> Vec<bool> {
    let split = DataSplit::new(log);
    (0..log.rows()).map(|row| split.is_held_out(row)).collect()
}
