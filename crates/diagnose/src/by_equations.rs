//! Diagnosis of logs of a Go2 with motor currents, or on a fixed base: the causes are those of highest evidence in the residuals of torques
//! or positions.
//!
//! [`twinstep_inference::equations`] finds them in the rows that are not held out. Simulations estimate the gains of
//! the joints where the equations show that they differ, measure the errors in the held-out rows, and choose the next experiment.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, ModelFile, Scope};
use twinstep_identify::window::WindowConfig;
use twinstep_inference::equations::{Explanation, explain};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{JOINT_NAMES, Joint, Rollout};

use super::cross_validation::{Accepted, CandidateFit};
use super::data_split::fitted_rows;
use super::explained::{AMBIGUOUS, LEAST_GAIN, also_fitted, confusable, finding, unexplained_law};
use super::findings::Diagnosis;
use super::hypothesis::Hypothesis;
use super::joint_gains::JointGains;
use super::residual_data::ResidualData;
use super::{DiagnoseError, DiagnosisOutput, errors, experiment_design, held_out_rows, reporting, unexplained};

/// Diagnoses the logs of one robot. Returns `None` if they have neither motor currents nor a fixed base, or if the robot does not hang, and
/// stand where its base moves.
pub fn diagnose_by_equations(
    logs: &[Log],
    model: &ModelFile,
    simulator: &mut dyn Rollout,
    stop: &Arc<AtomicBool>,
    say: &mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
) -> Result<Option<DiagnosisOutput>, DiagnoseError> {
    let robot = model.robot_model()?;
    let Some(joined) = Log::joined(logs) else { return Ok(None) };
    let is_fixed = joined.segments().all(|(segment, _)| segment.base.is_fixed());
    match joined.meta().tau_sensor {
        TorqueSensor::MotorCurrent => {}
        TorqueSensor::None if is_fixed => {}
        _ => return Ok(None),
    }
    let held_out: Vec<Vec<bool>> = logs.iter().map(held_out_rows).collect();
    let is_used: Vec<bool> = logs.iter().flat_map(fitted_rows).collect();
    let mut interrupted = Ok(());
    let mut go_on = |text: &str| {
        interrupted = say(text);
        interrupted.is_ok()
    };
    let found = explain(&joined, &robot, stop, |row| is_used[row], &mut go_on);
    interrupted?;
    let Ok(found) = found else { return Ok(None) };
    // Simulations that were ended have left nothing to report.
    let found = found.filter(|_| !stop.load(Ordering::Relaxed)).ok_or(DiagnoseError::Interrupted)?;
    say("simulating the log")?;
    let evidence = ResidualData::new(logs.to_vec(), &robot, WindowConfig::DIAGNOSIS)?;
    let with_causes = extended(model, found.all())?;
    let gains = found.gains_differ.then(|| JointGains::fit(&evidence, &with_causes, LEAST_GAIN, simulator)).flatten();
    let extended = gains.as_ref().map_or(with_causes.clone(), |gains| gains.added_to(&with_causes));
    if evidence.residual_power(simulator, &robot).diverged() {
        return Err(DiagnoseError::Diverges);
    }
    let corrected = extended.robot_model()?;
    let left = evidence.residual_power(simulator, &corrected);
    let [baseline, after] = [&robot, &corrected].map(|robot| errors(&evidence, robot, simulator));
    say("choosing the next experiment")?;
    let accepted: Accepted = found.causes.iter().map(candidates).collect();
    let confusable = confusable(&found);
    let pairs = experiment_design::pairs(&extended, &accepted, &confusable);
    let next = experiment_design::next_motion(&pairs, &evidence, &robot, simulator);
    let unexplained = unexplained_law(&found);
    let joints = JOINT_NAMES.map(str::to_owned);
    let diagnosis = Diagnosis {
        baseline: baseline?,
        extended: after?,
        noise_floor: reporting::noise_floor(&evidence),
        findings: found.causes.iter().map(|cause| finding(cause, &joints)).collect(),
        joint_gains: gains.map_or(BTreeMap::new(), |gains| gains.by_joint()),
        also_fitted: also_fitted(&found, &joints),
        confusable,
        unexplained,
        learned_residual: None,
        next_experiment: next.as_ref().map(|next| next.summary.clone()),
        decisions: found.decisions,
        extended_model: String::new(),
    };
    Ok(Some(DiagnosisOutput {
        diagnosis,
        before_last_fit: extended.clone(),
        extended,
        lacks_torque: left.shows_missing_torque(unexplained::LEAST_EXCESS),
        held_out,
        next,
    }))
}

/// Returns the model with effects and their intervals.
fn extended<'a>(model: &ModelFile, causes: impl Iterator<Item = &'a Explanation>) -> Result<ModelFile, DiagnoseError> {
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

/// Returns a cause and its rivals as hypotheses.
fn candidates(cause: &Explanation) -> (CandidateFit, Vec<CandidateFit>) {
    let fit = |effect, scope, values: &[f64], score: f64| CandidateFit {
        hypothesis: Hypothesis { effect, scope, values: values.to_vec() },
        score,
        gain: cause.explained,
        explained_fraction: cause.explained,
        threshold: LEAST_GAIN,
    };
    let close = cause.rivals.iter().filter(|(.., behind)| *behind > -AMBIGUOUS);
    let rivals = close.map(|(effect, name, values, behind)| fit(effect, scope(name), values, cause.gain + behind));
    (fit(cause.effect, scope(&cause.scope), &cause.values, cause.gain), rivals.collect())
}
