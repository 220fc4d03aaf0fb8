//! Identification: predicted identifiability, global search, refinement, and intervals.

use nalgebra::DMatrix;
use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, EntryError, Scope};
use twinstep_model::{Precision, Rollout};

use crate::estimates::{CorrelatedPairs, ParameterEstimate, estimates};
use crate::experiment::{Experiment, Regime};
use crate::global_search::GlobalSearch;
use crate::least_squares::{Differences, LeastSquaresProblem};
use crate::local_search::local_search;
use crate::parameter::{
    FreeParameter, coordinate_in, drop_unidentifiable, free_parameters, initial_coordinate, set_intervals, with_values,
};
use crate::refine::{DAMPING_FACTORS, SIMULATOR_MISMATCH_STD, covariance, information, refine};

/// Ratio of posterior to prior standard deviation above which a parameter is not identifiable and keeps its prior.
const MAX_POSTERIOR_TO_PRIOR: f64 = 0.7;
/// Options of an identification.
#[derive(Clone, Debug)]
pub struct IdentifyOptions {
    /// Maximum number of generations of the global search. With 0 there is no local search either: the estimate is that of
    /// gradient steps.
    pub generations: usize,
    /// Random seed of the global search.
    pub seed: u64,
    /// Also estimate parameters that are not identifiable.
    pub force: bool,
    /// Checkpoint of an interrupted search to resume.
    pub resume: Option<GlobalSearch>,
    /// Model from whose values of the effects the search starts. Default: the given model, where an effect that it does
    /// not have does nothing.
    ///
    /// From far away, the search may end in a local minimum on a log of fast walking.
    pub start: Option<ModelFile>,
}

impl Default for IdentifyOptions {
    fn default() -> Self {
        Self { generations: 60, seed: 1, force: false, resume: None, start: None }
    }
}

/// Stage of an identification.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Prediction of identifiability.
    Identifiability,
    /// CMA-ES.
    GlobalSearch,
    /// Levenberg–Marquardt.
    Refinement,
    /// CMA-ES within the uncertainty of the estimate.
    LocalSearch,
}

/// Progress callback with stage, step and value: the RMS residual in the first stage, then the cost.
///
/// If it returns false, the identification is interrupted and returns the best point so far.
pub type IdentifyProgress<'a> = dyn FnMut(Stage, usize, f64) -> bool + 'a;

/// Result of an identification.
#[derive(Clone, Debug)]
pub struct Identification {
    /// The model with the estimates and their intervals.
    pub model: ModelFile,
    /// Estimate of each parameter.
    pub findings: Vec<ParameterEstimate>,
    /// Root mean square of the residuals [noise std] of the given model and of the result.
    pub rms: [f64; 2],
    /// Pairs of highly correlated parameters: names, correlation, and an experiment that discriminates between them.
    pub correlated: CorrelatedPairs,
    /// State of the search for resuming, if the identification was interrupted.
    pub checkpoint: Option<GlobalSearch>,
}

/// Reason why an identification is impossible.
#[derive(Debug, thiserror::Error)]
pub enum IdentifyError {
    /// An effect cannot be estimated at its scope.
    #[error(transparent)]
    Entry(#[from] EntryError),
    /// The simulation of the given model diverges.
    #[error("the simulation of the given model diverges on this log: start from a model that does not diverge")]
    Diverges,
    /// The checkpoint belongs to another problem.
    #[error("the checkpoint belongs to another problem\n  checkpoint: {resumed}\n  requested:  {asked}")]
    ResumeMismatch {
        /// Problem of the checkpoint.
        resumed: String,
        /// Requested problem.
        asked: String,
    },
    /// The selected rows contain no residual.
    #[error("there is nothing to compare: the selected rows contain no measurement after the first row of a window")]
    NothingToCompare,
}

/// Estimates the parameters of `effects` on top of `model` from the logs of `experiments`.
///
/// The cost is the sum of squares of all residuals [noise std], plus the squared distance of each parameter from its
/// prior mean [prior std]: the cost of SPI-Active (eq. 4) with the noise as weights. Residuals that exceed the noise
/// are scaled by the root mean square residual of the best model.
pub fn identify(
    model: &ModelFile,
    effects: &[(&'static Effect, Scope)],
    experiments: &[Experiment],
    simulator: &mut dyn Rollout,
    options: &IdentifyOptions,
    progress: &mut IdentifyProgress,
) -> Result<Identification, IdentifyError> {
    let (file, all) = free_parameters(model, effects)?;
    let (file, begin) = starting_point(file, &all, options.start.as_ref());
    let whole = LeastSquaresProblem {
        file: &file,
        unknowns: &all,
        experiments,
        residual_scale: &[],
        tolerances: None,
        precision: Precision::Double,
    };
    let given = LeastSquaresProblem {
        file: model,
        unknowns: &[],
        experiments,
        residual_scale: &[],
        tolerances: None,
        precision: Precision::Double,
    };
    let first = given.residuals(simulator, &[Vec::new()]).remove(0).ok_or(IdentifyError::Diverges)?;
    if first.is_empty() {
        return Err(IdentifyError::NothingToCompare);
    }
    let predicted = predicted(&whole, simulator);
    let identifiable: Vec<bool> = predicted.iter().map(|std| options.force || *std < MAX_POSTERIOR_TO_PRIOR).collect();
    // Parameters that are not identifiable keep their initial value.
    let free: Vec<FreeParameter> = select(&all, &identifiable);
    let task = LeastSquaresProblem { unknowns: &free, ..whole };
    let mut search = match &options.resume {
        Some(resumed) => resumed.clone(),
        None => GlobalSearch::new(
            problem_key(&free, first.len(), rms(&first), options.seed),
            &task,
            select(&begin, &identifiable),
            simulator,
        ),
    };
    let requested = problem_key(&free, first.len(), rms(&first), options.seed);
    if search.problem_key != requested {
        return Err(IdentifyError::ResumeMismatch { resumed: search.problem_key, asked: requested });
    }
    let mut interrupted = !progress(Stage::Identifiability, 1, rms(&first));
    if !free.is_empty() && !interrupted {
        let mut each = |step, cost| progress(Stage::GlobalSearch, step, cost);
        interrupted = search.run(
            &LeastSquaresProblem { precision: Precision::Single, ..task },
            simulator,
            options.generations,
            options.seed,
            &mut each,
        );
    }
    let mut point = search.best.clone();
    let mut spread = task.estimate_residual_scale(simulator, &point);
    let mut steps = 0;
    // The residual scale is more accurate after the first refinement.
    for _ in 0..2 {
        if free.is_empty() || interrupted {
            break;
        }
        let scaled = LeastSquaresProblem { residual_scale: &spread, ..task };
        point = refine(&scaled, simulator, &DAMPING_FACTORS, point, |cost| {
            steps += 1;
            interrupted = !progress(Stage::Refinement, steps, cost);
            !interrupted
        });
        spread = task.estimate_residual_scale(simulator, &point);
    }
    let searches = options.generations > 0 && experiments.iter().any(Experiment::has_floating_base);
    if !free.is_empty() && !interrupted && searches {
        let scaled = LeastSquaresProblem { residual_scale: &spread, ..task };
        let here = scaled.linearise(simulator, &point);
        if let Some(covariance) = here.and_then(|here| covariance(&here, &blocks(experiments), &[])) {
            let single = LeastSquaresProblem { precision: Precision::Single, ..scaled };
            steps = 0;
            point = local_search(&single, simulator, &point, &covariance, options.seed, |cost| {
                steps += 1;
                interrupted = !progress(Stage::LocalSearch, steps, cost);
                !interrupted
            });
            spread = task.estimate_residual_scale(simulator, &point);
        }
    }
    let last = task.residuals(simulator, std::slice::from_ref(&point)).remove(0).unwrap_or_else(|| first.clone());
    let here = LeastSquaresProblem { residual_scale: &spread, ..task }.linearise(simulator, &point);
    let spread = here.and_then(|here| covariance(&here, &blocks(experiments), &[]));
    let mut found = with_values(&file, &free, &point);
    let (findings, correlated) = estimates(&all, &predicted, &identifiable, &free, &point, &begin, spread.as_ref());
    let intervals: Vec<_> = findings.iter().map(|finding| finding.interval).collect();
    set_intervals(&mut found, &all, &intervals);
    drop_unidentifiable(&mut found, model, &all, &identifiable);
    let interrupted = interrupted.then_some(search);
    Ok(Identification { model: found, findings, rms: [rms(&first), rms(&last)], correlated, checkpoint: interrupted })
}

/// Returns the file and the coordinates of the parameters with the values of `start`, if there is one.
fn starting_point(file: ModelFile, all: &[FreeParameter], start: Option<&ModelFile>) -> (ModelFile, Vec<f64>) {
    let coordinate = |unknown: &FreeParameter| {
        let in_start = start.and_then(|start| coordinate_in(start, unknown));
        in_start.unwrap_or_else(|| initial_coordinate(&file, unknown))
    };
    let begin: Vec<f64> = all.iter().map(coordinate).collect();
    let file = if start.is_some() { with_values(&file, all, &begin) } else { file };
    (file, begin)
}

fn select<T: Clone>(all: &[T], identifiable: &[bool]) -> Vec<T> {
    all.iter().zip(identifiable).filter(|(_, identifiable)| **identifiable).map(|(one, _)| one.clone()).collect()
}

/// Returns a description of the problem, which identifies a checkpoint.
fn problem_key(free: &[FreeParameter], residuals: usize, rms: f64, seed: u64) -> String {
    let names: Vec<_> = free.iter().map(FreeParameter::name).collect();
    format!("seed {seed}, {residuals} residuals of RMS {rms:.6e}, free parameters {}", names.join(", "))
}

fn rms(residuals: &[f64]) -> f64 {
    (residuals.iter().map(|residual| residual * residual).sum::<f64>() / residuals.len().max(1) as f64).sqrt()
}

/// Returns the blocks of the residuals of all experiments, with distinct numbers for each experiment.
pub fn blocks(experiments: &[Experiment]) -> Vec<usize> {
    let mut all = Vec::new();
    for experiment in experiments {
        let first = all.iter().max().map_or(0, |last| last + 1);
        all.extend(experiment.blocks().into_iter().map(|block| first + block));
    }
    all
}

/// Predicts the standard deviation of each parameter [prior std] from the Fisher information of residuals and prior.
///
/// It is evaluated at the prior means, where every effect acts.
fn predicted(task: &LeastSquaresProblem, simulator: &mut dyn Rollout) -> Vec<f64> {
    let prior_mean = task.from_prior_units(&vec![0.0; task.unknowns.len()]);
    let factor = predicted_information(task, Differences::Central, simulator, &prior_mean).and_then(DMatrix::cholesky);
    factor.map_or_else(
        || vec![0.0; task.unknowns.len()],
        |factor| {
            factor.inverse().diagonal().iter().map(|variance| variance.sqrt().hypot(SIMULATOR_MISMATCH_STD)).collect()
        },
    )
}

/// Returns the Fisher information of residuals and prior at `point` [1/prior std²], before anything is fitted.
///
/// Returns `None` if a simulation diverges.
pub fn predicted_information(
    task: &LeastSquaresProblem,
    differences: Differences,
    simulator: &mut dyn Rollout,
    point: &[f64],
) -> Option<DMatrix<f64>> {
    // Residuals are correlated: one row in thirty counts as independent, and one in 200, a window, with a floating
    // base.
    let independent =
        |group: &usize| if Experiment::regime(*group) == Regime::Fixed { 30f64.sqrt() } else { 200f64.sqrt() };
    let groups: Vec<usize> = task.experiments.iter().flat_map(Experiment::groups).collect();
    let spread: Vec<f64> = groups.iter().map(independent).collect();
    let task = LeastSquaresProblem { residual_scale: &spread, ..*task };
    let here = task.linearise_by(differences, simulator, point)?;
    Some(information(&here))
}
