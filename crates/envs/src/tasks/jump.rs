//! The task `jump`: the robot jumps to a target on the ground, once, from standing (U2E, §IV-B).
//!
//! The observation is that of `walk` with a zero command, the phase of the jump, and the target relative to the pose at
//! the start. None of it needs motion capture. The landing is the pose of the base at the first contact of a foot after
//! all feet were off the ground for at least 60 ms ([`Flight`]).

use glam::Vec3;
use rand::RngExt;
use twinstep_model::{EnvSpec, Feet, RobotModel, SpecField, Stream, frames};

use super::jump_config::{JumpConfig, RewardWeights};
use super::jump_flight::{Flight, JumpMotion, Stage};
use super::jump_reward::{LandingError, RewardInput};
use super::walk::{Walk, WalkState};
use crate::config::{ConfigError, Range};
use crate::feet::{foot_states, per_leg};
use crate::observation::{CRITIC_OBS_LEN, OBS_LEN, observe, observe_privileged};
use crate::path::GroundPose;
use crate::task::{RobotView, Step, Task, Truth};

/// Bound of the target and of errors in the observation [m, rad].
const TARGET_BOUND: f32 = 5.0;
/// Height of the base above the ground at the predicted landing [m].
const LANDING_HEIGHT: f32 = 0.28;

/// The task `jump` on one robot model.
#[derive(Clone, Debug)]
pub struct Jump {
    config: JumpConfig,
    walk: Walk,
    spec: EnvSpec,
    has_ground_truth: bool,
    default_pose: Vec<f32>,
    feet: Feet,
    foot_radius: f32,
}

/// State of an episode of `jump`.
#[derive(Clone, Debug, Default)]
pub struct JumpState {
    walk: WalkState,
    flight: Flight,
    /// Time since the start [s].
    time: f32,
    /// The target relative to the start, which is the origin of the world.
    target: GroundPose,
    /// Error of the landing: predicted from the motion until the robot has landed.
    error: LandingError,
}

impl Jump {
    /// Creates the task for `robot`. A backend without ground truth has none of the terms that `walk` does not have.
    pub fn new(config: JumpConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let walk = Walk::new(config.walk.clone(), robot, has_ground_truth)?;
        let mut spec = EnvSpec { task: "jump".to_owned(), ..walk.spec().clone() };
        for field in &mut spec.observation {
            if field.name == "velocity_command" {
                "no_velocity_command".clone_into(&mut field.name);
                "zero; `walk` has its command here".clone_into(&mut field.description);
            }
        }
        spec.observation.extend([
            field("phase", 1, "", 0.0, 1.0, "time since the start in units of `task.phase_s`, at most 1"),
            field(
                "landing_target",
                3,
                "m, m, rad",
                -TARGET_BOUND,
                TARGET_BOUND,
                "target relative to the pose at the start: forward, left, yaw",
            ),
        ]);
        if has_ground_truth {
            spec.reward_terms.extend(RewardWeights::NAMES.iter().map(|name| (*name).to_owned()));
            spec.critic_observation.extend([
                field("jump_stage", 2, "", 0.0, 1.0, "1 in flight, else 0; 1 after the landing, else 0"),
                field("landing_error", 2, "m, rad", 0.0, TARGET_BOUND, "distance and angle of the landing, predicted"),
            ]);
        }
        Ok(Self {
            default_pose: robot.control.default_pose_f32().to_vec(),
            feet: Feet::from(robot),
            foot_radius: robot.shapes.foot_radius as f32,
            has_ground_truth,
            walk,
            spec,
            config,
        })
    }

    fn motion(&self, robot: &RobotView, truth: &Truth) -> (JumpMotion, [f32; 4]) {
        let world_from_base = frames::world_from_base(robot.orientation);
        let base = Vec3::from(truth.base_position);
        let angular_velocity = world_from_base * Vec3::from(truth.base_angular_velocity);
        let feet = foot_states(&self.feet, robot, truth);
        let forward = world_from_base * Vec3::X;
        let motion = JumpMotion {
            pose: GroundPose { x: base.x, y: base.y, yaw: forward.y.atan2(forward.x) },
            height: base.z - robot.ground.height(base.x, base.y),
            velocity: truth.base_linear_velocity,
            yaw_rate: angular_velocity.z,
            foot_clearance: per_leg(feet.iter().map(|foot| (foot.height - self.foot_radius).max(0.0))),
            foot_velocity_z: per_leg(feet.iter().map(|foot| foot.vertical_velocity)),
            foot_force: per_leg(truth.foot_force.iter().copied()),
        };
        (motion, per_leg(self.feet.motions(robot.q, robot.dq).map(|foot| foot.position.z)))
    }

    /// Returns the terms that `walk` does not have, and advances the jump.
    fn evaluate_jump(
        &self,
        state: &mut JumpState,
        robot: &RobotView,
        truth: &Truth,
    ) -> [f32; RewardWeights::NAMES.len()] {
        let (config, policy_dt) = (&self.config, self.spec.policy_dt as f32);
        let (motion, foot_z) = self.motion(robot, truth);
        let lands = state.flight.update(&motion, policy_dt);
        let pose = state.flight.landing().unwrap_or_else(|| motion.landing_at(LANDING_HEIGHT));
        let [dx, dy, yaw] = pose.relative_to(state.target);
        state.error = LandingError { distance: dx.hypot(dy), yaw: yaw.abs() };
        let stage = state.flight.stage();
        let flight_time = 2.0 * config.takeoff_velocity_z / 9.81;
        let [vx, vy, vz] = motion.velocity;
        config.reward.evaluate(&RewardInput {
            policy_dt,
            stage,
            may_take_off: stage == Stage::BeforeTakeOff && state.time < config.takeoff_s,
            lands,
            landing_error: state.error,
            takeoff_error_xy: (vx - state.target.x / flight_time).hypot(vy - state.target.y / flight_time),
            takeoff_error_z: vz - config.takeoff_velocity_z,
            takeoff_error_yaw: motion.yaw_rate - state.target.yaw / flight_time,
            foot_z,
            target_foot_z: config.target_foot_z_m,
            q: robot.q,
            default_pose: &self.default_pose,
            speed: vx.hypot(vy),
        })
    }
}

fn field(name: &str, size: usize, unit: &str, low: f32, high: f32, text: &str) -> SpecField {
    SpecField { name: name.to_owned(), size, unit: unit.to_owned(), low, high, description: text.to_owned() }
}

fn draw([low, high]: Range, random: &mut Stream) -> f32 {
    low + (high - low) * random.random::<f32>()
}

impl Task for Jump {
    type State = JumpState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, JumpState) {
        let (q, mut walk) = self.walk.start(random);
        self.walk.set_velocity_command(&mut walk, [0.0; 3]);
        let JumpConfig { target_x_m, target_y_m, target_yaw_rad, .. } = self.config;
        let target =
            GroundPose { x: draw(target_x_m, random), y: draw(target_y_m, random), yaw: draw(target_yaw_rad, random) };
        (q, JumpState { walk, target, ..JumpState::default() })
    }

    fn observe(&self, state: &JumpState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        observe(robot, [0.0; 3], &self.default_pose, action, obs);
        let GroundPose { x, y, yaw } = state.target;
        let phase = (state.time / self.config.phase_s).min(1.0);
        obs[OBS_LEN..].copy_from_slice(&[phase, x, y, yaw]);
    }

    fn observe_critic(&self, state: &JumpState, robot: &RobotView, obs: &mut [f32]) {
        let Some(truth) = &robot.truth else { return };
        observe_privileged(robot, truth, obs);
        let stage = |stage| f32::from(u8::from(state.flight.stage() == stage));
        let LandingError { distance, yaw } = state.error;
        let error = [distance, yaw].map(|value| value.min(TARGET_BOUND));
        obs[CRITIC_OBS_LEN..].copy_from_slice(&[stage(Stage::Flight), stage(Stage::Landed), error[0], error[1]]);
    }

    fn evaluate(&self, state: &mut JumpState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        state.time += self.spec.policy_dt as f32;
        let (of_walk, own) = terms.split_at_mut(self.walk.spec().reward_terms.len());
        let has_fallen = self.walk.evaluate(&mut state.walk, step, random, of_walk);
        if let Some(truth) = step.robot.truth.as_ref().filter(|_| self.has_ground_truth) {
            own.copy_from_slice(&self.evaluate_jump(state, &step.robot, truth));
        }
        has_fallen
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, RobotStates, go2, stream};

    use super::*;

    fn task(has_ground_truth: bool) -> Jump {
        let config = JumpConfig { target_x_m: [0.6, 0.6], ..JumpConfig::default() };
        Jump::new(config, &go2(), has_ground_truth).expect("valid")
    }

    /// Returns a robot in the default pose that jumps with 1.5 m/s forward and 2 m/s upward, `time` after its take-off.
    fn jumping_robot(time: f32) -> RobotStates {
        let mut states = RobotStates::new(1);
        let height = (2.0 * time - 4.905 * time * time).clamp(0.0, 1.0);
        let robot = go2();
        let q = robot.control.default_pose_f32();
        let foot = Feet::from(&robot).motions(&q, &[0.0; 12]).next().expect("four");
        let foot = foot.position.z - robot.shapes.foot_radius as f32;
        states.measured.q[0] = q;
        states.truth.base_position[0] = [1.5 * time.max(0.0), 0.0, height - foot];
        states.truth.base_linear_velocity[0] = [1.5, 0.0, 2.0 - 9.81 * time];
        states.truth.foot_force[0] = if height > 0.0 { [0.0; 4] } else { [40.0; 4] };
        states
    }

    /// Returns the terms of every step of the jump, by name.
    fn jump(task: &Jump) -> (JumpState, Vec<impl Fn(&str) -> f32>) {
        let mut random = stream(0, "test", 0);
        let mut state = task.start(&mut random).1;
        let names = &task.spec().reward_terms;
        let steps = (-5..40).map(|step| {
            let states = jumping_robot(0.02 * step as f32 + 0.005);
            let robot = RobotView::of(&states.measured, Some(&states.truth), &Ground::FLAT, 0);
            let action = [0.0; 12];
            let input = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
            let mut terms = vec![f32::NAN; names.len()];
            assert!(!task.evaluate(&mut state, &input, &mut random, &mut terms));
            move |name: &str| terms[names.iter().position(|other| other == name).expect("a term")]
        });
        let steps = steps.collect();
        (state, steps)
    }

    #[test]
    fn landing_of_a_jump_is_rewarded_once_at_the_place_of_a_projectile() {
        let task = task(true);
        let (state, steps) = jump(&task);
        // 2 · 2 m/s / g in the air.
        let landing = state.flight.landing().expect("landed").x;
        assert!((landing - 0.6116).abs() < 1e-3, "{landing}");
        assert!((state.error.distance - 0.0116).abs() < 1e-3 && state.error.yaw == 0.0);
        let sum = |name: &str| steps.iter().map(|terms| terms(name)).sum::<f32>();
        assert!((sum("landing_position") - 5.0 * (-0.0116f32 / 0.15).exp()).abs() < 0.01, "one landing");
        assert_eq!(sum("success"), 5.0);
        // 21 steps in the air, of which the third is the first of the flight.
        assert!((sum("in_air") - 6.0 * 0.38).abs() < 1e-4, "{}", sum("in_air"));
        assert_eq!(steps[3]("recovery"), 0.0, "not before the landing");
        assert!(steps[44]("recovery") > 0.0 && sum("symmetry") == 0.0);
    }

    #[test]
    fn motion_of_a_turned_and_pitching_robot_is_in_the_world_frame() {
        let (task, ground) = (task(true), Ground::FLAT);
        let mut states = jumping_robot(0.1);
        let half = std::f32::consts::FRAC_PI_4;
        states.measured.orientation[0] = [half.cos(), 0.0, 0.0, half.sin()];
        states.truth.base_angular_velocity[0] = [0.0, 3.0, 0.7];
        let robot = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        let (motion, foot_z) = task.motion(&robot, &robot.truth.expect("a simulator"));
        assert!((motion.pose.yaw - 2.0 * half).abs() < 1e-6 && (motion.yaw_rate - 0.7).abs() < 1e-6);
        // Nose down: v_z = v_z of the base − ω_y · x of the foot in the base frame.
        let feet: Vec<_> = task.feet.motions(&states.measured.q[0], &states.measured.dq[0]).collect();
        for leg in 0..4 {
            let expected = states.truth.base_linear_velocity[0][2] - 3.0 * feet[leg].position.x;
            assert!((motion.foot_velocity_z[leg] - expected).abs() < 1e-5, "{motion:?}");
            assert_eq!(foot_z[leg], feet[leg].position.z);
        }
    }

    #[test]
    fn observation_has_phase_and_target_and_no_command() {
        let (task, ground) = (task(true), Ground::FLAT);
        let (state, _) = jump(&task);
        let states = jumping_robot(0.1);
        let robot = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        let mut obs = vec![f32::NAN; task.spec().obs_len()];
        task.observe(&state, &robot, &[0.0; 12], &mut obs);
        // 45 steps of 20 ms, and 1 s from phase 0 to 1.
        assert!((obs[45] - 0.9).abs() < 1e-4 && obs[46..] == [0.6, 0.0, 0.0] && obs[6..9] == [0.0; 3], "{obs:?}");
        let mut critic = vec![f32::NAN; task.spec().critic_obs_len()];
        task.observe_critic(&state, &robot, &mut critic);
        assert!(critic.iter().all(|entry| entry.is_finite()) && critic[11..13] == [0.0, 1.0], "{critic:?}");
    }

    #[test]
    fn robot_and_its_simulation_have_the_same_observation() {
        let (simulated, real) = (task(true), task(false));
        assert_eq!(real.spec().hash(), simulated.spec().hash());
        assert!(!real.spec().reward_terms.iter().any(|name| name == "success"));
        let states = RobotStates::new(1);
        let robot = RobotView::of(&states.measured, None, &Ground::FLAT, 0);
        let (action, mut random) = ([0.0; 12], stream(0, "test", 0));
        let mut state = real.start(&mut random).1;
        let input = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length: 1 };
        let mut terms = vec![f32::NAN; real.spec().reward_terms.len()];
        assert!(!real.evaluate(&mut state, &input, &mut random, &mut terms));
        assert!(terms.iter().all(|term| term.is_finite()));
    }
}
