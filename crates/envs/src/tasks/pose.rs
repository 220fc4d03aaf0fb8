//! The task `pose`: the joints of any robot follow targets, and a robot with a free base does not fall.
//!
//! Every robot can do it: an arm reaches, a humanoid stands and moves. New targets of all joints are drawn after a random time.

use rand::RngExt;
use twinstep_model::{EnvSpec, SpecField, Stream, frames};

use super::pose_config::PoseConfig;
use crate::config::ConfigError;

/// Names of the reward terms.
const TERMS: [&str; 4] = ["track_joints", "joint_torque", "action_rate", "termination"];

/// A robot of any tree and how it is controlled.
#[derive(Clone, Debug, PartialEq)]
pub struct ControlledRobot {
    /// Name of the robot.
    pub name: String,
    /// Names of the joints.
    pub joints: Vec<String>,
    /// Position gain [N·m/rad] and velocity gain [N·m·s/rad] of each joint.
    pub gains: Vec<[f64; 2]>,
    /// Joint positions to which actions are relative [rad or m].
    pub default_pose: Vec<f64>,
    /// Lowest and highest position of each joint.
    pub ranges: Vec<[f64; 2]>,
    /// Torque limit of each joint [N·m or N].
    pub torque_limits: Vec<f64>,
    /// Joint offset of an action of 1 [rad or m].
    pub action_scale: f64,
    /// Actuator period [s].
    pub actuator_dt: f64,
    /// Number of actuator periods per policy period.
    pub decimation: usize,
    /// Height of the base in the default pose [m]; `None` if the base is fixed.
    pub standing_height: Option<f64>,
}

/// What the task knows of a robot.
#[derive(Clone, Copy, Debug)]
pub struct TreeView<'a> {
    /// Joint positions [rad or m].
    pub q: &'a [f64],
    /// Joint velocities.
    pub dq: &'a [f64],
    /// Torques, mean over the last actuator period.
    pub tau: &'a [f64],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub orientation: [f32; 4],
    /// Angular velocity in the base frame [rad/s].
    pub angular_velocity: [f32; 3],
    /// Height of the base [m].
    pub height: f64,
}

/// The task `pose` on one robot.
#[derive(Clone, Debug)]
pub struct PoseTask {
    config: PoseConfig,
    robot: ControlledRobot,
    spec: EnvSpec,
}

/// State of an episode of `pose`.
#[derive(Clone, Debug, Default)]
pub struct PoseState {
    /// Targets of the joints, relative to the default pose.
    targets: Vec<f32>,
    /// Policy steps until the next targets.
    steps_left: u32,
}

impl PoseTask {
    /// Creates the task for a robot. `max_episode_steps` overrides the length of an episode.
    pub fn new(
        config: PoseConfig,
        robot: ControlledRobot,
        max_episode_steps: Option<u32>,
    ) -> Result<Self, ConfigError> {
        config.check()?;
        let mut spec = spec(&config, &robot);
        spec.max_episode_steps = max_episode_steps.unwrap_or(spec.max_episode_steps);
        Ok(Self { config, robot, spec })
    }

    /// Returns layouts, periods, gains and limits.
    pub fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    /// Returns the robot.
    pub fn robot(&self) -> &ControlledRobot {
        &self.robot
    }

    /// Samples initial joint positions [rad or m] and the first targets.
    pub fn start(&self, random: &mut Stream) -> (Vec<f64>, PoseState) {
        let noise = f64::from(self.config.reset_joint_noise_rad);
        let joints = self.robot.default_pose.iter().zip(&self.robot.ranges);
        let q = joints.map(|(q, [low, high])| (q + noise * symmetric(random)).clamp(*low, *high)).collect();
        (q, self.targets(random))
    }

    fn targets(&self, random: &mut Stream) -> PoseState {
        let largest = f64::from(self.config.target_rad);
        let joints = self.robot.default_pose.iter().zip(&self.robot.ranges);
        let target = |(pose, [low, high]): (&f64, &[f64; 2])| {
            ((pose + largest * symmetric(random)).clamp(*low, *high) - pose) as f32
        };
        let targets = joints.map(target).collect();
        let [low, high] = self.config.target_interval_s;
        let seconds = low + (high - low) * random.random::<f32>();
        PoseState { targets, steps_left: (f64::from(seconds) / self.spec.policy_dt).round().max(1.0) as u32 }
    }

    /// Writes the observation, clipped to the bounds of the spec.
    pub fn observe(&self, state: &PoseState, robot: &TreeView, action: &[f32], obs: &mut [f32]) {
        let gravity = frames::projected_gravity(robot.orientation);
        let relative = robot.q.iter().zip(&self.robot.default_pose).map(|(q, pose)| (q - pose) as f32);
        let values = robot.angular_velocity.into_iter().chain(gravity.to_array()).chain(relative);
        let values = values.chain(robot.dq.iter().map(|dq| *dq as f32)).chain(state.targets.iter().copied());
        let bounds =
            self.spec.observation.iter().flat_map(|field| std::iter::repeat_n([field.low, field.high], field.size));
        for ((entry, value), [low, high]) in obs.iter_mut().zip(values.chain(action.iter().copied())).zip(bounds) {
            *entry = value.clamp(low, high);
        }
    }

    /// Writes the weighted reward terms after a step, and draws new targets when it is time. Returns true if the robot has fallen.
    pub fn evaluate(
        &self,
        state: &mut PoseState,
        robot: &TreeView,
        [action, previous]: [&[f32]; 2],
        random: &mut Stream,
        terms: &mut [f32],
    ) -> bool {
        let (config, dt) = (&self.config, self.spec.policy_dt as f32);
        let error = |((q, pose), target): ((&f64, &f64), &f32)| (q - pose) as f32 - target;
        let errors = robot.q.iter().zip(&self.robot.default_pose).zip(&state.targets).map(error);
        let share =
            |(tau, limit): (&f64, &f64)| if limit.is_finite() && *limit > 0.0 { (tau / limit) as f32 } else { 0.0 };
        let torques = robot.tau.iter().zip(&self.robot.torque_limits).map(share);
        let changes = action.iter().zip(previous).map(|(action, previous)| action - previous);
        let has_fallen = self.has_fallen(robot);
        terms[0] = config.track_joints * (-mean_square(errors) / config.tracking_sigma).exp() * dt;
        terms[1] = config.joint_torque * mean_square(torques) * dt;
        terms[2] = config.action_rate * mean_square(changes) * dt;
        terms[3] = if has_fallen { config.termination } else { 0.0 };
        state.steps_left -= 1;
        if state.steps_left == 0 {
            *state = self.targets(random);
        }
        has_fallen
    }

    fn has_fallen(&self, robot: &TreeView) -> bool {
        let Some(standing) = self.robot.standing_height else { return false };
        let is_tilted = -frames::projected_gravity(robot.orientation).z < self.config.max_tilt_rad.cos();
        is_tilted || robot.height < f64::from(self.config.min_height) * standing
    }
}

/// Returns a number within ±1.
fn symmetric(random: &mut Stream) -> f64 {
    2.0 * random.random::<f64>() - 1.0
}

fn mean_square(values: impl Iterator<Item = f32>) -> f32 {
    let (count, sum) = values.fold((0, 0.0), |(count, sum), value| (count + 1, sum + value * value));
    sum / count.max(1) as f32
}

fn spec(config: &PoseConfig, robot: &ControlledRobot) -> EnvSpec {
    let joints = robot.joints.len();
    let field = |name: &str, size: usize, unit: &str, bound: f32, text: &str| SpecField {
        name: name.to_owned(),
        size,
        unit: unit.to_owned(),
        low: -bound,
        high: bound,
        description: text.to_owned(),
    };
    let policy_dt = robot.actuator_dt * robot.decimation as f64;
    let [kp, kd] = robot.gains[0];
    let alike = robot.gains.iter().all(|gains| *gains == robot.gains[0]);
    EnvSpec {
        task: "pose".to_owned(),
        robot: robot.name.clone(),
        observation: vec![
            field("base_angular_velocity", 3, "rad/s", 50.0, "angular velocity of the base in the base frame"),
            field("projected_gravity", 3, "", 1.0, "unit vector of gravity in the base frame"),
            field("joint_position", joints, "rad", 6.3, "position relative to the default pose"),
            field("joint_velocity", joints, "rad/s", 100.0, "velocity"),
            field("joint_target", joints, "rad", 10.0, "target of the position, relative to the default pose"),
            field("previous_action", joints, "", 1.0, "action of the previous step, clipped"),
        ],
        critic_observation: Vec::new(),
        action: vec![field(
            "joint_position_offset",
            joints,
            "action_scale",
            1.0,
            "commanded joint position relative to the default pose, in units of action_scale",
        )],
        joint_order: robot.joints.clone(),
        policy_dt,
        actuator_dt: robot.actuator_dt,
        kp,
        kd,
        joint_gains: if alike { Vec::new() } else { robot.gains.clone() },
        action_scale: robot.action_scale,
        default_pose: robot.default_pose.clone(),
        reward_terms: TERMS.map(str::to_owned).to_vec(),
        max_episode_steps: (f64::from(config.max_episode_s) / policy_dt).round() as u32,
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;

    fn robot() -> ControlledRobot {
        ControlledRobot {
            name: "biped".to_owned(),
            joints: vec!["left".to_owned(), "right".to_owned()],
            gains: vec![[20.0, 0.5], [40.0, 1.0]],
            default_pose: vec![0.2, -0.2],
            ranges: vec![[0.1, 0.25], [-1.0, 1.0]],
            torque_limits: vec![10.0, 20.0],
            action_scale: 0.5,
            actuator_dt: 0.005,
            decimation: 4,
            standing_height: Some(1.0),
        }
    }

    fn view<'a>(q: &'a [f64; 2], tau: &'a [f64; 2], height: f64) -> TreeView<'a> {
        TreeView { q, dq: &[1.0, 200.0], tau, orientation: [1.0, 0.0, 0.0, 0.0], angular_velocity: [0.0; 3], height }
    }

    #[test]
    fn observation_has_every_joint_and_is_clipped() {
        let task = PoseTask::new(PoseConfig::default(), robot(), None).expect("valid");
        assert_eq!((task.spec().obs_len(), task.spec().action_len()), (6 + 4 * 2, 2));
        assert_eq!(task.spec().observation_entry(7), "joint_position[right]");
        assert_eq!(task.spec().joint_gains, [[20.0, 0.5], [40.0, 1.0]]);
        let (q, state) = task.start(&mut stream(1, "pose", 0));
        assert!((0.1..=0.25).contains(&q[0]) && (q[1] + 0.2).abs() <= 0.02, "{q:?}");
        assert!(state.targets[0] <= 0.05 && state.targets[1].abs() <= 0.1, "{state:?}");
        let mut obs = [f32::NAN; 14];
        task.observe(&state, &view(&[0.3, -0.2], &[0.0; 2], 1.0), &[0.5, -0.5], &mut obs);
        let targets = [state.targets[0], state.targets[1]];
        let expected = [0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.1, 0.0, 1.0, 100.0, targets[0], targets[1], 0.5, -0.5];
        assert!(obs.iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-6), "{obs:?}");
    }

    #[test]
    fn robot_at_its_targets_has_the_full_reward_and_one_that_lies_ends_the_episode() {
        let config = PoseConfig { target_rad: 0.0, ..PoseConfig::default() };
        let task = PoseTask::new(config, robot(), None).expect("valid");
        let mut random = stream(1, "pose", 0);
        let (_, mut state) = task.start(&mut random);
        let (mut terms, action) = ([f32::NAN; 4], [0.1f32, 0.0]);
        let stands = view(&[0.2, -0.2], &[0.0, 10.0], 0.9);
        assert!(!task.evaluate(&mut state, &stands, [&action, &action], &mut random, &mut terms));
        assert!((terms[0] - 0.02).abs() < 1e-6 && (terms[1] + 0.1 * 0.125 * 0.02).abs() < 1e-7, "{terms:?}");
        assert_eq!((terms[2], terms[3]), (0.0, 0.0));
        let lies = view(&[0.2, -0.2], &[0.0, 10.0], 0.4);
        assert!(task.evaluate(&mut state, &lies, [&action, &action], &mut random, &mut terms));
        assert_eq!(terms[3], -1.0);
    }
}
