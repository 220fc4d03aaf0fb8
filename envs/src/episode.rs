//! One robot's episode: how it starts, and what a policy step makes of it.

use glam::Vec3;
use rand::{Rng, RngExt};
use twinstep_model::{
    ControlConfig, EnvSpec, Ground, NUM_JOINTS, PerJoint, PerLeg, RobotModel, RobotStates, Stream, RandomisationSample, frames, stream,
};

use crate::config::{Range, NUM_REWARD_TERMS};
use crate::observation::observe;
use crate::reward::RewardInput;
use crate::{Randomisation, TaskConfig};

/// A foot counts as on the ground above this force [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;
/// Share of a joint's range that counts as safe.
const SOFT_JOINT_LIMIT_FACTOR: f32 = 0.9;

/// What holds for every episode.
pub struct EpisodeConfig {
    /// The task.
    pub task: TaskConfig,
    /// What varies from episode to episode.
    pub randomise: Randomisation,
    control: ControlConfig,
    ground: Ground,
    policy_dt: f32,
    default_pose: PerJoint,
    soft_lower: PerJoint,
    soft_upper: PerJoint,
    max_episode_steps: u32,
    resample_steps: u32,
    /// The episode ends when the cosine of the tilt falls below this.
    cos_max_tilt: f32,
}

/// What an environment remembers of its running episode.
pub struct Episode {
    /// Where its random numbers come from.
    stream: Stream,
    seed: u64,
    /// Episodes that were started under this seed.
    episode_index: u64,
    /// False before the first reset, and after the end of an episode that nobody has reset.
    pub running: bool,
    /// Policy steps so far.
    pub length: u32,
    /// Sum of rewards so far.
    pub episode_return: f32,
    /// Sum of each weighted term so far.
    pub term_sums: [f32; NUM_REWARD_TERMS],
    /// Velocity wanted: forward [m/s], left [m/s], turning left [rad/s].
    pub command: [f32; 3],
    action: PerJoint,
    previous_action: PerJoint,
    previous_dq: PerJoint,
    air_time: PerLeg,
}

/// What an episode starts with.
pub struct EpisodeStart {
    /// How body and ground differ from the model's.
    pub variation: RandomisationSample,
    /// Where the effects of the model file are drawn from.
    pub effects: Stream,
    /// Seed of what is random in the drives.
    pub drive_seed: u64,
    /// Joint position [rad].
    pub q: PerJoint,
    /// Position gain [N·m/rad].
    pub kp: f32,
    /// Velocity gain [N·m·s/rad].
    pub kd: f32,
}

/// What a policy step gave.
#[derive(Clone, Copy)]
pub struct StepOutcome {
    /// The reward.
    pub reward: f32,
    /// The robot fell.
    pub terminated: bool,
    /// The time is over.
    pub truncated: bool,
}

impl EpisodeConfig {
    /// The rules of `task` for `robot` on `ground`; periods and lengths are those of `spec`.
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

    /// The ground under all robots.
    pub fn ground(&self) -> &Ground {
        &self.ground
    }
}

impl Episode {
    /// None yet; the first will draw from `seed`.
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

    /// The next episodes will draw from `seed`.
    pub fn seed(&mut self, seed: u64) {
        (self.stream, self.seed, self.episode_index) = (stream(seed, "walk", 0), seed, 0);
    }

    /// True if an episode ended here; false if none ever ran or the last one diverged.
    pub fn was_started(&self) -> bool {
        self.length > 0
    }

    /// Forgets the episode before, and draws body, gains, pose and command of the next.
    pub fn start(&mut self, rules: &EpisodeConfig) -> EpisodeStart {
        let EpisodeConfig { randomise, control, .. } = rules;
        let noise = rules.task.reset_joint_noise_rad;
        // Streams of their own, so that poses and commands are the same with and without.
        let effects = stream(self.seed, "effects", self.episode_index);
        let drive_seed = stream(self.seed, "drives", self.episode_index).next_u64();
        let stream = &mut self.stream;
        let variation = RandomisationSample {
            mass_scale: draw(stream, randomise.mass_scale),
            payload: draw(stream, randomise.payload_kg),
            com_shift: std::array::from_fn(|_| draw(stream, randomise.com_shift_m)),
            friction_scale: draw(stream, randomise.friction_scale),
        };
        let kp = control.kp as f32 * draw(stream, randomise.kp_scale);
        let kd = control.kd as f32 * draw(stream, randomise.kd_scale);
        let q = rules.default_pose.map(|position| position + draw(stream, [-noise, noise]));
        self.draw_command(rules);
        self.episode_index += 1;
        self.running = true;
        self.length = 0;
        self.episode_return = 0.0;
        self.term_sums = [0.0; NUM_REWARD_TERMS];
        self.action = [0.0; NUM_JOINTS];
        self.air_time = [0.0; 4];
        EpisodeStart { variation, effects, drive_seed, q, kp, kd }
    }

    /// Takes the action in, before the step, and returns the joint positions that it wants [rad].
    pub fn joint_targets(&mut self, rules: &EpisodeConfig, action: &PerJoint, dq: &PerJoint) -> PerJoint {
        let scale = rules.control.action_scale as f32;
        self.previous_action = self.action;
        self.action = action.map(|value| value.clamp(-1.0, 1.0));
        self.previous_dq = *dq;
        std::array::from_fn(|j| rules.default_pose[j] + scale * self.action[j])
    }

    /// Reward and end, after the step; writes the observation that follows into `obs`.
    pub fn evaluate_step(&mut self, rules: &EpisodeConfig, states: &RobotStates, robot: usize, obs: &mut [f32]) -> StepOutcome {
        let landed_air_time = self.update_air_time(&states.foot_force[robot], rules.policy_dt);
        let base_from_world = frames::world_from_base(states.base_orientation[robot]).inverse();
        let gravity = base_from_world * Vec3::NEG_Z;
        let terms = rules.task.reward.evaluate(&RewardInput {
            policy_dt: rules.policy_dt,
            tracking_width: rules.task.tracking_sigma,
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
            default_pose: &rules.default_pose,
            soft_lower: &rules.soft_lower,
            soft_upper: &rules.soft_upper,
            touchdown_air_time: landed_air_time,
            body_contact: states.body_contact[robot],
            uncertainty: states.epistemic_uncertainty[robot],
        });
        let reward = terms.iter().sum();
        self.length += 1;
        self.episode_return += reward;
        self.term_sums = std::array::from_fn(|term| self.term_sums[term] + terms[term]);
        let [x, y, z] = states.base_position[robot];
        let sunk = z - rules.ground.height(x, y) < rules.task.min_base_height_m;
        let terminated = sunk || -gravity.z < rules.cos_max_tilt;
        let timed_out = self.length >= rules.max_episode_steps;
        if self.length.is_multiple_of(rules.resample_steps) {
            self.draw_command(rules);
        }
        self.running = !(terminated || timed_out);
        self.observe(rules, states, robot, obs);
        StepOutcome { reward, terminated, truncated: timed_out && !terminated }
    }

    /// Writes the observation into `obs`.
    pub fn observe(&self, rules: &EpisodeConfig, states: &RobotStates, robot: usize, obs: &mut [f32]) {
        observe(states, robot, self.command, &rules.default_pose, &self.action, obs);
    }

    fn draw_command(&mut self, rules: &EpisodeConfig) {
        let ranges = &rules.task.command;
        self.command = [ranges.linear_velocity_x, ranges.linear_velocity_y, ranges.angular_velocity_z].map(|range| draw(&mut self.stream, range));
    }

    /// Counts each foot's time in the air, and returns that of the feet that touched down.
    fn update_air_time(&mut self, foot_force: &PerLeg, policy_dt: f32) -> PerLeg {
        let air_time = &mut self.air_time;
        std::array::from_fn(|leg| {
            let in_air = foot_force[leg] < CONTACT_FORCE_THRESHOLD;
            let landed = if in_air { 0.0 } else { air_time[leg] };
            air_time[leg] = if in_air { air_time[leg] + policy_dt } else { 0.0 };
            landed
        })
    }
}

fn draw(stream: &mut Stream, [low, high]: Range) -> f32 {
    low + (high - low) * stream.random::<f32>()
}
