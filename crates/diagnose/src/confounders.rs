//! Hypotheses that the scan may have missed: confounders of its best candidate.

use twinstep_effects::{CATALOGUE, Effect, ModelFile, Scope};
use twinstep_model::{Joint, Leg, Rollout};

use super::hypothesis::{Hypothesis, fine_probes};
use super::residual_data::ResidualData;
use super::scan::best_values;

/// Maximum number of hypotheses about parts of a scope.
const ON_PARTS: usize = 3;

/// Returns the confounders of `best` on the same scope, in either direction of the catalogue's list.
///
/// Each has its best grid value. Skips those in `tried`.
pub fn confounders_of(
    evidence: &ResidualData,
    model: &ModelFile,
    best: &Hypothesis,
    tried: &[String],
    simulator: &mut dyn Rollout,
) -> Vec<Hypothesis> {
    let effects = alike(evidence, best.effect).filter(|effect| effect.name != best.effect.name);
    let on_same_scope = effects.map(|effect| (effect, best.scope));
    best_of_grids(evidence, model, on_same_scope, tried, simulator).into_iter().map(|(_, found)| found).collect()
}

/// Returns the effect of `best` and its confounders on parts of its scope, without those in `tried`.
///
/// They are the [`ON_PARTS`] that gain most, each with its best grid value. On the ground, one simulation of an effect on all joints does not show what it does at some of them.
pub fn on_parts(
    evidence: &ResidualData,
    model: &ModelFile,
    best: &Hypothesis,
    tried: &[String],
    simulator: &mut dyn Rollout,
) -> Vec<Hypothesis> {
    if !evidence.has_free_parts() || evidence.fixed_base_rows().is_some() {
        return Vec::new();
    }
    let parts = parts(best.scope).into_iter();
    let on_parts = parts.flat_map(|scope| alike(evidence, best.effect).map(move |effect| (effect, scope)));
    let mut found = best_of_grids(evidence, model, on_parts, tried, simulator);
    found.sort_by(|(one, _), (other, _)| other.total_cmp(one));
    found.truncate(ON_PARTS);
    found.into_iter().map(|(_, hypothesis)| hypothesis).collect()
}

/// Returns the scopes into which a scope is divided: sides and legs of all joints, legs of a side, joints of a leg or type.
///
/// The scan simulates each joint type by itself.
fn parts(scope: Scope) -> Vec<Scope> {
    let legs = Leg::ALL.into_iter().map(Scope::Leg);
    let joints = Joint::ALL.into_iter().filter(|joint| scope.contains(*joint));
    match scope {
        Scope::All => [Scope::Left, Scope::Right].into_iter().chain(legs).collect(),
        Scope::Left | Scope::Right => legs.filter(|leg| joints.clone().any(|joint| leg.contains(joint))).collect(),
        Scope::Leg(_) | Scope::Kind(_) => joints.map(Scope::Joint).collect(),
        Scope::Joint(_) | Scope::Base | Scope::Ground => Vec::new(),
    }
}

/// Returns an effect and its confounders that act on the same part of the robot.
pub fn alike(evidence: &ResidualData, effect: &'static Effect) -> impl Iterator<Item = &'static Effect> {
    let confused =
        |one: &Effect, other: &Effect| one.confounders.iter().any(|confusion| confusion.effect == other.name);
    CATALOGUE.into_iter().filter(move |other| {
        let alike = other.name == effect.name || confused(other, effect) || confused(effect, other);
        alike && other.target == effect.target && evidence.has_required_torque(other)
    })
}

/// Returns the effects on these scopes, each with its log-likelihood gain [nat] at its best grid value.
fn best_of_grids(
    evidence: &ResidualData,
    model: &ModelFile,
    effects: impl Iterator<Item = (&'static Effect, Scope)>,
    tried: &[String],
    simulator: &mut dyn Rollout,
) -> Vec<(f64, Hypothesis)> {
    let is_new = |effect: &Effect, scope: Scope| !tried.contains(&format!("{}@{scope}", effect.name));
    let best = |(effect, scope): (&'static Effect, Scope)| {
        let (gain, values) = best_values(evidence, model, effect, scope, fine_probes(effect), false, simulator)?;
        Some((gain, Hypothesis { effect, scope, values }))
    };
    effects.filter(|(effect, scope)| is_new(effect, *scope)).filter_map(best).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_model::BaseMount;

    use super::*;
    use crate::test_data::{Coupled, coupled_with_calf_friction};

    #[test]
    fn friction_of_one_joint_of_a_standing_robot_is_tried_where_the_scan_found_friction_of_its_leg() {
        let data = coupled_with_calf_friction(BaseMount::Floating, 0.3);
        let effect = |name| Effect::named(name).expect("in the catalogue");
        let joint = Joint::ALL[0];
        let best = Hypothesis { effect: effect("viscous_friction"), scope: Scope::Leg(joint.leg), values: vec![0.1] };
        let tried = on_parts(&data, &ModelFile::default(), &best, &[], &mut Coupled);
        let first = &tried[0];
        assert_eq!(first.name(), "coulomb_friction@FL_calf", "{tried:?}");
        assert!((first.values[0] - 0.3).abs() < 0.2, "{first:?}");
    }

    #[test]
    fn scope_is_divided_into_the_next_narrower_ones() {
        let of = |scope: &str| {
            let parts = parts(scope.parse().expect("a scope"));
            parts.iter().map(ToString::to_string).collect::<Vec<String>>().join(" ")
        };
        assert_eq!(of("all"), "left right FL FR RL RR");
        assert_eq!(of("right"), "FR RR");
        assert_eq!(of("RL"), "RL_hip RL_thigh RL_calf");
        assert_eq!(of("calf"), "FL_calf FR_calf RL_calf RR_calf");
        assert_eq!(of("RL_hip") + &of("base"), "");
    }
}
