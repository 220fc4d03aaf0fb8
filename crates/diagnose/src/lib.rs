//! Diagnosis: identifies the effects of the catalogue that a model lacks, by comparison with logs.
//!
//! - [`by_equations`]: logs of a Go2 with motor currents, or on a fixed base; [`of_tree`]: logs of a robot of any tree; [`explained`]: their findings.
//!
//! Other logs of a Go2 are searched in simulations:
//!
//! - [`data_split`]: rows for fits, in two folds, and held-out blocks of another regime; [`residual_rows`]: residuals
//!   of these rows; [`residual_power`]: their sums of squares; [`residual_data`]: residuals of motion and torque
//!   together.
//! - [`hypothesis`]: an effect on a scope, with values.
//! - [`forward_selection`]: forward selection with backward elimination, which uses the following modules in turn.
//! - [`scope_merging`]: one cause on a wider scope in place of several.
//! - [`backward_elimination`]: evidence of each cause beside all others.
//! - [`friction_family`]: a search that begins with the friction and inertia of all joints, fitted together.
//! - [`joint_gains`]: gains that differ from joint to joint by a few percent, which are no cause.
//! - [`scan`]: evaluates every effect on all scopes with a few simulations, and returns the best candidates.
//! - [`ripple_scan`]: the same for torque ripple, without simulations of it.
//! - [`confounders`]: hypotheses that the scan may have missed.
//! - [`candidates`]: which hypotheses of a scan are fitted; [`affected_channels`]: what a cause must explain.
//! - [`cross_validation`]: fits a hypothesis to one fold and evaluates it on the other, in full simulation.
//! - [`null_distribution`]: the threshold of the evidence, from the log itself.
//! - [`profile_likelihood`]: restarts from other local minima, and profile-likelihood intervals.
//! - [`final_fit`]: the fit to all rows, with intervals; [`unreported_effects`]: what causes too small to be reported add to them.
//! - [`law_shape`]: causes whose size depends on the state of the joint, which are another law; [`joint_samples`]: residuals by
//!   that state.
//! - [`size_drift`]: causes whose size differs between the two halves of the rows.
//! - [`discrimination`], [`experiment_design`]: choose an experiment that discriminates between ambiguous causes.
//! - [`true_law`]: how evident a known effect is in a log.
//! - [`unexplained`]: describes the unexplained residual; [`explained_variance`]: how much of it depends on a variable;
//!   [`spectral_line`]: its strongest frequency.
//!
//! A candidate is accepted as a cause if its log-likelihood gain exceeds [`null_distribution::thresholds`], it explains
//! at least [`forward_selection::MIN_EXPLAINED_FRACTION`] of the residual power above noise, and it exceeds a minimum
//! size. All accepted causes are then refitted together, and the search continues.

mod affected_channels;
mod backward_elimination;
mod by_equations;
mod candidates;
mod confounders;
mod cross_validation;
mod data_split;
mod discrimination;
mod excitation;
mod experiment_design;
mod explained;
mod explained_variance;
mod final_fit;
mod findings;
mod forward_selection;
mod friction_family;
mod hypothesis;
mod joint_gains;
mod joint_samples;
mod law_shape;
mod null_distribution;
mod of_tree;
mod profile_likelihood;
mod reporting;
mod residual_data;
mod residual_power;
mod residual_rows;
mod ripple_scan;
mod scan;
mod scope_merging;
mod size_drift;
mod spectral_line;
#[cfg(test)]
mod test_data;
mod true_law;
mod unexplained;
mod unreported_effects;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, Scope};
use twinstep_inference::InferenceError;
use twinstep_logs::replay::check_gains;
use twinstep_logs::{Log, TooSlowForMotion};
use twinstep_model::{RobotModel, Rollout};

use cross_validation::{Accepted, CandidateFit, FitProblem};
use data_split::DataSplit;
pub use discrimination::HypothesisPair;
pub use excitation::{EXCITATION_TRAJECTORIES, ExcitationTrajectory};
pub use experiment_design::ProposedExperiment;
use final_fit::FinalFit;
pub use findings::{
    AlternativeCause, Cause, CorrelatedPair, Diagnosis, DiscriminatedPair, Estimate, LearnedResidual, NextExperiment,
    ParameterValue, RmsErrors, Unexplained, WeightedHypothesis,
};
use forward_selection::{ForwardSelection, WindowedData, write_estimates};
use hypothesis::Hypothesis;
pub use of_tree::{TreeDiagnosis, diagnose_tree};
use residual_data::ResidualData;
pub use true_law::true_law_gain;
use twinstep_identify::ExperimentError;
use twinstep_identify::evaluate::evaluate;
use twinstep_identify::window::WindowConfig;

/// Difference of the log-likelihood gain from that of a cause within which an alternative is ambiguous [nat].
///
/// Simulators of the same law differ by as much.
const AMBIGUITY_NATS: f64 = 6.0;
/// The same difference, divided by the gain of the cause; the larger of the two applies.
const AMBIGUITY_FRACTION: f64 = 0.05;

/// Reason why a diagnosis is impossible.
#[derive(Debug, thiserror::Error)]
pub enum DiagnoseError {
    /// A log cannot be used as an experiment.
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
    /// The given model cannot be simulated.
    #[error("the simulation of the given model diverges on this log: start from a model that does not diverge")]
    Diverges,
    /// The given model is not a valid robot.
    #[error(transparent)]
    Model(#[from] twinstep_effects::EntryError),
    /// The sensors of a log are too slow for its motion.
    #[error(transparent)]
    TooSlowForMotion(#[from] TooSlowForMotion),
    /// Logs of a robot of any tree differ.
    #[error(
        "the logs have other joints, torque sensors, rates or base orientations, or one states no gains: diagnose them one by one"
    )]
    Unlike,
    /// A log and a robot of any tree cannot be compared.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// `progress` returned false.
    #[error("interrupted before completion")]
    Interrupted,
}

/// Progress callback with a description of the current step. The diagnosis is interrupted if it returns false.
pub type DiagnoseProgress<'a> = dyn FnMut(&str) -> bool + 'a;

/// Result of a diagnosis, with the corrected model.
#[derive(Clone, Debug)]
pub struct DiagnosisOutput {
    /// The findings. The caller that writes the files sets `extended_model`.
    pub diagnosis: Diagnosis,
    /// The given model with the gains of the joints, if they differ, the causes and their intervals.
    pub extended: ModelFile,
    /// The model before the last fit, which includes the held-out blocks: what [`Diagnosis::extended`] evaluates.
    pub before_last_fit: ModelFile,
    /// True if torques, or positions with a fixed base, have a residual above noise that the causes leave.
    pub lacks_torque: bool,
    /// For each log, which rows are held out.
    pub held_out: Vec<Vec<bool>>,
    /// Proposed experiment, if there are ambiguous causes.
    pub next: Option<ProposedExperiment>,
}

/// Identifies the effects that `model` lacks, from `logs` of one robot.
///
/// Simulations end soon after `stop` is true; `progress` must return false then.
pub fn diagnose(
    logs: Vec<Log>,
    model: &ModelFile,
    simulator: &mut dyn Rollout,
    stop: &Arc<AtomicBool>,
    progress: &mut DiagnoseProgress,
) -> Result<DiagnosisOutput, DiagnoseError> {
    let mut say = |text: &str| if progress(text) { Ok(()) } else { Err(DiagnoseError::Interrupted) };
    for log in &logs {
        check_gains(log).map_err(ExperimentError::from)?;
        log.check_measurements_per_period()?;
    }
    if let Some(output) = by_equations::diagnose_by_equations(&logs, model, simulator, stop, &mut say)? {
        return Ok(output);
    }
    say("fitting the ground and the nuisance parameters")?;
    let Views { robot, judged, views } = Views::new(logs, model, simulator)?;
    let mut search = ForwardSelection {
        view: views.len() - 1,
        views: &views,
        baseline: judged.clone(),
        accepted: Accepted::new(),
        model: judged.clone(),
        unsupported: BTreeMap::new(),
        scan_without_causes: None,
        joint_gains: None,
        simulator,
        progress: &mut say,
    };
    search.run()?;
    backward_elimination::eliminate(&mut search)?;
    friction_family::extend(&mut search)?;
    let ForwardSelection { view, mut accepted, baseline: judged, joint_gains, .. } = search;
    let model = &joint_gains.as_ref().map_or(model.clone(), |gains| gains.added_to(model));
    let WindowedData { evidence, given } = &views[view];
    say("refitting all causes")?;
    refitted(&judged, &mut accepted, evidence, simulator);
    let mut before_last = accepted.clone();
    say("computing intervals")?;
    let FinalFit { extended, confusable, drifts, other_laws } =
        FinalFit::new(model, &judged, &mut accepted, evidence, simulator);
    if accepted.len() < before_last.len() {
        let is_cause = |name: String| accepted.iter().any(|(cause, _)| cause.hypothesis.name() == name);
        before_last.retain(|(cause, _)| is_cause(cause.hypothesis.name()));
        refitted(&judged, &mut before_last, evidence, simulator);
    }
    let before_last_fit = with_causes(model, &before_last);
    let errors_of_fit = errors(evidence, &before_last_fit.robot_model()?, simulator)?;
    let left = evidence.residual_power(simulator, &with_causes(&judged, &before_last).robot_model()?);
    say("choosing the next experiment")?;
    let pairs = experiment_design::pairs(&extended, &accepted, &confusable);
    let next = experiment_design::next_motion(&pairs, evidence, &robot, simulator);
    let causes =
        accepted.iter().zip(drifts).map(|((best, others), drifts)| cause(best, others, drifts, &extended)).collect();
    let mut unexplained = unexplained::unexplained(evidence, &extended.robot_model()?, given, &left, simulator);
    unexplained.text += &other_laws;
    let diagnosis = Diagnosis {
        baseline: errors(evidence, &robot, simulator)?,
        extended: errors_of_fit,
        noise_floor: reporting::noise_floor(evidence),
        findings: causes,
        joint_gains: joint_gains.map_or(BTreeMap::new(), |gains| gains.by_joint()),
        also_fitted: Vec::new(),
        confusable,
        unexplained,
        learned_residual: None,
        next_experiment: next.as_ref().map(|next| next.summary.clone()),
        decisions: Vec::new(),
        extended_model: String::new(),
    };
    let held_out = evidence.logs().iter().map(held_out_rows).collect();
    let lacks_torque = left.shows_missing_torque(unexplained::LEAST_EXCESS);
    Ok(DiagnosisOutput { diagnosis, extended, before_last_fit, lacks_torque, held_out, next })
}

/// Returns for each row of a log whether it takes no part in the selections and fits of [`diagnose`], which measures its
/// errors on these rows.
pub fn held_out_rows(log: &Log) -> Vec<bool> {
    let split = DataSplit::new(log);
    (0..log.rows()).map(|row| split.is_held_out(row)).collect()
}

/// Residuals of logs in windows of all lengths that are needed, and the models with which they are computed.
struct Views {
    /// Robot of the given model.
    robot: RobotModel,
    /// The given model with fitted ground.
    judged: ModelFile,
    /// Data in long windows, and in short ones if the given model fails to track the joints in the long ones.
    views: Vec<WindowedData>,
}

impl Views {
    fn new(logs: Vec<Log>, model: &ModelFile, simulator: &mut dyn Rollout) -> Result<Self, DiagnoseError> {
        let robot = model.robot_model()?;
        let mut evidence = ResidualData::new(logs.clone(), &robot, WindowConfig::DIAGNOSIS)?;
        let left = evidence.residual_power(simulator, &robot);
        if left.diverged() {
            return Err(DiagnoseError::Diverges);
        }
        let judged = with_fitted_ground(&evidence, model, simulator);
        let mut views = vec![WindowedData::new(evidence, &judged, &robot, simulator)?];
        if views[0].evidence.fails_to_track(&left) {
            evidence = ResidualData::new(logs, &robot, WindowConfig::SHORT)?;
            views.push(WindowedData::new(evidence, &judged, &robot, simulator)?);
        }
        Ok(Self { robot, judged, views })
    }
}

/// Returns the model with the ground's time constant fitted to the log, if the change is too small for a cause.
///
/// Contact laws differ between any two simulators. Without this step the difference is attributed to a shifted mass or
/// an elastic gear.
fn with_fitted_ground(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> ModelFile {
    let effect = Effect::named("ground_stiffness").expect("an effect of the catalogue");
    let own = model.effects.iter().rfind(|entry| entry.effect == effect);
    let values = own.map_or(vec![effect.parameters[0].no_effect_value], |entry| entry.values.clone());
    let hypothesis = Hypothesis { effect, scope: Scope::Ground, values };
    let Some(fit) = FitProblem::new(model, std::slice::from_ref(&hypothesis)).filter(|_| evidence.has_free_parts())
    else {
        return model.clone();
    };
    let point = fit.solve(&evidence.fit_rows, simulator);
    let fitted = Hypothesis { values: vec![fit.unknowns[0].value(point[0])], ..hypothesis };
    if fitted.exceeds_min_size() { model.clone() } else { fit.model(&point) }
}

/// Returns the fit of all causes on top of `model`, from their current values; `None` without causes.
fn joint_fit(model: &ModelFile, accepted: &Accepted) -> Option<FitProblem> {
    let hypotheses: Vec<_> = accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect();
    FitProblem::new(model, &hypotheses).filter(|_| !hypotheses.is_empty())
}

/// Returns `model` with the current values of all causes.
fn with_causes(model: &ModelFile, accepted: &Accepted) -> ModelFile {
    joint_fit(model, accepted).map_or(model.clone(), |fit| fit.model(&fit.initial_point))
}

/// Refits all causes without the held-out blocks, and writes their values to `accepted`.
fn refitted(judged: &ModelFile, accepted: &mut Accepted, evidence: &ResidualData, simulator: &mut dyn Rollout) {
    let Some(fit) = joint_fit(judged, accepted) else { return };
    let point = profile_likelihood::refine_with_restarts(&fit, evidence, simulator);
    write_estimates(accepted, &fit, &point);
}

/// Returns the RMS errors on held-out blocks.
fn errors(
    evidence: &ResidualData,
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
) -> Result<RmsErrors, DiagnoseError> {
    let (mut torque, mut q) = (Vec::new(), Vec::new());
    for (log, split) in evidence.logs().iter().zip(evidence.splits()) {
        let evaluation = evaluate(log, robot, simulator, |row| split.is_held_out(row))?;
        torque.extend(evaluation.torque_rmse_nm);
        q.extend(evaluation.q_rmse_rad);
    }
    let whole = |errors: Vec<f64>| {
        let squares: f64 = errors.iter().map(|error| error * error).sum();
        (!errors.is_empty()).then(|| (squares / errors.len() as f64).sqrt())
    };
    Ok(RmsErrors { torque_rmse_nm: whole(torque), q_rmse_rad: whole(q) })
}

/// Returns the alternatives that are ambiguous with the best candidate.
fn ambiguous<'a>(best: &CandidateFit, others: &'a [CandidateFit]) -> impl Iterator<Item = &'a CandidateFit> {
    let least = best.score - AMBIGUITY_NATS.max(AMBIGUITY_FRACTION * best.score);
    others.iter().filter(move |other| other.score > least)
}

/// Returns the posterior probabilities of hypotheses with these effects, scopes and scores [nat], the best first.
///
/// Scores of the same law in two simulators differ by [`AMBIGUITY_NATS`] or [`AMBIGUITY_FRACTION`]; the log-likelihood
/// ratio counts in units of a third of that.
fn posterior(hypotheses: Vec<(String, String, f64)>) -> Vec<WeightedHypothesis> {
    let best = hypotheses.first().map_or(0.0, |(_, _, score)| *score);
    let unit = AMBIGUITY_NATS.max(AMBIGUITY_FRACTION * best) / 3.0;
    let weight = |score: f64| ((score - best) / unit).exp();
    let total: f64 = hypotheses.iter().map(|(_, _, score)| weight(*score)).sum();
    let weighted = |(effect, scope, score)| WeightedHypothesis { effect, scope, probability: weight(score) / total };
    hypotheses.into_iter().map(weighted).collect()
}

fn cause(best: &CandidateFit, others: &[CandidateFit], drifts: Option<[f64; 2]>, extended: &ModelFile) -> Cause {
    let hypothesis = &best.hypothesis;
    let scored =
        |one: &CandidateFit| (one.hypothesis.effect.name.to_owned(), one.hypothesis.scope.to_string(), one.score);
    Cause {
        effect: hypothesis.effect.name.to_owned(),
        scope: hypothesis.scope.to_string(),
        parameters: reporting::estimates(hypothesis, extended),
        held_out_gain: best.gain,
        score_nats: best.score,
        threshold_nats: best.threshold,
        ambiguous_with: ambiguous(best, others).map(|other| other.hypothesis.name()).collect(),
        posterior: posterior(std::iter::once(best).chain(ambiguous(best, others)).map(scored).collect()),
        drifts,
        remedy: hypothesis.effect.remedy.to_owned(),
        rivals: others.iter().take(5).map(reporting::rival).collect(),
        evidence: reporting::explanation(best, others) + &reporting::drift(hypothesis, drifts),
    }
}
