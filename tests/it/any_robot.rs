//! Every proposal of a search is either a valid robot model or rejected, and its rollout terminates.

use glam::DMat3;
use proptest::prelude::*;
use twinstep_effects::{CATALOGUE, EffectEntry, Scope, Target, apply_effects};
use twinstep_model::{
    BaseMount, Command, InitialState, Joint, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, go2,
};
use twinstep_sim::{BatchRollout, SimConfig};

/// Length of a rollout [actuator periods].
const PERIODS: usize = 40;

/// Returns a strategy for any effect with any of its scopes and any allowed values.
fn any_entry() -> impl Strategy<Value = EffectEntry> {
    (0..CATALOGUE.len(), any::<prop::sample::Index>(), prop::array::uniform10(0.0..=1.0f64)).prop_map(
        |(effect, scope, fractions)| {
            let effect = CATALOGUE[effect];
            let bodies = [Scope::Base].into_iter().chain(Joint::ALL.map(Scope::Joint));
            let scopes = match effect.target {
                Target::Joints => Scope::of_joints(),
                Target::Supply => vec![Scope::All],
                Target::Bodies => bodies.collect(),
                Target::Imu => vec![Scope::Base],
                Target::Ground => vec![Scope::Ground],
            };
            let parameters = effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one, one.count));
            let values = parameters.zip(fractions).map(|(parameter, fraction)| {
                let [low, high] = parameter.bounds;
                low + fraction * (high - low)
            });
            EffectEntry::new(effect, *scope.get(&scopes), values.collect()).unwrap()
        },
    )
}

/// Returns true if `matrix` is positive definite, by Sylvester's criterion.
fn is_positive_definite(matrix: &DMat3) -> bool {
    let minor = matrix.x_axis.x * matrix.y_axis.y - matrix.x_axis.y * matrix.y_axis.x;
    matrix.x_axis.x > 0.0 && minor > 0.0 && matrix.determinant() > 0.0
}

/// Simulates a step of all joints of `robots`, which start just above the ground.
fn simulate(robots: &[RobotModel], base: BaseMount) -> Vec<RobotStates> {
    let pose = go2().control.default_pose_f32();
    let commands = vec![Command::hold(pose.map(|q| q + 0.2), 30.0, 0.75); PERIODS];
    let start = InitialState::at_rest(0.33, pose);
    let jobs: Vec<_> = robots
        .iter()
        .map(|robot| RolloutRequest { robot, base, start, history: &[], commands: &commands, derating: &[] })
        .collect();
    let config = SimConfig { threads: 1, ..SimConfig::default() };
    BatchRollout::new(&go2(), &config).unwrap().run(&jobs, Precision::Double)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_proposal_is_a_valid_robot_or_rejected_and_its_rollout_terminates(
        proposals in prop::collection::vec(prop::collection::vec(any_entry(), 1..6), 3),
        is_fixed: bool,
    ) {
        let base = if is_fixed { BaseMount::Fixed } else { BaseMount::Floating };
        let composed = proposals.iter().filter_map(|entries| apply_effects(&go2(), entries).ok());
        let robots: Vec<_> = std::iter::once(go2()).chain(composed).collect();
        for robot in &robots {
            for body in robot.legs.iter().flat_map(|leg| &leg.bodies).chain([&robot.trunk]) {
                prop_assert!(body.mass > 0.0 && is_positive_definite(&body.inertia), "{body:?}");
            }
        }
        let rollouts = simulate(&robots, base);
        // Robots in the same SIMD register do not affect the ideal robot.
        prop_assert_eq!(&rollouts[0], &simulate(&robots[..1], base)[0]);
        prop_assert!((0..=PERIODS).all(|entry| rollouts[0].first_not_finite(entry).is_none()));
        for states in &rollouts {
            prop_assert_eq!(states.measured.q.len(), PERIODS + 1);
            // A diverged robot remains diverged.
            let diverged = (0..=PERIODS).map(|entry| states.first_not_finite(entry).is_some());
            prop_assert!(diverged.is_sorted());
        }
    }
}
