//! Forward selection of causes with backward elimination.

use std::collections::BTreeMap;
use std::ops::Range;

use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, Probes, Search, Target};
use twinstep_model::{Joint, RobotModel, Rollout};

use super::DiagnoseError;
use super::cross_validation::{CandidateFit, FitProblem, cross_validate};
use super::hypothesis::Hypothesis;
use super::null_distribution::{self, LOWEST_THRESHOLD};
use super::profile_likelihood::refine_with_restarts;
use super::residual_data::ResidualData;
use super::residual_power::{CHANNELS, DYNAMIC, GYRO, ResidualPower, STANCE, TORQUE, TRUNK, WRENCH};
use super::scan::{self, ScoredHypothesis, scan};
use super::scope_merging;

/// Log-likelihood gain that a cause must reach where no null distribution is computed: torques of other robots, and the
/// friction family [nat].
///
/// Set by hand after a false positive with 22 nat in a case of `twinstep hunt` that is not in a published table.
pub const THRESHOLD: f64 = 30.0;
/// Share of the largest log-likelihood gain that a further cause must reach.
///
/// The laws of the catalogue are approximations, and what a large effect leaves imitates small ones.
pub const MIN_SHARE_OF_LARGEST: f64 = 0.01;
/// Maximum number of causes.
const MOST_CAUSES: usize = 12;
/// Maximum number of rounds of selection and elimination.
const MOST_SEARCHES: usize = 24;
/// Maximum number of causes that are eliminated before the search ends.
const MOST_ELIMINATIONS: usize = 3;
/// Maximum number of hypotheses about joints that are fitted in full simulation.
const MAX_JOINT_CANDIDATES: usize = 5;
/// Maximum number of hypotheses about bodies, about the gyroscope, about the ground, and about encoders.
const MAX_BODY_CANDIDATES: usize = 2;
/// Fraction of the power above noise that a cause must explain.
pub const MIN_EXPLAINED_FRACTION: f64 = 0.3;
/// The same fraction, for a cause that is too small to report. It is added until the end of the search.
///
/// What explains nearly everything is the true cause. Without it, others that imitate it would be added in its place.
const EXPLAINED_BY_SMALL_CAUSE: f64 = 0.9;
/// Fraction of the power above noise that may remain in the channels that a cause affects, after the joint refit.
///
/// A wrong law imitates the true one in part: Coulomb friction explains 57 % of the power of friction that acts in one
/// direction only. True causes leave less than 1 % if robot and model share the code of their laws; elastic gears in MuJoCo,
/// with actuators of their own, left 26 %.
pub const MAX_REMAINING_FRACTION: f64 = 0.27;
/// Power above noise per row that is negligible [noise variance].
pub const NEGLIGIBLE_EXCESS: f64 = 1.0;

/// Accepted causes, each with its alternative hypotheses.
pub type Accepted = Vec<(CandidateFit, Vec<CandidateFit>)>;

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

/// State of the forward selection.
pub struct ForwardSelection<'a> {
    /// Data in long windows, and in short ones if the given model fails to track the joints in the long ones.
    pub views: &'a [WindowedData],
    /// Index of the data in use.
    pub view: usize,
    /// The given model with fitted ground.
    pub baseline: ModelFile,
    pub accepted: Accepted,
    /// [`ForwardSelection::baseline`] with all accepted causes, fitted jointly to both folds.
    pub model: ModelFile,
    /// Scan's scores of hypotheses by name when a fit did not support them [nat].
    pub unsupported: BTreeMap<String, f64>,
    pub simulator: &'a mut dyn Rollout,
    pub progress: &'a mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
}

impl<'a> ForwardSelection<'a> {
    /// Runs forward selection with backward elimination.
    ///
    /// Each round adds the best candidate and refits all causes. If none reaches the threshold, a cause that is
    /// implausible or leaves much of the error of its own channels is removed and excluded. Causes that are too small are
    /// removed at the end.
    pub fn run(&mut self) -> Result<(), DiagnoseError> {
        let mut excluded = Vec::new();
        for _ in 0..MOST_SEARCHES {
            let next = if self.accepted.len() < MOST_CAUSES { self.best_addition(&excluded)? } else { None };
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
                scope_merging::merge(self, effect);
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

    /// Returns the index of a cause to eliminate after the joint refit, if any.
    fn find_cause_to_eliminate(&mut self) -> Option<usize> {
        let WindowedData { evidence, given } = self.looked_at();
        let robot = self.model.robot_model().expect("fitted within its bounds");
        let left = evidence.residual_power(self.simulator, &robot);
        let stands = |hypothesis: &Hypothesis| {
            let at_sensor = evidence.torque_sensor_shows(&self.baseline, hypothesis);
            hypothesis.is_plausible() && explains_affected_channels(hypothesis, at_sensor, given, &left)
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
        for candidates in candidates(evidence, &self.model, self.simulator) {
            let found = self.best_of(candidates, excluded, &left)?;
            if found.is_some() {
                return Ok(found);
            }
        }
        Ok(None)
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
        if let Some(best) = trials.first().filter(|best| best.score >= thresholds.of(best.hypothesis.effect)) {
            // Confounders of the best candidate, which the scan of all joints at once may have missed.
            let names: Vec<String> = trials.iter().map(|trial| trial.hypothesis.name()).collect();
            let alike = scan::confounders_of(evidence, &self.model, &best.hypothesis, &names, left, self.simulator);
            trials.extend(self.evaluate(alike, excluded, left)?);
            trials.sort_by(best_first);
        }
        let largest = self.accepted.iter().map(|(best, _)| best.score).fold(0.0, f64::max);
        let least = |trial: &CandidateFit| thresholds.of(trial.hypothesis.effect).max(MIN_SHARE_OF_LARGEST * largest);
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
                let hypothesis = scan::refine_delay_grid(evidence, &self.model, hypothesis, left, self.simulator);
                trials.extend(cross_validate(evidence, &self.model, left, &hypothesis, self.simulator));
            }
        }
        trials.sort_by(best_first);
        Ok(trials)
    }

    fn looked_at(&self) -> &'a WindowedData {
        &self.views[self.view]
    }

    /// Returns true if a hypothesis was eliminated or is accepted.
    fn is_excluded(&self, hypothesis: &Hypothesis, excluded: &[String]) -> bool {
        let named = |accepted: &CandidateFit| accepted.hypothesis.name() == hypothesis.name();
        excluded.contains(&hypothesis.name()) || self.accepted.iter().any(|(accepted, _)| named(accepted))
    }

    /// Refits all accepted causes jointly.
    pub fn refit(&mut self) {
        let hypotheses: Vec<_> = self.accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
        self.model = self.baseline.clone();
        let Some(fit) = FitProblem::new(&self.baseline, &hypotheses).filter(|_| !hypotheses.is_empty()) else { return };
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

fn best_first(one: &CandidateFit, other: &CandidateFit) -> std::cmp::Ordering {
    other.score.total_cmp(&one.score)
}

/// Returns true if a cause leaves at most [`MAX_REMAINING_FRACTION`] of the excess power in the channels that it affects.
///
/// `at_sensor` tells whether it changes the torque at the sensor.
fn explains_affected_channels(
    hypothesis: &Hypothesis,
    at_sensor: bool,
    given: &ResidualPower,
    left: &ResidualPower,
) -> bool {
    affected_channels(hypothesis, at_sensor, given).into_iter().all(|channels| {
        let excess = |left: &ResidualPower| channels.iter().map(|channel| left.channel_excess(*channel)).sum::<f64>();
        let rows: f64 = channels.iter().flat_map(|channel| left.counts[*channel]).sum();
        excess(left) <= NEGLIGIBLE_EXCESS * rows || excess(left) <= MAX_REMAINING_FRACTION * excess(given)
    })
}

/// Returns the groups of channels that a cause must explain, each separately.
///
/// For joints, these are the positions with a fixed base, and the torques. If the base never is fixed, positions have the
/// errors of the contact model, too: a cause that the torque sensor shows must explain the torques, another the
/// positions. For bodies, the group is force and moment on the base; where they are not known, and for the ground, all motion
/// channels with a floating base; for the ground of a robot that walks or jumps, those of that.
fn affected_channels(hypothesis: &Hypothesis, at_sensor: bool, given: &ResidualPower) -> Vec<Vec<usize>> {
    let has = |channels: Range<usize>| given.counts[channels].iter().flatten().any(|count| *count > 0.0);
    let joints = |first: usize| {
        let all = Joint::ALL.into_iter().filter(|joint| hypothesis.scope.contains(*joint));
        all.map(|joint| first + joint.index()).collect()
    };
    match hypothesis.effect.target {
        Target::Joints if has(0..TORQUE) => vec![joints(0), joints(TORQUE)],
        Target::Joints if at_sensor => vec![joints(TORQUE)],
        Target::Joints => vec![joints(STANCE)],
        Target::Imu => vec![(GYRO..STANCE).collect()],
        Target::Ground if has(DYNAMIC..CHANNELS) => vec![(DYNAMIC..CHANNELS).collect()],
        Target::Bodies if has(WRENCH..DYNAMIC) => vec![(WRENCH..DYNAMIC).collect()],
        Target::Bodies | Target::Ground => vec![(TRUNK..GYRO).chain(STANCE..DYNAMIC).collect()],
        Target::Supply => Vec::new(),
    }
}

/// Writes the values of a joint fit to the accepted causes.
pub fn write_estimates(accepted: &mut Accepted, fit: &FitProblem, point: &[f64]) {
    let mut values = fit.unknowns.iter().zip(point).map(|(unknown, coordinate)| unknown.value(*coordinate));
    for (best, _) in accepted {
        best.hypothesis.values = values.by_ref().take(best.hypothesis.values.len()).collect();
    }
}

/// Returns the hypotheses of the scan to fit in full simulation, and more about joints to fit if none of them is a cause: what
/// imitates the error of a large effect at many joints outranks a small effect at one.
///
/// Joints, bodies, the gyroscope, the ground and encoder offsets are ranked separately, because the scan evaluates them on
/// different rows or channels. Encoder offsets are left out where the robot walks: feet that touch down at other times in the
/// model imitate them.
fn candidates(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> [Vec<ScoredHypothesis>; 2] {
    let mut lists: [Vec<ScoredHypothesis>; 5] = Default::default();
    for scored in scan(evidence, model, simulator).into_iter().filter(|scored| scored.score > 0.0) {
        let list = match scored.hypothesis.effect {
            Effect { target: Target::Bodies, .. } => 1,
            Effect { target: Target::Imu, .. } => 2,
            Effect { target: Target::Ground, .. } => 3,
            Effect { search: Search { whole_log_probes: Probes::None, .. }, .. } => 0,
            _ => 4,
        };
        lists[list].push(scored);
    }
    let of_encoders = if evidence.is_dynamic { 0 } else { MAX_BODY_CANDIDATES };
    let most = [MAX_JOINT_CANDIDATES, MAX_BODY_CANDIDATES, MAX_BODY_CANDIDATES, MAX_BODY_CANDIDATES, of_encoders];
    let tried = |(scored, most): (&Vec<ScoredHypothesis>, usize)| {
        let least = 0.3 * scored.first().map_or(0.0, |best| best.score);
        scored.iter().filter(|scored| scored.score >= least).take(most).cloned().collect::<Vec<_>>()
    };
    let first: Vec<ScoredHypothesis> = lists.iter().zip(most).flat_map(tried).collect();
    let is_new = |other: &ScoredHypothesis| first.iter().all(|one| one.hypothesis.name() != other.hypothesis.name());
    let others = lists[0].iter().filter(|scored| scored.score >= LOWEST_THRESHOLD && is_new(scored));
    let second = others.take(MAX_JOINT_CANDIDATES).cloned().collect();
    [first, second]
}

#[cfg(test)]
mod tests {
    use twinstep_effects::Scope;

    use super::*;

    fn hypothesis(effect: &str, scope: Scope) -> Hypothesis {
        Hypothesis { effect: Effect::named(effect).expect("an effect of the catalogue"), scope, values: Vec::new() }
    }

    /// Returns 100 rows of every channel with this residual power [noise variance].
    fn residual_power(power: impl Fn(usize) -> f64) -> ResidualPower {
        let mut left = ResidualPower::empty();
        for channel in 0..CHANNELS {
            left.sums[channel][0] = 100.0 * power(channel);
            left.counts[channel][0] = 100.0;
        }
        left
    }

    #[test]
    fn cause_must_explain_most_of_the_excess_in_its_channels() {
        let (hip, calf) = (Joint::ALL[0], Joint::ALL[2]);
        let given = residual_power(|channel| if channel == hip.index() { 20.0 } else { 10.0 });
        let only_hip = residual_power(|channel| if channel == hip.index() { 1.0 } else { 9.9 });
        let explains = |effect, scope| explains_affected_channels(&hypothesis(effect, scope), true, &given, &only_hip);
        assert!(!explains("backlash", Scope::Joint(hip)), "the torque of the hip is not explained");
        assert!(!explains("backlash", Scope::Joint(calf)));
        assert!(!explains("com_shift", Scope::Base), "an effect on the base affects all joints");
        assert!(!explains("gyro_bias", Scope::Base));
        let noise = residual_power(|_| 1.0);
        for (effect, scope) in [("backlash", Scope::Joint(hip)), ("com_shift", Scope::Base), ("gyro_bias", Scope::Base)]
        {
            assert!(explains_affected_channels(&hypothesis(effect, scope), true, &given, &noise));
        }
    }

    #[test]
    fn cause_on_the_base_must_explain_force_and_moment_where_they_are_known() {
        let shift = hypothesis("com_shift", Scope::Base);
        let explains =
            |given: &ResidualPower, left: &ResidualPower| explains_affected_channels(&shift, false, given, left);
        let is_wrench = |channel: usize| (WRENCH..DYNAMIC).contains(&channel);
        let given = residual_power(|_| 20.0);
        assert!(explains(&given, &residual_power(|channel| if is_wrench(channel) { 1.0 } else { 20.0 })));
        assert!(!explains(&given, &residual_power(|channel| if is_wrench(channel) { 20.0 } else { 1.0 })));
        let unknown = |mut left: ResidualPower| {
            left.counts[WRENCH..DYNAMIC].fill([0.0; 2]);
            left.sums[WRENCH..DYNAMIC].fill([0.0; 2]);
            left
        };
        assert!(!explains(&unknown(given), &unknown(residual_power(|_| 19.0))), "positions are not explained");
    }

    /// Contact adds to the position error of every joint. A delay is seen in the torques, friction in the positions.
    #[test]
    fn cause_of_a_robot_that_never_hangs_must_explain_the_channel_that_shows_it() {
        let scope = Scope::Joint(Joint::ALL[2]);
        let floating = |power: [f64; 2]| {
            let mut left = residual_power(|channel| if channel >= STANCE { power[0] } else { power[1] });
            left.counts[..TORQUE].fill([0.0; 2]);
            left.sums[..TORQUE].fill([0.0; 2]);
            left
        };
        let [given, torque_explained, position_explained] = [[5.0, 13.0], [5.0, 1.0], [1.0, 13.0]].map(floating);
        let explains =
            |effect, at_sensor, left| explains_affected_channels(&hypothesis(effect, scope), at_sensor, &given, left);
        assert!(explains("torque_delay", true, &torque_explained));
        assert!(!explains("torque_delay", true, &position_explained));
        assert!(explains("coulomb_friction", false, &position_explained));
        assert!(!explains("coulomb_friction", false, &torque_explained));
    }
}
