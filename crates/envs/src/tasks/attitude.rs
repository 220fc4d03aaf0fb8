//! The task `attitude`: the robot stands and follows roll, pitch and height of its base (SPI-Active, attitude tracking).
//!
//! The observation is that of `walk`, with the reference as command. Each of its three components is a sine of the time, whose
//! amplitude and frequency are drawn for each episode. It needs no motion capture: the height is not observed, and follows
//! from the joints.

use std::f32::consts::TAU;

use rand::RngExt;
use twinstep_model::{EnvSpec, RobotModel, Stream, frames};

use super::attitude_config::AttitudeConfig;
use super::walk::{Walk, WalkState};
use crate::config::ConfigError;
use crate::observation::{base_height, observe};
use crate::task::{RobotView, Step, Task};

/// Names of the terms that `walk` does not have; the second one needs ground truth.
const TERMS: [&str; 2] = ["track_attitude", "track_height"];

/// The task `attitude` on one robot model.
#[derive(Clone, Debug)]
pub struct Attitude {
    config: AttitudeConfig,
    walk: Walk,
    spec: EnvSpec,
    default_pose: Vec<f32>,
}

/// State of an episode of `attitude`.
#[derive(Clone, Debug, Default)]
pub struct AttitudeState {
    walk: WalkState,
    /// Amplitude and frequency [Hz] of roll [rad], pitch [rad] and height [m].
    sines: [[f32; 2]; 3],
    /// Time since the start [s].
    time: f32,
}

impl Attitude {
    /// Creates the task for `robot`. A backend without ground truth has no terms that need it.
    pub fn new(config: AttitudeConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let walk = Walk::new(config.walk.clone(), robot, has_ground_truth)?;
        let mut spec = EnvSpec { task: "attitude".to_owned(), ..walk.spec().clone() };
        let own = if has_ground_truth { &TERMS[..] } else { &TERMS[..1] };
        spec.reward_terms.extend(own.iter().map(ToString::to_string));
        for field in &mut spec.observation {
            if field.name == "velocity_command" {
                "attitude_command".clone_into(&mut field.name);
                "rad, rad, m".clone_into(&mut field.unit);
                "roll and pitch of the base, and its height, at the end of the next step"
                    .clone_into(&mut field.description);
            }
        }
        Ok(Self { default_pose: robot.control.default_pose_f32().to_vec(), walk, spec, config })
    }

    /// Returns roll [rad], pitch [rad] and height [m] of the reference at a time since the start [s].
    fn reference(&self, state: &AttitudeState, time: f32) -> [f32; 3] {
        let [roll, pitch, height] = state.sines.map(|[amplitude, hz]| amplitude * (TAU * hz * time).sin());
        [roll, pitch, self.walk.target_base_height() + height]
    }

    fn policy_dt(&self) -> f32 {
        self.spec.policy_dt as f32
    }
}

/// Returns roll and pitch [rad] of a base with this orientation, a unit quaternion (w, x, y, z). A positive pitch lowers the nose.
pub fn roll_and_pitch(orientation: [f32; 4]) -> [f32; 2] {
    let gravity = frames::projected_gravity(orientation);
    [(-gravity.y).atan2(-gravity.z), gravity.x.clamp(-1.0, 1.0).asin()]
}

impl Task for Attitude {
    type State = AttitudeState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, AttitudeState) {
        let (q, walk) = self.walk.start(random);
        let AttitudeConfig { roll_rad, pitch_rad, height_m, frequency_hz: [low, high], .. } = self.config;
        let sines = [roll_rad, pitch_rad, height_m].map(|largest| {
            [largest * (2.0 * random.random::<f32>() - 1.0), low + (high - low) * random.random::<f32>()]
        });
        (q, AttitudeState { walk, sines, time: 0.0 })
    }

    fn observe(&self, state: &AttitudeState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        observe(robot, self.reference(state, state.time + self.policy_dt()), &self.default_pose, action, obs);
    }

    fn observe_critic(&self, state: &AttitudeState, robot: &RobotView, obs: &mut [f32]) {
        self.walk.observe_critic(&state.walk, robot, obs);
    }

    fn evaluate(&self, state: &mut AttitudeState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        let (config, dt) = (&self.config, self.policy_dt());
        state.time += dt;
        self.walk.set_velocity_command(&mut state.walk, [0.0; 3]);
        let of_walk = self.walk.spec().reward_terms.len();
        let has_fallen = self.walk.evaluate(&mut state.walk, step, random, &mut terms[..of_walk]);
        let [roll, pitch, height] = self.reference(state, state.time);
        let robot = &step.robot;
        let [is_roll, is_pitch] = roll_and_pitch(robot.orientation);
        let error = (roll - is_roll).powi(2) + (pitch - is_pitch).powi(2);
        terms[of_walk] = config.track_attitude * (-error / config.attitude_sigma).exp() * dt;
        if let Some(truth) = &robot.truth {
            let error = (height - base_height(robot, truth)).powi(2);
            terms[of_walk + 1] = config.track_height * (-error / config.height_sigma).exp() * dt;
        }
        has_fallen
    }
}

#[cfg(test)]
mod tests {
    use glam::{EulerRot, Quat};
    use twinstep_model::{Ground, RobotStates, go2, stream};

    use super::*;

    fn task(has_ground_truth: bool) -> Attitude {
        Attitude::new(AttitudeConfig::default(), &go2(), has_ground_truth).expect("valid")
    }

    fn orientation(yaw: f32, pitch: f32, roll: f32) -> [f32; 4] {
        let [x, y, z, w] = Quat::from_euler(EulerRot::ZYX, yaw, pitch, roll).to_array();
        [w, x, y, z]
    }

    #[test]
    fn roll_and_pitch_do_not_depend_on_the_yaw() {
        for yaw in [0.0, 1.0, -2.5] {
            let [roll, pitch] = roll_and_pitch(orientation(yaw, 0.2, -0.3));
            assert!((roll + 0.3).abs() < 1e-6 && (pitch - 0.2).abs() < 1e-6, "{roll} {pitch}");
        }
    }

    #[test]
    fn command_is_the_reference_at_the_end_of_the_step_and_a_robot_there_has_the_full_terms() {
        let (task, ground) = (task(true), Ground::FLAT);
        let mut random = stream(0, "test", 0);
        let mut state = task.start(&mut random).1;
        let mut states = RobotStates::new(1);
        let (mut obs, action) = (vec![f32::NAN; task.spec().obs_len()], [0.0; 12]);
        let mut terms = vec![f32::NAN; task.spec().reward_terms.len()];
        let (mut largest, of_walk) = (0.0f32, task.walk.spec().reward_terms.len());
        for length in 1..=500 {
            let robot = RobotView::of(&states.measured, None, &ground, 0);
            task.observe(&state, &robot, &action, &mut obs);
            let [roll, pitch, height] = [obs[6], obs[7], obs[8]];
            largest = largest.max(roll.abs()).max(pitch.abs());
            states.measured.orientation[0] = orientation(0.4, pitch, roll);
            states.truth.base_position[0] = [0.0, 0.0, height];
            let robot = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
            let step = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length };
            assert!(!task.evaluate(&mut state, &step, &mut random, &mut terms));
            assert!((terms[of_walk] - 0.08).abs() < 1e-4 && (terms[of_walk + 1] - 0.02).abs() < 1e-4, "{terms:?}");
        }
        assert!((0.05..=0.3).contains(&largest), "{largest} rad");
    }

    #[test]
    fn robot_and_its_simulation_agree_and_only_the_simulation_knows_the_height() {
        let (simulated, real) = (task(true), task(false));
        assert_eq!(simulated.spec().hash(), real.spec().hash());
        assert!(real.spec().reward_terms.ends_with(&["track_attitude".to_owned()]), "{:?}", real.spec().reward_terms);
        assert_eq!(simulated.spec().observation_entry(7), "attitude_command[1]");
    }
}
