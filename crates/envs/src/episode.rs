//! Episode of one robot: initial state, reward and termination.

use glam::Vec3;
use rand::{Rng, RngExt};
use twinstep_model::{
    ControlConfig, EnvSpec, Ground, NUM_JOINTS, PerJoint, PerLeg, RandomisationSample, RobotModel, RobotStates, Stream,
    frames, stream,
};

use crate::config::{NUM_REWARD_TERMS, Range};
use crate::observation::observe;
use crate::reward::RewardInput;
use crate::{Randomisation, TaskConfig};

/// Contact force above which a foot is on the ground [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;
/// Fraction of a joint's range within its soft limits.
const SOFT_JOINT_LIMIT_FACTOR: f32 = 0.9;

/// Settings that all episodes share.
pub struct EpisodeConfig {
    /// The task.
    pub task: TaskConfig,
    /// Domain randomisation.
    pub randomise: Randomisation,
    control: ControlConfig,
    ground: Ground,
    policy_dt: f32,
    default_pose: PerJoint,
    soft_lower: PerJoint,
    soft_upper: PerJoint,
    max_episode_steps: u32,
    resample_steps: u32,
    /// Cosine of the tilt below which the episode terminates.
    cos_max_tilt: f32,
}

/// State of the episode of one environment.
pub struct Episode {
    /// Source of random numbers for poses and commands.
    stream: Stream,
    seed: u64,
    /// Number of episodes that were started with this seed.
    episode_index: u64,
    /// True from a reset to the end of the episode.
    pub running: bool,
    /// Number of policy steps so far.
    pub length: u32,
    /// Sum of rewards so far.
    pub episode_return: f32,
    /// Sum of each weighted reward term so far.
    pub term_sums: [f32; NUM_REWARD_TERMS],
    /// Velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
    pub command: [f32; 3],
    action: PerJoint,
    previous_action: PerJoint,
    previous_dq: PerJoint,
    air_time: PerLeg,
}

/// Random values of a new episode.
pub struct EpisodeStart {
    /// Randomisation of the bodies and the ground.
    pub variation: RandomisationSample,
    /// Source of random numbers for the effects of the model file.
    pub effects: Stream,
    /// Seed of the random numbers in the actuators.
    pub actuator_seed: u64,
    /// Joint position [rad].
    pub q: PerJoint,
    /// Position gain [N·m/rad].
    pub kp: f32,
    /// Velocity gain [N·m·s/rad].
    pub kd: f32,
}

/// Reward and end flags of a policy step.
#[derive(Clone, Copy)]
pub struct StepOutcome {
    /// The reward.
    pub reward: f32,
    /// True if the robot fell.
    pub terminated: bool,
    /// True if the time limit ended the episode.
    pub truncated: bool,
}

impl EpisodeConfig {
    /// Creates the settings of `task` for `robot` on `ground`, with the periods and the episode length of `spec`.
    pub fn new(task: TaskConfig, randomise: Randomisation, robot: &RobotModel, ground: Ground, spec: &EnvSpec) -> Self {
        let (lower, upper) = (robot.lower_limits(), robot.upper_limits());
        let margin = |j: usize| (1.0 - SOFT_JOINT_LIMIT_FACTOR) / 2.0 * (upper[j] - lower[j]);
        let policy_dt = spec.policy_dt as f32;
        Self {
            control: robot.control,
            ground,
            policy_dt,
            default_pose: robot.control.default_pose_f32(),
            soft_lower: std::array::from_fn(|j| lower[j] + margin(j)),
            soft_upper: std::array::from_fn(|j| upper[j] - margin(j)),
            max_episode_steps: spec.max_episode_steps,
            resample_steps: (task.command_resample_s / policy_dt).round().max(1.0) as u32,
            cos_max_tilt: task.max_tilt_rad.cos(),
            task,
            randomise,
        }
    }

    /// Returns the ground under all robots.
    pub fn ground(&self) -> &Ground {
        &self.ground
    }
}

impl Episode {
    /// Creates an environment without an episode, whose random numbers come from `seed`.
    pub fn not_started(seed: u64) -> Self {
        Self {
            stream: stream(seed, "walk", 0),
            seed,
            episode_index: 0,
            running: false,
            length: 0,
            episode_return: 0.0,
            term_sums: [0.0; NUM_REWARD_TERMS],
            command: [0.0; 3],
            action: [0.0; NUM_JOINTS],
            previous_action: [0.0; NUM_JOINTS],
            previous_dq: [0.0; NUM_JOINTS],
            air_time: [0.0; 4],
        }
    }

    /// Sets the seed of the following episodes.
    pub fn seed(&mut self, seed: u64) {
        (self.stream, self.seed, self.episode_index) = (stream(seed, "walk", 0), seed, 0);
    }

    /// Returns true if an episode has run. False before the first reset and after a divergence.
    pub fn was_started(&self) -> bool {
        self.length > 0
    }

    /// Starts a new episode: resets the sums and samples bodies, gains, pose and velocity command.
    pub fn start(&mut self, config: &EpisodeConfig) -> EpisodeStart {
        let EpisodeConfig { randomise, control, .. } = config;
        let noise = config.task.reset_joint_noise_rad;
        // Separate streams: poses and commands do not depend on whether effects and actuators use random numbers.
        let effects = stream(self.seed, "effects", self.episode_index);
        let actuator_seed = stream(self.seed, "drives", self.episode_index).next_u64();
        let stream = &mut self.stream;
        let variation = RandomisationSample {
            mass_scale: draw(stream, randomise.mass_scale),
            payload: draw(stream, randomise.payload_kg),
            com_shift: std::array::from_fn(|_| draw(stream, randomise.com_shift_m)),
            friction_scale: draw(stream, randomise.friction_scale),
        };
        let kp = control.kp as f32 * draw(stream, randomise.kp_scale);
        let kd = control.kd as f32 * draw(stream, randomise.kd_scale);
        let q = config.default_pose.map(|position| position + draw(stream, [-noise, noise]));
        self.draw_command(config);
        self.episode_index += 1;
        self.running = true;
        self.length = 0;
        self.episode_return = 0.0;
        self.term_sums = [0.0; NUM_REWARD_TERMS];
        self.action = [0.0; NUM_JOINTS];
        self.air_time = [0.0; 4];
        EpisodeStart { variation, effects, actuator_seed, q, kp, kd }
    }

    /// Stores the action before a step and returns the commanded joint positions [rad].
    pub fn joint_targets(&mut self, config: &EpisodeConfig, action: &PerJoint, dq: &PerJoint) -> PerJoint {
        let scale = config.control.action_scale as f32;
        self.previous_action = self.action;
        self.action = action.map(|value| value.clamp(-1.0, 1.0));
        self.previous_dq = *dq;
        std::array::from_fn(|j| config.default_pose[j] + scale * self.action[j])
    }

    /// Returns the reward and the end flags after a step, and writes the next observation into `obs`.
    pub fn evaluate_step(
        &mut self,
        config: &EpisodeConfig,
        states: &RobotStates,
        robot: usize,
        obs: &mut [f32],
    ) -> StepOutcome {
        let touchdown_air_time = self.update_air_time(&states.foot_force[robot], config.policy_dt);
        let base_from_world = frames::world_from_base(states.base_orientation[robot]).inverse();
        let gravity = base_from_world * Vec3::NEG_Z;
        let terms = config.task.reward.evaluate(&RewardInput {
            policy_dt: config.policy_dt,
            tracking_sigma: config.task.tracking_sigma,
            command: self.command,
            linear_velocity: (base_from_world * Vec3::from(states.base_linear_velocity[robot])).to_array(),
            angular_velocity: states.base_angular_velocity[robot],
            gravity: gravity.to_array(),
            q: &states.q[robot],
            dq: &states.dq[robot],
            previous_dq: &self.previous_dq,
            tau: &states.tau[robot],
            action: &self.action,
            previous_action: &self.previous_action,
            default_pose: &config.default_pose,
            soft_lower: &config.soft_lower,
            soft_upper: &config.soft_upper,
            touchdown_air_time,
            body_contact: states.body_contact[robot],
            uncertainty: states.epistemic_uncertainty[robot],
        });
        let reward = terms.iter().sum();
        self.length += 1;
        self.episode_return += reward;
        self.term_sums = std::array::from_fn(|term| self.term_sums[term] + terms[term]);
        let [x, y, z] = states.base_position[robot];
        let is_too_low = z - config.ground.height(x, y) < config.task.min_base_height_m;
        let terminated = is_too_low || -gravity.z < config.cos_max_tilt;
        let timed_out = self.length >= config.max_episode_steps;
        if self.length.is_multiple_of(config.resample_steps) {
            self.draw_command(config);
        }
        self.running = !(terminated || timed_out);
        self.observe(config, states, robot, obs);
        StepOutcome { reward, terminated, truncated: timed_out && !terminated }
    }

    /// Writes the observation into `obs`.
    pub fn observe(&self, config: &EpisodeConfig, states: &RobotStates, robot: usize, obs: &mut [f32]) {
        observe(states, robot, self.command, &config.default_pose, &self.action, obs);
    }

    fn draw_command(&mut self, config: &EpisodeConfig) {
        let ranges = &config.task.command;
        self.command = [ranges.linear_velocity_x, ranges.linear_velocity_y, ranges.angular_velocity_z]
            .map(|range| draw(&mut self.stream, range));
    }

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

fn draw(stream: &mut Stream, [low, high]: Range) -> f32 {
    low + (high - low) * stream.random::<f32>()
}
