//! The scan: every effect on every joint at once, a few simulations an effect. With the trunk held joints hardly disturb
//! each other, so that one simulation judges all twelve, and any scope is a sum over its joints. Effects on the trunk, the
//! ground and the gyroscope are judged by the whole log.

use twinstep_model::effects::{CATALOGUE, Effect, Entry, Scope, Target};
use twinstep_model::{Joint, ModelFile, RobotModel, Rollout};

use super::evidence::Evidence;
use super::hypothesis::{Hypothesis, choice, sizes, sizes_on_one_scope, whole_sizes, with_effect};
use super::leftover::{CHANNELS, Leftover, TORQUE};

/// Scopes of one effect that go on.
const OF_ONE_EFFECT: usize = 2;

/// A hypothesis with its evidence on held-out blocks [nats].
#[derive(Clone, Debug)]
pub struct Scored {
    /// The hypothesis, with the best of the values that were tried.
    pub hypothesis: Hypothesis,
    /// Evidence, less the price of choosing.
    pub score: f64,
}

/// Effects that one simulation of all joints can judge, the best first.
pub fn scan(evidence: &Evidence, model: &ModelFile, simulator: &mut dyn Rollout) -> Vec<Scored> {
    let Ok(robot) = model.robot_model() else { return Vec::new() };
    let before = evidence.leftovers(simulator, std::slice::from_ref(&robot), true).remove(0);
    let effects = CATALOGUE.into_iter().filter(|effect| matches!(effect.target, Target::Joints | Target::Supply));
    let mut scored: Vec<Scored> =
        effects.flat_map(|effect| scan_effect(evidence, model, effect, &before, simulator)).collect();
    if evidence.has_free_parts() {
        scored.extend(scan_whole(evidence, model, &robot, simulator));
    }
    scored.sort_by(|one, other| other.score.total_cmp(&one.score));
    scored
}

fn scan_effect(
    evidence: &Evidence,
    model: &ModelFile,
    effect: &'static Effect,
    before: &Leftover,
    simulator: &mut dyn Rollout,
) -> Vec<Scored> {
    let built = |values: Vec<f64>| -> Option<(Vec<f64>, RobotModel)> {
        let robot = with_effect(model, effect, &values).ok()?.robot_model().ok()?;
        Some((values, robot))
    };
    let (values, robots): (Vec<_>, Vec<_>) = sizes(effect).into_iter().filter_map(built).unzip();
    let gains: Vec<_> =
        evidence.leftovers(simulator, &robots, true).iter().map(|now| joint_gains(evidence, now, before)).collect();
    let scopes = if effect.target == Target::Supply { vec![Scope::All] } else { Scope::of_joints() };
    let mut scored: Vec<Scored> = scopes
        .into_iter()
        .filter_map(|scope| {
            let of = |size: usize, fold: usize| -> f64 {
                Joint::ALL
                    .iter()
                    .filter(|joint| scope.contains(**joint))
                    .map(|joint| gains[size][joint.index()][fold])
                    .sum()
            };
            let best =
                |of: &dyn Fn(usize) -> f64| (0..values.len()).max_by(|one, other| of(*one).total_cmp(&of(*other)));
            // Chosen on one fold, judged on the other.
            let judged = of(best(&|size| of(size, 0))?, 1) + of(best(&|size| of(size, 1))?, 0);
            let whole = best(&|size| of(size, 0) + of(size, 1))?;
            let hypothesis = Hypothesis { effect, scope, values: values[whole].clone() };
            Some(Scored { hypothesis, score: judged - choice(scope) })
        })
        .collect();
    scored.sort_by(|one, other| other.score.total_cmp(&one.score));
    scored.truncate(OF_ONE_EFFECT);
    scored
}

/// What `best` is taken for, and what is taken for it, on its scope, each with the best of its values; none of `tried`.
pub fn alike(
    evidence: &Evidence,
    model: &ModelFile,
    best: &Hypothesis,
    tried: &[String],
    before: &Leftover,
    simulator: &mut dyn Rollout,
) -> Vec<Hypothesis> {
    let confused = |one: &Effect, other: &Effect| one.confusions.iter().any(|confusion| confusion.with == other.name);
    let is_new = |effect: &Effect| !tried.contains(&format!("{}@{}", effect.name, best.scope));
    let effects = CATALOGUE.into_iter().filter(|effect| {
        let alike = confused(effect, best.effect) || confused(best.effect, effect);
        alike && effect.target == best.effect.target && is_new(effect)
    });
    let first = |effect: &'static Effect| {
        let at = sizes_on_one_scope(effect);
        Some(Hypothesis {
            effect,
            scope: best.scope,
            values: best_of(evidence, model, effect, best.scope, at, before, simulator)?,
        })
    };
    effects.filter_map(first).collect()
}

/// Delays and lags with which a loop rings are in step only where they are nearly right, and no slope leads there from afar:
/// of those the best of many values, and of ever closer ones around it.
pub fn in_step(
    evidence: &Evidence,
    model: &ModelFile,
    hypothesis: Hypothesis,
    before: &Leftover,
    simulator: &mut dyn Rollout,
) -> Hypothesis {
    let Hypothesis { effect, scope, mut values } = hypothesis;
    if !["command_delay", "torque_delay", "drive_lag"].contains(&effect.name) {
        return Hypothesis { effect, scope, values };
    }
    let [least, most] = effect.parameters[0].bounds;
    let mut tried = sizes_on_one_scope(effect);
    tried.push(values.clone());
    for around in [[0.88, 0.94, 1.06, 1.12], [0.97, 0.985, 1.015, 1.03]] {
        let Some(best) = best_of(evidence, model, effect, scope, tried, before, simulator) else { break };
        values = best;
        let near = around.map(|factor| vec![(factor * values[0]).clamp(least, most)]);
        tried = near.into_iter().chain([values.clone()]).collect();
    }
    Hypothesis { effect, scope, values }
}

/// The values that leave least of the whole logs.
fn best_of(
    evidence: &Evidence,
    model: &ModelFile,
    effect: &'static Effect,
    scope: Scope,
    values: Vec<Vec<f64>>,
    before: &Leftover,
    simulator: &mut dyn Rollout,
) -> Option<Vec<f64>> {
    let built = |values: Vec<f64>| {
        let mut file = model.clone();
        file.effects.push(Entry::new(effect, scope, values.clone()).ok()?);
        Some((values, file.robot_model().ok()?))
    };
    let (values, robots): (Vec<_>, Vec<_>) = values.into_iter().filter_map(built).unzip();
    let scores = evidence.leftovers(simulator, &robots, false).into_iter().map(|now| nats(evidence, &now, before));
    scores.zip(values).max_by(|one, other| one.0.total_cmp(&other.0)).map(|(_, values)| values)
}

/// Evidence of everything [nats].
pub fn nats(evidence: &Evidence, now: &Leftover, before: &Leftover) -> f64 {
    let of = |channel: usize| {
        [0, 1].map(|fold| now.gain(before, channel, fold, evidence.rows_in_one(channel))).iter().sum::<f64>()
    };
    (0..CHANNELS).map(of).sum::<f64>() + now.tolerated_gain(before)
}

/// Effects that are not of joints, and offsets of encoders: with the trunk held nothing shows of those but gravity.
fn of_the_whole() -> Vec<(&'static Effect, Scope)> {
    let named = |name: &str| Effect::named(name).expect("an effect of the catalogue");
    let whole = ["payload", "com_shift", "gyro_bias"].map(|name| (named(name), Scope::Base));
    let ground = ["ground_friction", "ground_stiffness"].map(|name| (named(name), Scope::Ground));
    let offsets = Scope::of_joints().into_iter().map(|scope| (named("encoder_offset"), scope));
    whole.into_iter().chain(ground).chain(offsets).collect()
}

/// Judges [`of_the_whole`].
fn scan_whole(evidence: &Evidence, model: &ModelFile, robot: &RobotModel, simulator: &mut dyn Rollout) -> Vec<Scored> {
    let before = evidence.leftover(simulator, robot);
    let mut scored = Vec::new();
    for (effect, scope) in of_the_whole() {
        let built = |values: Vec<f64>| {
            let mut file = model.clone();
            file.effects.push(Entry::new(effect, scope, values.clone()).ok()?);
            Some((values, file.robot_model().ok()?))
        };
        let (values, robots): (Vec<_>, Vec<_>) = whole_sizes(effect).into_iter().filter_map(built).unzip();
        let gains = evidence.leftovers(simulator, &robots, false).into_iter().map(|now| nats(evidence, &now, &before));
        let best = gains.zip(values).max_by(|one, other| one.0.total_cmp(&other.0));
        scored.extend(best.map(|(score, values)| Scored {
            hypothesis: Hypothesis { effect, scope, values },
            score: score - choice(scope),
        }));
    }
    scored
}

/// Evidence by joint and fold, from its position and its torque [nats].
fn joint_gains(evidence: &Evidence, now: &Leftover, before: &Leftover) -> Vec<[f64; 2]> {
    let of = |joint: usize, fold: usize| {
        [joint, TORQUE + joint]
            .map(|channel| now.gain(before, channel, fold, evidence.rows_in_one(channel)))
            .iter()
            .sum::<f64>()
    };
    (0..twinstep_model::NUM_JOINTS).map(|joint| [of(joint, 0), of(joint, 1)]).collect()
}
