//! Search for the command sequence whose log tells most.

use std::collections::BTreeMap;

use nalgebra::DMatrix;
use twinstep_identify::CmaEs;
use twinstep_identify::least_squares::Differences;
use twinstep_model::{Rollout, stream};

use crate::criterion::{Criterion, identifiable, posterior_std};
use crate::sequence::{CommandRanges, CommandSequence};
use crate::trial::{Limits, Motion, Trial, TrialError};
use crate::unknowns::{InformationError, Unknowns};

/// Standard deviation of the first generation of CMA-ES, relative to half of the ranges.
const FIRST_SPREAD: f64 = 0.5;
/// Cost of a sequence that does not keep the limits, before its excess is added. Larger than any criterion.
const FORBIDDEN: f64 = 1e12;

/// What is searched.
#[derive(Clone, Debug)]
pub struct DesignOptions {
    /// Duration of a segment [s].
    pub segment_s: f64,
    /// Number of segments.
    pub segments: usize,
    /// Commands that a sequence may have.
    pub ranges: CommandRanges,
    /// What a run may do.
    pub limits: Limits,
    /// Number that is maximised.
    pub criterion: Criterion,
    /// Number of sequences to simulate, of which the first generation is random.
    pub candidates: usize,
    /// Seed of the search.
    pub seed: u64,
}

/// A sequence and what its log tells.
#[derive(Clone, Debug)]
pub struct Score {
    /// The sequence.
    pub sequence: CommandSequence,
    /// Value of the criterion.
    pub value: f64,
    /// Standard deviation of each parameter that log and prior leave [prior std].
    pub std: Vec<f64>,
    /// What the robot did.
    pub motion: Motion,
}

/// Result of a search.
#[derive(Clone, Debug)]
pub struct Design {
    /// The best sequence.
    pub best: Score,
    /// The random sequence with the median value, among those that keep the limits.
    pub random: Score,
    /// Number of simulated sequences.
    pub simulated: usize,
    /// Number of sequences that did not keep the limits, by the limit.
    pub rejected: BTreeMap<&'static str, usize>,
}

/// No sequence was found.
#[derive(Debug, thiserror::Error)]
pub enum DesignError {
    /// A policy cannot be simulated.
    #[error(transparent)]
    Trial(#[from] TrialError),
    /// The information of a log cannot be computed.
    #[error(transparent)]
    Information(#[from] InformationError),
    /// No random sequence keeps the limits.
    #[error(
        "none of {tried} random sequences keeps the limits; the last one: {last}\n  allow a larger room, or give \
         smaller velocities or shorter segments"
    )]
    NothingAllowed {
        /// Number of sequences.
        tried: usize,
        /// What the robot did in the last one.
        last: Motion,
    },
}

/// Simulates sequences, as [`crate::simulate`].
pub type RunSequences<'a> = dyn FnMut(&[CommandSequence]) -> Result<Vec<Trial>, TrialError> + 'a;

/// Searches for the sequence that maximises the criterion.
///
/// `progress` receives the number of simulated sequences and the best
/// value so far after each generation, and returns false to end the search with the best sequence so far.
pub fn design(
    unknowns: &Unknowns,
    options: &DesignOptions,
    run: &mut RunSequences<'_>,
    simulator: &mut dyn Rollout,
    progress: &mut dyn FnMut(usize, f64) -> bool,
) -> Result<Design, DesignError> {
    let mut random = stream(options.seed, "excite", 0);
    let mut search = CmaEs::new(&vec![0.0; options.ranges.dim() * options.segments], FIRST_SPREAD);
    let population = search.population();
    let criterion = options.criterion.clone();
    let mut evaluation =
        Evaluation { unknowns, options, criterion, run, simulator, simulated: 0, rejected: BTreeMap::new() };
    let first: Vec<_> = (0..population)
        .map(|_| CommandSequence::random(options.segment_s, options.segments, &options.ranges, &mut random))
        .collect();
    let (mut scores, last) = evaluation.evaluate(&first)?;
    let mut allowed: Vec<Score> = scores.drain(..).filter_map(Result::ok).collect();
    allowed.sort_by(|one, other| one.value.total_cmp(&other.value));
    let median = allowed.get(allowed.len() / 2).cloned();
    let (Some(mut best), Some(median)) = (allowed.pop(), median) else {
        return Err(DesignError::NothingAllowed { tried: population, last });
    };
    search = CmaEs::new(&best.sequence.coordinates(&options.ranges), FIRST_SPREAD);
    while evaluation.simulated < options.candidates && progress(evaluation.simulated, best.value) {
        let points = search.ask(&mut random);
        let sequences: Vec<_> = points
            .iter()
            .map(|point| CommandSequence::from_coordinates(options.segment_s, point, &options.ranges))
            .collect();
        let (scores, _) = evaluation.evaluate(&sequences)?;
        let costs: Vec<f64> = scores.iter().zip(&points).map(|(score, point)| cost(score, point)).collect();
        search.tell(&points, &costs);
        for score in scores.into_iter().flatten() {
            if score.value > best.value {
                best = score;
            }
        }
    }
    let Evaluation { simulated, rejected, .. } = evaluation;
    Ok(Design { best, random: median, simulated, rejected })
}

/// Cost of a point of CMA-ES. Coordinates beyond the ranges cost a little, so that the search does not drift away.
fn cost(score: &Result<Score, f64>, point: &[f64]) -> f64 {
    let beyond: f64 =
        point.iter().map(|coordinate| (coordinate.abs() - 1.0).max(0.0)).map(|beyond| beyond * beyond).sum();
    match score {
        Ok(score) => -score.value + 0.01 * beyond * score.value.abs(),
        Err(excess) => FORBIDDEN * (1.0 + excess),
    }
}

/// Sequences that are evaluated, and their number so far.
struct Evaluation<'a> {
    unknowns: &'a Unknowns,
    options: &'a DesignOptions,
    criterion: Criterion,
    run: &'a mut RunSequences<'a>,
    simulator: &'a mut dyn Rollout,
    simulated: usize,
    rejected: BTreeMap<&'static str, usize>,
}

impl Evaluation<'_> {
    /// Returns the score of each sequence, or the excess of one that does not keep the limits, and the last motion.
    fn evaluate(&mut self, sequences: &[CommandSequence]) -> Result<(Vec<Result<Score, f64>>, Motion), DesignError> {
        let trials = (self.run)(sequences)?;
        let mut scores = Vec::new();
        let mut last = Motion::default();
        for (sequence, trial) in sequences.iter().zip(trials) {
            last = trial.motion;
            scores.push(self.score(sequence, trial)?);
        }
        self.simulated += sequences.len();
        Ok((scores, last))
    }

    fn score(&mut self, sequence: &CommandSequence, trial: Trial) -> Result<Result<Score, f64>, InformationError> {
        if let Some(violation) = self.options.limits.violation(&trial.motion, sequence.duration_s()) {
            *self.rejected.entry(violation.name()).or_default() += 1;
            return Ok(Err(violation.excess()));
        }
        // A log of one row has no window.
        let Some(log) = trial.log else { return Ok(Err(1.0)) };
        let information: Option<DMatrix<f64>> =
            self.unknowns.information(&log, Differences::OneSided, self.simulator)?;
        let Some(information) = information else {
            *self.rejected.entry("diverged").or_default() += 1;
            return Ok(Err(1.0));
        };
        if matches!(&self.criterion, Criterion::Qoed(of_interest) if of_interest.is_empty()) {
            self.criterion = Criterion::Qoed(identifiable(&information));
        }
        let value = self.criterion.value(&information);
        let std = posterior_std(&information);
        Ok(Ok(Score { sequence: sequence.clone(), value, std, motion: trial.motion }))
    }
}
