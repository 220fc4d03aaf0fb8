//! Diagnosis: what a model gets wrong, by name, and the gain on seconds that took no part in the choice.
//!
//! - [`residual_rows`]: logs as residuals, in two folds of alternating seconds; [`residual_power`]: what a candidate leaves of them;
//!   [`residual_data`]: of motion and torque together.
//! - [`hypothesis`]: an effect on a scope, with values.
//! - [`forward_selection`]: the search, which uses these in turn:
//! - [`scan`]: every effect on every joint at once; the best go on.
//! - [`cross_validation`]: one hypothesis fitted to one fold and judged on the other, in full simulation.
//! - [`profile_likelihood`]: what slopes do not show of a fit: other valleys, and how far their floor goes.
//! - [`discrimination`], [`experiment_design`]: which motion would part causes that the logs cannot tell apart.
//! - [`unexplained`]: what is left, and what it depends on; [`spectral_line`]: or at which frequency it shakes.
//!
//! Joints that are not a Go2's are looked at by their torques alone: [`torque_only`], with [`joint_slots`] and [`torque_fit`].
//!
//! The best trial is accepted if its evidence exceeds the threshold and it explains a good part of what is above the noise;
//! all that is accepted is fitted anew together, and the search goes on from there.

mod cross_validation;
mod discrimination;
mod excitation;
mod experiment_design;
mod findings;
mod forward_selection;
mod hypothesis;
mod joint_slots;
mod profile_likelihood;
mod reporting;
mod residual_data;
mod residual_power;
mod residual_rows;
mod scan;
mod spectral_line;
mod torque_fit;
mod torque_only;
mod unexplained;

use twinstep_logs::Log;
use twinstep_effects::{Effect, Scope};
use twinstep_effects::ModelFile;
use twinstep_model::{Precision, RobotModel, Rollout};

use twinstep_identify::evaluate::evaluate;
use twinstep_identify::experiment::ExperimentError;
use twinstep_identify::identify::blocks;
use twinstep_identify::refine::{SIMULATOR_MISMATCH_STD, covariance};
use twinstep_identify::nuisance::NuisanceModel;
use twinstep_identify::window::WindowConfig;
pub use excitation::{EXCITATION_TRAJECTORIES, ExcitationTrajectory};
pub use findings::{
    AlternativeCause, Cause, CorrelatedPair, Diagnosis, DiscriminatedPair, Estimate, NextExperiment, ParameterValue, RmsErrors, Unexplained,
};
pub use torque_only::diagnose_torques;
use forward_selection::{Accepted, ForwardSelection, THRESHOLD, WindowedData, write_estimates};
use residual_data::ResidualData;
use hypothesis::Hypothesis;
pub use experiment_design::ProposedExperiment;
pub use discrimination::HypothesisPair;
use cross_validation::{FitProblem, CandidateFit};

/// A rival this close [nats], or within this share of the cause's own evidence, cannot be told from the cause: simulators of
/// one law differ by as much.
const AMBIGUITY_NATS: f64 = 6.0;
const AMBIGUITY_FRACTION: f64 = 0.05;

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
    Model(#[from] twinstep_effects::EntryError),
    /// Ended by `progress`.
    #[error("ended before it was done")]
    Interrupted,
}

/// What is being done, said now and then; ends the diagnosis when it returns false.
pub type DiagnoseProgress<'a> = dyn FnMut(&str) -> bool + 'a;

/// A diagnosis and the model that it makes.
#[derive(Clone, Debug)]
pub struct DiagnosisOutput {
    /// What is said; `extended_model` is left to who writes the files.
    pub diagnosis: Diagnosis,
    /// The given model with the causes, and intervals.
    pub extended: ModelFile,
    /// What to play next, where causes are left that the logs cannot tell apart.
    pub next: Option<ProposedExperiment>,
}

/// Names what `model` gets wrong in `logs` of one robot.
pub fn diagnose(
    logs: Vec<Log>,
    model: &ModelFile,
    simulator: &mut dyn Rollout,
    progress: &mut DiagnoseProgress,
) -> Result<DiagnosisOutput, DiagnoseError> {
    let robot = model.robot_model()?;
    let mut say = |text: &str| if progress(text) { Ok(()) } else { Err(DiagnoseError::Interrupted) };
    say("the ground, and errors of any robot")?;
    let mut evidence = ResidualData::new(logs.clone(), &robot, WindowConfig::DIAGNOSIS)?;
    let left = evidence.leftover(simulator, &robot);
    if left.diverged() {
        return Err(DiagnoseError::Diverges);
    }
    let judged = with_fitted_ground(&evidence, model, simulator);
    let mut views = vec![WindowedData::new(evidence, &judged, &robot, simulator)?];
    if views[0].evidence.fails_to_track(&left) {
        evidence = ResidualData::new(logs, &robot, WindowConfig::SHORT)?;
        views.push(WindowedData::new(evidence, &judged, &robot, simulator)?);
    }
    let mut search = ForwardSelection {
        view: views.len() - 1,
        views: &views,
        baseline: judged.clone(),
        accepted: Accepted::new(),
        model: judged.clone(),
        simulator,
        progress: &mut say,
    };
    search.run()?;
    let ForwardSelection { view, mut accepted, model: named, .. } = search;
    let WindowedData { evidence, given } = &views[view];
    let left = evidence.leftover(simulator, &named.robot_model()?);
    say("intervals")?;
    let (extended, confusable) = intervals(model, &judged, &mut accepted, evidence, simulator);
    say("choosing the next experiment")?;
    let rivalries = experiment_design::rivalries(&extended, &accepted, &confusable);
    let next = experiment_design::next_motion(&rivalries, evidence, &robot, simulator);
    let causes = accepted.iter().map(|(best, others)| cause(best, others, &extended)).collect();
    let diagnosis = Diagnosis {
        baseline: errors(evidence, &robot, simulator)?,
        extended: errors(evidence, &extended.robot_model()?, simulator)?,
        noise_floor: reporting::noise_floor(evidence),
        findings: causes,
        confusable,
        unexplained: unexplained::unexplained(evidence, &extended.robot_model()?, given, &left, simulator),
        next_experiment: next.as_ref().map(|next| next.summary.clone()),
        extended_model: String::new(),
    };
    Ok(DiagnosisOutput { diagnosis, extended, next })
}

/// The model on ground of a hardness that suits the log, as long as the difference is not worth a name: how a foot meets the
/// ground differs between a simulator and anything else, and would pass for a shifted mass or a softer gear.
fn with_fitted_ground(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> ModelFile {
    let effect = Effect::named("ground_stiffness").expect("an effect of the catalogue");
    let own = model.effects.iter().rfind(|entry| entry.effect == effect);
    let values = own.map_or(vec![effect.parameters[0].no_effect_value], |entry| entry.values.clone());
    let hypothesis = Hypothesis { effect, scope: Scope::Ground, values };
    let Some(fit) = FitProblem::new(model, std::slice::from_ref(&hypothesis)).filter(|_| evidence.has_free_parts()) else {
        return model.clone();
    };
    let point = fit.solve(&evidence.fit_rows, simulator);
    let fitted = Hypothesis { values: vec![fit.unknowns[0].value(point[0])], ..hypothesis };
    if fitted.exceeds_min_size() { model.clone() } else { fit.model(&point) }
}

/// The model with the causes and their 95 % intervals, and what cannot be told apart.
fn intervals(
    model: &ModelFile,
    judged: &ModelFile,
    accepted: &mut Accepted,
    evidence: &ResidualData,
    simulator: &mut dyn Rollout,
) -> (ModelFile, Vec<CorrelatedPair>) {
    let hypotheses: Vec<_> = accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
    let fits = [judged, model].map(|model| FitProblem::new(model, &hypotheses).filter(|_| !hypotheses.is_empty()));
    let [Some(on_ground), Some(mut fit)] = fits else { return (model.clone(), Vec::new()) };
    fit.initial_point = profile_likelihood::refine_with_restarts(&on_ground, evidence, simulator);
    write_estimates(accepted, &fit, &fit.initial_point);
    let experiments = &evidence.fit_rows.experiments;
    let tolerances =
        fit.model(&fit.initial_point).robot_model().ok().and_then(|robot| NuisanceModel::new(experiments, &robot, simulator));
    let covariance = fit.with_problem(&evidence.fit_rows, simulator, Precision::Double, |task, simulator| {
        let errors = tolerances.map_or(Vec::new(), |all| all.robot_errors(task.residual_scale, task.tolerances));
        covariance(&task.linearise(simulator, &fit.initial_point)?, &blocks(experiments), &errors)
    });
    let near = profile_likelihood::profile_intervals(&fit, evidence, simulator);
    reporting::with_intervals(&fit, covariance.as_ref(), SIMULATOR_MISMATCH_STD, &near)
}

/// On the seconds that are set aside.
fn errors(evidence: &ResidualData, robot: &RobotModel, simulator: &mut dyn Rollout) -> Result<RmsErrors, DiagnoseError> {
    let (mut torque, mut q) = (Vec::new(), Vec::new());
    for log in evidence.logs() {
        let evaluation = evaluate(log, robot, simulator, |row| residual_rows::fold_of(log, row).is_none())?;
        torque.extend(evaluation.torque_rmse_nm);
        q.extend(evaluation.q_rmse_rad);
    }
    let whole = |errors: Vec<f64>| {
        let squares: f64 = errors.iter().map(|error| error * error).sum();
        (!errors.is_empty()).then(|| (squares / errors.len() as f64).sqrt())
    };
    Ok(RmsErrors { torque_rmse_nm: whole(torque), q_rmse_rad: whole(q) })
}

/// Of the others those that the logs cannot tell from the best.
fn ambiguous<'a>(best: &CandidateFit, others: &'a [CandidateFit]) -> impl Iterator<Item = &'a CandidateFit> {
    let least = best.score - AMBIGUITY_NATS.max(AMBIGUITY_FRACTION * best.score);
    others.iter().filter(move |other| other.score > least)
}

fn cause(best: &CandidateFit, others: &[CandidateFit], extended: &ModelFile) -> Cause {
    let hypothesis = &best.hypothesis;
    Cause {
        effect: hypothesis.effect.name.to_owned(),
        scope: hypothesis.scope.to_string(),
        parameters: reporting::estimates(hypothesis, extended),
        held_out_gain: best.gain,
        score_nats: best.score,
        threshold_nats: THRESHOLD,
        ambiguous_with: ambiguous(best, others).map(|other| other.hypothesis.name()).collect(),
        rivals: others.iter().take(5).map(reporting::rival).collect(),
        evidence: reporting::explanation(best, others),
    }
}
