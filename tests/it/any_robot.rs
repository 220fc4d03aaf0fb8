//! Whatever a search may propose is a robot or refused, and its rollout ends.

use glam::DMat3;
use proptest::prelude::*;
use twinstep_effects::{CATALOGUE, EffectEntry, Scope, Target, apply_effects};
use twinstep_model::{
    BaseMount, Command, InitialState, Joint, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, go2,
};
use twinstep_sim::{BatchRollout, SimConfig};

/// Actuator periods of a rollout.
const PERIODS: usize = 40;

/// An effect with any scope that it can have and any values that it may have.
fn any_entry() -> impl Strategy<Value = EffectEntry> {
    (0..CATALOGUE.len(), any::<prop::sample::Index>(), prop::array::uniform10(0.0..=1.0f64)).prop_map(
        |(effect, scope, shares)| {
            let effect = CATALOGUE[effect];
            let bodies = [Scope::Base].into_iter().chain(Joint::ALL.map(Scope::Joint));
            let scopes = match effect.target {
                Target::Joints => Scope::of_joints(),
                Target::Supply => vec![Scope::All],
                Target::Bodies => bodies.collect(),
                Target::Base => vec![Scope::Base],
                Target::Ground => vec![Scope::Ground],
            };
            let parameters = effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one, one.count));
            let values = parameters.zip(shares).map(|(parameter, share)| {
                let [low, high] = parameter.bounds;
                low + share * (high - low)
            });
            EffectEntry::new(effect, *scope.get(&scopes), values.collect()).unwrap()
        },
    )
}

/// Sylvester's criterion.
fn is_positive_definite(matrix: &DMat3) -> bool {
    let minor = matrix.x_axis.x * matrix.y_axis.y - matrix.x_axis.y * matrix.y_axis.x;
    matrix.x_axis.x > 0.0 && minor > 0.0 && matrix.determinant() > 0.0
}

/// A step of all joints of `robots`, from just above the ground.
fn play(robots: &[RobotModel], base: BaseMount) -> Vec<RobotStates> {
    let pose = go2().control.default_pose_f32();
    let commands = vec![Command::hold(pose.map(|q| q + 0.2), 30.0, 0.75); PERIODS];
    let start = InitialState::at_rest(0.33, pose);
    let jobs: Vec<_> =
        robots.iter().map(|robot| RolloutRequest { robot, base, start, history: &[], commands: &commands }).collect();
    let config = SimConfig { threads: 1, ..SimConfig::default() };
    BatchRollout::new(&go2(), &config).unwrap().run(&jobs, Precision::Double)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_proposal_is_a_robot_or_refused_and_its_rollout_ends(
        proposals in prop::collection::vec(prop::collection::vec(any_entry(), 1..6), 3),
        held: bool,
    ) {
        let base = if held { BaseMount::Fixed } else { BaseMount::Floating };
        let composed = proposals.iter().filter_map(|entries| apply_effects(&go2(), entries).ok());
        let robots: Vec<_> = std::iter::once(go2()).chain(composed).collect();
        for robot in &robots {
            for body in robot.legs.iter().flat_map(|leg| &leg.bodies).chain([&robot.trunk]) {
                prop_assert!(body.mass > 0.0 && is_positive_definite(&body.inertia), "{body:?}");
            }
        }
        let played = play(&robots, base);
        // Whatever the neighbours in the register do, the ideal robot is not disturbed.
        prop_assert_eq!(&played[0], &play(&robots[..1], base)[0]);
        prop_assert!((0..=PERIODS).all(|entry| played[0].first_not_finite(entry).is_none()));
        for states in &played {
            prop_assert_eq!(states.q.len(), PERIODS + 1);
            // Who has diverged does not come back.
            let diverged = (0..=PERIODS).map(|entry| states.first_not_finite(entry).is_some());
            prop_assert!(diverged.is_sorted());
        }
    }
}
