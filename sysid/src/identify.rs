//! Identification: a global search, a local one, and what the data can and cannot tell.

use twinstep_model::effects::{Effect, EntryError, Scope};
use twinstep_model::{ModelFile, Rollout, stream};

use crate::cmaes::CmaEs;
use crate::experiment::Experiment;
use crate::jacobian::{linear, residuals};
use crate::refine::{cost, covariance, information, refine};
use crate::unknown::{Unknown, set_intervals, start, unknowns, with_values, without_untold};

/// An unknown that keeps more than this share of its prior deviation is left at its prior: the log cannot tell.
const TELLING: f64 = 0.7;
/// Correlations of this size and above are named.
const CORRELATED: f64 = 0.9;
/// Effects whose share of the torque is computed from the log once, for all candidates.
const WEAKENING: [&str; 2] = ["supply_sag", "thermal_derating"];
/// Generations in which the search has to get better by a hundredth.
const PATIENCE: usize = 10;
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
}

impl Default for Options {
    fn default() -> Self {
        Self { generations: 60, seed: 1, force: false }
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
    /// True if it was ended before it was done.
    pub interrupted: bool,
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
    /// No cell of the logs is left.
    #[error("nothing is left to compare: the rows that count hold no measurement after a window's first row")]
    NothingToCompare,
    /// A held trunk and a free one cannot be simulated by one simulator.
    #[error("one log has its base held and another free: identify from one kind at a time")]
    BothBases,
    /// What weakens the motors comes with the log, not with the candidate.
    #[error("`{0}` cannot be identified yet: give its value in the model file")]
    Weakening(&'static str),
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
    if let Some((effect, _)) = effects.iter().find(|(effect, _)| WEAKENING.contains(&effect.name)) {
        return Err(IdentifyError::Weakening(effect.name));
    }
    if experiments.windows(2).any(|pair| pair[0].floating != pair[1].floating) {
        return Err(IdentifyError::BothBases);
    }
    let (file, all) = unknowns(model, effects)?;
    let begin: Vec<f64> = all.iter().map(|unknown| start(&file, unknown)).collect();
    let at = |simulator: &mut dyn Rollout, unknowns: &[Unknown], file: &ModelFile, point: &[f64]| {
        residuals(experiments, simulator, file, unknowns, &[point.to_vec()]).remove(0)
    };
    let first = at(simulator, &[], model, &[]).ok_or(IdentifyError::Diverges)?;
    if first.is_empty() {
        return Err(IdentifyError::NothingToCompare);
    }
    let told = if options.force { vec![true; all.len()] } else { can_tell(&file, &all, experiments, simulator) };
    let mut interrupted = !progress(Stage::Check, 1, rms(&first));
    // What the log cannot tell stays where it starts: at its neutral value where it has one.
    let free: Vec<Unknown> =
        all.iter().zip(&told).filter(|(_, told)| **told).map(|(unknown, _)| unknown.clone()).collect();
    let mut point: Vec<f64> = begin.iter().zip(&told).filter(|(_, told)| **told).map(|(value, _)| *value).collect();
    let mut scale = 1.0;
    if !free.is_empty() && !interrupted {
        (point, interrupted) = search(&file, &free, experiments, simulator, options, point, progress);
        if let Some(found) = at(simulator, &free, &file, &point) {
            scale = (rms(&found) * rms(&found)).max(1.0);
        }
        let mut steps = 0;
        if !interrupted {
            point = refine(experiments, simulator, &file, &free, point, scale, |cost| {
                steps += 1;
                interrupted = !progress(Stage::Refine, steps, cost);
                !interrupted
            });
        }
    }
    let last = at(simulator, &free, &file, &point).unwrap_or_else(|| first.clone());
    let scale = (rms(&last) * rms(&last)).max(1.0);
    let blocks: Vec<usize> = blocks(experiments);
    let spread =
        linear(experiments, simulator, &file, &free, &point).and_then(|here| covariance(&here, &blocks, scale));
    let mut found = with_values(&file, &free, &point);
    let (findings, confusable) = judge(&all, &told, &free, &point, &begin, spread.as_ref());
    let intervals: Vec<_> = findings.iter().map(|finding| finding.interval).collect();
    set_intervals(&mut found, &all, &intervals);
    without_untold(&mut found, model, &all, &told);
    Ok(Identification { model: found, findings, rms: [rms(&first), rms(&last)], confusable, interrupted })
}

fn rms(residuals: &[f64]) -> f64 {
    (residuals.iter().map(|residual| residual * residual).sum::<f64>() / residuals.len().max(1) as f64).sqrt()
}

/// Blocks of all experiments, each with numbers of its own.
fn blocks(experiments: &[Experiment]) -> Vec<usize> {
    let mut all = Vec::new();
    for experiment in experiments {
        let first = all.iter().max().map_or(0, |last| last + 1);
        all.extend(experiment.blocks().into_iter().map(|block| first + block));
    }
    all
}

/// For each unknown, whether its predicted deviation (Fisher information on this motion, prior included) is clearly less
/// than its prior's. Predicted in the middle of the priors, where every effect is there.
fn can_tell(file: &ModelFile, all: &[Unknown], experiments: &[Experiment], simulator: &mut dyn Rollout) -> Vec<bool> {
    let middle: Vec<f64> = all
        .iter()
        .map(|unknown| {
            let [low, high] = unknown.coordinate_bounds();
            unknown.prior[0].clamp(low, high)
        })
        .collect();
    let Some(here) = linear(experiments, simulator, file, all, &middle) else { return vec![true; all.len()] };
    // Closed loops leave errors that go on for long: count a tenth of the rows as independent.
    match information(&here, 10.0).cholesky() {
        Some(factor) => factor.inverse().diagonal().iter().map(|variance| variance.sqrt() < TELLING).collect(),
        None => vec![true; all.len()],
    }
}

fn search(
    file: &ModelFile,
    free: &[Unknown],
    experiments: &[Experiment],
    simulator: &mut dyn Rollout,
    options: &Options,
    begin: Vec<f64>,
    progress: &mut Progress,
) -> (Vec<f64>, bool) {
    let mut random = stream(options.seed, "identify", 0);
    let scaled = |point: &[f64]| -> Vec<f64> {
        free.iter().zip(point).map(|(unknown, value)| (value - unknown.prior[0]) / unknown.prior[1]).collect()
    };
    let mut search = CmaEs::new(&scaled(&begin), 0.5);
    let judged = residuals(experiments, simulator, file, free, std::slice::from_ref(&begin)).remove(0);
    let mut lowest = judged.map_or(f64::MAX, |found| cost(&found, free, &begin, 1.0));
    let (mut best, mut lows) = (begin, Vec::new());
    for generation in 1..=options.generations {
        let asked = search.ask(&mut random);
        // A point beyond a bound is judged at the bound, and pays for the way.
        let points: Vec<Vec<f64>> = asked
            .iter()
            .map(|point| {
                let back = free.iter().zip(point).map(|(unknown, value)| {
                    let [low, high] = unknown.coordinate_bounds();
                    (unknown.prior[0] + value * unknown.prior[1]).clamp(low, high)
                });
                back.collect()
            })
            .collect();
        let costs: Vec<f64> = residuals(experiments, simulator, file, free, &points)
            .iter()
            .zip(points.iter().zip(&asked))
            .map(|(found, (point, asked))| {
                let beyond: f64 = scaled(point).iter().zip(asked).map(|(one, other)| (one - other).powi(2)).sum();
                found.as_ref().map_or(f64::MAX, |found| cost(found, free, point, 1.0) * (1.0 + beyond))
            })
            .collect();
        for (point, cost) in points.iter().zip(&costs) {
            if *cost < lowest {
                lowest = *cost;
                best.clone_from(point);
            }
        }
        search.tell(&asked, &costs);
        if !progress(Stage::Search, generation, lowest) {
            return (best, true);
        }
        // Gauss-Newton is faster in a valley: the search has only to find it.
        lows.push(lowest);
        let before = lows.len().checked_sub(PATIENCE).map(|index| lows[index]);
        if search.width() < 0.01 || before.is_some_and(|before| before - lowest < 0.01 * lowest) {
            break;
        }
    }
    (best, false)
}

type Confusable = Vec<(String, String, f64, Option<&'static str>)>;

fn judge(
    all: &[Unknown],
    told: &[bool],
    free: &[Unknown],
    point: &[f64],
    begin: &[f64],
    spread: Option<&nalgebra::DMatrix<f64>>,
) -> (Vec<Finding>, Confusable) {
    let mut findings = Vec::new();
    let mut place = 0;
    for (index, unknown) in all.iter().enumerate() {
        if !told[index] {
            let (unknown, value) = (unknown.clone(), unknown.value(begin[index]));
            findings.push(Finding { unknown, value, interval: None, verdict: Verdict::CannotTell });
            continue;
        }
        let [low, high] = unknown.coordinate_bounds();
        let at_bound = |end: f64| (point[place] - end).abs() < 1e-6 * unknown.prior[1];
        let verdict = if at_bound(low) || at_bound(high) { Verdict::AtBound } else { Verdict::Found };
        let interval = spread.map(|spread| {
            let half = TWO_SIDED_95 * spread[(place, place)].sqrt() * unknown.prior[1];
            let ends = [unknown.value(point[place] - half), unknown.value(point[place] + half)];
            [ends[0].min(ends[1]), ends[0].max(ends[1])]
        });
        findings.push(Finding { unknown: unknown.clone(), value: unknown.value(point[place]), interval, verdict });
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
