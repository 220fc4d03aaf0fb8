//! The task `pose`: the joints of any robot follow targets, and a robot with a free base does not fall.
//!
//! Every robot can do it: an arm reaches, a humanoid stands and moves. New targets of all joints are drawn after a random time.

use rand::RngExt;
use twinstep_model::{EnvSpec, Stream, frames};

use super::pose_config::PoseConfig;
use crate::ControlledRobot;
use crate::config::ConfigError;
use crate::observation::{base_height, field, spec_of};
use crate::task::{RobotView, Step, Task};

/// Names of the reward terms.
const TERMS: [&str; 4] = ["track_joints", "joint_torque", "action_rate", "termination"];

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
    /// Creates the task for a robot.
    pub fn new(config: PoseConfig, robot: ControlledRobot) -> Result<Self, ConfigError> {
        config.check()?;
        let spec = spec(&config, &robot);
        Ok(Self { config, robot, spec })
    }

    /// Returns the robot.
    pub fn robot(&self) -> &ControlledRobot {
        &self.robot
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

    fn has_fallen(&self, robot: &RobotView) -> bool {
        let Some(standing) = self.robot.standing_height else { return false };
        let is_tilted = -frames::projected_gravity(robot.orientation).z < self.config.max_tilt_rad.cos();
        let lowest = f64::from(self.config.min_height) * standing;
        is_tilted || robot.truth.is_some_and(|truth| f64::from(base_height(robot, &truth)) < lowest)
    }
}

impl Task for PoseTask {
    type State = PoseState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, PoseState) {
        let noise = f64::from(self.config.reset_joint_noise_rad);
        let joints = self.robot.default_pose.iter().zip(&self.robot.ranges);
        let q = joints.map(|(q, [low, high])| (q + noise * symmetric(random)).clamp(*low, *high) as f32).collect();
        (q, self.targets(random))
    }

    fn observe(&self, state: &PoseState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        let gravity = frames::projected_gravity(robot.orientation);
        let relative = robot.q.iter().zip(&self.robot.default_pose).map(|(q, pose)| (f64::from(*q) - pose) as f32);
        let values = robot.gyro.into_iter().chain(gravity.to_array()).chain(relative);
        let values = values.chain(robot.dq.iter().copied()).chain(state.targets.iter().copied());
        let bounds =
            self.spec.observation.iter().flat_map(|field| std::iter::repeat_n([field.low, field.high], field.size));
        for ((entry, value), [low, high]) in obs.iter_mut().zip(values.chain(action.iter().copied())).zip(bounds) {
            *entry = value.clamp(low, high);
        }
    }

    fn evaluate(&self, state: &mut PoseState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        let (config, dt, robot) = (&self.config, self.spec.policy_dt as f32, &step.robot);
        let error = |((q, pose), target): ((&f32, &f64), &f32)| (f64::from(*q) - pose) as f32 - target;
        let errors = robot.q.iter().zip(&self.robot.default_pose).zip(&state.targets).map(error);
        let share =
            |(tau, limit): (&f32, &f64)| if limit.is_finite() && *limit > 0.0 { tau / *limit as f32 } else { 0.0 };
        let torques = robot.tau.iter().zip(&self.robot.torque_limits).map(share);
        let changes = step.action.iter().zip(step.previous_action).map(|(action, previous)| action - previous);
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
    let observation = vec![
        field("base_angular_velocity", 3, "rad/s", 50.0, "angular velocity of the base in the base frame"),
        field("projected_gravity", 3, "", 1.0, "unit vector of gravity in the base frame"),
        field("joint_position", joints, "rad", 6.3, "position relative to the default pose"),
        field("joint_velocity", joints, "rad/s", 100.0, "velocity"),
        field("joint_target", joints, "rad", 10.0, "target of the position, relative to the default pose"),
        field("previous_action", joints, "", 1.0, "action of the previous step, clipped"),
    ];
    spec_of("pose", robot, observation, TERMS.map(str::to_owned).to_vec(), config.max_episode_s)
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Feet, Ground, go2, stream};

    use crate::task::Truth;

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
            mass: 30.0,
            feet: Feet::from(&go2()),
            hips: Vec::new(),
        }
    }

    fn view<'a>(q: &'a [f32; 2], tau: &'a [f32; 2], height: f32) -> RobotView<'a> {
        let truth = Truth {
            base_position: [0.0, 0.0, height],
            base_linear_velocity: [0.0; 3],
            base_angular_velocity: [0.0; 3],
            foot_force: &[],
            body_contact: false,
            epistemic_uncertainty: 0.0,
        };
        let orientation = [1.0, 0.0, 0.0, 0.0];
        RobotView { q, dq: &[1.0, 200.0], tau, orientation, gyro: [0.0; 3], truth: Some(truth), ground: &Ground::FLAT }
    }

    #[test]
    fn observation_has_every_joint_and_is_clipped() {
        let task = PoseTask::new(PoseConfig::default(), robot()).expect("valid");
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
        let task = PoseTask::new(config, robot()).expect("valid");
        let mut random = stream(1, "pose", 0);
        let (_, mut state) = task.start(&mut random);
        let (mut terms, action) = ([f32::NAN; 4], [0.1f32, 0.0]);
        let stands = view(&[0.2, -0.2], &[0.0, 10.0], 0.9);
        let step = |robot| Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
        assert!(!task.evaluate(&mut state, &step(stands), &mut random, &mut terms));
        assert!((terms[0] - 0.02).abs() < 1e-6 && (terms[1] + 0.1 * 0.125 * 0.02).abs() < 1e-7, "{terms:?}");
        assert_eq!((terms[2], terms[3]), (0.0, 0.0));
        let lies = view(&[0.2, -0.2], &[0.0, 10.0], 0.4);
        assert!(task.evaluate(&mut state, &step(lies), &mut random, &mut terms));
        assert_eq!(terms[3], -1.0);
    }
}
