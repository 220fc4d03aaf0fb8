//! The task `walk`: the robot follows a velocity command.

use rand::RngExt;
use twinstep_model::{EnvSpec, FootKinematics, GroundTruth, PerJoint, RobotModel, Stream, frames};

use crate::config::ConfigError;
use crate::feet::{FootContacts, foot_states};
use crate::observation::{
    base_height, base_spec, linear_velocity_in_base, observe, observe_privileged, privileged_fields,
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
    spec: EnvSpec,
    /// Indices of the reward terms in the spec. Without ground truth some are missing.
    terms: Vec<usize>,
    default_pose: PerJoint,
    feet: FootKinematics,
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
    /// Policy steps until the next command; `None` if the agent sets it.
    steps_to_command: Option<u32>,
    contacts: FootContacts,
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
        let margin = |j: usize| {
            let margin = (1.0 - SOFT_JOINT_LIMIT_FACTOR) / 2.0 * (upper[j] - lower[j]);
            // A joint without limits has none within them.
            if margin.is_finite() { margin } else { 0.0 }
        };
        Ok(Self {
            terms,
            default_pose: robot.control.default_pose_f32(),
            feet: FootKinematics::new(robot),
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
        let is_standing = random.random::<f32>() < self.config.standing_probability;
        let factor = if is_standing { 0.0 } else { 1.0 };
        [ranges.linear_velocity_x, ranges.linear_velocity_y, ranges.angular_velocity_z]
            .map(|[low, high]| factor * (low + (high - low) * random.random::<f32>()))
    }

    fn reward_input<'a>(&'a self, state: &mut WalkState, step: &'a Step, is_terminated: bool) -> RewardInput<'a> {
        let robot = &step.robot;
        let (measured, index) = (robot.measured, robot.index);
        let policy_dt = self.spec.policy_dt as f32;
        // Terms that need the ground truth are not in `terms` where there is none.
        let of_truth =
            |value: fn(&RobotView, &GroundTruth) -> f32| robot.truth.map_or(0.0, |truth| value(robot, truth));
        let velocity = robot.truth.map(|truth| linear_velocity_in_base(robot, truth).to_array());
        let feet = robot.truth.map(|truth| foot_states(&self.feet, robot, truth));
        if let Some(truth) = robot.truth {
            state.contacts.update(&truth.foot_force[index], policy_dt);
        }
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
            touchdown_air_time: state.contacts.touchdown_air_time(),
            target_air_time: self.config.target_air_time_s,
            foot_contact: state.contacts.on_ground(),
            foot_height: feet.map_or([0.0; 4], |feet| feet.map(|foot| foot.height)),
            foot_speed: feet.map_or([0.0; 4], |feet| feet.map(|foot| foot.horizontal_speed)),
            target_foot_height: self.config.target_foot_height_m,
            base_height: of_truth(base_height),
            target_base_height: self.config.target_base_height_m,
            is_terminated,
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
        let command = self.draw_command(random);
        // The first command is shorter, so that robots that start together do not change their commands together.
        let steps_to_command = Some(random.random_range(1..=self.resample_steps));
        (q, WalkState { command, steps_to_command, contacts: FootContacts::default() })
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
        let gravity = frames::projected_gravity(step.robot.measured.orientation[step.robot.index]);
        let is_too_low =
            step.robot.truth.is_some_and(|truth| base_height(&step.robot, truth) < self.config.min_base_height_m);
        let is_terminated = is_too_low || -gravity.z < self.cos_max_tilt;
        let values = self.config.reward.evaluate(&self.reward_input(state, step, is_terminated));
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
