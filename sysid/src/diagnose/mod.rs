//! Diagnosis: what a model gets wrong, by name, and the gain on seconds that took no part in the choice.
//!
//! - [`rows`]: logs as residuals, in two folds of alternating seconds; [`leftover`]: what a candidate leaves of them;
//!   [`evidence`]: of motion and torque together.
//! - [`hypothesis`]: an effect on a scope, with values.
//! - [`scan`]: every effect on every joint at once; the best go on.
//! - [`trial`]: one hypothesis fitted to one fold and judged on the other, in full simulation.
//! - [`rivalry`], [`next`]: which motion would part causes that the logs cannot tell apart.
//! - [`unexplained`]: what is left, and what it depends on; [`line`]: or at which frequency it shakes.
//!
//! The best trial is accepted if its evidence exceeds the threshold and it explains a good part of what is above the noise;
//! all that is accepted is fitted anew together, and the search goes on from there.

mod evidence;
mod hypothesis;
mod leftover;
mod line;
mod next;
mod rivalry;
mod rows;
mod scan;
mod trial;
mod unexplained;
mod words;

use twinstep_logs::Log;
use twinstep_model::effects::{Effect, Scope, Target};
use twinstep_model::{Joint, ModelFile, Precision, RobotModel, Rollout};

use crate::diagnosis::{Cause, Confusable, Diagnosis, Errors};
use crate::evaluate::evaluate;
use crate::experiment::ExperimentError;
use crate::identify::blocks;
use crate::refine::{SIMULATORS, covariance};
use crate::tolerance::Tolerances;
use crate::window::Horizon;
use evidence::Evidence;
use hypothesis::Hypothesis;
use leftover::{Leftover, TORQUE};
pub use next::NextMotion;
pub use rivalry::Rivalry;
use scan::{Scored, scan};
use trial::{Fit, Trial, trial};

/// Evidence that a cause has to exceed [nats]: set by hand, after a wrong name with 22 on a robot of `twinstep hunt` that is in no
/// published table.
const THRESHOLD: f64 = 30.0;
/// Most causes that are named.
const MOST_CAUSES: usize = 5;
/// Most rounds of the search, and of taking back.
const MOST_SEARCHES: usize = 10;
/// Hypotheses about joints that are tried in full.
const TRIED: usize = 5;
/// And about the trunk, the ground and the gyroscope, and about encoders.
const TRIED_OF_WHOLE: usize = 2;
/// Share of the power above noise that a cause has to explain.
const LEAST_SHARE: f64 = 0.3;
/// Share of the power above noise at a cause's own joints that may stay when all is named, and power in units of noise that
/// is too little to tell. A gain that grows with the error is followed a part of the way by one that is higher.
const MOST_LEFT: f64 = 0.5;
const TOO_LITTLE: f64 = 1.0;
/// A rival this close [nats], or within this share of the cause's own evidence, cannot be told from the cause: simulators of
/// one law differ by as much.
const CLOSE: f64 = 6.0;
const CLOSE_SHARE: f64 = 0.05;

/// Why there is no diagnosis.
#[derive(Debug, thiserror::Error)]
pub enum DiagnoseError {
    /// A log is no experiment.
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
    /// The given model cannot be simulated.
    #[error("the simulation of the given model diverges on this log: start from a model that does not")]
    Diverges,
    /// The given model is none.
    #[error(transparent)]
    Model(#[from] twinstep_model::effects::EntryError),
    /// Ended by `progress`.
    #[error("ended before it was done")]
    Ended,
}

/// What is being done, said now and then; ends the diagnosis when it returns false.
pub type Progress<'a> = dyn FnMut(&str) -> bool + 'a;

/// A diagnosis and the model that it makes.
#[derive(Clone, Debug)]
pub struct Diagnosed {
    /// What is said; `extended_model` is left to who writes the files.
    pub diagnosis: Diagnosis,
    /// The given model with the causes, and intervals.
    pub extended: ModelFile,
    /// What to play next, where causes are left that the logs cannot tell apart.
    pub next: Option<NextMotion>,
}

/// Names what `model` gets wrong in `logs` of one robot.
pub fn diagnose(
    logs: Vec<Log>,
    model: &ModelFile,
    simulator: &mut dyn Rollout,
    progress: &mut Progress,
) -> Result<Diagnosed, DiagnoseError> {
    let robot = model.robot_model()?;
    let mut say = |text: &str| if progress(text) { Ok(()) } else { Err(DiagnoseError::Ended) };
    say("the ground, and errors of any robot")?;
    let mut evidence = Evidence::new(logs.clone(), &robot, Horizon::DIAGNOSIS)?;
    let left = evidence.leftover(simulator, &robot);
    if left.diverged() {
        return Err(DiagnoseError::Diverges);
    }
    let judged = on_fitted_ground(&evidence, model, simulator);
    let mut views = vec![View::new(evidence, &judged, &robot, simulator)?];
    if views[0].evidence.is_lost(&left) {
        evidence = Evidence::new(logs, &robot, Horizon::LOST)?;
        views.push(View::new(evidence, &judged, &robot, simulator)?);
    }
    let mut search = Search {
        view: views.len() - 1,
        views: &views,
        judged: judged.clone(),
        accepted: Accepted::new(),
        model: judged.clone(),
        simulator,
        say: &mut say,
    };
    search.run()?;
    let Search { view, mut accepted, model: named, .. } = search;
    let View { evidence, given } = &views[view];
    let left = evidence.leftover(simulator, &named.robot_model()?);
    say("intervals")?;
    let (extended, confusable) = intervals(model, &judged, &mut accepted, evidence, simulator);
    say("choosing the next experiment")?;
    let rivalries = next::rivalries(&extended, &accepted, &confusable);
    let next = next::next_motion(&rivalries, evidence, &robot, simulator);
    let causes = accepted.iter().map(|(best, others)| cause(best, others, &extended)).collect();
    let diagnosis = Diagnosis {
        baseline: errors(evidence, &robot, simulator)?,
        extended: errors(evidence, &extended.robot_model()?, simulator)?,
        noise_floor: words::noise_floor(evidence),
        findings: causes,
        confusable,
        unexplained: unexplained::unexplained(evidence, &extended.robot_model()?, given, &left, simulator),
        next_experiment: next.as_ref().map(|next| next.said.clone()),
        extended_model: String::new(),
    };
    Ok(Diagnosed { diagnosis, extended, next })
}

/// Causes that are accepted, each with the others that were tried in its place.
type Accepted = Vec<(Trial, Vec<Trial>)>;

/// Logs in windows of one length.
struct View {
    evidence: Evidence,
    /// What the given model leaves.
    given: Leftover,
}

impl View {
    fn new(
        mut evidence: Evidence,
        judged: &ModelFile,
        robot: &RobotModel,
        simulator: &mut dyn Rollout,
    ) -> Result<Self, DiagnoseError> {
        evidence.tolerate(&judged.robot_model()?, simulator);
        let given = evidence.leftover(simulator, robot);
        Ok(Self { evidence, given })
    }
}

/// The search for causes.
struct Search<'a> {
    /// In long windows; and in short ones, if the given model is lost in those.
    views: &'a [View],
    /// The one that is looked at.
    view: usize,
    /// The given model on ground that suits the log.
    judged: ModelFile,
    accepted: Accepted,
    /// [`Search::judged`] with all that is accepted, fitted together to everything.
    model: ModelFile,
    simulator: &'a mut dyn Rollout,
    say: &'a mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
}

impl<'a> Search<'a> {
    /// One cause after the other, until none earns a name. What is left too small, or is more than any robot has, or does not
    /// explain its own joints when all are fitted together was another in disguise: it goes, and the search goes on without it.
    fn run(&mut self) -> Result<(), DiagnoseError> {
        let mut excluded = Vec::new();
        for _ in 0..MOST_SEARCHES {
            let next = if self.accepted.len() < MOST_CAUSES { self.next(&excluded)? } else { None };
            if let Some(next) = next {
                self.accepted.push(next);
            } else {
                let Some(place) = self.untenable() else { break };
                excluded.push(self.accepted.remove(place).0.hypothesis.name());
            }
            self.fit_together();
        }
        while let Some(place) = self.untenable() {
            self.accepted.remove(place);
            self.fit_together();
        }
        Ok(())
    }

    /// A cause that does not stand when all are fitted together.
    fn untenable(&mut self) -> Option<usize> {
        let View { evidence, given } = self.looked_at();
        let robot = self.model.robot_model().expect("fitted within its bounds");
        let left = evidence.leftover(self.simulator, &robot);
        let stands = |hypothesis: &Hypothesis| {
            hypothesis.is_large_enough() && hypothesis.is_plausible() && explains_its_joints(hypothesis, given, &left)
        };
        self.accepted.iter().position(|(best, _)| !stands(&best.hypothesis))
    }

    /// The best cause on top of those that are accepted, if one earns a name.
    fn next(&mut self, excluded: &[String]) -> Result<Option<(Trial, Vec<Trial>)>, DiagnoseError> {
        let evidence = &self.looked_at().evidence;
        let left = evidence.leftover(self.simulator, &self.model.robot_model()?);
        let named = self.accepted.len();
        (self.say)(&format!("scanning, {named} named"))?;
        let candidates = candidates(evidence, &self.model, self.simulator);
        let mut trials = self.tried(candidates, excluded, &left)?;
        if let Some(best) = trials.first().filter(|best| best.score >= THRESHOLD) {
            // What the best is taken for, which one simulation of all joints may have missed.
            let names: Vec<String> = trials.iter().map(|trial| trial.hypothesis.name()).collect();
            let alike = scan::alike(evidence, &self.model, &best.hypothesis, &names, &left, self.simulator);
            trials.extend(self.tried(alike, excluded, &left)?);
            trials.sort_by(best_first);
        }
        let earns_name = |trial: &Trial| {
            trial.score >= THRESHOLD && trial.explains >= LEAST_SHARE && trial.hypothesis.is_large_enough()
        };
        let place = trials.iter().position(earns_name);
        Ok(place.map(|place| (trials.remove(place), trials)))
    }

    /// Trials of hypotheses, the best first, of what leaves `left`.
    fn tried(
        &mut self,
        hypotheses: Vec<Hypothesis>,
        excluded: &[String],
        left: &Leftover,
    ) -> Result<Vec<Trial>, DiagnoseError> {
        let evidence = &self.looked_at().evidence;
        let mut trials = Vec::new();
        for hypothesis in hypotheses {
            if !self.is_out(&hypothesis, excluded) {
                (self.say)(&format!("trying {}, {} named", hypothesis.name(), self.accepted.len()))?;
                let hypothesis = scan::in_step(evidence, &self.model, hypothesis, left, self.simulator);
                trials.extend(trial(evidence, &self.model, left, &hypothesis, self.simulator));
            }
        }
        trials.sort_by(best_first);
        Ok(trials)
    }

    fn looked_at(&self) -> &'a View {
        &self.views[self.view]
    }

    /// Whether a hypothesis did not stand, or is named.
    fn is_out(&self, hypothesis: &Hypothesis, excluded: &[String]) -> bool {
        let named = |accepted: &Trial| accepted.hypothesis.name() == hypothesis.name();
        excluded.contains(&hypothesis.name()) || self.accepted.iter().any(|(accepted, _)| named(accepted))
    }

    /// Fits all that is accepted together.
    fn fit_together(&mut self) {
        let hypotheses: Vec<_> = self.accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
        self.model = self.judged.clone();
        let Some(fit) = Fit::new(&self.judged, &hypotheses).filter(|_| !hypotheses.is_empty()) else { return };
        let point = fit.to(&self.looked_at().evidence.whole, self.simulator);
        self.model = fit.model(&point);
        take_values(&mut self.accepted, &fit, &point);
        self.look();
    }

    /// Long windows tell more, where the model follows them.
    fn look(&mut self) {
        if self.views.len() > 1 {
            let robot = self.model.robot_model().expect("fitted within its bounds");
            let evidence = &self.views[0].evidence;
            self.view = usize::from(evidence.is_lost(&evidence.leftover(self.simulator, &robot)));
        }
    }
}

fn best_first(one: &Trial, other: &Trial) -> std::cmp::Ordering {
    other.score.total_cmp(&one.score)
}

/// Whether most of what was wrong at the joints of a cause is explained, in their positions and in their torques.
fn explains_its_joints(hypothesis: &Hypothesis, given: &Leftover, left: &Leftover) -> bool {
    if hypothesis.effect.target != Target::Joints {
        return true;
    }
    let joints = || Joint::ALL.iter().filter(|joint| hypothesis.scope.contains(**joint)).map(|joint| joint.index());
    [0, TORQUE].into_iter().all(|first| {
        let excess = |left: &Leftover| joints().map(|joint| left.channel_excess(first + joint)).sum::<f64>();
        let rows: f64 = joints().flat_map(|joint| left.counts[first + joint]).sum();
        excess(left) <= TOO_LITTLE * rows || excess(left) <= MOST_LEFT * excess(given)
    })
}

/// Writes the values of a fit of all causes into them.
fn take_values(accepted: &mut Accepted, fit: &Fit, point: &[f64]) {
    let mut values = fit.unknowns.iter().zip(point).map(|(unknown, coordinate)| unknown.value(*coordinate));
    for (best, _) in accepted {
        best.hypothesis.values = values.by_ref().take(best.hypothesis.values.len()).collect();
    }
}

/// The model on ground of a hardness that suits the log, as long as the difference is not worth a name: how a foot meets the
/// ground differs between a simulator and anything else, and would pass for a shifted mass or a softer gear.
fn on_fitted_ground(evidence: &Evidence, model: &ModelFile, simulator: &mut dyn Rollout) -> ModelFile {
    let effect = Effect::named("ground_stiffness").expect("an effect of the catalogue");
    let own = model.effects.iter().rfind(|entry| entry.effect == effect);
    let values = own.map_or(vec![effect.parameters[0].neutral], |entry| entry.values.clone());
    let hypothesis = Hypothesis { effect, scope: Scope::Ground, values };
    let Some(fit) = Fit::new(model, std::slice::from_ref(&hypothesis)).filter(|_| evidence.has_free_parts()) else {
        return model.clone();
    };
    let point = fit.to(&evidence.whole, simulator);
    let fitted = Hypothesis { values: vec![fit.unknowns[0].value(point[0])], ..hypothesis };
    if fitted.is_large_enough() { model.clone() } else { fit.model(&point) }
}

/// What is tried in full: the best of the scan, of the joints and of the rest, which have seen different parts of the logs.
fn candidates(evidence: &Evidence, model: &ModelFile, simulator: &mut dyn Rollout) -> Vec<Hypothesis> {
    let scored = scan(evidence, model, simulator).into_iter().filter(|scored| scored.score > 0.0);
    let (offsets, others): (Vec<_>, Vec<_>) =
        scored.partition(|scored| scored.hypothesis.effect.name == "encoder_offset");
    let (joints, whole): (Vec<_>, Vec<_>) = others
        .into_iter()
        .partition(|scored| matches!(scored.hypothesis.effect.target, Target::Joints | Target::Supply));
    let tried = |scored: Vec<Scored>, most: usize| {
        let least = 0.3 * scored.first().map_or(0.0, |best| best.score);
        scored.into_iter().filter(move |scored| scored.score >= least).take(most).map(|scored| scored.hypothesis)
    };
    tried(joints, TRIED).chain(tried(whole, TRIED_OF_WHOLE)).chain(tried(offsets, TRIED_OF_WHOLE)).collect()
}

/// The model with the causes and their 95 % intervals, and what cannot be told apart.
fn intervals(
    model: &ModelFile,
    judged: &ModelFile,
    accepted: &mut Accepted,
    evidence: &Evidence,
    simulator: &mut dyn Rollout,
) -> (ModelFile, Vec<Confusable>) {
    let hypotheses: Vec<_> = accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
    let fits = [judged, model].map(|model| Fit::new(model, &hypotheses).filter(|_| !hypotheses.is_empty()));
    let [Some(on_ground), Some(mut fit)] = fits else { return (model.clone(), Vec::new()) };
    fit.begin = on_ground.to(&evidence.whole, simulator);
    take_values(accepted, &fit, &fit.begin);
    let experiments = &evidence.whole.experiments;
    let tolerances =
        fit.model(&fit.begin).robot_model().ok().and_then(|robot| Tolerances::new(experiments, &robot, simulator));
    let covariance = fit.task(&evidence.whole, simulator, Precision::Double, |task, simulator| {
        let errors = tolerances.map_or(Vec::new(), |all| all.robot_errors(task.spread, task.tolerances));
        covariance(&task.linear(simulator, &fit.begin)?, &blocks(experiments), &errors)
    });
    words::with_intervals(&fit, covariance.as_ref(), SIMULATORS)
}

/// On the seconds that are set aside.
fn errors(evidence: &Evidence, robot: &RobotModel, simulator: &mut dyn Rollout) -> Result<Errors, DiagnoseError> {
    let (mut torque, mut q) = (Vec::new(), Vec::new());
    for log in evidence.logs() {
        let evaluation = evaluate(log, robot, simulator, |row| rows::fold_of(log, row).is_none())?;
        torque.extend(evaluation.torque_rmse_nm);
        q.extend(evaluation.q_rmse_rad);
    }
    let whole = |errors: Vec<f64>| {
        let squares: f64 = errors.iter().map(|error| error * error).sum();
        (!errors.is_empty()).then(|| (squares / errors.len() as f64).sqrt())
    };
    Ok(Errors { torque_rmse_nm: whole(torque), q_rmse_rad: whole(q) })
}

/// Of the others those that the logs cannot tell from the best.
fn close<'a>(best: &Trial, others: &'a [Trial]) -> impl Iterator<Item = &'a Trial> {
    let least = best.score - CLOSE.max(CLOSE_SHARE * best.score);
    others.iter().filter(move |other| other.score > least)
}

fn cause(best: &Trial, others: &[Trial], extended: &ModelFile) -> Cause {
    let hypothesis = &best.hypothesis;
    Cause {
        effect: hypothesis.effect.name.to_owned(),
        scope: hypothesis.scope.to_string(),
        parameters: words::estimates(hypothesis, extended),
        held_out_gain: best.gain,
        score_nats: best.score,
        threshold_nats: THRESHOLD,
        ambiguous_with: close(best, others).map(|other| other.hypothesis.name()).collect(),
        rivals: others.iter().take(5).map(words::rival).collect(),
        evidence: words::evidence(best, others),
    }
}
