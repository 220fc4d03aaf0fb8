//! Diagnosis: what a model gets wrong, by name, and the gain on seconds that took no part in the choice.
//!
//! - [`rows`]: logs as residuals, in two folds of alternating seconds; [`leftover`]: what a candidate leaves of them;
//!   [`evidence`]: of motion and torque together.
//! - [`hypothesis`]: an effect on a scope, with values.
//! - [`causes`]: the search, which uses these in turn:
//! - [`scan`]: every effect on every joint at once; the best go on.
//! - [`trial`]: one hypothesis fitted to one fold and judged on the other, in full simulation.
//! - [`landscape`]: what slopes do not show of a fit: other valleys, and how far their floor goes.
//! - [`rivalry`], [`next`]: which motion would part causes that the logs cannot tell apart.
//! - [`unexplained`]: what is left, and what it depends on; [`line`]: or at which frequency it shakes.
//!
//! Joints that are not a Go2's are looked at by their torques alone: [`any_joints`], with [`seats`] and [`torque_fit`].
//!
//! The best trial is accepted if its evidence exceeds the threshold and it explains a good part of what is above the noise;
//! all that is accepted is fitted anew together, and the search goes on from there.

mod any_joints;
mod causes;
mod evidence;
mod hypothesis;
mod landscape;
mod leftover;
mod line;
mod next;
mod rivalry;
mod rows;
mod scan;
mod seats;
mod torque_fit;
mod trial;
mod unexplained;
mod words;

use twinstep_logs::Log;
use twinstep_model::effects::{Effect, Scope};
use twinstep_model::{ModelFile, Precision, RobotModel, Rollout};

use crate::diagnosis::{Cause, Confusable, Diagnosis, Errors};
use crate::evaluate::evaluate;
use crate::experiment::ExperimentError;
use crate::identify::blocks;
use crate::refine::{SIMULATORS, covariance};
use crate::tolerance::Tolerances;
use crate::window::Horizon;
pub use any_joints::diagnose_torques;
use causes::{Accepted, Search, THRESHOLD, View, take_values};
use evidence::Evidence;
use hypothesis::Hypothesis;
pub use next::NextMotion;
pub use rivalry::Rivalry;
use trial::{Fit, Trial};

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
    fit.begin = landscape::settled(&on_ground, evidence, simulator);
    take_values(accepted, &fit, &fit.begin);
    let experiments = &evidence.whole.experiments;
    let tolerances =
        fit.model(&fit.begin).robot_model().ok().and_then(|robot| Tolerances::new(experiments, &robot, simulator));
    let covariance = fit.task(&evidence.whole, simulator, Precision::Double, |task, simulator| {
        let errors = tolerances.map_or(Vec::new(), |all| all.robot_errors(task.spread, task.tolerances));
        covariance(&task.linear(simulator, &fit.begin)?, &blocks(experiments), &errors)
    });
    let near = landscape::near(&fit, evidence, simulator);
    words::with_intervals(&fit, covariance.as_ref(), SIMULATORS, &near)
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
