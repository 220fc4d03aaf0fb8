//! The task `track`: the robot follows a path on the ground (U2E, §IV-B).
//!
//! The observation is that of `walk` with the velocity of the path as command, and the pose of the reference in the base
//! frame, which needs motion capture. On a robot without it the pose error is zero.

use glam::Vec3;
use rand::RngExt;
use twinstep_model::{EnvSpec, RobotModel, SpecField, Stream, frames};

use super::track_config::TrackConfig;
use super::walk::{Walk, WalkState};
use crate::config::ConfigError;
use crate::observation::{OBS_LEN, observe};
use crate::path::{GroundPose, Path, PathShape};
use crate::task::{RobotView, Step, Task, Truth};

/// Bound of the pose error in the observation [m, rad].
const ERROR_BOUND: f32 = 3.2;
/// Largest correction of the velocity in the tracking rewards, along each axis [m/s, rad/s].
const MAX_CORRECTION: f32 = 0.5;
/// Names of the terms that `walk` does not have.
const TERMS: [&str; 2] = ["track_position", "track_heading"];

/// The task `track` on one robot model.
#[derive(Clone, Debug)]
pub struct Track {
    config: TrackConfig,
    walk: Walk,
    spec: EnvSpec,
    default_pose: Vec<f32>,
}

/// State of an episode of `track`.
#[derive(Clone, Debug, Default)]
pub struct TrackState {
    walk: WalkState,
    path: Path,
    /// Time since the start of the path [s].
    time: f32,
    /// Pose of the reference in the world.
    reference: GroundPose,
}

impl Track {
    /// Creates the task for `robot`. A backend without ground truth has neither a pose error nor the terms that need it.
    pub fn new(config: TrackConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let walk = Walk::new(config.walk.clone(), robot, has_ground_truth)?;
        let mut spec = EnvSpec { task: "track".to_owned(), ..walk.spec().clone() };
        if has_ground_truth {
            spec.reward_terms.extend(TERMS.map(str::to_owned));
        }
        for field in &mut spec.observation {
            if field.name == "velocity_command" {
                "path_velocity".clone_into(&mut field.name);
                "velocity of the path in its own frame: forward, left, yaw rate".clone_into(&mut field.description);
            }
        }
        spec.observation.push(SpecField {
            name: "pose_error".to_owned(),
            size: 3,
            unit: "m, m, rad".to_owned(),
            low: -ERROR_BOUND,
            high: ERROR_BOUND,
            description: "pose of the path's reference in the base frame: forward, left, yaw; 0 without motion capture"
                .to_owned(),
        });
        Ok(Self { default_pose: robot.control.default_pose_f32().to_vec(), walk, spec, config })
    }

    /// Returns the pose of the reference in the frame of the robot: forward [m], left [m], yaw [rad].
    fn error(state: &TrackState, robot: &RobotView, truth: &Truth) -> [f32; 3] {
        state.reference.relative_to(ground_pose(robot, truth))
    }

    /// Returns the velocity in the base frame that follows the path and removes the error.
    fn target_velocity(&self, state: &TrackState, error: [f32; 3]) -> [f32; 3] {
        let [vx, vy, rate] = state.path.velocity(state.time);
        let (sin, cos) = error[2].sin_cos();
        let of_path = [cos * vx - sin * vy, sin * vx + cos * vy, rate];
        std::array::from_fn(|axis| {
            of_path[axis] + (self.config.correction_rate * error[axis]).clamp(-MAX_CORRECTION, MAX_CORRECTION)
        })
    }
}

/// Returns the pose of a robot's base on the ground.
fn ground_pose(robot: &RobotView, truth: &Truth) -> GroundPose {
    let [x, y, _] = truth.base_position;
    let forward = frames::world_from_base(robot.orientation) * Vec3::X;
    GroundPose { x, y, yaw: forward.y.atan2(forward.x) }
}

impl Task for Track {
    type State = TrackState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, TrackState) {
        let (q, walk) = self.walk.start(random);
        let TrackConfig { path: shape, radius_m, speed, start_offset_m, start_offset_rad, .. } = self.config;
        let commands = &self.config.walk.command;
        let ranges = [commands.linear_velocity_x, commands.linear_velocity_y, commands.angular_velocity_z];
        let path = Path::new(shape, radius_m, speed, ranges, random);
        // The other shapes begin at the robot, which starts at the origin.
        let mut offset = |largest: f32| match shape {
            PathShape::Random => largest * (2.0 * random.random::<f32>() - 1.0),
            _ => 0.0,
        };
        let reference =
            GroundPose { x: offset(start_offset_m), y: offset(start_offset_m), yaw: offset(start_offset_rad) };
        (q, TrackState { walk, path, time: 0.0, reference })
    }

    fn observe(&self, state: &TrackState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        observe(robot, state.path.velocity(state.time), &self.default_pose, action, obs);
        let truth = robot.truth.as_ref().filter(|_| self.config.observe_pose_error);
        let error = truth.map_or([0.0; 3], |truth| Self::error(state, robot, truth));
        for (entry, error) in obs[OBS_LEN..].iter_mut().zip(error) {
            *entry = error.clamp(-ERROR_BOUND, ERROR_BOUND);
        }
    }

    fn observe_critic(&self, state: &TrackState, robot: &RobotView, obs: &mut [f32]) {
        self.walk.observe_critic(&state.walk, robot, obs);
    }

    fn evaluate(&self, state: &mut TrackState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        let (config, dt) = (&self.config, self.spec.policy_dt as f32);
        state.reference = state.path.advance(state.reference, state.time, dt);
        state.time += dt;
        let error = step.robot.truth.as_ref().map(|truth| Self::error(state, &step.robot, truth));
        let target = self.target_velocity(state, error.unwrap_or_default());
        self.walk.set_velocity_command(&mut state.walk, target);
        let of_walk = self.walk.spec().reward_terms.len();
        let has_fallen = self.walk.evaluate(&mut state.walk, step, random, &mut terms[..of_walk]);
        let Some([forward, left, yaw]) = error else { return has_fallen };
        let distance = forward.hypot(left);
        terms[of_walk] = config.track_position * (-distance.powi(2) / config.position_sigma).exp() * dt;
        terms[of_walk + 1] = config.track_heading * (-yaw.powi(2) / config.heading_sigma).exp() * dt;
        has_fallen || distance > config.max_position_error_m
    }

    fn velocity_command(&self, state: &TrackState) -> Option<[f32; 3]> {
        Some(state.path.velocity(state.time))
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, RobotStates, go2, stream};

    use super::*;

    fn task(path: PathShape) -> Track {
        Track::new(TrackConfig { path, ..TrackConfig::default() }, &go2(), true).expect("valid")
    }

    /// Returns a robot at this pose.
    fn robot_at(pose: GroundPose) -> RobotStates {
        let mut states = RobotStates::new(1);
        states.truth.base_position[0] = [pose.x, pose.y, 0.3];
        let half = 0.5 * pose.yaw;
        states.measured.orientation[0] = [half.cos(), 0.0, 0.0, half.sin()];
        states
    }

    fn view<'a>(states: &'a RobotStates, ground: &'a Ground) -> RobotView<'a> {
        RobotView::of(&states.measured, Some(&states.truth), ground, 0)
    }

    #[test]
    fn robot_on_the_reference_has_no_error_and_the_full_terms() {
        let (task, ground) = (task(PathShape::Circle), Ground::FLAT);
        let mut random = stream(0, "test", 0);
        let mut state = task.start(&mut random).1;
        let mut terms = vec![f32::NAN; task.spec().reward_terms.len()];
        let (mut obs, action) = (vec![f32::NAN; task.spec().obs_len()], [0.0; 12]);
        for step in 1..=100 {
            let pose = state.path.advance(state.reference, state.time, 0.02);
            let states = robot_at(pose);
            let robot = view(&states, &ground);
            let input = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: step };
            assert!(!task.evaluate(&mut state, &input, &mut random, &mut terms));
            assert!((terms[18] - 0.04).abs() < 1e-5 && (terms[19] - 0.02).abs() < 1e-5, "{terms:?}");
            task.observe(&state, &robot, &action, &mut obs);
            assert_eq!(obs[6..9], [0.5, 0.0, 0.5]);
            assert!(obs[45..].iter().all(|error| error.abs() < 1e-4), "{:?}", &obs[45..]);
        }
        // 2 s at 0.5 rad/s.
        assert!((state.reference.yaw - 1.0).abs() < 1e-4 && (state.reference.x - 1.0f32.sin()).abs() < 1e-4);
    }

    #[test]
    fn error_is_in_the_base_frame_and_absent_without_motion_capture() {
        let (mut task, ground) = (task(PathShape::Circle), Ground::FLAT);
        let state = task.start(&mut stream(0, "test", 0)).1;
        // The reference is at the origin: behind a robot that looks to the left from 0.2 m beyond it, 0.1 m to its left.
        let states = robot_at(GroundPose { x: 0.1, y: 0.2, yaw: std::f32::consts::FRAC_PI_2 });
        let mut obs = vec![f32::NAN; 48];
        task.observe(&state, &view(&states, &ground), &[0.0; 12], &mut obs);
        let expected = [-0.2, 0.1, -std::f32::consts::FRAC_PI_2];
        assert!(obs[45..].iter().zip(expected).all(|(one, other)| (one - other).abs() < 1e-6), "{:?}", &obs[45..]);
        task.config.observe_pose_error = false;
        task.observe(&state, &view(&states, &ground), &[0.0; 12], &mut obs);
        assert_eq!(obs[45..], [0.0; 3]);
        let real = Track::new(TrackConfig::default(), &go2(), false).expect("valid");
        assert_eq!(real.spec().hash(), task.spec().hash(), "a robot and its simulation agree");
    }

    #[test]
    fn robot_far_from_the_path_ends_the_episode() {
        let (task, ground) = (task(PathShape::Square), Ground::FLAT);
        let mut random = stream(0, "test", 0);
        let mut state = task.start(&mut random).1;
        let states = robot_at(GroundPose { x: 0.0, y: 1.1, yaw: 0.0 });
        let (action, mut terms) = ([0.0; 12], vec![0.0; 20]);
        let robot = view(&states, &ground);
        let input = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
        assert!(task.evaluate(&mut state, &input, &mut random, &mut terms));
    }
}
