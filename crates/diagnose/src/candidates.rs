//! Hypotheses of a scan that are fitted in full simulation.

use twinstep_effects::{Effect, Probes, Search, Target};

use super::hypothesis::ScoredHypothesis;
use super::null_distribution::LOWEST_THRESHOLD;

/// Maximum number of hypotheses about joints that are fitted in full simulation.
const MAX_JOINT_CANDIDATES: usize = 6;
/// Maximum number of hypotheses about bodies, about the gyroscope, about the ground, and about encoders.
const MAX_BODY_CANDIDATES: usize = 2;

/// Returns the hypotheses of a scan to fit in full simulation, and more about joints to fit if none of them is a cause: what
/// imitates the error of a large effect at many joints outranks a small effect at one.
///
/// Joints, bodies, the gyroscope, the ground and encoder offsets are ranked separately, because the scan evaluates them on
/// different rows or channels. Encoder offsets are left out if the robot `walks`: feet that touch down at other times in the
/// model imitate them.
pub fn candidates(scored: Vec<ScoredHypothesis>, walks: bool) -> [Vec<ScoredHypothesis>; 2] {
    let mut lists: [Vec<ScoredHypothesis>; 5] = Default::default();
    for scored in scored.into_iter().filter(|scored| scored.score > 0.0) {
        let list = match scored.hypothesis.effect {
            Effect { target: Target::Bodies, .. } => 1,
            Effect { target: Target::Imu, .. } => 2,
            Effect { target: Target::Ground, .. } => 3,
            Effect { search: Search { whole_log_probes: Probes::None, .. }, .. } => 0,
            _ => 4,
        };
        lists[list].push(scored);
    }
    let of_encoders = if walks { 0 } else { MAX_BODY_CANDIDATES };
    let most = [MAX_JOINT_CANDIDATES, MAX_BODY_CANDIDATES, MAX_BODY_CANDIDATES, MAX_BODY_CANDIDATES, of_encoders];
    let tried = |(scored, most): (&Vec<ScoredHypothesis>, usize)| {
        let least = 0.3 * scored.first().map_or(0.0, |best| best.score);
        scored.iter().filter(|scored| scored.score >= least).take(most).cloned().collect::<Vec<_>>()
    };
    let first: Vec<ScoredHypothesis> = lists.iter().zip(most).flat_map(tried).collect();
    let is_new = |other: &ScoredHypothesis| first.iter().all(|one| one.hypothesis.name() != other.hypothesis.name());
    let others = lists[0].iter().filter(|scored| scored.score >= LOWEST_THRESHOLD && is_new(scored));
    let second = others.take(MAX_JOINT_CANDIDATES).cloned().collect();
    [first, second]
}

#[cfg(test)]
mod tests {
    use twinstep_effects::Scope;
    use twinstep_model::Joint;

    use super::*;
    use crate::hypothesis::Hypothesis;

    fn scored(effect: &str, joint: usize, score: f64) -> ScoredHypothesis {
        let effect = Effect::named(effect).expect("in the catalogue");
        let scope = if effect.target == Target::Joints { Scope::Joint(Joint::ALL[joint]) } else { Scope::Base };
        ScoredHypothesis { hypothesis: Hypothesis { effect, scope, values: Vec::new() }, score }
    }

    fn names(candidates: &[ScoredHypothesis]) -> Vec<String> {
        candidates.iter().map(|scored| scored.hypothesis.name()).collect()
    }

    #[test]
    fn small_effect_at_one_joint_follows_imitators_at_many() {
        let imitators = (0..7).map(|joint| scored("backlash", joint, 1000.0 - joint as f64));
        let [first, second] = candidates(
            imitators.chain([scored("stribeck_friction", 7, 90.0), scored("armature", 8, 5.0)]).collect(),
            false,
        );
        assert_eq!(first.len(), MAX_JOINT_CANDIDATES);
        assert_eq!(names(&second), ["backlash@RL_hip", "stribeck_friction@RL_thigh"], "5 nat are noise");
    }

    #[test]
    fn gyroscope_is_not_compared_with_bodies_and_encoders_not_with_other_joints() {
        let scan =
            || vec![scored("payload", 0, 900.0), scored("encoder_offset", 3, 40.0), scored("gyro_bias", 0, 20.0)];
        let of = |walks: bool| names(&candidates(scan(), walks)[0]);
        assert_eq!(of(false), ["payload@base", "gyro_bias@base", "encoder_offset@FR_hip"]);
        assert_eq!(of(true), ["payload@base", "gyro_bias@base"]);
    }
}
