//! The search for causes: one after the other, until none earns a name; and what does not stand in the end is taken back.

use twinstep_effects::Target;
use twinstep_model::{Joint, RobotModel, Rollout};
use twinstep_effects::ModelFile;

use super::DiagnoseError;
use super::residual_data::ResidualData;
use super::hypothesis::Hypothesis;
use super::profile_likelihood::refine_with_restarts;
use super::residual_power::{CHANNELS, GYRO, ResidualPower, TORQUE, TRUNK};
use super::scan::{self, ScoredHypothesis, scan};
use super::cross_validation::{FitProblem, CandidateFit, cross_validate};

/// Evidence that a cause has to exceed [nats]: set by hand, after a wrong name with 22 on a robot of `twinstep hunt` that is in no
/// published table.
pub const THRESHOLD: f64 = 30.0;
/// Most causes that are named.
const MOST_CAUSES: usize = 5;
/// Most rounds of the search, and of taking back.
const MOST_SEARCHES: usize = 10;
/// Hypotheses about joints that are tried in full.
const MAX_JOINT_CANDIDATES: usize = 5;
/// And about the trunk, the ground and the gyroscope, and about encoders.
const MAX_BODY_CANDIDATES: usize = 2;
/// Share of the power above noise that a cause has to explain.
pub const MIN_EXPLAINED_FRACTION: f64 = 0.3;
/// Share of the power above noise at a cause's own joints that may stay when all is named, and power in units of noise that
/// is too little to tell. A gain that grows with the error is followed a part of the way by one that is higher.
pub const MAX_REMAINING_FRACTION: f64 = 0.5;
pub const NEGLIGIBLE_EXCESS: f64 = 1.0;

/// Causes that are accepted, each with the others that were tried in its place.
pub type Accepted = Vec<(CandidateFit, Vec<CandidateFit>)>;

/// Logs in windows of one length.
pub struct WindowedData {
    /// The logs.
    pub evidence: ResidualData,
    /// What the given model leaves.
    pub given: ResidualPower,
}

impl WindowedData {
    /// Of logs that nothing is tolerated in yet.
    pub fn new(
        mut evidence: ResidualData,
        judged: &ModelFile,
        robot: &RobotModel,
        simulator: &mut dyn Rollout,
    ) -> Result<Self, DiagnoseError> {
        evidence.set_nuisance_model(&judged.robot_model()?, simulator);
        let given = evidence.leftover(simulator, robot);
        Ok(Self { evidence, given })
    }
}

/// The search for causes.
pub struct ForwardSelection<'a> {
    /// In long windows; and in short ones, if the given model is lost in those.
    pub views: &'a [WindowedData],
    /// The one that is looked at.
    pub view: usize,
    /// The given model on ground that suits the log.
    pub baseline: ModelFile,
    pub accepted: Accepted,
    /// [`Search::judged`] with all that is accepted, fitted together to everything.
    pub model: ModelFile,
    pub simulator: &'a mut dyn Rollout,
    pub progress: &'a mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
}

impl<'a> ForwardSelection<'a> {
    /// One cause after the other, until none earns a name. What is left too small, or is more than any robot has, or does not
    /// explain its own joints when all are fitted together was another in disguise: it goes, and the search goes on without it.
    pub fn run(&mut self) -> Result<(), DiagnoseError> {
        let mut excluded = Vec::new();
        for _ in 0..MOST_SEARCHES {
            let next = if self.accepted.len() < MOST_CAUSES { self.best_addition(&excluded)? } else { None };
            if let Some(next) = next {
                self.accepted.push(next);
            } else {
                let Some(place) = self.to_eliminate() else { break };
                excluded.push(self.accepted.remove(place).0.hypothesis.name());
            }
            self.refit();
        }
        while let Some(place) = self.to_eliminate() {
            self.accepted.remove(place);
            self.refit();
        }
        Ok(())
    }

    /// A cause that does not stand when all are fitted together.
    fn to_eliminate(&mut self) -> Option<usize> {
        let WindowedData { evidence, given } = self.looked_at();
        let robot = self.model.robot_model().expect("fitted within its bounds");
        let left = evidence.leftover(self.simulator, &robot);
        let stands = |hypothesis: &Hypothesis| {
            hypothesis.exceeds_min_size() && hypothesis.is_plausible() && explains_affected_channels(hypothesis, given, &left)
        };
        self.accepted.iter().position(|(best, _)| !stands(&best.hypothesis))
    }

    /// The best cause on top of those that are accepted, if one earns a name.
    fn best_addition(&mut self, excluded: &[String]) -> Result<Option<(CandidateFit, Vec<CandidateFit>)>, DiagnoseError> {
        let evidence = &self.looked_at().evidence;
        let left = evidence.leftover(self.simulator, &self.model.robot_model()?);
        let named = self.accepted.len();
        (self.progress)(&format!("scanning, {named} named"))?;
        let candidates = candidates(evidence, &self.model, self.simulator);
        let mut trials = self.evaluate(candidates, excluded, &left)?;
        if let Some(best) = trials.first().filter(|best| best.score >= THRESHOLD) {
            // What the best is taken for, which one simulation of all joints may have missed.
            let names: Vec<String> = trials.iter().map(|trial| trial.hypothesis.name()).collect();
            let alike = scan::confounders_of(evidence, &self.model, &best.hypothesis, &names, &left, self.simulator);
            trials.extend(self.evaluate(alike, excluded, &left)?);
            trials.sort_by(best_first);
        }
        let earns_name = |trial: &CandidateFit| {
            trial.score >= THRESHOLD && trial.explained_fraction >= MIN_EXPLAINED_FRACTION && trial.hypothesis.exceeds_min_size()
        };
        let place = trials.iter().position(earns_name);
        Ok(place.map(|place| (trials.remove(place), trials)))
    }

    /// Trials of hypotheses, the best first, of what leaves `left`.
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
                (self.progress)(&format!("trying {}, {} named", hypothesis.name(), self.accepted.len()))?;
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

    /// Whether a hypothesis did not stand, or is named.
    fn is_excluded(&self, hypothesis: &Hypothesis, excluded: &[String]) -> bool {
        let named = |accepted: &CandidateFit| accepted.hypothesis.name() == hypothesis.name();
        excluded.contains(&hypothesis.name()) || self.accepted.iter().any(|(accepted, _)| named(accepted))
    }

    /// Fits all that is accepted together.
    fn refit(&mut self) {
        let hypotheses: Vec<_> = self.accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
        self.model = self.baseline.clone();
        let Some(fit) = FitProblem::new(&self.baseline, &hypotheses).filter(|_| !hypotheses.is_empty()) else { return };
        let point = refine_with_restarts(&fit, &self.looked_at().evidence, self.simulator);
        self.model = fit.model(&point);
        write_estimates(&mut self.accepted, &fit, &point);
        self.choose_windows();
    }

    /// Long windows tell more, where the model follows them.
    fn choose_windows(&mut self) {
        if self.views.len() > 1 {
            let robot = self.model.robot_model().expect("fitted within its bounds");
            let evidence = &self.views[0].evidence;
            self.view = usize::from(evidence.fails_to_track(&evidence.leftover(self.simulator, &robot)));
        }
    }
}

fn best_first(one: &CandidateFit, other: &CandidateFit) -> std::cmp::Ordering {
    other.score.total_cmp(&one.score)
}

/// Whether most of what was wrong where a cause acts is explained.
fn explains_affected_channels(hypothesis: &Hypothesis, given: &ResidualPower, left: &ResidualPower) -> bool {
    affected_channels(hypothesis).into_iter().all(|channels| {
        let excess = |left: &ResidualPower| channels.iter().map(|channel| left.channel_excess(*channel)).sum::<f64>();
        let rows: f64 = channels.iter().flat_map(|channel| left.counts[*channel]).sum();
        excess(left) <= NEGLIGIBLE_EXCESS * rows || excess(left) <= MAX_REMAINING_FRACTION * excess(given)
    })
}

/// Channels of which each group has to be explained: of joints their positions, and their torques; of the trunk and the ground
/// the motion of everything.
fn affected_channels(hypothesis: &Hypothesis) -> Vec<Vec<usize>> {
    match hypothesis.effect.target {
        Target::Joints => {
            let joints = || Joint::ALL.into_iter().filter(|joint| hypothesis.scope.contains(*joint));
            [0, TORQUE].map(|first| joints().map(|joint| first + joint.index()).collect()).to_vec()
        }
        Target::Base if hypothesis.effect.name == "gyro_bias" => vec![(GYRO..CHANNELS).collect()],
        Target::Base | Target::Bodies | Target::Ground => vec![(0..TORQUE).chain(TRUNK..GYRO).collect()],
        Target::Supply => Vec::new(),
    }
}

/// Writes the values of a fit of all causes into them.
pub fn write_estimates(accepted: &mut Accepted, fit: &FitProblem, point: &[f64]) {
    let mut values = fit.unknowns.iter().zip(point).map(|(unknown, coordinate)| unknown.value(*coordinate));
    for (best, _) in accepted {
        best.hypothesis.values = values.by_ref().take(best.hypothesis.values.len()).collect();
    }
}

/// What is tried in full: the best of the scan, of the joints and of the rest, which have seen different parts of the logs.
fn candidates(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> Vec<Hypothesis> {
    let scored = scan(evidence, model, simulator).into_iter().filter(|scored| scored.score > 0.0);
    let (offsets, others): (Vec<_>, Vec<_>) =
        scored.partition(|scored| scored.hypothesis.effect.name == "encoder_offset");
    let (joints, whole): (Vec<_>, Vec<_>) = others
        .into_iter()
        .partition(|scored| matches!(scored.hypothesis.effect.target, Target::Joints | Target::Supply));
    let tried = |scored: Vec<ScoredHypothesis>, most: usize| {
        let least = 0.3 * scored.first().map_or(0.0, |best| best.score);
        scored.into_iter().filter(move |scored| scored.score >= least).take(most).map(|scored| scored.hypothesis)
    };
    tried(joints, MAX_JOINT_CANDIDATES).chain(tried(whole, MAX_BODY_CANDIDATES)).chain(tried(offsets, MAX_BODY_CANDIDATES)).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, Scope};

    use super::*;

    fn hypothesis(effect: &str, scope: Scope) -> Hypothesis {
        Hypothesis { effect: Effect::named(effect).expect("an effect of the catalogue"), scope, values: Vec::new() }
    }

    /// A hundred rows of every channel, of this power, in units of noise.
    fn leftover(power: impl Fn(usize) -> f64) -> ResidualPower {
        let mut left = ResidualPower::empty();
        for channel in 0..CHANNELS {
            left.sums[channel][0] = 100.0 * power(channel);
            left.counts[channel][0] = 100.0;
        }
        left
    }

    #[test]
    fn cause_has_to_explain_half_of_what_was_wrong_where_it_acts() {
        let (hip, calf) = (Joint::ALL[0], Joint::ALL[2]);
        let given = leftover(|channel| if channel == hip.index() { 20.0 } else { 10.0 });
        let only_hip = leftover(|channel| if channel == hip.index() { 1.0 } else { 9.9 });
        let explains = |effect, scope| explains_affected_channels(&hypothesis(effect, scope), &given, &only_hip);
        assert!(!explains("backlash", Scope::Joint(hip)), "the hip's torque is as wrong as before");
        assert!(!explains("backlash", Scope::Joint(calf)));
        assert!(!explains("com_shift", Scope::Base), "a trunk moves all joints");
        assert!(!explains("gyro_bias", Scope::Base));
        let noise = leftover(|_| 1.0);
        for (effect, scope) in [("backlash", Scope::Joint(hip)), ("com_shift", Scope::Base), ("gyro_bias", Scope::Base)]
        {
            assert!(explains_affected_channels(&hypothesis(effect, scope), &given, &noise));
        }
    }
}
