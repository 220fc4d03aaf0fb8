//! Diagnosis of a Go2: the causes of highest evidence in the equations of its logs.
//!
//! They are found in the rows that are not held out. Simulations measure the errors in the held-out rows, and choose the next experiment.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, ModelFile, Scope};
use twinstep_identify::evaluate::evaluate;
use twinstep_identify::experiment::ResidualChannel;
use twinstep_identify::window::{WindowConfig, base_estimate};
use twinstep_inference::equations::{Explanation, explain};
use twinstep_logs::Log;
use twinstep_logs::replay::check_gains;
use twinstep_model::{JOINT_NAMES, Joint, RobotModel, Rollout};

use super::data_split::fitted_rows;
use super::explained::{AMBIGUOUS, also_fitted, confusable, finding, not_reported, unexplained_law};
use super::findings::{Diagnosis, RmsErrors};
use super::hypothesis::Hypothesis;
use super::promise::promise;
use super::residual_data::ResidualData;
use super::{DiagnoseError, DiagnoseProgress, DiagnosisOutput, ExperimentError, experiment_design, held_out_rows};

/// Power above noise from which a residual may be learned [noise variance].
const LEAST_EXCESS: f64 = 0.3;

/// Identifies the effects that `model` lacks, from `logs` of one robot.
///
/// Simulations end soon after `stop` is true; `progress` must return false then.
pub fn diagnose(
    logs: &[Log],
    model: &ModelFile,
    simulator: &mut dyn Rollout,
    stop: &Arc<AtomicBool>,
    progress: &mut DiagnoseProgress,
) -> Result<DiagnosisOutput, DiagnoseError> {
    for log in logs {
        check_gains(log).map_err(ExperimentError::from)?;
        log.check_measurements_per_period()?;
    }
    let robot = model.robot_model()?;
    let joined = Log::joined(logs).ok_or(DiagnoseError::Unlike)?;
    let joined = with_velocity(joined, &robot)?;
    let held_out: Vec<Vec<bool>> = logs.iter().map(held_out_rows).collect();
    let is_used: Vec<bool> = logs.iter().flat_map(fitted_rows).collect();
    let found = explain(&joined, &robot, stop, |row| is_used[row], progress)?;
    // Simulations that were ended have left nothing to report.
    let found = found.filter(|_| !stop.load(Ordering::Relaxed)).ok_or(DiagnoseError::Interrupted)?;
    let mut say = |text: &str| if progress(text) { Ok(()) } else { Err(DiagnoseError::Interrupted) };
    say("simulating the log")?;
    let evidence = ResidualData::new(logs.to_vec(), &robot, WindowConfig::DIAGNOSIS)?;
    if evidence.residual_power(simulator, &robot).diverged() {
        return Err(DiagnoseError::Diverges);
    }
    let extended = extended(model, found.all(), &found.gains)?;
    let corrected = extended.robot_model()?;
    let lacks_torque = evidence.residual_power(simulator, &corrected).shows_missing_torque(LEAST_EXCESS);
    let [baseline, after] = [&robot, &corrected].map(|robot| errors(logs, &held_out, robot, simulator));
    let joints = JOINT_NAMES.map(str::to_owned);
    say("predicting the gain")?;
    let promise = if extended.effects == model.effects {
        None
    } else {
        promise(logs, &held_out, [&robot, &corrected], &joints, simulator)?
    };
    say("choosing the next experiment")?;
    let confusable = confusable(&found);
    let ambiguous: Vec<(Hypothesis, Vec<Hypothesis>)> = found.causes.iter().map(hypotheses).collect();
    let pairs = experiment_design::pairs(&extended, &ambiguous, &confusable);
    let next = experiment_design::next_motion(&pairs, &evidence, &robot, simulator);
    let gains = joints.iter().cloned().zip(found.gains.iter().copied());
    let diagnosis = Diagnosis {
        baseline: baseline?,
        extended: after?,
        noise_floor: noise_floor(&evidence),
        findings: found.causes.iter().map(|cause| finding(cause, &joints)).collect(),
        joint_gains: gains.collect::<BTreeMap<_, _>>(),
        also_fitted: also_fitted(&found, &joints),
        confusable,
        unexplained: unexplained_law(&found),
        promise,
        learned_residual: None,
        next_experiment: next.as_ref().map(|next| next.summary.clone()),
        not_reported: not_reported(&found),
        decisions: found.decisions,
        extended_model: String::new(),
    };
    Ok(DiagnosisOutput { diagnosis, extended, lacks_torque, held_out, next })
}

/// Returns the log with the velocity of the base by legs and gyroscope, if neither it nor an acceleration was measured.
fn with_velocity(log: Log, robot: &RobotModel) -> Result<Log, ExperimentError> {
    if ["vel_x", "acc_x"].into_iter().any(|name| log.channel(name).is_some()) {
        return Ok(log);
    }
    let Some(estimate) = base_estimate(&log, robot)? else { return Ok(log) };
    let axis = |axis: usize| estimate.velocity.iter().map(|velocity| velocity[axis]).collect();
    Ok(log.with_base_velocity([0, 1, 2].map(axis)))
}

/// Returns the model with effects and their intervals, and with the gains of the joints.
fn extended<'a>(
    model: &ModelFile,
    causes: impl Iterator<Item = &'a Explanation>,
    gains: &[[f64; 2]],
) -> Result<ModelFile, DiagnoseError> {
    let mut extended = model.clone();
    for cause in causes {
        let each = cause.by_joint.iter().map(|own| (Scope::Joint(Joint::ALL[own.joint]), &own.values, &own.intervals));
        let mut added: Vec<_> = each.collect();
        if added.is_empty() {
            added.push((scope(&cause.scope), &cause.values, &cause.intervals));
        }
        for (scope, values, intervals) in added {
            if cause.effect.composition == Composition::Replace {
                extended.effects.retain(|entry| entry.effect != cause.effect || entry.scope != scope);
            }
            extended.effects.push(entry(cause.effect, scope, values, intervals)?);
        }
    }
    let effect = Effect::named("pd_gain").expect("an effect of the catalogue");
    for (joint, scales) in Joint::ALL.into_iter().zip(gains) {
        extended.effects.push(EffectEntry::new(effect, Scope::Joint(joint), scales.to_vec())?);
    }
    Ok(extended)
}

/// Returns the scope of a quadruped by its name.
fn scope(name: &str) -> Scope {
    name.parse().expect("the name of a scope")
}

fn entry(
    effect: &'static Effect,
    scope: Scope,
    values: &[f64],
    intervals: &[[f64; 2]],
) -> Result<EffectEntry, EntryError> {
    let entry = EffectEntry::new(effect, scope, values.to_vec())?;
    Ok(EffectEntry { intervals: intervals.iter().map(|interval| Some(*interval)).collect(), ..entry })
}

/// Returns a cause, and the rivals that explain the log as well.
fn hypotheses(cause: &Explanation) -> (Hypothesis, Vec<Hypothesis>) {
    let one = |effect, name: &str, values: &[f64]| Hypothesis { effect, scope: scope(name), values: values.to_vec() };
    let close = cause.rivals.iter().filter(|(.., behind)| *behind > -AMBIGUOUS);
    let rivals = close.map(|(effect, name, values, _)| one(effect, name, values)).collect();
    (one(cause.effect, &cause.scope, &cause.values), rivals)
}

/// Returns the root mean square errors of a robot in the held-out rows.
fn errors(
    logs: &[Log],
    held_out: &[Vec<bool>],
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
) -> Result<RmsErrors, DiagnoseError> {
    let (mut torque, mut q) = (Vec::new(), Vec::new());
    for (log, held_out) in logs.iter().zip(held_out) {
        let evaluation = evaluate(log, robot, simulator, |row| held_out[row])?;
        torque.extend(evaluation.torque_rmse_nm);
        q.extend(evaluation.q_rmse_rad);
    }
    let whole = |errors: &[f64]| (!errors.is_empty()).then(|| root_mean_square(errors));
    Ok(RmsErrors { torque_rmse_nm: whole(&torque), q_rmse_rad: whole(&q) })
}

/// Returns the errors due to sensor noise alone.
fn noise_floor(evidence: &ResidualData) -> RmsErrors {
    let experiments = &evidence.fit_rows.experiments;
    let of_positions = experiments.iter().flat_map(|experiment| {
        experiment.joints().iter().map(|joint| experiment.sigma(ResidualChannel::Position(joint.index())))
    });
    let of_positions: Vec<f64> = of_positions.collect();
    let of_torques = |log: &Log| -> Vec<f64> {
        let noise = |joint: &String| log.noise(&format!("tau_measured_{joint}")).unwrap_or(0.2);
        log.joints().iter().filter(|joint| log.tau_measured(joint).is_some()).map(noise).collect()
    };
    let of_torques: Vec<f64> = evidence.logs().iter().flat_map(of_torques).collect();
    RmsErrors {
        torque_rmse_nm: (!of_torques.is_empty()).then(|| root_mean_square(&of_torques)),
        q_rmse_rad: Some(root_mean_square(&of_positions)),
    }
}

fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
}
