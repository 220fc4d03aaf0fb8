//! The task `walk`: the robot follows a velocity command.

use glam::Vec3;
use rand::RngExt;
use twinstep_model::{EnvSpec, RobotModel, Stream, frames};

use crate::ControlledRobot;
use crate::config::ConfigError;
use crate::feet::{FootContacts, FootState, foot_states};
use crate::observation::{
    base_height, framed, ground_heights_field, linear_velocity_in_base, observe, observe_ground, observe_privileged,
    policy_fields, privileged_fields_of, privileged_len, spec_of,
};
use crate::reward::{NEED_GROUND_TRUTH, RewardInput};
use crate::task::{RobotView, Step, Task};
use crate::tasks::walk_config::{RewardWeights, WalkConfig};

/// Fraction of a joint's range within its soft limits.
const SOFT_JOINT_LIMIT_FACTOR: f32 = 0.9;

/// Yaw rate per error of the heading [1/s] (legged_gym: `heading_command`).
const HEADING_GAIN: f32 = 0.5;

/// The task `walk` on one robot model.
#[derive(Clone, Debug)]
pub struct Walk {
    config: WalkConfig,
    robot: ControlledRobot,
    spec: EnvSpec,
    /// Indices of the reward terms in the spec. Without ground truth some are missing.
    terms: Vec<usize>,
    default_pose: Vec<f32>,
    /// Lower and upper limits of the joints.
    soft_limits: [Vec<f32>; 2],
    torque_scale: f32,
    target_base_height: f32,
    min_base_height: f32,
    resample_steps: u32,
    /// Cosine of the tilt below which the episode terminates.
    cos_max_tilt: f32,
}

/// State of an episode of `walk`.
#[derive(Clone, Debug, Default)]
pub struct WalkState {
    /// Velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
    command: [f32; 3],
    /// Direction in the world to which the yaw rate turns the robot [rad].
    heading: Option<f32>,
    /// Policy steps until the next command; `None` if the agent sets it.
    steps_to_command: Option<u32>,
    contacts: FootContacts,
}

impl Walk {
    /// Creates the task for a quadruped.
    pub fn new(config: WalkConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        Self::of(config, ControlledRobot::from(robot), has_ground_truth)
    }

    /// Creates the task for a robot with feet. A backend without ground truth has neither a critic group nor the reward terms of
    /// [`NEED_GROUND_TRUTH`], and its episodes do not end by the height of the base.
    pub fn of(config: WalkConfig, robot: ControlledRobot, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let known = |name: &str| has_ground_truth || !NEED_GROUND_TRUTH.contains(&name);
        let terms: Vec<usize> =
            (0..RewardWeights::NAMES.len()).filter(|term| known(RewardWeights::NAMES[*term])).collect();
        let names = terms.iter().map(|term| RewardWeights::NAMES[*term].to_owned()).collect();
        let observation = framed(&policy_fields(robot.joints.len()), config.frames);
        let mut spec = spec_of("walk", &robot, observation, names, config.max_episode_s);
        if has_ground_truth {
            let feet: Vec<_> = robot.feet.feet().iter().map(|foot| foot.name.as_str()).collect();
            spec.critic_observation = privileged_fields_of(&feet);
            spec.critic_observation.extend(config.critic_heights.then(ground_heights_field));
        }
        let [target_base_height, min_base_height] = config.heights(&robot)?;
        Ok(Self {
            terms,
            default_pose: robot.default_pose_f32(),
            soft_limits: soft_limits(&robot),
            torque_scale: robot.torque_scale() as f32,
            target_base_height,
            min_base_height,
            resample_steps: (config.command_resample_s / spec.policy_dt as f32).round().max(1.0) as u32,
            cos_max_tilt: config.max_tilt_rad.cos(),
            robot,
            spec,
            config,
        })
    }

    /// Returns the robot.
    pub fn robot(&self) -> &ControlledRobot {
        &self.robot
    }

    /// Returns the height of the base without a penalty [m].
    pub fn target_base_height(&self) -> f32 {
        self.target_base_height
    }

    fn draw_command(&self, random: &mut Stream) -> [f32; 3] {
        let ranges = &self.config.command;
        let is_standing = random.random::<f32>() < self.config.standing_probability;
        let factor = if is_standing { 0.0 } else { 1.0 };
        [ranges.linear_velocity_x, ranges.linear_velocity_y, ranges.angular_velocity_z]
            .map(|[low, high]| factor * (low + (high - low) * random.random::<f32>()))
    }

    /// Samples a heading for a new command; `None` if its yaw rate is to stay as it is.
    fn draw_heading(&self, command: [f32; 3], random: &mut Stream) -> Option<f32> {
        let probability = self.config.heading_probability;
        // Without headings no random numbers are drawn, and a robot that is to stand does not turn.
        if probability == 0.0 || command == [0.0; 3] {
            return None;
        }
        let (drawn, heading) = (random.random::<f32>(), std::f32::consts::PI * random.random_range(-1.0f32..1.0));
        (drawn < probability).then_some(heading)
    }

    /// Turns the robot to its heading by the yaw rate of its command.
    fn follow_heading(&self, state: &mut WalkState, robot: &RobotView) {
        let Some(heading) = state.heading else { return };
        let forward = frames::world_from_base(robot.orientation) * Vec3::X;
        let error = heading - forward.y.atan2(forward.x);
        let [low, high] = self.config.command.angular_velocity_z;
        state.command[2] = (HEADING_GAIN * error.sin().atan2(error.cos())).clamp(low, high);
    }

    fn reward_input<'a>(
        &'a self,
        state: &'a WalkState,
        step: &'a Step,
        feet: &'a [FootState],
        is_terminated: bool,
    ) -> RewardInput<'a> {
        let robot = &step.robot;
        // Terms that need the ground truth are not in `terms` where there is none.
        let truth = robot.truth.as_ref();
        let velocity = truth.map(|truth| linear_velocity_in_base(robot, truth).to_array());
        RewardInput {
            policy_dt: self.spec.policy_dt as f32,
            tracking_sigma: self.config.tracking_sigma,
            command: state.command,
            linear_velocity: velocity.unwrap_or_default(),
            angular_velocity: robot.gyro,
            gravity: frames::projected_gravity(robot.orientation).to_array(),
            q: robot.q,
            dq: robot.dq,
            previous_dq: step.previous_dq,
            tau: robot.tau,
            torque_scale: self.torque_scale,
            action: step.action,
            previous_action: step.previous_action,
            default_pose: &self.default_pose,
            soft_lower: &self.soft_limits[0],
            soft_upper: &self.soft_limits[1],
            hips: &self.robot.hips,
            touchdown_air_time: state.contacts.touchdown_air_time(),
            target_air_time: self.config.target_air_time_s,
            foot_contact: state.contacts.on_ground(),
            feet,
            target_foot_height: self.config.target_foot_height_m,
            base_height: truth.map_or(0.0, |truth| base_height(robot, truth)),
            target_base_height: self.target_base_height,
            is_terminated,
            body_contact: truth.is_some_and(|truth| truth.body_contact),
            uncertainty: truth.map_or(0.0, |truth| truth.epistemic_uncertainty),
        }
    }
}

/// Returns lower and upper limits of the central part of each joint's range.
fn soft_limits(robot: &ControlledRobot) -> [Vec<f32>; 2] {
    let limits = robot.ranges.iter().map(|[low, high]| [*low as f32, *high as f32]);
    let soft = limits.map(|[low, high]| {
        let margin = (1.0 - SOFT_JOINT_LIMIT_FACTOR) / 2.0 * (high - low);
        // A joint without limits has none within them.
        let margin = if margin.is_finite() { margin } else { 0.0 };
        (low + margin, high - margin)
    });
    let (lower, upper) = soft.unzip();
    [lower, upper]
}

impl Task for Walk {
    type State = WalkState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, WalkState) {
        let noise = self.config.reset_joint_noise_rad;
        let pose = self.default_pose.iter();
        let q = pose.map(|position| position + (2.0 * noise * random.random::<f32>() - noise)).collect();
        let command = self.draw_command(random);
        // The first command is shorter, so that robots that start together do not change their commands together.
        let steps_to_command = Some(random.random_range(1..=self.resample_steps));
        let heading = self.draw_heading(command, random);
        (q, WalkState { command, heading, steps_to_command, contacts: FootContacts::default() })
    }

    fn place(&self, state: &mut WalkState, robot: &RobotView) {
        self.follow_heading(state, robot);
    }

    fn frames(&self) -> usize {
        self.config.frames
    }

    fn observe(&self, state: &WalkState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        observe(robot, state.command, &self.default_pose, action, obs);
    }

    fn observe_critic(&self, _state: &WalkState, robot: &RobotView, obs: &mut [f32]) {
        if let Some(truth) = &robot.truth {
            let (own, heights) = obs.split_at_mut(privileged_len(self.robot.feet.len()));
            observe_privileged(robot, truth, own);
            if self.config.critic_heights {
                observe_ground(robot, truth, heights);
            }
        }
    }

    fn evaluate(&self, state: &mut WalkState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        let robot = &step.robot;
        let gravity = frames::projected_gravity(robot.orientation);
        let is_too_low = robot.truth.is_some_and(|truth| base_height(robot, &truth) < self.min_base_height);
        let is_terminated = is_too_low || -gravity.z < self.cos_max_tilt;
        let feet = robot.truth.map_or_else(Vec::new, |truth| {
            state.contacts.update(truth.foot_force, self.spec.policy_dt as f32);
            foot_states(&self.robot.feet, robot, &truth)
        });
        let values = self.config.reward.evaluate(&self.reward_input(state, step, &feet, is_terminated));
        for (term, index) in terms.iter_mut().zip(&self.terms) {
            *term = values[*index];
        }
        state.steps_to_command = state.steps_to_command.map(|steps| steps.saturating_sub(1));
        if state.steps_to_command == Some(0) {
            (state.command, state.steps_to_command) = (self.draw_command(random), Some(self.resample_steps));
            state.heading = self.draw_heading(state.command, random);
        }
        self.follow_heading(state, robot);
        is_terminated
    }

    fn velocity_command(&self, state: &WalkState) -> Option<[f32; 3]> {
        Some(state.command)
    }

    fn set_velocity_command(&self, state: &mut WalkState, command: [f32; 3]) {
        (state.command, state.heading, state.steps_to_command) = (command, None, None);
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, RobotStates, go2, stream};

    use super::*;

    fn task(has_ground_truth: bool) -> Walk {
        Walk::new(WalkConfig::default(), &go2(), has_ground_truth).expect("valid")
    }

    #[test]
    fn hash_depends_on_the_gains_but_not_on_the_episode_length_or_the_critic() {
        let config = WalkConfig::default();
        let mut other_gain = go2();
        other_gain.control.kp[3] += 1.0;
        let hash = task(true).spec().hash();
        assert_ne!(Walk::new(config.clone(), &other_gain, true).expect("valid").spec().hash(), hash);
        let longer = WalkConfig { max_episode_s: 30.0, ..config };
        assert_eq!(Walk::new(longer, &go2(), true).expect("valid").spec().hash(), hash);
        assert_eq!(task(false).spec().hash(), hash, "a robot and its simulation agree");
    }

    #[test]
    fn terms_and_ends_that_need_the_ground_truth_are_absent_without_it() {
        let (simulated, real) = (task(true), task(false));
        let names = &real.spec().reward_terms;
        assert_eq!(names.len() + NEED_GROUND_TRUTH.len(), simulated.spec().reward_terms.len());
        assert!(NEED_GROUND_TRUTH.iter().all(|name| !names.iter().any(|other| other == name)));
        assert!(real.spec().critic_observation.is_empty() && !simulated.spec().critic_observation.is_empty());

        let states = RobotStates::new(1);
        let (ground, action, mut random) = (Ground::FLAT, [0.0; 12], stream(0, "test", 0));
        let ends = |task: &Walk, truth: bool, random: &mut Stream| {
            let truth = truth.then_some(&states.truth);
            let robot = RobotView::of(&states.measured, truth, &ground, 0);
            let step = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
            let mut terms = vec![f32::NAN; task.spec().reward_terms.len()];
            let ended = task.evaluate(&mut task.start(random).1, &step, random, &mut terms);
            assert!(terms.iter().all(|term| term.is_finite()), "{terms:?}");
            ended
        };
        assert!(ends(&simulated, true, &mut random), "the base is on the ground");
        assert!(!ends(&real, false, &mut random), "the height of the base is not measured");
    }

    /// Returns a robot that is turned by `yaw` [rad].
    fn view<'a>(states: &'a RobotStates, ground: &'a Ground, yaw: f32) -> RobotView<'a> {
        let robot = RobotView::of(&states.measured, Some(&states.truth), ground, 0);
        RobotView { orientation: [(0.5 * yaw).cos(), 0.0, 0.0, (0.5 * yaw).sin()], ..robot }
    }

    #[test]
    fn frames_of_the_observation_are_those_of_the_last_steps() {
        let config = WalkConfig { frames: 3, ..WalkConfig::default() };
        let task = Walk::new(config, &go2(), true).expect("valid");
        let names: Vec<&str> = task.spec().observation.iter().map(|field| field.name.as_str()).collect();
        assert_eq!(
            [names[0], names[6], names[12]],
            ["base_angular_velocity", "base_angular_velocity_1", "base_angular_velocity_2"]
        );
        let (states, ground) = (RobotStates::new(1), Ground::FLAT);
        let (mut obs, state) = (vec![0.0; task.spec().obs_len()], WalkState::default());
        for step in 1..=4 {
            let action = [step as f32; 12];
            crate::observe_next(&task, &state, &view(&states, &ground, 0.0), &action, &mut obs);
            if step == 1 {
                crate::repeat_first_frame(&task, &mut obs);
                assert_eq!([obs[33], obs[45 + 33], obs[90 + 33]], [1.0; 3], "an episode has no earlier frames");
            }
        }
        assert_eq!([obs[33], obs[45 + 33], obs[90 + 33]], [4.0, 3.0, 2.0]);
    }

    #[test]
    fn robot_with_a_heading_turns_to_it_and_an_agent_turns_it_as_it_likes() {
        let config = WalkConfig { heading_probability: 1.0, ..WalkConfig::default() };
        let (task, states, ground) =
            (Walk::new(config, &go2(), true).expect("valid"), RobotStates::new(1), Ground::FLAT);
        let mut state = WalkState { heading: Some(1.0), ..WalkState::default() };
        let yaw_rate = |state: &mut WalkState, yaw: f32| {
            task.follow_heading(state, &view(&states, &ground, yaw));
            state.command[2]
        };
        assert!((yaw_rate(&mut state, 0.0) - 0.5).abs() < 1e-5);
        assert!((yaw_rate(&mut state, 1.2) + 0.1).abs() < 1e-5);
        state.heading = Some(3.0);
        assert!(yaw_rate(&mut state, -3.0) < 0.0, "the shorter way");
        task.set_velocity_command(&mut state, [0.1, 0.0, 0.7]);
        assert_eq!(yaw_rate(&mut state, 0.0), 0.7);
    }

    #[test]
    fn critic_sees_the_depth_of_the_ground_around_the_robot() {
        let config = WalkConfig { critic_heights: true, ..WalkConfig::default() };
        let task = Walk::new(config, &go2(), true).expect("valid");
        let slope = 0.2f32;
        let ground = Ground { normal: [-slope.sin(), 0.0, slope.cos()], ..Ground::FLAT };
        let mut states = RobotStates::new(1);
        states.truth.base_position[0] = [0.0, 0.0, 0.3];
        let mut obs = vec![0.0; task.spec().critic_obs_len()];
        for (yaw, ahead) in [(0.0, slope.tan()), (std::f32::consts::FRAC_PI_2, 0.0)] {
            task.observe_critic(&WalkState::default(), &view(&states, &ground, yaw), &mut obs);
            let depths = &obs[11..];
            assert_eq!(depths.len(), 35);
            assert!((depths[17] - 0.3).abs() < 1e-5, "under the base");
            assert!((depths[32] - (0.3 - 0.6 * ahead)).abs() < 1e-5, "0.6 m ahead: {}", depths[32]);
            let left = 0.3 + if yaw == 0.0 { 0.0 } else { 0.4 * slope.tan() };
            assert!((depths[19] - left).abs() < 1e-5, "0.4 m to the left: {}", depths[19]);
        }
    }
}
