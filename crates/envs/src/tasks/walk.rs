//! The task `walk`: the robot follows a velocity command.

use rand::RngExt;
use serde::{Deserialize, Serialize};
use twinstep_model::{EnvSpec, GroundTruth, PerJoint, PerLeg, RobotModel, Stream, frames};

use crate::config::{ConfigError, Range, check_range, check_value};
use crate::observation::{
    base_height, base_spec, linear_velocity_in_base, observe, observe_privileged, privileged_fields,
};
use crate::reward::{NEED_GROUND_TRUTH, RewardInput, reward_weights};
use crate::task::{RobotView, Step, Task};

/// Contact force above which a foot is on the ground [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;
/// Fraction of a joint's range within its soft limits.
const SOFT_JOINT_LIMIT_FACTOR: f32 = 0.9;

/// The `[task]` table of `walk`: velocity commands, rewards, termination.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WalkConfig {
    /// Time after which an episode is truncated [s].
    pub max_episode_s: f32,
    /// Time after which a new velocity command is sampled [s].
    pub command_resample_s: f32,
    /// Ranges of the velocity commands.
    pub command: CommandRanges,
    /// Weight of each reward term; 0 disables the term.
    pub reward: RewardWeights,
    /// Width σ of the tracking rewards `exp(−error² / σ)` [m²/s², rad²/s²].
    pub tracking_sigma: f32,
    /// Tilt of the base above which the episode terminates [rad].
    pub max_tilt_rad: f32,
    /// Height of the base above the ground under it, below which the episode terminates [m].
    pub min_base_height_m: f32,
    /// Maximum initial offset of each joint from the default pose [rad].
    pub reset_joint_noise_rad: f32,
}

impl Default for WalkConfig {
    fn default() -> Self {
        Self {
            max_episode_s: 20.0,
            command_resample_s: 10.0,
            command: CommandRanges::default(),
            reward: RewardWeights::default(),
            tracking_sigma: 0.25,
            max_tilt_rad: 1.0,
            min_base_height_m: 0.15,
            reset_joint_noise_rad: 0.1,
        }
    }
}

impl WalkConfig {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let command = &self.command;
        check_range("task.command.linear_velocity_x", command.linear_velocity_x, -5.0, 5.0)?;
        check_range("task.command.linear_velocity_y", command.linear_velocity_y, -5.0, 5.0)?;
        check_range("task.command.angular_velocity_z", command.angular_velocity_z, -5.0, 5.0)?;
        check_value("task.max_episode_s", self.max_episode_s, 0.02, 1e6)?;
        check_value("task.command_resample_s", self.command_resample_s, 0.02, 1e6)?;
        check_value("task.tracking_sigma", self.tracking_sigma, 1e-6, 1e6)?;
        check_value("task.max_tilt_rad", self.max_tilt_rad, 0.0, 3.2)?;
        check_value("task.min_base_height_m", self.min_base_height_m, -1e6, 1.0)?;
        check_value("task.reset_joint_noise_rad", self.reset_joint_noise_rad, 0.0, 1.0)?;
        self.reward
            .values()
            .try_for_each(|(name, weight)| check_value(&format!("task.reward.{name}"), weight, -1e6, 1e6))
    }
}

/// Ranges of the velocity command in the base frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CommandRanges {
    /// Forward velocity [m/s].
    pub linear_velocity_x: Range,
    /// Velocity to the left [m/s].
    pub linear_velocity_y: Range,
    /// Yaw rate, positive to the left [rad/s].
    pub angular_velocity_z: Range,
}

impl Default for CommandRanges {
    fn default() -> Self {
        Self { linear_velocity_x: [-1.0, 1.0], linear_velocity_y: [-0.5, 0.5], angular_velocity_z: [-1.0, 1.0] }
    }
}

// Terms and weights follow legged_gym's locomotion settings for the Go2, which U2E uses.
reward_weights! {
    /// Tracking of the commanded horizontal velocity (Isaac Lab: `track_lin_vel_xy_exp`).
    track_linear_velocity = 1.0,
    /// Tracking of the commanded yaw rate (`track_ang_vel_z_exp`).
    track_angular_velocity = 0.5,
    /// Vertical velocity of the base, squared (`lin_vel_z_l2`).
    linear_velocity_z = -2.0,
    /// Roll and pitch rates of the base, squared (`ang_vel_xy_l2`).
    angular_velocity_xy = -0.05,
    /// Tilt of the trunk (`flat_orientation_l2`).
    flat_orientation = -1.0,
    /// Joint torques, squared (`joint_torques_l2`).
    joint_torque = -0.0002,
    /// Joint accelerations, squared (`joint_acc_l2`).
    joint_acceleration = -2.5e-7,
    /// Change of the action, squared (`action_rate_l2`).
    action_rate = -0.01,
    /// Joint positions outside the soft limits (`joint_pos_limits`).
    joint_position_limits = -10.0,
    /// Long swing phases of the feet (`feet_air_time`).
    feet_air_time = 1.0,
    /// Contact of the trunk or a thigh with the ground (`undesired_contacts`).
    undesired_contact = -1.0,
    /// Offset from the default pose while the velocity command is zero.
    stand_still = -0.1,
    /// Epistemic uncertainty of the actuator networks. Only for model files with an actuator network.
    epistemic_uncertainty = 0.0,
}

/// The task `walk` on one robot model.
#[derive(Clone, Debug)]
pub struct Walk {
    config: WalkConfig,
    spec: EnvSpec,
    /// Indices of the reward terms in the spec. Without ground truth some are missing.
    terms: Vec<usize>,
    default_pose: PerJoint,
    soft_lower: PerJoint,
    soft_upper: PerJoint,
    resample_steps: u32,
    /// Cosine of the tilt below which the episode terminates.
    cos_max_tilt: f32,
}

/// State of an episode of `walk`.
#[derive(Clone, Debug, Default)]
pub struct WalkState {
    /// Velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
    command: [f32; 3],
    air_time: PerLeg,
}

impl Walk {
    /// Creates the task for `robot`. A backend without ground truth has neither a critic group nor the reward terms of
    /// [`NEED_GROUND_TRUTH`], and its episodes do not end by the height of the base.
    pub fn new(config: WalkConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let known = |name: &str| has_ground_truth || !NEED_GROUND_TRUTH.contains(&name);
        let terms: Vec<usize> =
            (0..RewardWeights::NAMES.len()).filter(|term| known(RewardWeights::NAMES[*term])).collect();
        let names = terms.iter().map(|term| RewardWeights::NAMES[*term].to_owned()).collect();
        let mut spec = base_spec("walk", robot, names, config.max_episode_s);
        if has_ground_truth {
            spec.critic_observation = privileged_fields();
        }
        let (lower, upper) = (robot.lower_limits(), robot.upper_limits());
        let margin = |j: usize| (1.0 - SOFT_JOINT_LIMIT_FACTOR) / 2.0 * (upper[j] - lower[j]);
        Ok(Self {
            terms,
            default_pose: robot.control.default_pose_f32(),
            soft_lower: std::array::from_fn(|j| lower[j] + margin(j)),
            soft_upper: std::array::from_fn(|j| upper[j] - margin(j)),
            resample_steps: (config.command_resample_s / spec.policy_dt as f32).round().max(1.0) as u32,
            cos_max_tilt: config.max_tilt_rad.cos(),
            spec,
            config,
        })
    }

    fn draw_command(&self, random: &mut Stream) -> [f32; 3] {
        let ranges = &self.config.command;
        [ranges.linear_velocity_x, ranges.linear_velocity_y, ranges.angular_velocity_z]
            .map(|[low, high]| low + (high - low) * random.random::<f32>())
    }

    fn reward_input<'a>(&'a self, state: &mut WalkState, step: &'a Step) -> RewardInput<'a> {
        let robot = &step.robot;
        let (measured, index) = (robot.measured, robot.index);
        let policy_dt = self.spec.policy_dt as f32;
        // Terms that need the ground truth are not in `terms` where there is none.
        let of_truth =
            |value: fn(&RobotView, &GroundTruth) -> f32| robot.truth.map_or(0.0, |truth| value(robot, truth));
        let velocity = robot.truth.map(|truth| linear_velocity_in_base(robot, truth).to_array());
        let foot_force = robot.truth.map(|truth| truth.foot_force[index]);
        RewardInput {
            policy_dt,
            tracking_sigma: self.config.tracking_sigma,
            command: state.command,
            linear_velocity: velocity.unwrap_or_default(),
            angular_velocity: measured.gyro[index],
            gravity: frames::projected_gravity(measured.orientation[index]).to_array(),
            q: &measured.q[index],
            dq: &measured.dq[index],
            previous_dq: step.previous_dq,
            tau: &measured.tau[index],
            action: step.action,
            previous_action: step.previous_action,
            default_pose: &self.default_pose,
            soft_lower: &self.soft_lower,
            soft_upper: &self.soft_upper,
            touchdown_air_time: foot_force.map_or([0.0; 4], |force| state.update_air_time(&force, policy_dt)),
            body_contact: robot.truth.is_some_and(|truth| truth.body_contact[index]),
            uncertainty: of_truth(|robot, truth| truth.epistemic_uncertainty[robot.index]),
        }
    }
}

impl Task for Walk {
    type State = WalkState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (PerJoint, WalkState) {
        let noise = self.config.reset_joint_noise_rad;
        let q = self.default_pose.map(|position| position + (2.0 * noise * random.random::<f32>() - noise));
        (q, WalkState { command: self.draw_command(random), air_time: [0.0; 4] })
    }

    fn observe(&self, state: &WalkState, robot: &RobotView, action: &PerJoint, obs: &mut [f32]) {
        observe(robot, state.command, &self.default_pose, action, obs);
    }

    fn observe_critic(&self, _state: &WalkState, robot: &RobotView, obs: &mut [f32]) {
        if let Some(truth) = robot.truth {
            observe_privileged(robot, truth, obs);
        }
    }

    fn evaluate(&self, state: &mut WalkState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        let input = self.reward_input(state, step);
        let (values, gravity) = (self.config.reward.evaluate(&input), input.gravity);
        for (term, index) in terms.iter_mut().zip(&self.terms) {
            *term = values[*index];
        }
        let is_too_low =
            step.robot.truth.is_some_and(|truth| base_height(&step.robot, truth) < self.config.min_base_height_m);
        if step.length.is_multiple_of(self.resample_steps) {
            state.command = self.draw_command(random);
        }
        is_too_low || -gravity[2] < self.cos_max_tilt
    }

    fn velocity_command(&self, state: &WalkState) -> Option<[f32; 3]> {
        Some(state.command)
    }
}

impl WalkState {
    /// Updates the air time of each foot, and returns that of the feet that touched down, 0 for the others [s].
    fn update_air_time(&mut self, foot_force: &PerLeg, policy_dt: f32) -> PerLeg {
        let air_time = &mut self.air_time;
        std::array::from_fn(|leg| {
            let in_air = foot_force[leg] < CONTACT_FORCE_THRESHOLD;
            let touchdown_time = if in_air { 0.0 } else { air_time[leg] };
            air_time[leg] = if in_air { air_time[leg] + policy_dt } else { 0.0 };
            touchdown_time
        })
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
        other_gain.control.kp += 1.0;
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
            let robot = RobotView { measured: &states.measured, truth, ground: &ground, index: 0 };
            let step = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
            let mut terms = vec![f32::NAN; task.spec().reward_terms.len()];
            let ended = task.evaluate(&mut task.start(random).1, &step, random, &mut terms);
            assert!(terms.iter().all(|term| term.is_finite()), "{terms:?}");
            ended
        };
        assert!(ends(&simulated, true, &mut random), "the base is on the ground");
        assert!(!ends(&real, false, &mut random), "the height of the base is not measured");
    }
}
