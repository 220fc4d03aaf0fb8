//! Experiment design: selects the excitation trajectory that discriminates best between ambiguous causes.

use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, EffectEntry};
use twinstep_logs::Log;
use twinstep_model::{BaseMount, RobotModel, Rollout};

use super::discrimination::HypothesisPair;
use super::hypothesis::Hypothesis;
use super::residual_data::ResidualData;
use crate::excitation::{EXCITATION_TRAJECTORIES, ExcitationTrajectory};
use crate::findings::{CorrelatedPair, DiscriminatedPair, NextExperiment};

/// Maximum number of pairs of causes; each is simulated with every trajectory.
const MAX_PAIRS: usize = 4;
/// Expected log-likelihood ratio below which a trajectory does not discriminate [nat]. Simulators of the same law differ by as much.
const LEAST_RATIO: f64 = 6.0;

/// Proposed experiment with its commands.
#[derive(Clone, Debug)]
pub struct ProposedExperiment {
    /// Summary for the findings. The caller that writes the files sets the name of the motion file.
    pub summary: NextExperiment,
    /// Commands of the experiment.
    pub motion: Log,
}

/// Returns the trajectory that discriminates best between the pairs.
///
/// Returns `None` without pairs, or if no trajectory discriminates between any of them.
pub fn next_motion(
    pairs: &[HypothesisPair],
    evidence: &ResidualData,
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
) -> Option<ProposedExperiment> {
    if pairs.is_empty() {
        return None;
    }
    // Trajectories on the ground need measured base motion.
    let on_ground = evidence.has_free_parts();
    let motions: Vec<ExcitationTrajectory> =
        EXCITATION_TRAJECTORIES.into_iter().filter(|motion| on_ground || motion.base == BaseMount::Fixed).collect();
    let like = &evidence.logs()[0];
    let mut nats = |motion: &ExcitationTrajectory| -> Vec<f64> {
        pairs.iter().map(|pair| pair.expected_log_likelihood_ratio(motion, like, simulator).unwrap_or(0.0)).collect()
    };
    let predicted: Vec<Vec<f64>> = motions.iter().map(&mut nats).collect();
    // The logarithm favours pairs with a small ratio over those that are already well discriminated.
    let worth = |motion: usize| predicted[motion].iter().map(|nats| nats.ln_1p()).sum::<f64>();
    let best = (0..motions.len()).max_by(|one, other| worth(*one).total_cmp(&worth(*other)))?;
    let parts = pairs.iter().enumerate().map(|(index, pair)| {
        let mut all: Vec<f64> = predicted.iter().map(|nats| nats[index]).collect();
        all.sort_by(f64::total_cmp);
        DiscriminatedPair {
            effects: pair.names(),
            predicted_nats: predicted[best][index],
            median_nats: all[all.len() / 2],
        }
    });
    let parts: Vec<_> = parts.filter(|part| part.predicted_nats >= LEAST_RATIO).collect();
    let text = words(&motions[best], &parts)?;
    let said = NextExperiment { motion: String::new(), parts, text };
    Some(ProposedExperiment { summary: said, motion: motions[best].motion(robot) })
}

/// Returns pairs of causes with their ambiguous alternatives, and pairs of causes with highly correlated estimates.
pub fn pairs(
    extended: &ModelFile,
    causes: &[(Hypothesis, Vec<Hypothesis>)],
    confusable: &[CorrelatedPair],
) -> Vec<HypothesisPair> {
    let mut pairs = Vec::new();
    for (cause, others) in causes {
        pairs.extend(others.iter().map(|other| hypothesis_pair(extended, cause, other)));
    }
    for pair in confusable {
        let [one, other] = pair
            .effects
            .each_ref()
            .map(|name| causes.iter().map(|(cause, _)| cause).find(|cause| cause.effect.name == name));
        pairs.extend(one.zip(other).map(|(one, other)| hypothesis_pair(extended, one, other)));
    }
    pairs.retain(|pair| pair.effects().iter().all(|effect| effect.search.predictable));
    pairs.truncate(MAX_PAIRS);
    pairs
}

/// Returns a pair of two hypotheses on top of all other causes.
fn hypothesis_pair(extended: &ModelFile, one: &Hypothesis, other: &Hypothesis) -> HypothesisPair {
    let is = |entry: &EffectEntry, hypothesis: &Hypothesis| {
        entry.effect.name == hypothesis.effect.name && entry.scope.is_within(hypothesis.scope)
    };
    let mut model = extended.clone();
    model.effects.retain(|entry| !is(entry, one) && !is(entry, other));
    let side = |hypothesis: &Hypothesis| -> (&'static Effect, _, _) {
        (hypothesis.effect, hypothesis.scope, hypothesis.values.clone())
    };
    HypothesisPair::new(model, [side(one), side(other)])
}

/// Describes the experiment and the pairs between which it discriminates. Returns `None` without pairs.
fn words(motion: &ExcitationTrajectory, parts: &[DiscriminatedPair]) -> Option<String> {
    let pairs = parts.iter().map(|DiscriminatedPair { effects: [one, other], predicted_nats, median_nats }| {
        format!(
            "{one} and {other}, expected log-likelihood ratio {predicted_nats:.0} nat (median trajectory: \
             {median_nats:.0} nat)"
        )
    });
    let pairs = pairs.collect::<Vec<_>>().join("; ");
    (!pairs.is_empty())
        .then(|| format!("Run {}, 10 s of {}. It discriminates between {pairs}.", motion.name, motion.what))
}
