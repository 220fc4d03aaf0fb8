//! Diagnosis of a log with motor currents: its causes are those of highest evidence in the equations of the log.
//!
//! [`twinstep_inference::equations`] finds them without simulation, in the rows that are not held out. Simulations estimate the gains of
//! the joints where the equations show that they differ, measure the errors in the held-out rows, and choose the next experiment.

use std::collections::BTreeMap;

use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, ModelFile, Scope};
use twinstep_identify::window::WindowConfig;
use twinstep_inference::equations::{Explained, Explanation, OfJoint, UnknownLaw, explain};
use twinstep_logs::Log;
use twinstep_model::Rollout;

use super::cross_validation::{Accepted, CandidateFit};
use super::data_split::DataSplit;
use super::findings::{Cause, CorrelatedPair, Diagnosis, Unexplained, WeightedHypothesis};
use super::hypothesis::Hypothesis;
use super::joint_gains::JointGains;
use super::residual_data::ResidualData;
use super::{DiagnoseError, DiagnosisOutput, errors, experiment_design, held_out_rows, reporting, unexplained};

/// Evidence by which a cause must be better than without it [nat].
const LEAST_GAIN: f64 = 3.0;
/// Evidence by which a rival may be worse than a cause, and still be as good an explanation: odds of 20 to 1 [nat].
const AMBIGUOUS: f64 = 3.0;
/// Absolute correlation of two estimates from which they are reported.
const CORRELATED: f64 = 0.9;

/// Diagnoses a log. Returns `None` if the equations do not apply to it: it lacks motor currents, velocities, or gains of a joint.
pub fn diagnose_by_equations(
    log: &Log,
    model: &ModelFile,
    simulator: &mut dyn Rollout,
    say: &mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
) -> Result<Option<DiagnosisOutput>, DiagnoseError> {
    let robot = model.robot_model()?;
    let split = DataSplit::new(log);
    let mut interrupted = Ok(());
    let mut go_on = |text: &str| {
        interrupted = say(text);
        interrupted.is_ok()
    };
    let found = explain(log, &robot, |row| !split.is_held_out(row), &mut go_on);
    interrupted?;
    let Some(found) = found else { return Ok(None) };
    say("simulating the log")?;
    let evidence = ResidualData::new(vec![log.clone()], &robot, WindowConfig::DIAGNOSIS)?;
    let with_causes = extended(model, &found.causes)?;
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
    let diagnosis = Diagnosis {
        baseline: baseline?,
        extended: after?,
        noise_floor: reporting::noise_floor(&evidence),
        findings: found.causes.iter().map(|cause| finding(cause, &extended)).collect::<Result<_, _>>()?,
        joint_gains: gains.map_or(BTreeMap::new(), |gains| gains.by_joint()),
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
        held_out: vec![held_out_rows(log)],
        next,
    }))
}

/// Returns the strongest law that the catalogue does not have.
fn unexplained_law(found: &Explained) -> Unexplained {
    let Some(UnknownLaw { joint, of_drive, variable, gain }) = found.unknown.first() else {
        return unexplained::only_noise();
    };
    let channel = if *variable == "t" { "t".to_owned() } else { format!("{variable}_{joint}") };
    let place = if *of_drive { "The torque of the drive" } else { "The torque on the link" };
    let others = found.unknown.len() - 1;
    let more = if others == 0 { String::new() } else { format!(" So do {others} more equations.") };
    let text = format!(
        "{place} of {joint} has another law, which the catalogue does not have: a function of {channel} and others explains what the causes leave, with {gain:.0} nat.{more}"
    );
    Unexplained { fraction: found.left, depends_on: vec![channel], text }
}

/// Returns the model with the causes and their intervals.
fn extended(model: &ModelFile, causes: &[Explanation]) -> Result<ModelFile, DiagnoseError> {
    let mut extended = model.clone();
    for cause in causes {
        let each = cause.by_joint.iter().map(|own| (Scope::Joint(own.joint), &own.values, &own.intervals));
        let mut added: Vec<_> = each.collect();
        if added.is_empty() {
            added.push((cause.scope, &cause.values, &cause.intervals));
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
    let rivals = close.map(|(effect, scope, values, behind)| fit(effect, *scope, values, cause.gain + behind));
    (fit(cause.effect, cause.scope, &cause.values, cause.gain), rivals.collect())
}

fn confusable(found: &Explained) -> Vec<CorrelatedPair> {
    let is_high = |(one, other, correlation): &&(usize, usize, f64)| {
        correlation.abs() >= CORRELATED && found.causes[*one].effect != found.causes[*other].effect
    };
    let pair = |(one, other, correlation): &(usize, usize, f64)| {
        let [one, other] = [*one, *other].map(|index| found.causes[index].effect);
        CorrelatedPair {
            effects: [one.name.to_owned(), other.name.to_owned()],
            correlation: *correlation,
            experiment: reporting::experiment_between(one, other),
        }
    };
    found.correlations.iter().filter(is_high).map(pair).collect()
}

fn finding(cause: &Explanation, extended: &ModelFile) -> Result<Cause, DiagnoseError> {
    let (own, close) = candidates(cause);
    let hypothesis = &own.hypothesis;
    let weights: Vec<f64> = close.iter().map(|rival| (rival.score - cause.gain).exp()).collect();
    let total = 1.0 + weights.iter().sum::<f64>();
    let weighted = |effect: &str, scope: Scope, weight: f64| WeightedHypothesis {
        effect: effect.to_owned(),
        scope: scope.to_string(),
        probability: weight / total,
    };
    let of_rivals = close
        .iter()
        .zip(&weights)
        .map(|(rival, weight)| weighted(rival.hypothesis.effect.name, rival.hypothesis.scope, *weight));
    let first = &cause.effect.parameters[0];
    let size = format!("{:.4} {}", cause.values[0], first.unit);
    let name = cause.effect.name.replace('_', " ");
    let mut evidence = format!(
        "{name} at {}, {} {}: without it, the other causes explain the log {:.0} nat less.",
        cause.scope,
        first.name,
        size.trim_end(),
        cause.gain
    );
    if let Some((effect, scope, _, behind)) = cause.rivals.first() {
        let rival = effect.name.replace('_', " ");
        evidence = format!("{evidence} In its place, {rival} at {scope} is {:.0} nat behind.", -behind);
    }
    let mut described = extended.clone();
    if !cause.by_joint.is_empty() {
        let of = |own: &OfJoint| format!("{} {:.3}", own.joint, own.values[0]);
        let all: Vec<String> = cause.by_joint.iter().map(of).collect();
        evidence = format!("{evidence} Each joint has its own: {}.", all.join(", "));
        // The model has the value of each joint, the finding their mean.
        described.effects.push(entry(cause.effect, cause.scope, &cause.values, &cause.intervals)?);
    }
    Ok(Cause {
        effect: cause.effect.name.to_owned(),
        scope: cause.scope.to_string(),
        parameters: reporting::estimates(hypothesis, &described),
        held_out_gain: cause.explained,
        score_nats: cause.gain,
        threshold_nats: LEAST_GAIN,
        ambiguous_with: close.iter().map(|rival| rival.hypothesis.name()).collect(),
        posterior: std::iter::once(weighted(cause.effect.name, cause.scope, 1.0)).chain(of_rivals).collect(),
        drifts: None,
        remedy: cause.effect.remedy.to_owned(),
        rivals: close.iter().map(reporting::rival).collect(),
        evidence: evidence + " " + cause.effect.signature,
    })
}
