//! Causes of one effect on several scopes are replaced by one cause on a wider scope, if that predicts as well.
//!
//! Another effect at some joints hides them from the scan, so that an effect on all joints is found on a part of them first.

use twinstep_effects::{Effect, Scope, Target};
use twinstep_model::Joint;

use super::cross_validation::{Accepted, CandidateFit};
use super::hypothesis::Hypothesis;

/// Largest difference of the sizes of causes that may be one, from their mean, relative to its distance from no effect.
const LARGEST_DIFFERENCE: f64 = 0.25;

/// Returns lists of causes in which one cause on a wider scope takes the place of all with this effect; none if these are
/// not alike.
pub fn with_wider_scopes(causes: &Accepted, effect: &Effect) -> Vec<Accepted> {
    let (alike, others): (Accepted, Accepted) =
        causes.iter().cloned().partition(|(cause, _)| cause.hypothesis.effect == effect);
    if alike.len() < 2 || effect.target != Target::Joints || !agree(&alike) {
        return Vec::new();
    }
    let with = |scope| others.iter().cloned().chain([merged(&alike, scope)]).collect();
    wider_scopes(&alike).into_iter().map(with).collect()
}

/// Returns true if the causes have no joint in common and similar sizes.
fn agree(causes: &Accepted) -> bool {
    let parameter = &causes[0].0.hypothesis.effect.parameters[0];
    let none = if parameter.no_effect_value.is_finite() { parameter.no_effect_value } else { 0.0 };
    let sizes: Vec<f64> = causes.iter().map(|(cause, _)| cause.hypothesis.values[0] - none).collect();
    let mean = sizes.iter().sum::<f64>() / sizes.len() as f64;
    let similar = sizes.iter().all(|size| (size - mean).abs() <= LARGEST_DIFFERENCE * mean.abs());
    similar && Joint::ALL.into_iter().all(|joint| num_causes_at(causes, joint) < 2)
}

fn num_causes_at(causes: &Accepted, joint: Joint) -> usize {
    causes.iter().filter(|(cause, _)| cause.hypothesis.scope.contains(joint)).count()
}

/// Returns the scopes that contain all joints of the causes.
fn wider_scopes(causes: &Accepted) -> Vec<Scope> {
    let contains_all =
        |scope: &Scope| Joint::ALL.into_iter().all(|joint| num_causes_at(causes, joint) == 0 || scope.contains(joint));
    Scope::of_joints().into_iter().filter(contains_all).collect()
}

/// Returns one cause on `scope` in place of several, with the evidence of all.
fn merged(causes: &Accepted, scope: Scope) -> (CandidateFit, Vec<CandidateFit>) {
    let (first, alternatives) = &causes[0];
    let hypothesis = Hypothesis { scope, ..first.hypothesis.clone() };
    let score = causes.iter().map(|(cause, _)| cause.score).sum();
    (CandidateFit { hypothesis, score, ..first.clone() }, alternatives.clone())
}

#[cfg(test)]
mod tests {
    use twinstep_model::{JointKind, Leg};

    use super::*;

    fn causes(effect: &str, scopes: &[(Scope, f64)]) -> Accepted {
        let effect = Effect::named(effect).expect("in the catalogue");
        let cause = |(scope, value): &(Scope, f64)| {
            let hypothesis = Hypothesis { effect, scope: *scope, values: vec![*value] };
            let fit = CandidateFit { hypothesis, score: 50.0, gain: 0.5, explained_fraction: 1.0, threshold: 10.0 };
            (fit, Vec::new())
        };
        scopes.iter().map(cause).collect()
    }

    #[test]
    fn causes_of_similar_size_on_different_joints_may_be_one() {
        let [hip, thigh] = [JointKind::Hip, JointKind::Thigh].map(Scope::Kind);
        assert!(agree(&causes("armature", &[(hip, 0.010), (thigh, 0.012)])));
        assert!(!agree(&causes("armature", &[(hip, 0.010), (thigh, 0.020)])));
        assert!(!agree(&causes("torque_gain", &[(hip, 0.9), (thigh, 1.1)])), "in opposite directions");
        assert!(!agree(&causes("armature", &[(hip, 0.010), (Scope::Leg(Leg::FL), 0.010)])), "FL_hip has both");
    }

    #[test]
    fn wider_scopes_contain_all_joints_of_the_causes() {
        let joint = |index: usize| Scope::Joint(Joint::ALL[index]);
        let of = |scopes: &[Scope]| {
            let scopes: Vec<(Scope, f64)> = scopes.iter().map(|scope| (*scope, 0.01)).collect();
            wider_scopes(&causes("armature", &scopes))
        };
        assert_eq!(of(&[joint(0), joint(1)]), [Scope::All, Scope::Left, Scope::Leg(Leg::FL)]);
        assert_eq!(of(&[joint(0), joint(3)]), [Scope::All, Scope::Kind(JointKind::Hip)]);
        let found = causes("armature", &[(joint(0), 0.01), (joint(3), 0.01)]);
        let wider = with_wider_scopes(&found, found[0].0.hypothesis.effect);
        let names = wider.iter().map(|causes| (causes.len(), causes[0].0.hypothesis.name(), causes[0].0.score));
        let [all, hip] = ["armature@all", "armature@hip"].map(|name| (1, name.to_owned(), 100.0));
        assert_eq!(names.collect::<Vec<_>>(), [all, hip]);
    }
}
