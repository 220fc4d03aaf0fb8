//! The task `getup`: a robot that lies in any orientation gets up and stands in its default pose.
//!
//! It falls from where its lowest point is 1 cm above the ground. Nothing ends an episode before its time. Rewards
//! multiply: height counts as far as the base is upright, the pose as far as it is upright and high (MuJoCo Playground,
//! `Go1Getup`). Targets of the joints reach far beyond those of `walk`: see [`ACTION_SCALE`].

use std::f32::consts::TAU;

use glam::Quat;
use rand::RngExt;
use twinstep_model::{EnvSpec, RobotModel, Stream, frames};

use super::getup_config::GetupConfig;
use crate::ControlledRobot;
use crate::config::ConfigError;
use crate::observation::{base_height, observe_privileged, policy_fields, privileged_fields, spec_of};
use crate::task::{RobotView, Step, Task};

/// Joint offset of an action of 1, unless `[control] action_scale` states another one [rad].
pub const ACTION_SCALE: f64 = 2.0;

/// Names of the reward terms. The second and the third need ground truth.
const TERMS: [&str; 6] = ["upright", "base_height", "posture", "joint_torque", "joint_velocity", "action_rate"];
const NEED_HEIGHT: [usize; 2] = [1, 2];

/// The task `getup` on one robot model.
#[derive(Clone, Debug)]
pub struct Getup {
    config: GetupConfig,
    robot: ControlledRobot,
    spec: EnvSpec,
    /// Indices of the reward terms in the spec. Without ground truth some are missing.
    terms: Vec<usize>,
    /// Height of the base in the default pose [m].
    standing_height: f32,
}

/// State of an episode of `getup`.
#[derive(Clone, Debug)]
pub struct GetupState {
    /// Rotation of the base at the start, relative to a robot that stands.
    start: Quat,
}

impl Default for GetupState {
    fn default() -> Self {
        Self { start: Quat::IDENTITY }
    }
}

impl Getup {
    /// Creates the task for a quadruped. A backend without ground truth has no terms that need the height.
    pub fn new(config: GetupConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let robot = ControlledRobot::from(robot);
        let terms: Vec<usize> =
            (0..TERMS.len()).filter(|term| has_ground_truth || !NEED_HEIGHT.contains(term)).collect();
        let names = terms.iter().map(|term| TERMS[*term].to_owned()).collect();
        let mut observation = policy_fields(robot.joints.len());
        observation.retain(|field| field.name != "velocity_command");
        let mut spec = spec_of("getup", &robot, observation, names, config.max_episode_s);
        if has_ground_truth {
            spec.critic_observation = privileged_fields();
        }
        let standing_height = robot.standing_height.expect("a quadruped stands") as f32;
        Ok(Self { config, robot, spec, terms, standing_height })
    }
}

impl Task for Getup {
    type State = GetupState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, GetupState) {
        let is_upright = random.random::<f32>() < self.config.upright_probability;
        let start = any_rotation([random.random(), random.random(), random.random()]);
        let mut joint = |[low, high]: &[f64; 2]| low + (high - low) * random.random::<f64>();
        let q: Vec<f32> = self.robot.ranges.iter().map(|range| joint(range) as f32).collect();
        if is_upright { (self.robot.default_pose_f32(), GetupState::default()) } else { (q, GetupState { start }) }
    }

    fn start_rotation(&self, state: &GetupState) -> Quat {
        state.start
    }

    fn observe(&self, _state: &GetupState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        let gravity = frames::projected_gravity(robot.orientation);
        let relative = robot.q.iter().zip(&self.robot.default_pose).map(|(q, pose)| (f64::from(*q) - pose) as f32);
        let values = robot.gyro.into_iter().chain(gravity.to_array()).chain(relative);
        let values = values.chain(robot.dq.iter().copied()).chain(action.iter().copied());
        let bounds =
            self.spec.observation.iter().flat_map(|field| std::iter::repeat_n([field.low, field.high], field.size));
        for ((entry, value), [low, high]) in obs.iter_mut().zip(values).zip(bounds) {
            *entry = value.clamp(low, high);
        }
    }

    fn observe_critic(&self, _state: &GetupState, robot: &RobotView, obs: &mut [f32]) {
        if let Some(truth) = &robot.truth {
            observe_privileged(robot, truth, obs);
        }
    }

    fn evaluate(&self, _state: &mut GetupState, step: &Step, _random: &mut Stream, terms: &mut [f32]) -> bool {
        let (config, robot, dt) = (&self.config, &step.robot, self.spec.policy_dt as f32);
        let upright = 0.5 - 0.5 * frames::projected_gravity(robot.orientation).z;
        let height = robot.truth.map_or(0.0, |truth| base_height(robot, &truth) / self.standing_height);
        let high = upright.powi(2) * height.clamp(0.0, 1.0);
        let errors = robot.q.iter().zip(&self.robot.default_pose).map(|(q, pose)| (f64::from(*q) - pose) as f32);
        let torques = robot.tau.iter().zip(&self.robot.torque_limits).map(|(tau, limit)| tau / *limit as f32);
        let changes = step.action.iter().zip(step.previous_action).map(|(action, previous)| action - previous);
        let values = [
            config.upright * upright,
            config.base_height * high,
            config.posture * high * (-mean_square(errors) / config.posture_sigma).exp(),
            config.joint_torque * mean_square(torques),
            config.joint_velocity * mean_square(robot.dq.iter().copied()),
            config.action_rate * mean_square(changes),
        ];
        for (term, index) in terms.iter_mut().zip(&self.terms) {
            *term = values[*index] * dt;
        }
        false
    }
}

/// Returns a rotation from three numbers from 0 to 1; uniform numbers give uniform rotations (Shoemake 1992, "Uniform random
/// rotations").
fn any_rotation([radius, first, second]: [f32; 3]) -> Quat {
    let (inner, outer) = ((1.0 - radius).sqrt(), radius.sqrt());
    let [(sin_first, cos_first), (sin_second, cos_second)] = [first, second].map(|turn| (TAU * turn).sin_cos());
    Quat::from_xyzw(inner * sin_first, inner * cos_first, outer * sin_second, outer * cos_second)
}

fn mean_square(values: impl Iterator<Item = f32>) -> f32 {
    let (count, sum) = values.fold((0, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    sum / count.max(1) as f32
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;
    use twinstep_model::{Ground, InitialState, RobotStates, go2, stream};

    use super::*;

    fn task(has_ground_truth: bool) -> Getup {
        Getup::new(GetupConfig::default(), &go2(), has_ground_truth).expect("valid")
    }

    /// Returns the terms of a robot at rest in the default pose with this rotation and height of the base [m].
    fn terms(rotation: Quat, height: f32) -> Vec<f32> {
        let (task, mut states, action) = (task(true), RobotStates::new(1), [0.0; 12]);
        states.measured.q[0] = go2().control.default_pose_f32();
        states.measured.orientation[0] = frames::to_wxyz(rotation);
        states.truth.base_position[0] = [0.0, 0.0, height];
        let robot = RobotView::of(&states.measured, Some(&states.truth), &Ground::FLAT, 0);
        let step = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
        let mut terms = vec![f32::NAN; task.spec().reward_terms.len()];
        assert!(!task.evaluate(&mut GetupState::default(), &step, &mut stream(0, "test", 0), &mut terms));
        terms
    }

    #[test]
    fn robot_that_stands_has_the_whole_reward_one_on_its_side_a_part_and_one_on_its_back_none() {
        let whole = [1.0, 2.0, 2.0, 0.0, 0.0, 0.0].map(|weight| weight * 0.02);
        let on_its_side = [0.5, 0.5, 0.5, 0.0, 0.0, 0.0].map(|weight| weight * 0.02);
        let close = |found: &[f32], expected: [f32; 6]| {
            assert!(found.iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-4), "{found:?}");
        };
        close(&terms(Quat::IDENTITY, 0.3235), whole);
        close(&terms(Quat::from_rotation_x(0.25 * TAU), 0.3235), on_its_side);
        close(&terms(Quat::from_rotation_y(0.5 * TAU), 0.3235), [0.0; 6]);
        let [_, height, ..] = terms(Quat::IDENTITY, 0.0809)[..] else { panic!("six terms") };
        assert!((height - 0.25 * 2.0 * 0.02).abs() < 1e-5, "{height}");
    }

    #[test]
    fn starts_are_in_all_orientations_and_touch_the_ground_nowhere() {
        let (task, robot, mut random) = (task(true), go2(), stream(3, "test", 0));
        let mut up_axes = Vec::new();
        for _ in 0..500 {
            let (q, state) = task.start(&mut random);
            let q = std::array::from_fn(|joint| q[joint]);
            let start = InitialState::turned_at(&Ground::FLAT, &robot, q, 0.01, [0.0; 3], task.start_rotation(&state));
            let rotation = frames::world_from_base(start.base_orientation);
            let half = robot.shapes.trunk_half_size.as_vec3();
            for corner in [half, -half, half * Vec3::new(1.0, -1.0, 1.0), half * Vec3::new(-1.0, 1.0, 1.0)] {
                assert!(start.base_position[2] + (rotation * corner).z >= 0.01 - 1e-5);
            }
            up_axes.push((rotation * Vec3::Z).z);
        }
        let share = |low: f32| up_axes.iter().filter(|z| **z < low).count() as f32 / 500.0;
        // Uniform rotations have a uniform height of the axis; a tenth stands.
        assert!((share(-0.5) - 0.9 * 0.25).abs() < 0.06 && (share(0.5) - 0.9 * 0.75).abs() < 0.06);
    }

    #[test]
    fn robot_and_its_simulation_agree_and_only_the_simulation_knows_the_height() {
        let (simulated, real) = (task(true), task(false));
        assert_eq!(simulated.spec().hash(), real.spec().hash());
        assert_eq!(real.spec().reward_terms, ["upright", "joint_torque", "joint_velocity", "action_rate"]);
        assert_eq!(
            (simulated.spec().obs_len(), simulated.spec().observation_entry(6)),
            (42, "joint_position[FL_hip]".into())
        );
    }

    proptest! {
        #[test]
        fn rotations_are_unit_quaternions(numbers: [u16; 3]) {
            let rotation = any_rotation(numbers.map(|number| f32::from(number) / f32::from(u16::MAX)));
            prop_assert!((rotation.length() - 1.0).abs() < 1e-5);
        }
    }
}
