//! Forward selection of causes with backward elimination.

use std::collections::{BTreeMap, BTreeSet};

use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_model::{Joint, RobotModel, Rollout};

use super::DiagnoseError;
use super::affected_channels::explains_affected_channels;
use super::candidates::candidates;
use super::confounders::{confounders_of, on_parts};
use super::cross_validation::{Accepted, CandidateFit, FitProblem, cross_validate, cross_validate_together};
use super::hypothesis::{Hypothesis, ScoredHypothesis};
use super::joint_gains::{self, JointGains};
use super::null_distribution::{self, LOWEST_THRESHOLD};
use super::profile_likelihood::refine_with_restarts;
use super::residual_data::ResidualData;
use super::residual_power::ResidualPower;
use super::ripple_scan::repeats;
use super::scan::{self, scan};
use super::scope_merging;

/// Log-likelihood gain that a cause must reach where no null distribution is computed: torques of other robots, and the
/// friction family [nat].
///
/// Set by hand after a false positive with 22 nat in a case of `twinstep hunt` that is not in a published table.
pub const THRESHOLD: f64 = 30.0;
/// Share of a log-likelihood gain that errors of its law may be: what another cause gains in the legs of a further cause, of which
/// that must gain as much, and the largest gain, for causes that are merged.
///
/// The laws of the catalogue are approximations, and what a large effect leaves imitates small ones in the same legs.
const MIN_SHARE_OF_LARGEST: f64 = 0.01;
/// Maximum number of causes.
const MOST_CAUSES: usize = 12;
/// Maximum number of rounds of selection and elimination.
const MOST_SEARCHES: usize = 24;
/// Maximum number of causes that are eliminated before the search ends.
const MOST_ELIMINATIONS: usize = 3;
/// Fraction of the power above noise that a cause must explain.
pub const MIN_EXPLAINED_FRACTION: f64 = 0.3;
/// The same fraction, for a cause that is too small to report. It is added until the end of the search.
///
/// What explains nearly everything is the true cause. Without it, others that imitate it would be added in its place.
const EXPLAINED_BY_SMALL_CAUSE: f64 = 0.9;

/// Residuals of logs in windows of one length.
pub struct WindowedData {
    /// Residuals of the logs.
    pub evidence: ResidualData,
    /// Residual power of the given model.
    pub given: ResidualPower,
}

impl WindowedData {
    /// Adds the nuisance parameters of `judged` to the data, and computes the residual power of `robot`.
    pub fn new(
        mut evidence: ResidualData,
        judged: &ModelFile,
        robot: &RobotModel,
        simulator: &mut dyn Rollout,
    ) -> Result<Self, DiagnoseError> {
        evidence.set_nuisance_model(&judged.robot_model()?, simulator);
        let given = evidence.residual_power(simulator, robot);
        Ok(Self { evidence, given })
    }
}

/// Scan of the catalogue on top of a model.
pub struct Scan {
    view: usize,
    model: ModelFile,
    found: Vec<ScoredHypothesis>,
}

/// State of the forward selection.
pub struct ForwardSelection<'a> {
    /// Data in long windows, and in short ones if the given model fails to track the joints in the long ones.
    pub views: &'a [WindowedData],
    /// Index of the data in use.
    pub view: usize,
    /// The given model with fitted ground, and with the gains of the joints, if they differ.
    pub baseline: ModelFile,
    pub accepted: Accepted,
    /// [`ForwardSelection::baseline`] with all accepted causes, fitted jointly to both folds.
    pub model: ModelFile,
    /// Scan's scores of hypotheses by name when a fit did not support them [nat].
    pub unsupported: BTreeMap<String, f64>,
    /// Last scan without causes.
    pub scan_without_causes: Option<Scan>,
    /// Gains of the joints that are in [`ForwardSelection::baseline`], if they differ.
    pub joint_gains: Option<JointGains>,
    pub simulator: &'a mut dyn Rollout,
    pub progress: &'a mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
}

impl<'a> ForwardSelection<'a> {
    /// Runs forward selection with backward elimination.
    ///
    /// Each round adds the best candidate, or the gains of all joints, and refits all causes. If none reaches the threshold, a
    /// cause that is implausible or leaves much of the error of its own channels is removed and excluded. Causes that are too
    /// small are removed at the end.
    pub fn run(&mut self) -> Result<(), DiagnoseError> {
        let mut excluded = Vec::new();
        for _ in 0..MOST_SEARCHES {
            let next = if self.accepted.len() < MOST_CAUSES { self.best_addition(&excluded)? } else { None };
            if let Some((best, _)) = &next
                && self.joint_gains_explain_more(best)?
            {
                continue;
            }
            let added = next.as_ref().map(|(best, _)| best.hypothesis.effect);
            if let Some(next) = next {
                self.accepted.push(next);
            } else {
                let place = self.find_cause_to_eliminate().filter(|_| excluded.len() < MOST_ELIMINATIONS);
                let Some(place) = place else { break };
                excluded.push(self.accepted.remove(place).0.hypothesis.name());
            }
            self.refit();
            if let Some(effect) = added {
                self.merge_scopes(effect, &excluded);
            }
        }
        while let Some(place) = self.find_cause_to_eliminate() {
            self.accepted.remove(place);
            self.refit();
        }
        // Too small to report. They stay until here, because without them the others explain less.
        let found = self.accepted.len();
        self.accepted.retain(|(best, _)| best.hypothesis.exceeds_min_size());
        if self.accepted.len() < found {
            self.refit();
        }
        Ok(())
    }

    /// Adds the gains of the joints to the model if they are more likely than `best`. Returns true if so.
    fn joint_gains_explain_more(&mut self, best: &CandidateFit) -> Result<bool, DiagnoseError> {
        if self.joint_gains.is_some() {
            return Ok(false);
        }
        (self.progress)(&format!("fitting the gains of all joints; causes: {}", self.accepted.len()))?;
        let evidence = &self.looked_at().evidence;
        let gains = JointGains::fit(evidence, &self.model, best.score, self.simulator);
        let Some(gains) = gains.filter(|gains| gains.score > best.score) else { return Ok(false) };
        self.baseline = gains.added_to(&self.baseline);
        self.joint_gains = Some(gains);
        self.refit();
        Ok(true)
    }

    /// Merges the causes of each effect as [`ForwardSelection::merge_scopes`] does.
    pub fn merge_all_scopes(&mut self) {
        let effects: BTreeSet<&str> = self.accepted.iter().map(|(cause, _)| cause.hypothesis.effect.name).collect();
        effects.into_iter().filter_map(Effect::named).for_each(|effect| self.merge_scopes(effect, &[]));
    }

    /// Replaces the causes with this effect by one on a wider scope that is not `excluded`, and refits all, if that loses less
    /// than [`MIN_SHARE_OF_LARGEST`] of the largest log-likelihood gain.
    fn merge_scopes(&mut self, effect: &Effect, excluded: &[String]) {
        let mut wider = scope_merging::with_wider_scopes(&self.accepted, effect);
        wider.retain(|causes| causes.iter().all(|(cause, _)| !excluded.contains(&cause.hypothesis.name())));
        if wider.is_empty() {
            return;
        }
        let before = self.gain_of(&self.accepted.clone());
        let largest = self.accepted.iter().map(|(cause, _)| cause.score).fold(0.0, f64::max);
        let gains: Vec<f64> = wider.iter().map(|causes| self.gain_of(causes)).collect();
        let best = gains.iter().zip(wider).max_by(|(one, _), (other, _)| one.total_cmp(other));
        if let Some((_, causes)) = best.filter(|(gain, _)| **gain >= before - MIN_SHARE_OF_LARGEST * largest) {
            self.accepted = causes;
            self.refit();
        }
    }

    /// Returns the cross-validated log-likelihood gain of causes [nat].
    fn gain_of(&mut self, causes: &Accepted) -> f64 {
        let hypotheses: Vec<Hypothesis> = causes.iter().map(|(cause, _)| cause.hypothesis.clone()).collect();
        cross_validate_together(&self.looked_at().evidence, &self.baseline, &hypotheses, self.simulator)
    }

    /// Returns the index of a cause to eliminate after the joint refit, if any.
    fn find_cause_to_eliminate(&mut self) -> Option<usize> {
        let WindowedData { evidence, given } = self.looked_at();
        let robot = self.model.robot_model().expect("fitted within its bounds");
        let left = evidence.residual_power(self.simulator, &robot);
        // What the gains of the joints explain, a cause does not.
        let with_gains = self.joint_gains.is_some().then(|| {
            let baseline = self.baseline.robot_model().expect("fitted within its bounds");
            evidence.residual_power(self.simulator, &baseline)
        });
        let given = with_gains.as_ref().unwrap_or(given);
        let stands = |hypothesis: &Hypothesis| {
            let at_sensor = evidence.torque_sensor_shows(&self.baseline, hypothesis);
            let is_plausible = hypothesis.is_plausible() && repeats(evidence.logs(), hypothesis);
            is_plausible && explains_affected_channels(hypothesis, at_sensor, given, &left)
        };
        self.accepted.iter().position(|(best, _)| !stands(&best.hypothesis))
    }

    /// Returns the best candidate on top of the accepted causes with its alternatives, if one reaches the threshold.
    fn best_addition(
        &mut self,
        excluded: &[String],
    ) -> Result<Option<(CandidateFit, Vec<CandidateFit>)>, DiagnoseError> {
        let evidence = &self.looked_at().evidence;
        let left = evidence.residual_power(self.simulator, &self.model.robot_model()?);
        let named = self.accepted.len();
        (self.progress)(&format!("scanning the catalogue; causes: {named}"))?;
        for candidates in candidates(self.scanned(), evidence.is_dynamic) {
            let found = self.best_of(candidates, excluded, &left)?;
            if found.is_some() {
                return Ok(found);
            }
        }
        Ok(None)
    }

    /// Scans the catalogue on top of the model. The search returns to the model without causes whenever it eliminates the only
    /// one; that scan is kept.
    fn scanned(&mut self) -> Vec<ScoredHypothesis> {
        let evidence = &self.looked_at().evidence;
        let is_known = |known: &Scan| known.view == self.view && known.model == self.model;
        if let Some(known) = self.scan_without_causes.as_ref().filter(|known| is_known(known)) {
            return known.found.clone();
        }
        let found = scan(evidence, &self.model, self.simulator);
        if self.accepted.is_empty() {
            self.scan_without_causes = Some(Scan { view: self.view, model: self.model.clone(), found: found.clone() });
        }
        found
    }

    /// Returns the best of `candidates` on top of the model with residual power `left`, with its alternatives, if it reaches
    /// the threshold.
    fn best_of(
        &mut self,
        mut candidates: Vec<ScoredHypothesis>,
        excluded: &[String],
        left: &ResidualPower,
    ) -> Result<Option<(CandidateFit, Vec<CandidateFit>)>, DiagnoseError> {
        let (evidence, named) = (&self.looked_at().evidence, self.accepted.len());
        // With more causes in the model, a hypothesis is fitted again only if the scan supports it more.
        let unsupported = &self.unsupported;
        candidates
            .retain(|scored| unsupported.get(&scored.hypothesis.name()).is_none_or(|score| scored.score > *score));
        let hypotheses = candidates.iter().map(|scored| scored.hypothesis.clone()).collect();
        let mut trials = self.evaluate(hypotheses, excluded, left)?;
        for trial in trials.iter().filter(|trial| trial.score < LOWEST_THRESHOLD) {
            let name = trial.hypothesis.name();
            let score = candidates.iter().find(|scored| scored.hypothesis.name() == name).map(|scored| scored.score);
            self.unsupported.extend(score.map(|score| (name, score)));
        }
        let Some(best) = trials.first().filter(|best| best.score >= LOWEST_THRESHOLD) else { return Ok(None) };
        (self.progress)(&format!("computing the threshold; causes: {named}"))?;
        let with_best = FitProblem::new(&self.model, std::slice::from_ref(&best.hypothesis));
        let with_best = with_best.map_or(self.model.clone(), |fit| fit.model(&fit.initial_point));
        let thresholds = null_distribution::thresholds(evidence, &with_best, self.simulator);
        if best.score >= thresholds.of(best.hypothesis.effect) {
            // Confounders of the best candidate, and its parts, which the scan may have missed.
            let best = best.hypothesis.clone();
            let tried = self.tried(&trials, excluded);
            let mut alike = confounders_of(evidence, &self.model, &best, &tried, self.simulator);
            alike.extend(on_parts(evidence, &self.model, &best, &tried, self.simulator));
            trials.extend(self.evaluate(alike, excluded, left)?);
            trials.sort_by(best_first);
            let now = trials[0].hypothesis.clone();
            if now.name() != best.name() {
                let tried = self.tried(&trials, excluded);
                let parts = on_parts(evidence, &self.model, &now, &tried, self.simulator);
                trials.extend(self.evaluate(parts, excluded, left)?);
                trials.sort_by(best_first);
            }
        }
        let gains_there = |trial: &CandidateFit| {
            let there = |cause: &CandidateFit| cause.score * share_at(cause.hypothesis.scope, trial.hypothesis.scope);
            self.accepted.iter().map(|(cause, _)| there(cause)).fold(0.0, f64::max)
        };
        let least = |trial: &CandidateFit| {
            thresholds.of(trial.hypothesis.effect).max(MIN_SHARE_OF_LARGEST * gains_there(trial))
        };
        let explains = |trial: &CandidateFit| {
            let small = !trial.hypothesis.exceeds_min_size();
            trial.explained_fraction >= if small { EXPLAINED_BY_SMALL_CAUSE } else { MIN_EXPLAINED_FRACTION }
        };
        let place = trials.iter().position(|trial| trial.score >= least(trial) && explains(trial));
        let accepted = place.map(|place| {
            let trial = trials.remove(place);
            // What was rejected although it scores more is no alternative.
            trials.retain(|other| other.score <= trial.score);
            CandidateFit { threshold: least(&trial), ..trial }
        });
        Ok(accepted.map(|best| (best, trials)))
    }

    /// Cross-validates hypotheses on top of the model with residual power `left`. Returns them with the best first.
    fn evaluate(
        &mut self,
        hypotheses: Vec<Hypothesis>,
        excluded: &[String],
        left: &ResidualPower,
    ) -> Result<Vec<CandidateFit>, DiagnoseError> {
        let evidence = &self.looked_at().evidence;
        let mut trials = Vec::new();
        for hypothesis in hypotheses {
            if !self.is_excluded(&hypothesis, excluded) {
                (self.progress)(&format!("fitting {}; causes: {}", hypothesis.name(), self.accepted.len()))?;
                let hypothesis = scan::refine_grid(evidence, &self.model, hypothesis, self.simulator);
                trials.extend(cross_validate(evidence, &self.model, left, &hypothesis, self.simulator));
            }
        }
        trials.retain(|trial| repeats(evidence.logs(), &trial.hypothesis));
        trials.sort_by(best_first);
        Ok(trials)
    }

    /// Returns the names of the accepted causes, the trials and the excluded hypotheses.
    fn tried(&self, trials: &[CandidateFit], excluded: &[String]) -> Vec<String> {
        let accepted = self.accepted.iter().map(|(cause, _)| cause);
        let names = accepted.chain(trials).map(|trial| trial.hypothesis.name());
        names.chain(excluded.iter().cloned()).collect()
    }

    fn looked_at(&self) -> &'a WindowedData {
        &self.views[self.view]
    }

    /// Returns true if a hypothesis was eliminated or is accepted.
    fn is_excluded(&self, hypothesis: &Hypothesis, excluded: &[String]) -> bool {
        let named = |accepted: &CandidateFit| accepted.hypothesis.name() == hypothesis.name();
        let is_in_baseline = self.joint_gains.is_some() && hypothesis.effect.name == joint_gains::EFFECT;
        is_in_baseline
            || excluded.contains(&hypothesis.name())
            || self.accepted.iter().any(|(accepted, _)| named(accepted))
    }

    /// Refits all accepted causes jointly.
    pub fn refit(&mut self) {
        let hypotheses: Vec<_> = self.accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
        self.model = self.baseline.clone();
        let Some(fit) = FitProblem::new(&self.baseline, &hypotheses).filter(|_| !hypotheses.is_empty()) else {
            return self.choose_windows();
        };
        let point = refine_with_restarts(&fit, &self.looked_at().evidence, self.simulator);
        self.model = fit.model(&point);
        write_estimates(&mut self.accepted, &fit, &point);
        self.choose_windows();
    }

    /// Selects long windows if the model tracks the joints in them, because they are more informative.
    fn choose_windows(&mut self) {
        if self.views.len() > 1 {
            let robot = self.model.robot_model().expect("fitted within its bounds");
            let evidence = &self.views[0].evidence;
            self.view = usize::from(evidence.fails_to_track(&evidence.residual_power(self.simulator, &robot)));
        }
    }
}

/// Returns the share of a cause's joints that are in the legs of `at`; 1 without joints, as for the base or the ground.
fn share_at(of: Scope, at: Scope) -> f64 {
    if of.joints() == 0 || at.joints() == 0 {
        return 1.0;
    }
    let in_legs_of_at = |joint: Joint| Joint::ALL.into_iter().any(|other| other.leg == joint.leg && at.contains(other));
    let shared = Joint::ALL.into_iter().filter(|joint| of.contains(*joint) && in_legs_of_at(*joint)).count();
    shared as f64 / of.joints() as f64
}

fn best_first(one: &CandidateFit, other: &CandidateFit) -> std::cmp::Ordering {
    other.score.total_cmp(&one.score)
}

/// Writes the values of a joint fit to the accepted causes.
pub fn write_estimates(accepted: &mut Accepted, fit: &FitProblem, point: &[f64]) {
    let mut values = fit.unknowns.iter().zip(point).map(|(unknown, coordinate)| unknown.value(*coordinate));
    for (best, _) in accepted {
        best.hypothesis.values = values.by_ref().take(best.hypothesis.values.len()).collect();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_cause_of_all_joints_leaves_in_one_leg_is_a_quarter_and_a_joint_is_compared_with_its_leg() {
        let share = |of: &str, at: &str| share_at(of.parse().expect("a scope"), at.parse().expect("a scope"));
        assert_eq!(share("all", "FL_thigh"), 0.25);
        assert_eq!(share("FL_calf", "FL_thigh"), 1.0);
        assert_eq!(share("FR_calf", "FL_thigh"), 0.0);
        assert_eq!(share("base", "FL_thigh"), 1.0);
    }
}
