//! Scan: evaluates every effect on all scopes, with a few simulations per effect.
//!
//! With a fixed base the legs are decoupled. One simulation of an effect on a joint type therefore evaluates the four joints of
//! that type, and one on all joints the wider scopes. Effects on base, ground and gyroscope are evaluated on the whole log.

use std::ops::Range;

use twinstep_effects::ModelFile;
use twinstep_effects::{CATALOGUE, Effect, EffectEntry, Probes, Scope, Target};
use twinstep_model::{Joint, JointKind, RobotModel, Rollout};

use super::hypothesis::{Hypothesis, OF_ONE_EFFECT, ScoredHypothesis, fine_probes, selection_penalty, with_effect};
use super::residual_data::ResidualData;
use super::residual_power::{ResidualPower, STANCE, TORQUE, evident_channels};
use super::ripple_scan::{self, scan_ripples};

/// Scans all effects of the catalogue. Returns the hypotheses with the best first.
pub fn scan(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> Vec<ScoredHypothesis> {
    let Ok(robot) = model.robot_model() else { return Vec::new() };
    let before = evidence.residual_powers(simulator, std::slice::from_ref(&robot), true).remove(0);
    let effects = CATALOGUE.into_iter().filter(|effect| {
        let is_scanned = matches!(effect.target, Target::Joints | Target::Supply) && effect.name != ripple_scan::EFFECT;
        is_scanned && evidence.has_required_torque(effect)
    });
    let mut scored: Vec<ScoredHypothesis> =
        effects.flat_map(|effect| scan_effect(evidence, model, effect, &before, simulator)).collect();
    scored.extend(scan_ripples(evidence, model, simulator));
    if evidence.has_free_parts() {
        scored.extend(scan_whole(evidence, model, &robot, simulator));
    }
    scored.sort_by(|one, other| other.score.total_cmp(&one.score));
    scored
}

fn scan_effect(
    evidence: &ResidualData,
    model: &ModelFile,
    effect: &'static Effect,
    before: &ResidualPower,
    simulator: &mut dyn Rollout,
) -> Vec<ScoredHypothesis> {
    let kinds = JointKind::ALL.into_iter().map(Scope::Kind).filter(|_| effect.target != Target::Supply);
    let simulated = [Scope::All].into_iter().chain(kinds);
    let mut scored: Vec<ScoredHypothesis> =
        simulated.flat_map(|simulated| scan_simulated(evidence, model, effect, simulated, before, simulator)).collect();
    scored.sort_by(|one, other| other.score.total_cmp(&one.score));
    scored.truncate(OF_ONE_EFFECT);
    scored
}

/// Returns the scopes that simulations of an effect on all joints or on those of one type evaluate.
fn evaluated_scopes(effect: &Effect, simulated: Scope) -> Vec<Scope> {
    let of_kind = |scope: &Scope| match (simulated, scope) {
        (Scope::Kind(kind), Scope::Joint(joint)) => joint.kind == kind,
        (Scope::Kind(_), scope) => *scope == simulated,
        (_, scope) => !matches!(scope, Scope::Kind(_) | Scope::Joint(_)),
    };
    if effect.target == Target::Supply {
        return vec![Scope::All];
    }
    Scope::of_joints().into_iter().filter(of_kind).collect()
}

/// Scores the scopes that simulations of an effect on the joints `simulated` evaluate: all, or those of one type.
fn scan_simulated(
    evidence: &ResidualData,
    model: &ModelFile,
    effect: &'static Effect,
    simulated: Scope,
    before: &ResidualPower,
    simulator: &mut dyn Rollout,
) -> Vec<ScoredHypothesis> {
    let built = |values: Vec<f64>| -> Option<(Vec<f64>, RobotModel)> {
        let robot = with_effect(model, effect, simulated, &values).ok()?.robot_model().ok()?;
        Some((values, robot))
    };
    let (values, robots): (Vec<_>, Vec<_>) =
        effect.probe_values(effect.search.probes).into_iter().filter_map(built).unzip();
    let gains: Vec<_> = evidence
        .residual_powers(simulator, &robots, true)
        .iter()
        .map(|now| joint_gains(evidence, now, before))
        .collect();
    let score = |scope: Scope| {
        // An effect on one joint moves the others of its leg, too.
        let in_its_legs = |joint: Joint| Joint::ALL.into_iter().any(|of| of.leg == joint.leg && scope.contains(of));
        let shows = |joint: &Joint| if simulated == Scope::All { scope.contains(*joint) } else { in_its_legs(*joint) };
        let joints: Vec<usize> = Joint::ALL.into_iter().filter(shows).map(Joint::index).collect();
        let of = |size: usize, fold: usize| -> f64 { joints.iter().map(|joint| gains[size][*joint][fold]).sum() };
        let best = |of: &dyn Fn(usize) -> f64| (0..values.len()).max_by(|one, other| of(*one).total_cmp(&of(*other)));
        // Selected on one fold, evaluated on the other.
        let judged = of(best(&|size| of(size, 0))?, 1) + of(best(&|size| of(size, 1))?, 0);
        let whole = best(&|size| of(size, 0) + of(size, 1))?;
        let hypothesis = Hypothesis { effect, scope, values: values[whole].clone() };
        Some(ScoredHypothesis { hypothesis, score: judged - selection_penalty(scope) })
    };
    evaluated_scopes(effect, simulated).into_iter().filter_map(score).collect()
}

/// Refines effects with many local minima on finer grids; returns other hypotheses unchanged.
///
/// If the loop oscillates, or the phase of a ripple is unknown, the residual has narrow minima, which a gradient step cannot
/// reach from far away.
pub fn refine_grid(
    evidence: &ResidualData,
    model: &ModelFile,
    hypothesis: Hypothesis,
    simulator: &mut dyn Rollout,
) -> Hypothesis {
    let Hypothesis { effect, scope, mut values } = hypothesis;
    let mut near = (effect.search.near)(&values);
    if !near.is_empty() {
        near.push(values.clone());
    }
    if let Some((_, best)) = best_values(evidence, model, effect, scope, near, true, simulator) {
        values = best;
    }
    if !effect.search.oscillates {
        return Hypothesis { effect, scope, values };
    }
    let [least, most] = effect.parameters[0].bounds;
    let mut tried = fine_probes(effect);
    tried.push(values.clone());
    for around in [[0.88, 0.94, 1.06, 1.12], [0.97, 0.985, 1.015, 1.03]] {
        let Some((_, best)) = best_values(evidence, model, effect, scope, tried, false, simulator) else { break };
        values = best;
        let near = around.map(|factor| vec![(factor * values[0]).clamp(least, most)]);
        tried = near.into_iter().chain([values.clone()]).collect();
    }
    Hypothesis { effect, scope, values }
}

/// Returns the largest log-likelihood gain [nat] and its values; with `quick` on rows with a fixed base, if there are any.
pub fn best_values(
    evidence: &ResidualData,
    model: &ModelFile,
    effect: &'static Effect,
    scope: Scope,
    values: Vec<Vec<f64>>,
    quick: bool,
    simulator: &mut dyn Rollout,
) -> Option<(f64, Vec<f64>)> {
    let built = |values: Vec<f64>| {
        let mut file = model.clone();
        file.effects.push(EffectEntry::new(effect, scope, values.clone()).ok()?);
        Some((values, file.robot_model().ok()?))
    };
    if values.is_empty() {
        return None;
    }
    let before = evidence.residual_powers(simulator, &[model.robot_model().ok()?], quick).remove(0);
    let (values, robots): (Vec<_>, Vec<_>) = values.into_iter().filter_map(built).unzip();
    let scores = evidence
        .residual_powers(simulator, &robots, quick)
        .into_iter()
        .map(|now| log_likelihood_gain(evidence, &now, &before, evident_channels([effect.target])));
    scores.zip(values).max_by(|one, other| one.0.total_cmp(&other.0))
}

/// Returns the log-likelihood gain of `channels`, including the penalties of nuisance parameters [nat].
pub fn log_likelihood_gain(
    evidence: &ResidualData,
    now: &ResidualPower,
    before: &ResidualPower,
    channels: Range<usize>,
) -> f64 {
    let of = |channel: usize| {
        [0, 1]
            .map(|fold| now.log_likelihood_gain(before, channel, fold, evidence.correlation_rows(channel)))
            .iter()
            .sum::<f64>()
    };
    channels.map(of).sum::<f64>() + now.tolerated_gain(before)
}

/// Returns the effects that are evaluated on the whole log, with their scopes.
///
/// Encoder offsets are among them because with a fixed base they are visible only through gravity.
fn whole_log_effects() -> Vec<(&'static Effect, Scope)> {
    let scopes = |effect: &Effect| match effect.target {
        Target::Joints => Scope::of_joints(),
        Target::Supply => vec![Scope::All],
        Target::Bodies | Target::Imu => vec![Scope::Base],
        Target::Ground => vec![Scope::Ground],
    };
    let effects = CATALOGUE.into_iter().filter(|effect| !matches!(effect.search.whole_log_probes, Probes::None));
    effects.flat_map(|effect| scopes(effect).into_iter().map(move |scope| (effect, scope))).collect()
}

/// Scans the effects of [`whole_log_effects`].
fn scan_whole(
    evidence: &ResidualData,
    model: &ModelFile,
    robot: &RobotModel,
    simulator: &mut dyn Rollout,
) -> Vec<ScoredHypothesis> {
    let before = evidence.residual_power(simulator, robot);
    let mut scored = Vec::new();
    for (effect, scope) in whole_log_effects() {
        let built = |values: Vec<f64>| {
            let mut file = model.clone();
            file.effects.push(EffectEntry::new(effect, scope, values.clone()).ok()?);
            Some((values, file.robot_model().ok()?))
        };
        let (values, robots): (Vec<_>, Vec<_>) =
            effect.probe_values(effect.search.whole_log_probes).into_iter().filter_map(built).unzip();
        let gains = evidence
            .residual_powers(simulator, &robots, false)
            .into_iter()
            .map(|now| log_likelihood_gain(evidence, &now, &before, evident_channels([effect.target])));
        let best = gains.zip(values).max_by(|one, other| one.0.total_cmp(&other.0));
        scored.extend(best.map(|(score, values)| ScoredHypothesis {
            hypothesis: Hypothesis { effect, scope, values },
            score: score - selection_penalty(scope),
        }));
    }
    scored
}

/// Returns the log-likelihood gain by joint and fold, of its position and torque [nat].
fn joint_gains(evidence: &ResidualData, now: &ResidualPower, before: &ResidualPower) -> Vec<[f64; 2]> {
    let of = |joint: usize, fold: usize| {
        [joint, TORQUE + joint, STANCE + joint]
            .map(|channel| now.log_likelihood_gain(before, channel, fold, evidence.correlation_rows(channel)))
            .iter()
            .sum::<f64>()
    };
    (0..twinstep_model::NUM_JOINTS).map(|joint| [of(joint, 0), of(joint, 1)]).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_model::BaseMount;

    use super::*;
    use crate::test_data::{Coupled, coupled_with_calf_friction};

    /// The same friction at all joints of a leg moves none of them.
    #[test]
    fn friction_of_one_joint_is_found_although_the_joints_of_a_leg_move_each_other() {
        let data = coupled_with_calf_friction(BaseMount::Fixed, 0.3);
        let best = scan(&data, &ModelFile::default(), &mut Coupled).remove(0);
        assert_eq!(best.hypothesis.name(), "coulomb_friction@FL_calf");
        assert!(best.score > 30.0, "{best:?}");
    }
}
