//! Hypotheses that the scan may have missed: confounders of its best candidate.

use twinstep_effects::{CATALOGUE, Effect, ModelFile, Scope};
use twinstep_model::{Joint, Rollout};

use super::hypothesis::{Hypothesis, fine_probes};
use super::residual_data::ResidualData;
use super::scan::best_values;

/// Maximum number of joints of a scope whose single joints are evaluated.
const MOST_JOINTS: usize = 4;
/// Maximum number of hypotheses about its single joints.
const SINGLE_JOINTS: usize = 3;

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

/// Returns the effect of `best` and its confounders on single joints of its scope, without those in `tried`.
///
/// They are the [`SINGLE_JOINTS`] that gain most, each with its best grid value. On the ground, one simulation of an effect on all joints does not show what it does at one of them.
pub fn on_single_joints(
    evidence: &ResidualData,
    model: &ModelFile,
    best: &Hypothesis,
    tried: &[String],
    simulator: &mut dyn Rollout,
) -> Vec<Hypothesis> {
    let decoupled = !evidence.has_free_parts() || evidence.fixed_base_rows().is_some();
    if decoupled || !(2..=MOST_JOINTS).contains(&best.scope.joints()) {
        return Vec::new();
    }
    let joints = Joint::ALL.into_iter().filter(|joint| best.scope.contains(*joint)).map(Scope::Joint);
    let single = joints.flat_map(|scope| alike(evidence, best.effect).map(move |effect| (effect, scope)));
    let mut found = best_of_grids(evidence, model, single, tried, simulator);
    found.sort_by(|(one, _), (other, _)| other.total_cmp(one));
    found.truncate(SINGLE_JOINTS);
    found.into_iter().map(|(_, hypothesis)| hypothesis).collect()
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
        let tried = on_single_joints(&data, &ModelFile::default(), &best, &[], &mut Coupled);
        let first = &tried[0];
        assert_eq!(first.name(), "coulomb_friction@FL_calf", "{tried:?}");
        assert!((first.values[0] - 0.3).abs() < 0.2, "{first:?}");
        let wide = Hypothesis { scope: Scope::All, ..best };
        assert!(on_single_joints(&data, &ModelFile::default(), &wide, &[], &mut Coupled).is_empty());
    }
}
