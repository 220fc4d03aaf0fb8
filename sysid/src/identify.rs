//! Identification: a global search, a local one, and what the data can and cannot tell.

use twinstep_model::effects::{Effect, EntryError, Scope};
use twinstep_model::{ModelFile, Precision, Rollout};

use crate::experiment::Experiment;
use crate::refine::{SIMULATORS, covariance, information, refine};
use crate::search::Search;
use crate::task::Task;
use crate::unknown::{Unknown, set_intervals, start, unknowns, with_values, without_untold};

/// An unknown that keeps more than this share of its prior deviation is left at its prior: the log cannot tell.
const TELLING: f64 = 0.7;
/// Correlations of this size and above are named.
const CORRELATED: f64 = 0.9;
/// The normal distribution's two-sided 95 %.
const TWO_SIDED_95: f64 = 1.96;

/// How hard to look.
#[derive(Clone, Debug)]
pub struct Options {
    /// Most generations of the global search.
    pub generations: usize,
    /// Seed of its random numbers.
    pub seed: u64,
    /// Seek also what the log cannot tell.
    pub force: bool,
    /// A search that was ended, to be taken up again.
    pub resume: Option<Search>,
}

impl Default for Options {
    fn default() -> Self {
        Self { generations: 60, seed: 1, force: false, resume: None }
    }
}

/// Where an identification is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Predicting what the log can tell.
    Check,
    /// CMA-ES.
    Search,
    /// Gauss-Newton.
    Refine,
}

/// Said now and then; ends the identification with the best so far when it returns false.
pub type Progress<'a> = dyn FnMut(Stage, usize, f64) -> bool + 'a;

/// What came out of an unknown.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// The unknown.
    pub unknown: Unknown,
    /// Its value.
    pub value: f64,
    /// 95 %; none where the log cannot tell.
    pub interval: Option<[f64; 2]>,
    /// The 95 % interval that was predicted before the search, around the prior's middle.
    pub predicted: [f64; 2],
    /// What is to be said of it.
    pub verdict: Verdict,
}

/// What is to be said of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It was found.
    Found,
    /// It lies at its bound: the truth may be beyond.
    AtBound,
    /// The log cannot tell: it was left at its prior.
    CannotTell,
}

/// What came out.
#[derive(Clone, Debug)]
pub struct Identification {
    /// The model with the values and their intervals.
    pub model: ModelFile,
    /// Unknown by unknown.
    pub findings: Vec<Finding>,
    /// Root mean square of the residuals, in units of their noise, at the start and at the end.
    pub rms: [f64; 2],
    /// Pairs of unknowns that the log cannot part, with their correlation and the experiment that would.
    pub confusable: Vec<(String, String, f64, Option<&'static str>)>,
    /// Where it was ended before it was done, to be taken up again.
    pub interrupted: Option<Search>,
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
    AnotherSearch {
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
    options: &Options,
    progress: &mut Progress,
) -> Result<Identification, IdentifyError> {
    let (file, all) = unknowns(model, effects)?;
    let whole =
        Task { file: &file, unknowns: &all, experiments, spread: &[], tolerances: None, precision: Precision::Double };
    let given =
        Task { file: model, unknowns: &[], experiments, spread: &[], tolerances: None, precision: Precision::Double };
    let first = given.residuals(simulator, &[Vec::new()]).remove(0).ok_or(IdentifyError::Diverges)?;
    if first.is_empty() {
        return Err(IdentifyError::NothingToCompare);
    }
    let begin: Vec<f64> = all.iter().map(|unknown| start(&file, unknown)).collect();
    let predicted = predicted(&whole, simulator);
    let told: Vec<bool> = predicted.iter().map(|deviation| options.force || *deviation < TELLING).collect();
    // What the log cannot tell stays where it starts: at its neutral value where it has one.
    let free: Vec<Unknown> = kept(&all, &told);
    let task = Task { unknowns: &free, ..whole };
    let mut search = match &options.resume {
        Some(resumed) => resumed.clone(),
        None => {
            Search::new(question(&free, first.len(), rms(&first), options.seed), &task, kept(&begin, &told), simulator)
        }
    };
    let asked = question(&free, first.len(), rms(&first), options.seed);
    if search.question != asked {
        return Err(IdentifyError::AnotherSearch { resumed: search.question, asked });
    }
    let mut interrupted = !progress(Stage::Check, 1, rms(&first));
    if !free.is_empty() && !interrupted {
        let mut each = |step, cost| progress(Stage::Search, step, cost);
        interrupted = search.run(
            &Task { precision: Precision::Single, ..task },
            simulator,
            options.generations,
            options.seed,
            &mut each,
        );
    }
    let mut point = search.best.clone();
    let mut spread = task.spread(simulator, &point);
    let mut steps = 0;
    // What the model cannot follow shows better after the first descent.
    for _ in 0..2 {
        if free.is_empty() || interrupted {
            break;
        }
        point = refine(&Task { spread: &spread, ..task }, simulator, point, |cost| {
            steps += 1;
            interrupted = !progress(Stage::Refine, steps, cost);
            !interrupted
        });
        spread = task.spread(simulator, &point);
    }
    let last = task.residuals(simulator, std::slice::from_ref(&point)).remove(0).unwrap_or_else(|| first.clone());
    let here = Task { spread: &spread, ..task }.linear(simulator, &point);
    let spread = here.and_then(|here| covariance(&here, &blocks(experiments), &[]));
    let mut found = with_values(&file, &free, &point);
    let (findings, confusable) = judge(&all, &predicted, &told, &free, &point, &begin, spread.as_ref());
    let intervals: Vec<_> = findings.iter().map(|finding| finding.interval).collect();
    set_intervals(&mut found, &all, &intervals);
    without_untold(&mut found, model, &all, &told);
    let interrupted = interrupted.then_some(search);
    Ok(Identification { model: found, findings, rms: [rms(&first), rms(&last)], confusable, interrupted })
}

fn kept<T: Clone>(all: &[T], told: &[bool]) -> Vec<T> {
    all.iter().zip(told).filter(|(_, told)| **told).map(|(one, _)| one.clone()).collect()
}

/// What a search is about, in words.
fn question(free: &[Unknown], residuals: usize, rms: f64, seed: u64) -> String {
    let names: Vec<_> = free.iter().map(Unknown::name).collect();
    format!("seed {seed}, {residuals} residuals of RMS {rms:.6e}, unknowns {}", names.join(", "))
}

/// The 95 % interval of a deviation [prior deviations] around a coordinate.
fn around(unknown: &Unknown, coordinate: f64, deviation: f64) -> [f64; 2] {
    let half = TWO_SIDED_95 * deviation * unknown.prior[1];
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
fn predicted(task: &Task, simulator: &mut dyn Rollout) -> Vec<f64> {
    let middle = task.within_bounds(&vec![0.0; task.unknowns.len()]);
    // Errors go on for long: count one row in thirty as independent, and with a free trunk one in a window.
    let independent = |group: &usize| if Experiment::is_held(*group) { 30f64.sqrt() } else { 200f64.sqrt() };
    let groups: Vec<usize> = task.experiments.iter().flat_map(Experiment::groups).collect();
    let spread: Vec<f64> = groups.iter().map(independent).collect();
    let here = Task { spread: &spread, ..*task }.linear(simulator, &middle);
    let factor = here.and_then(|here| information(&here).cholesky());
    factor.map_or_else(
        || vec![0.0; task.unknowns.len()],
        |factor| factor.inverse().diagonal().iter().map(|variance| variance.sqrt().hypot(SIMULATORS)).collect(),
    )
}

type Confusable = Vec<(String, String, f64, Option<&'static str>)>;

fn judge(
    all: &[Unknown],
    predicted: &[f64],
    told: &[bool],
    free: &[Unknown],
    point: &[f64],
    begin: &[f64],
    spread: Option<&nalgebra::DMatrix<f64>>,
) -> (Vec<Finding>, Confusable) {
    let mut findings = Vec::new();
    let mut place = 0;
    for (index, unknown) in all.iter().enumerate() {
        let predicted = around(unknown, unknown.prior[0], predicted[index]);
        if !told[index] {
            let (unknown, value) = (unknown.clone(), unknown.value(begin[index]));
            findings.push(Finding { unknown, value, interval: None, predicted, verdict: Verdict::CannotTell });
            continue;
        }
        let [low, high] = unknown.coordinate_bounds();
        let at_bound = |end: f64| (point[place] - end).abs() < 1e-6 * unknown.prior[1];
        let verdict = if at_bound(low) || at_bound(high) { Verdict::AtBound } else { Verdict::Found };
        let interval = spread.map(|spread| around(unknown, point[place], spread[(place, place)].sqrt()));
        let (unknown, value) = (unknown.clone(), unknown.value(point[place]));
        findings.push(Finding { unknown, value, interval, predicted, verdict });
        place += 1;
    }
    let mut confusable = Vec::new();
    if let Some(spread) = spread {
        for i in 0..free.len() {
            for j in 0..i {
                let correlation = spread[(i, j)] / (spread[(i, i)] * spread[(j, j)]).sqrt();
                if correlation.abs() >= CORRELATED {
                    let experiment = free[i].effect.confusions.iter().find(|other| other.with == free[j].effect.name);
                    let back = free[j].effect.confusions.iter().find(|other| other.with == free[i].effect.name);
                    let experiment = experiment.or(back).map(|confusion| confusion.experiment);
                    confusable.push((free[j].name(), free[i].name(), correlation, experiment));
                }
            }
        }
    }
    (findings, confusable)
}
