//! Diagnosis of the actuators of any robot by their torques only, from `q`, `dq`, `q_cmd`, gains and measured torque.
//!
//! Joints can have any names and number. Bodies are not simulated, so their parameters are not needed.
//!
//! The rules are those of the full diagnosis. A cause is fitted to one fold and evaluated on the other. It is reported
//! if its log-likelihood gain exceeds the threshold, it explains enough of the power above noise, and it is large
//! enough.

use std::collections::BTreeMap;

use twinstep_effects::{CATALOGUE, EffectEntry, Parameter, Scope, Target};
use twinstep_logs::Log;
use twinstep_logs::replay::check_gains;
use twinstep_model::RobotModel;

use super::affected_channels::{MAX_REMAINING_FRACTION, NEGLIGIBLE_EXCESS};
use super::forward_selection::{MIN_EXPLAINED_FRACTION, THRESHOLD};
use super::hypothesis::{Hypothesis, selection_penalty};
use super::joint_slots::JointSlots;
use super::residual_power::{ResidualPower, TORQUE};
use super::torque_fit::{TorqueCandidate, TorqueFit, excess, nats};
use super::unexplained::{self, LEAST_EXCESS};
use super::{AMBIGUITY_FRACTION, AMBIGUITY_NATS, DiagnoseError, DiagnoseProgress, posterior};
use crate::findings::{AlternativeCause, Cause, Diagnosis, Estimate, ParameterValue, RmsErrors, Unexplained};
use twinstep_identify::ExperimentError;

/// Number of joints in a group: the number of slots of the Go2.
const TOGETHER: usize = twinstep_model::NUM_JOINTS;
/// Maximum number of hypotheses of the scan that are fitted.
const TRIED: usize = 4;
/// Maximum number of causes per group of joints.
const MOST_CAUSES: usize = 12;

/// Identifies the effects that ideal actuators lack, from the torques in `logs` of one robot with joints of any names.
pub fn diagnose_torques(logs: &[Log], progress: &mut DiagnoseProgress) -> Result<Diagnosis, DiagnoseError> {
    for log in logs {
        check_gains(log).map_err(ExperimentError::from)?;
        log.check_measurements_per_period()?;
    }
    let mut all = Vec::new();
    for names in logs[0].joints().chunks(TOGETHER) {
        let slots = JointSlots::new(logs, names).map_err(ExperimentError::from)?;
        let mut search = TorqueForwardSelection { slots: &slots, causes: Vec::new(), progress: &mut *progress };
        search.run()?;
        let causes = std::mem::take(&mut search.causes);
        all.push(JointGroupResult::new(&slots, &causes, &logs[0]));
    }
    let sums = |of: fn(&JointGroupResult) -> [f64; 3]| {
        let sum = |index: usize| all.iter().map(|part| of(part)[index]).sum::<f64>();
        let rmse =
            |squares: f64| RmsErrors { torque_rmse_nm: Some((squares / sum(2).max(1.0)).sqrt()), q_rmse_rad: None };
        [rmse(sum(0)), rmse(sum(1))]
    };
    let ([baseline, noise_floor], [extended, _]) = (sums(|part| part.before), sums(|part| part.after));
    let unexplained = all.iter().map(|part| part.unexplained.clone());
    Ok(Diagnosis {
        decisions: Vec::new(),
        baseline,
        extended,
        noise_floor,
        unexplained: unexplained.max_by(|one, other| one.fraction.total_cmp(&other.fraction)).unwrap_or_default(),
        findings: all.into_iter().flat_map(|part| part.causes).collect(),
        joint_gains: BTreeMap::new(),
        confusable: Vec::new(),
        learned_residual: None,
        next_experiment: None,
        extended_model: String::new(),
    })
}

/// Result for a group of joints.
struct JointGroupResult {
    causes: Vec<Cause>,
    before: [f64; 3],
    after: [f64; 3],
    unexplained: Unexplained,
}

impl JointGroupResult {
    fn new(slots: &JointSlots, causes: &[TorqueCandidate], log: &Log) -> Self {
        let entries: Vec<EffectEntry> = causes.iter().map(|cause| cause.entry.clone()).collect();
        let [given, named] = [&[][..], &entries].map(|entries| slots.robot(entries).expect("entries that were fitted"));
        let torque_cause = |index: usize| {
            let others = entries.iter().enumerate().filter(|(other, _)| *other != index);
            let others: Vec<EffectEntry> = others.map(|(_, entry)| entry.clone()).collect();
            cause(slots, &causes[index], &others)
        };
        Self {
            causes: (0..causes.len()).map(torque_cause).collect(),
            before: slots.held_out_sums(&given),
            after: slots.held_out_sums(&named),
            unexplained: left(slots, [&given, &named], log),
        }
    }
}

/// State of the forward selection for a group of joints.
struct TorqueForwardSelection<'a, 'b> {
    slots: &'a JointSlots,
    causes: Vec<TorqueCandidate>,
    progress: &'a mut DiagnoseProgress<'b>,
}

impl TorqueForwardSelection<'_, '_> {
    fn run(&mut self) -> Result<(), DiagnoseError> {
        while self.causes.len() < MOST_CAUSES {
            self.say()?;
            let Some(next) = self.next() else { break };
            self.causes.push(next);
        }
        // Refits each cause on top of all others, including those found after it.
        for place in 0..self.causes.len() {
            self.say()?;
            let cause = self.causes.remove(place);
            let others = self.entries();
            let again = TorqueFit::new(self.slots, &others, &cause.entry);
            let entry = again.map_or(cause.entry.clone(), |fit| fit.entry_at(&fit.coordinate_descent(&[0, 1])));
            self.causes.insert(place, TorqueCandidate { entry, ..cause });
        }
        while let Some(place) = self.untenable() {
            self.causes.remove(place);
        }
        Ok(())
    }

    fn say(&mut self) -> Result<(), DiagnoseError> {
        let text = format!("fitting torques of the group of {}; causes: {}", self.slots.name(0), self.causes.len());
        if (self.progress)(&text) { Ok(()) } else { Err(DiagnoseError::Interrupted) }
    }

    fn entries(&self) -> Vec<EffectEntry> {
        self.causes.iter().map(|cause| cause.entry.clone()).collect()
    }

    /// Returns the best candidate on top of the accepted causes, if one reaches the threshold.
    fn next(&self) -> Option<TorqueCandidate> {
        let entries = self.entries();
        let named = |entry: &EffectEntry| {
            entries.iter().any(|other| other.effect == entry.effect && other.scope == entry.scope)
        };
        let tried = self.candidates(&entries)?.into_iter().filter(|entry| !named(entry)).take(TRIED);
        let mut found: Vec<TorqueCandidate> =
            tried.filter_map(|entry| TorqueFit::new(self.slots, &entries, &entry)?.cross_validated()).collect();
        found.sort_by(|one, other| other.score.total_cmp(&one.score));
        let earns = |found: &TorqueCandidate| {
            found.score >= THRESHOLD
                && found.explains >= MIN_EXPLAINED_FRACTION
                && hypothesis(&found.entry).exceeds_min_size()
        };
        let place = found.iter().position(earns)?;
        let best = found.remove(place);
        Some(TorqueCandidate { others: found, ..best })
    }

    /// Scans every effect that affects torques, on all joints and on each joint, on a grid of sizes.
    ///
    /// Returns the candidates with the best first.
    fn candidates(&self, entries: &[EffectEntry]) -> Option<Vec<EffectEntry>> {
        let now = self.slots.robot(entries)?;
        let before = self.slots.residual_powers(std::slice::from_ref(&now)).remove(0);
        let mut scored = Vec::new();
        for effect in CATALOGUE.into_iter().filter(|effect| effect.target == Target::Joints) {
            let with = |values: Vec<f64>| {
                let entry = EffectEntry::new(effect, Scope::All, values.clone()).ok()?;
                Some((values, self.slots.robot(&[entries, &[entry]].concat())?))
            };
            let (values, robots): (Vec<_>, Vec<_>) =
                effect.probe_values(effect.search.probes).into_iter().filter_map(with).unzip();
            if !robots.iter().any(|robot| self.slots.affects_torque(robot, &now)) {
                continue;
            }
            let left = self.slots.residual_powers(&robots);
            for scope in self.slots.scopes() {
                let of = |size: usize, fold: usize| nats(self.slots, scope, &left[size], &before, &[fold]);
                let best = |of: &dyn Fn(usize) -> f64| (0..values.len()).max_by(|a, b| of(*a).total_cmp(&of(*b)));
                // Selected on one fold, evaluated on the other.
                let judged =
                    of(best(&|size| of(size, 0))?, 1) + of(best(&|size| of(size, 1))?, 0) - selection_penalty(scope);
                let whole = best(&|size| of(size, 0) + of(size, 1))?;
                scored.push((judged, EffectEntry::new(effect, scope, values[whole].clone()).ok()?));
            }
        }
        scored.retain(|(score, _)| *score > 0.0);
        scored.sort_by(|(one, _), (other, _)| other.total_cmp(one));
        Some(scored.into_iter().map(|(_, entry)| entry).collect())
    }

    /// Returns the index of a cause that is too small, implausible, or does not halve the RMS error of its own joints.
    fn untenable(&self) -> Option<usize> {
        let (given, named) = (self.slots.robot(&[])?, self.slots.robot(&self.entries())?);
        let left = self.slots.residual_powers(&[given, named]);
        let stands = |cause: &TorqueCandidate| {
            let excess = |left: &ResidualPower| excess(self.slots, cause.entry.scope, left);
            let rows: f64 = self.slots.of(cause.entry.scope).flat_map(|seat| left[1].counts[TORQUE + seat]).sum();
            let one = hypothesis(&cause.entry);
            let explains = excess(&left[1]) <= NEGLIGIBLE_EXCESS * rows
                || excess(&left[1]) <= MAX_REMAINING_FRACTION * excess(&left[0]);
            one.exceeds_min_size() && one.is_plausible() && explains
        };
        self.causes.iter().position(|cause| !stands(cause))
    }
}

fn hypothesis(entry: &EffectEntry) -> Hypothesis {
    Hypothesis { effect: entry.effect, scope: entry.scope, values: entry.values.clone() }
}

/// Returns the cause for the findings, with the names and units of the joints in the logs.
fn cause(slots: &JointSlots, found: &TorqueCandidate, others: &[EffectEntry]) -> Cause {
    let (effect, scope) = (found.entry.effect, slots.scope_name(found.entry.scope));
    let fit = TorqueFit::new(slots, others, &found.entry).expect("it was fitted before");
    let numbers = effect.parameters.iter().zip(&found.entry.values).zip(fit.intervals());
    let estimate = |((parameter, value), [low, high]): ((&Parameter, &f64), [f64; 2])| {
        // Torques in the slots are scaled.
        let unit =
            if parameter.unit.contains("N·m") || parameter.unit == "kg·m²" { slots.torque_scale } else { 1.0 };
        let [value, low, high] = [*value, low, high].map(|number| ParameterValue::Number(unit * number));
        (parameter.name.to_owned(), Estimate { value, low, high })
    };
    let name = |entry: &EffectEntry| format!("{}@{}", entry.effect.name, slots.scope_name(entry.scope));
    let close =
        |other: &&TorqueCandidate| other.score > found.score - AMBIGUITY_NATS.max(AMBIGUITY_FRACTION * found.score);
    let scored =
        |one: &TorqueCandidate| (one.entry.effect.name.to_owned(), slots.scope_name(one.entry.scope), one.score);
    let rival = |other: &TorqueCandidate| AlternativeCause {
        effect: other.entry.effect.name.to_owned(),
        scope: slots.scope_name(other.entry.scope),
        held_out_gain: other.gain,
    };
    let mut evidence = format!(
        "{} at {scope}: it reduces the cross-validated RMS error of the torque by {:.0} %.",
        effect.name.replace('_', " "),
        100.0 * found.gain
    );
    if let Some(other) = found.others.first() {
        let behind = found.score - other.score;
        evidence = format!("{evidence} Best alternative: {}, {behind:.0} nat less.", name(&other.entry));
    }
    Cause {
        effect: effect.name.to_owned(),
        parameters: numbers.map(estimate).collect(),
        held_out_gain: found.gain,
        score_nats: found.score,
        threshold_nats: THRESHOLD,
        ambiguous_with: found.others.iter().filter(close).map(|other| name(&other.entry)).collect(),
        posterior: posterior(std::iter::once(found).chain(found.others.iter().filter(close)).map(scored).collect()),
        drifts: None,
        remedy: effect.remedy.to_owned(),
        rivals: found.others.iter().map(rival).collect(),
        evidence: format!("{evidence} {}", effect.signature),
        scope,
    }
}

/// Describes the unexplained residual of the joint with the largest power above noise.
fn left(slots: &JointSlots, [given, named]: [&RobotModel; 2], log: &Log) -> Unexplained {
    let left = slots.residual_powers(&[given.clone(), named.clone()]);
    let [before, after] = [&left[0], &left[1]].map(|left| excess(slots, Scope::All, left));
    let share = |seat: usize| {
        let rows: f64 = left[1].counts[TORQUE + seat].iter().sum();
        left[1].channel_excess(TORQUE + seat) / rows.max(1.0)
    };
    let worst = slots.of(Scope::All).max_by(|one, other| share(*one).total_cmp(&share(*other)));
    let Some(seat) = worst.filter(|seat| share(*seat) > LEAST_EXCESS) else { return unexplained::only_noise() };
    let fraction = if before > 0.0 { (after / before).min(1.0) } else { 0.0 };
    let whose = format!("The torque of {}", slots.name(seat));
    unexplained::describe_residual(log, &slots.residual(named, seat), &unexplained::measured(log), fraction, &whose)
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::BaseMount;
    use twinstep_model::{standard_normal, stream};

    use super::*;

    const RATE_HZ: f64 = 500.0;
    const ROWS: usize = 5_000;
    const NOISE_NM: f64 = 0.5;

    /// Returns a log of fourteen joints of an arm with torques up to 60 N·m, which follow sums of sines.
    ///
    /// `made` returns the torque of a joint in a row [N·m] from the commanded torque in each row.
    fn log(made: impl Fn(usize, &[f64], usize) -> f64) -> Log {
        let mut columns = vec![("t".to_owned(), (0..ROWS).map(|row| row as f64 / RATE_HZ).collect::<Vec<f64>>())];
        for joint in 0..14 {
            let mut random = stream(3, "arm", joint as u64);
            let waves: Vec<[f64; 2]> =
                (0..5).map(|_| [random.random_range(1.0..25.0), random.random_range(0.0..6.0)]).collect();
            // Smooth start from rest within one second.
            let at = |row: usize| row as f64 / RATE_HZ;
            let grown = |t: f64| if t < 1.0 { [t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t)] } else { [1.0, 0.0] };
            let sum =
                |of: &dyn Fn(f64, f64) -> f64| 0.1 * waves.iter().map(|[rate, phase]| of(*rate, *phase)).sum::<f64>();
            let motion = |row: usize| {
                let (t, [size, growth]) = (at(row), grown(at(row)));
                let wave = sum(&|rate, phase| (rate * t + phase).sin());
                let slope = sum(&|rate, phase| rate * (rate * t + phase).cos());
                [size * wave, growth * wave + size * slope]
            };
            let [q, dq] = [0, 1].map(|part| (0..ROWS).map(|row| motion(row)[part]).collect::<Vec<f64>>());
            let q_cmd: Vec<f64> = (0..ROWS).map(|row| 1.3 * q[row] + 0.02 * dq[row]).collect();
            let wanted: Vec<f64> = (0..ROWS).map(|row| 200.0 * (q_cmd[row] - q[row]) - 2.0 * dq[row]).collect();
            let tau = (0..ROWS).map(|row| made(joint, &wanted, row) + NOISE_NM * standard_normal(&mut random));
            let tau = tau.collect();
            for (quantity, cells) in [("q", q), ("dq", dq), ("q_cmd", q_cmd), ("tau_measured", tau)] {
                columns.push((format!("{quantity}_axis_{joint}"), cells));
            }
        }
        columns.push(("kp".to_owned(), vec![200.0; ROWS]));
        columns.push(("kd".to_owned(), vec![2.0; ROWS]));
        let segments = vec![Segment { name: "bench".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(RATE_HZ, TorqueSensor::JointOutput, segments);
        let noise = [("q", 1e-5), ("dq", 1e-3), ("tau_measured", NOISE_NM)];
        meta.noise = noise.map(|(quantity, sigma)| (quantity.to_owned(), sigma)).into();
        Log::new(meta, columns).expect("a log")
    }

    fn diagnosis(log: Log) -> Diagnosis {
        diagnose_torques(&[log], &mut |_| true).expect("a diagnosis")
    }

    #[test]
    fn ideal_actuators_give_no_cause() {
        let found = diagnosis(log(|_, wanted, row| wanted[row]));
        assert!(found.findings.is_empty(), "{:#?}", found.findings);
        assert_eq!(found.unexplained.fraction, 0.0);
    }

    #[test]
    fn delayed_and_weak_actuators_of_a_robot_with_fourteen_joints_are_identified() {
        let found = diagnosis(log(|joint, wanted, row| match joint {
            3 => wanted[row.saturating_sub(4)],
            13 => 0.85 * wanted[row],
            _ => wanted[row],
        }));
        let names: Vec<_> = found.findings.iter().map(|cause| format!("{}@{}", cause.effect, cause.scope)).collect();
        // Torque delay and sensor delay give the same measured torque; only the motion distinguishes them.
        let late = ["torque_delay@axis_3", "torque_sensor_delay@axis_3"];
        assert!(late.contains(&names[0].as_str()), "{names:?}");
        assert!(late.contains(&found.findings[0].ambiguous_with[0].as_str()), "{:#?}", found.findings[0]);
        assert_eq!(names[1..], ["torque_gain@axis_13"], "{:#?}", found.findings);
        let within = |place: usize, name: &str, truth: f64| {
            let estimate = &found.findings[place].parameters[name];
            let [ParameterValue::Number(low), ParameterValue::Number(high)] = [&estimate.low, &estimate.high] else {
                return false;
            };
            (*low..=*high).contains(&truth)
        };
        assert!(within(0, "delay_s", 0.008) && within(1, "gain", 0.85), "{:#?}", found.findings);
        assert!(found.extended.torque_rmse_nm < Some(1.1 * NOISE_NM), "{:?}", found.extended);
    }

    #[test]
    fn cause_of_a_group_of_joints_lists_them() {
        let found = diagnosis(log(|joint, wanted, row| if joint >= 12 { 0.8 * wanted[row] } else { wanted[row] }));
        let names: Vec<_> = found.findings.iter().map(|cause| format!("{}@{}", cause.effect, cause.scope)).collect();
        assert_eq!(names, ["torque_gain@axis_12+axis_13"], "{:#?}", found.findings);
    }

    #[test]
    fn error_for_a_missing_column_contains_the_joint() {
        let whole = log(|_, wanted, row| wanted[row]);
        let columns: Vec<(String, Vec<f64>)> = std::iter::once(("t".to_owned(), whole.t().to_vec()))
            .chain(whole.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec())))
            .filter(|(name, _)| name != "tau_measured_axis_5")
            .collect();
        let log = Log::new(whole.meta().clone(), columns).expect("a log");
        let error = diagnose_torques(&[log], &mut |_| true).expect_err("refused").to_string();
        assert_eq!(error, "joint `axis_5` of the log has no `tau_measured`");
    }
}
