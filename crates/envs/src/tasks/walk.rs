//! The task `walk`: the robot follows a velocity command.

use rand::RngExt;
use twinstep_model::{EnvSpec, RobotModel, Stream, frames};

use crate::ControlledRobot;
use crate::config::ConfigError;
use crate::feet::{FootContacts, FootState, foot_states};
use crate::observation::{
    base_height, linear_velocity_in_base, observe, observe_privileged, policy_fields, privileged_fields_of, spec_of,
};
use crate::reward::{NEED_GROUND_TRUTH, RewardInput};
use crate::task::{RobotView, Step, Task};
use crate::tasks::walk_config::{RewardWeights, WalkConfig};

/// Fraction of a joint's range within its soft limits.
const SOFT_JOINT_LIMIT_FACTOR: f32 = 0.9;

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
        let mut spec = spec_of("walk", &robot, policy_fields(robot.joints.len()), names, config.max_episode_s);
        if has_ground_truth {
            let feet: Vec<_> = robot.feet.feet().iter().map(|foot| foot.name.as_str()).collect();
            spec.critic_observation = privileged_fields_of(&feet);
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
        (q, WalkState { command, steps_to_command, contacts: FootContacts::default() })
    }

    fn observe(&self, state: &WalkState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        observe(robot, state.command, &self.default_pose, action, obs);
    }

    fn observe_critic(&self, _state: &WalkState, robot: &RobotView, obs: &mut [f32]) {
        if let Some(truth) = &robot.truth {
            observe_privileged(robot, truth, obs);
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
        }
        is_terminated
    }

    fn velocity_command(&self, state: &WalkState) -> Option<[f32; 3]> {
        Some(state.command)
    }

    fn set_velocity_command(&self, state: &mut WalkState, command: [f32; 3]) {
        (state.command, state.steps_to_command) = (command, None);
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
}
