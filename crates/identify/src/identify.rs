//! Identification: a global search, a local one, and what the data can and cannot tell.

use twinstep_effects::{Effect, EntryError, Scope};
use twinstep_effects::ModelFile;
use twinstep_model::{Precision, Rollout};

use crate::experiment::Experiment;
use crate::refine::{SIMULATOR_MISMATCH_STD, covariance, information, refine};
use crate::global_search::GlobalSearch;
use crate::least_squares::LeastSquaresProblem;
use crate::parameter::{FreeParameter, set_intervals, initial_coordinate, free_parameters, with_values, drop_unidentifiable};

/// An unknown that keeps more than this share of its prior deviation is left at its prior: the log cannot tell.
const MAX_POSTERIOR_TO_PRIOR: f64 = 0.7;
/// Correlations of this size and above are named.
const MIN_CORRELATION: f64 = 0.9;
/// The normal distribution's two-sided 95 %.
const Z_95: f64 = 1.96;

/// How hard to look.
#[derive(Clone, Debug)]
pub struct IdentifyOptions {
    /// Most generations of the global search.
    pub generations: usize,
    /// Seed of its random numbers.
    pub seed: u64,
    /// Seek also what the log cannot tell.
    pub force: bool,
    /// A search that was ended, to be taken up again.
    pub resume: Option<GlobalSearch>,
}

impl Default for IdentifyOptions {
    fn default() -> Self {
        Self { generations: 60, seed: 1, force: false, resume: None }
    }
}

/// Where an identification is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Predicting what the log can tell.
    Identifiability,
    /// CMA-ES.
    GlobalSearch,
    /// Gauss-Newton.
    Refinement,
}

/// Said now and then; ends the identification with the best so far when it returns false.
pub type IdentifyProgress<'a> = dyn FnMut(Stage, usize, f64) -> bool + 'a;

/// What came out of an unknown.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterEstimate {
    /// The unknown.
    pub parameter: FreeParameter,
    /// Its value.
    pub value: f64,
    /// 95 %; none where the log cannot tell.
    pub interval: Option<[f64; 2]>,
    /// The 95 % interval that was predicted before the search, around the prior's middle.
    pub predicted_interval: [f64; 2],
    /// What is to be said of it.
    pub verdict: EstimateStatus,
}

/// What is to be said of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EstimateStatus {
    /// It was found.
    Identified,
    /// It lies at its bound: the truth may be beyond.
    AtBound,
    /// The log cannot tell: it was left at its prior.
    NotIdentifiable,
}

/// What came out.
#[derive(Clone, Debug)]
pub struct Identification {
    /// The model with the values and their intervals.
    pub model: ModelFile,
    /// Unknown by unknown.
    pub findings: Vec<ParameterEstimate>,
    /// Root mean square of the residuals, in units of their noise, at the start and at the end.
    pub rms: [f64; 2],
    /// Pairs of unknowns that the log cannot part, with their correlation and the experiment that would.
    pub correlated: Vec<(String, String, f64, Option<&'static str>)>,
    /// Where it was ended before it was done, to be taken up again.
    pub checkpoint: Option<GlobalSearch>,
}

/// Why there is no identification.
#[derive(Debug, thiserror::Error)]
pub enum IdentifyError {
    /// An effect cannot be sought there.
    #[error(transparent)]
    Entry(#[from] EntryError),
    /// The given model, played through the log's commands, diverges.
    #[error("the simulation of the given model diverges on this log: start from a model that does not")]
    Diverges,
    /// The search that is to be taken up again sought something else.
    #[error("the search to be resumed is another one\n  it:   {resumed}\n  this: {asked}")]
    ResumeMismatch {
        /// What it sought.
        resumed: String,
        /// What is sought now.
        asked: String,
    },
    /// No cell of the logs is left.
    #[error("nothing is left to compare: the rows that count hold no measurement after a window's first row")]
    NothingToCompare,
}

/// Seeks the numbers of `effects` on top of `model`, so that simulations follow the logs of `experiments`.
///
/// The cost is the sum of squares of all residuals in units of their noise, plus the squared distance of each unknown from
/// its prior in prior deviations: SPI-Active's cost (its eq. 4) with the noise as weights. Residuals larger than the
/// stated noise widen it: they are scaled by what the best model leaves.
pub fn identify(
    model: &ModelFile,
    effects: &[(&'static Effect, Scope)],
    experiments: &[Experiment],
    simulator: &mut dyn Rollout,
    options: &IdentifyOptions,
    progress: &mut IdentifyProgress,
) -> Result<Identification, IdentifyError> {
    let (file, all) = free_parameters(model, effects)?;
    let whole =
        LeastSquaresProblem { file: &file, unknowns: &all, experiments, residual_scale: &[], tolerances: None, precision: Precision::Double };
    let given =
        LeastSquaresProblem { file: model, unknowns: &[], experiments, residual_scale: &[], tolerances: None, precision: Precision::Double };
    let first = given.residuals(simulator, &[Vec::new()]).remove(0).ok_or(IdentifyError::Diverges)?;
    if first.is_empty() {
        return Err(IdentifyError::NothingToCompare);
    }
    let begin: Vec<f64> = all.iter().map(|unknown| initial_coordinate(&file, unknown)).collect();
    let predicted = predicted(&whole, simulator);
    let told: Vec<bool> = predicted.iter().map(|deviation| options.force || *deviation < MAX_POSTERIOR_TO_PRIOR).collect();
    // What the log cannot tell stays where it starts: at its neutral value where it has one.
    let free: Vec<FreeParameter> = kept(&all, &told);
    let task = LeastSquaresProblem { unknowns: &free, ..whole };
    let mut search = match &options.resume {
        Some(resumed) => resumed.clone(),
        None => {
            GlobalSearch::new(question(&free, first.len(), rms(&first), options.seed), &task, kept(&begin, &told), simulator)
        }
    };
    let asked = question(&free, first.len(), rms(&first), options.seed);
    if search.problem_key != asked {
        return Err(IdentifyError::ResumeMismatch { resumed: search.problem_key, asked });
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
    // What the model cannot follow shows better after the first descent.
    for _ in 0..2 {
        if free.is_empty() || interrupted {
            break;
        }
        point = refine(&LeastSquaresProblem { residual_scale: &spread, ..task }, simulator, point, |cost| {
            steps += 1;
            interrupted = !progress(Stage::Refinement, steps, cost);
            !interrupted
        });
        spread = task.estimate_residual_scale(simulator, &point);
    }
    let last = task.residuals(simulator, std::slice::from_ref(&point)).remove(0).unwrap_or_else(|| first.clone());
    let here = LeastSquaresProblem { residual_scale: &spread, ..task }.linearise(simulator, &point);
    let spread = here.and_then(|here| covariance(&here, &blocks(experiments), &[]));
    let mut found = with_values(&file, &free, &point);
    let (findings, confusable) = estimates(&all, &predicted, &told, &free, &point, &begin, spread.as_ref());
    let intervals: Vec<_> = findings.iter().map(|finding| finding.interval).collect();
    set_intervals(&mut found, &all, &intervals);
    drop_unidentifiable(&mut found, model, &all, &told);
    let interrupted = interrupted.then_some(search);
    Ok(Identification { model: found, findings, rms: [rms(&first), rms(&last)], correlated: confusable, checkpoint: interrupted })
}

fn kept<T: Clone>(all: &[T], told: &[bool]) -> Vec<T> {
    all.iter().zip(told).filter(|(_, told)| **told).map(|(one, _)| one.clone()).collect()
}

/// What a search is about, in words.
fn question(free: &[FreeParameter], residuals: usize, rms: f64, seed: u64) -> String {
    let names: Vec<_> = free.iter().map(FreeParameter::name).collect();
    format!("seed {seed}, {residuals} residuals of RMS {rms:.6e}, unknowns {}", names.join(", "))
}

/// The 95 % interval of a deviation [prior deviations] around a coordinate.
fn around(unknown: &FreeParameter, coordinate: f64, deviation: f64) -> [f64; 2] {
    let half = Z_95 * deviation * unknown.prior[1];
    let ends = [unknown.value(coordinate - half), unknown.value(coordinate + half)];
    [ends[0].min(ends[1]), ends[0].max(ends[1])]
}

fn rms(residuals: &[f64]) -> f64 {
    (residuals.iter().map(|residual| residual * residual).sum::<f64>() / residuals.len().max(1) as f64).sqrt()
}

/// Blocks of all experiments, each with numbers of its own.
pub fn blocks(experiments: &[Experiment]) -> Vec<usize> {
    let mut all = Vec::new();
    for experiment in experiments {
        let first = all.iter().max().map_or(0, |last| last + 1);
        all.extend(experiment.blocks().into_iter().map(|block| first + block));
    }
    all
}

/// The deviation of each unknown [prior deviations] that the Fisher information of this motion, prior included, lets
/// expect in the middle of the priors, where every effect is there.
fn predicted(task: &LeastSquaresProblem, simulator: &mut dyn Rollout) -> Vec<f64> {
    let middle = task.from_prior_units(&vec![0.0; task.unknowns.len()]);
    // Errors go on for long: count one row in thirty as independent, and with a floating base one in a window.
    let independent = |group: &usize| if Experiment::is_held(*group) { 30f64.sqrt() } else { 200f64.sqrt() };
    let groups: Vec<usize> = task.experiments.iter().flat_map(Experiment::groups).collect();
    let spread: Vec<f64> = groups.iter().map(independent).collect();
    let here = LeastSquaresProblem { residual_scale: &spread, ..*task }.linearise(simulator, &middle);
    let factor = here.and_then(|here| information(&here).cholesky());
    factor.map_or_else(
        || vec![0.0; task.unknowns.len()],
        |factor| factor.inverse().diagonal().iter().map(|variance| variance.sqrt().hypot(SIMULATOR_MISMATCH_STD)).collect(),
    )
}

type CorrelatedPairs = Vec<(String, String, f64, Option<&'static str>)>;

fn estimates(
    all: &[FreeParameter],
    predicted: &[f64],
    told: &[bool],
    free: &[FreeParameter],
    point: &[f64],
    begin: &[f64],
    spread: Option<&nalgebra::DMatrix<f64>>,
) -> (Vec<ParameterEstimate>, CorrelatedPairs) {
    let mut findings = Vec::new();
    let mut place = 0;
    for (index, unknown) in all.iter().enumerate() {
        let predicted = around(unknown, unknown.prior[0], predicted[index]);
        if !told[index] {
            let (unknown, value) = (unknown.clone(), unknown.value(begin[index]));
            findings.push(ParameterEstimate { parameter: unknown, value, interval: None, predicted_interval: predicted, verdict: EstimateStatus::NotIdentifiable });
            continue;
        }
        let [low, high] = unknown.coordinate_bounds();
        let at_bound = |end: f64| (point[place] - end).abs() < 1e-6 * unknown.prior[1];
        let verdict = if at_bound(low) || at_bound(high) { EstimateStatus::AtBound } else { EstimateStatus::Identified };
        let interval = spread.map(|spread| around(unknown, point[place], spread[(place, place)].sqrt()));
        let (unknown, value) = (unknown.clone(), unknown.value(point[place]));
        findings.push(ParameterEstimate { parameter: unknown, value, interval, predicted_interval: predicted, verdict });
        place += 1;
    }
    let mut confusable = Vec::new();
    if let Some(spread) = spread {
        for i in 0..free.len() {
            for j in 0..i {
                let correlation = spread[(i, j)] / (spread[(i, i)] * spread[(j, j)]).sqrt();
                if correlation.abs() >= MIN_CORRELATION {
                    let experiment = free[i].effect.confounders.iter().find(|other| other.effect == free[j].effect.name);
                    let back = free[j].effect.confounders.iter().find(|other| other.effect == free[i].effect.name);
                    let experiment = experiment.or(back).map(|confusion| confusion.discriminating_experiment);
                    confusable.push((free[j].name(), free[i].name(), correlation, experiment));
                }
            }
        }
    }
    (findings, confusable)
}
