//! The task `gait`: the robot follows a velocity command with a commanded gait (Margolis and Agrawal 2022, Walk These Ways).
//!
//! The observation is that of `walk`, the step frequency, the phase offsets of the feet, and the phases of the feet. None of
//! it needs motion capture.

use rand::RngExt;
use twinstep_model::{EnvSpec, Feet, GaitCommand, RobotModel, SpecField, Stream};

use super::gait_clock::GaitClock;
use super::gait_config::{GaitConfig, RewardWeights};
use super::gait_reward::RewardInput;
use super::walk::{Walk, WalkState};
use crate::config::ConfigError;
use crate::feet::{foot_states, per_leg};
use crate::observation::OBS_LEN;
use crate::task::{RobotView, Step, Task, Truth};

/// The task `gait` on one robot model.
#[derive(Clone, Debug)]
pub struct GaitTask {
    config: GaitConfig,
    walk: Walk,
    spec: EnvSpec,
    feet: Feet,
    foot_radius: f32,
    has_ground_truth: bool,
    resample_steps: u32,
}

/// State of an episode of `gait`.
#[derive(Clone, Debug, Default)]
pub struct GaitState {
    walk: WalkState,
    clock: GaitClock,
    /// Policy steps until the next gait; `None` while the agent sets it.
    steps_to_gait: Option<u32>,
}

impl GaitTask {
    /// Creates the task for `robot`. A backend without ground truth has none of the terms that `walk` does not have.
    pub fn new(config: GaitConfig, robot: &RobotModel, has_ground_truth: bool) -> Result<Self, ConfigError> {
        config.check()?;
        let walk = Walk::new(config.walk.clone(), robot, has_ground_truth)?;
        let mut spec = EnvSpec { task: "gait".to_owned(), ..walk.spec().clone() };
        spec.observation.extend([
            field("step_frequency", 1, "Hz", 0.0, 10.0, "commanded cycles per second of each foot"),
            field("phase_offset", 3, "cycles", 0.0, 1.0, "commanded phases of FR, RL and RR relative to FL"),
            field(
                "foot_phase",
                8,
                "",
                -1.0,
                1.0,
                "sine, then cosine, of the phase angles of FL, FR, RL, RR; a foot touches down at angle 0",
            ),
        ]);
        if has_ground_truth {
            spec.reward_terms.extend(RewardWeights::NAMES.iter().map(|name| (*name).to_owned()));
        }
        let resample_steps = (config.walk.command_resample_s / spec.policy_dt as f32).round().max(1.0) as u32;
        Ok(Self {
            feet: Feet::from(robot),
            foot_radius: robot.shapes.foot_radius as f32,
            has_ground_truth,
            resample_steps,
            walk,
            spec,
            config,
        })
    }

    /// Draws gait and step frequency. The phase of FL continues.
    fn draw_gait(&self, clock: &mut GaitClock, random: &mut Stream) {
        let [low, high] = self.config.step_frequency_hz;
        let gait = self.config.gaits[random.random_range(0..self.config.gaits.len())];
        clock.step_frequency = low + (high - low) * random.random::<f32>();
        clock.phase_offset = gait.phase_offset();
    }

    fn reward_input<'a>(&self, clock: &GaitClock, robot: &RobotView, truth: &Truth<'a>) -> RewardInput<'a> {
        let (phases, schedule) = (clock.foot_phases(), self.config.schedule());
        let feet = foot_states(&self.feet, robot, truth);
        let height = |phase| self.foot_radius + self.config.swing_height_m * schedule.swing_height(phase);
        RewardInput {
            policy_dt: self.spec.policy_dt as f32,
            desired_contact: phases.map(|phase| schedule.desired_contact(phase)),
            foot_force: truth.foot_force,
            foot_speed: per_leg(feet.iter().map(|foot| foot.horizontal_speed.hypot(foot.vertical_velocity))),
            foot_height: per_leg(feet.iter().map(|foot| foot.height)),
            target_foot_height: phases.map(height),
            force_sigma: self.config.force_sigma,
            velocity_sigma: self.config.velocity_sigma,
        }
    }
}

fn field(name: &str, size: usize, unit: &str, low: f32, high: f32, text: &str) -> SpecField {
    SpecField { name: name.to_owned(), size, unit: unit.to_owned(), low, high, description: text.to_owned() }
}

impl Task for GaitTask {
    type State = GaitState;

    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn start(&self, random: &mut Stream) -> (Vec<f32>, GaitState) {
        let (q, walk) = self.walk.start(random);
        let mut clock = GaitClock { phase: random.random(), ..GaitClock::default() };
        self.draw_gait(&mut clock, random);
        (q, GaitState { walk, clock, steps_to_gait: Some(random.random_range(1..=self.resample_steps)) })
    }

    fn observe(&self, state: &GaitState, robot: &RobotView, action: &[f32], obs: &mut [f32]) {
        let (of_walk, own) = obs.split_at_mut(OBS_LEN);
        self.walk.observe(&state.walk, robot, action, of_walk);
        own[0] = state.clock.step_frequency;
        own[1..4].copy_from_slice(&state.clock.phase_offset);
        own[4..].copy_from_slice(&state.clock.sin_cos());
    }

    fn observe_critic(&self, state: &GaitState, robot: &RobotView, obs: &mut [f32]) {
        self.walk.observe_critic(&state.walk, robot, obs);
    }

    fn evaluate(&self, state: &mut GaitState, step: &Step, random: &mut Stream, terms: &mut [f32]) -> bool {
        state.clock.advance(self.spec.policy_dt as f32);
        let (of_walk, own) = terms.split_at_mut(self.walk.spec().reward_terms.len());
        let has_fallen = self.walk.evaluate(&mut state.walk, step, random, of_walk);
        if let Some(truth) = step.robot.truth.as_ref().filter(|_| self.has_ground_truth) {
            let input = self.reward_input(&state.clock, &step.robot, truth);
            own.copy_from_slice(&self.config.reward.evaluate(&input));
        }
        state.steps_to_gait = state.steps_to_gait.map(|steps| steps.saturating_sub(1));
        if state.steps_to_gait == Some(0) {
            state.steps_to_gait = Some(self.resample_steps);
            self.draw_gait(&mut state.clock, random);
        }
        has_fallen
    }

    fn velocity_command(&self, state: &GaitState) -> Option<[f32; 3]> {
        self.walk.velocity_command(&state.walk)
    }

    fn set_velocity_command(&self, state: &mut GaitState, command: [f32; 3]) {
        self.walk.set_velocity_command(&mut state.walk, command);
    }

    fn set_gait_command(&self, state: &mut GaitState, [step_frequency, phase_offset @ ..]: GaitCommand) {
        state.clock = GaitClock { step_frequency, phase_offset, ..state.clock };
        state.steps_to_gait = None;
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, RobotStates, go2, stream};

    use super::*;
    use crate::tasks::gait_clock::Gait;

    fn task(has_ground_truth: bool) -> GaitTask {
        let config = GaitConfig { gaits: vec![Gait::Trot], step_frequency_hz: [2.5, 2.5], ..GaitConfig::default() };
        GaitTask::new(config, &go2(), has_ground_truth).expect("valid")
    }

    /// Returns a robot that stands in the default pose.
    fn standing() -> RobotStates {
        let mut states = RobotStates::new(1);
        states.measured.q[0] = go2().control.default_pose_f32();
        states.truth.base_position[0] = [0.0, 0.0, 0.3];
        states.truth.foot_force[0] = [35.0; 4];
        states
    }

    #[test]
    fn clock_of_the_observation_advances_with_the_step_frequency() {
        let (task, ground, states) = (task(true), Ground::FLAT, standing());
        let mut random = stream(0, "test", 0);
        let mut state = task.start(&mut random).1;
        let start = state.clock.phase;
        let (mut obs, action) = (vec![f32::NAN; task.spec().obs_len()], [0.0; 12]);
        let mut terms = vec![f32::NAN; task.spec().reward_terms.len()];
        let robot = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        for length in 1..=10 {
            let step = Step { robot, action: &action, previous_action: &action, previous_dq: &action, length };
            assert!(!task.evaluate(&mut state, &step, &mut random, &mut terms));
        }
        task.observe(&state, &robot, &action, &mut obs);
        assert_eq!((obs.len(), &obs[45..49]), (57, &[2.5, 0.5, 0.5, 0.0][..]));
        // 10 steps are 0.2 s, half a cycle.
        let angle = std::f32::consts::TAU * (start + 0.5);
        assert!((obs[49] - angle.sin()).abs() < 1e-3 && (obs[53] - angle.cos()).abs() < 1e-3, "{:?}", &obs[49..]);
        assert!((obs[50] + obs[49]).abs() < 1e-5 && (obs[52] - obs[49]).abs() < 1e-5, "diagonal pairs");
    }

    #[test]
    fn standing_robot_has_the_velocity_term_and_half_of_its_feet_are_too_heavy() {
        let (task, ground, states) = (task(true), Ground::FLAT, standing());
        let robot = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        let clock = GaitClock { phase: 0.25, step_frequency: 2.5, phase_offset: Gait::Trot.phase_offset() };
        let terms = task.config.reward.evaluate(&task.reward_input(&clock, &robot, &robot.truth.expect("a simulator")));
        // Two of four feet are to be on the ground.
        assert!(terms[0] < 1e-3 && (terms[1] - 4.0 * 0.5 * 0.02).abs() < 2e-3, "{terms:?}");
        let feet: Vec<_> = task.feet.motions(&states.measured.q[0], &[0.0; 12]).collect();
        let error = |leg: usize| (feet[leg].position.z + 0.3 - task.foot_radius - 0.08).powi(2);
        // FR and RL are in the middle of their swing phases.
        let expected = -30.0 * (error(1) + error(2)) * 0.02;
        assert!((terms[2] - expected).abs() < 0.02 * expected.abs(), "{} is not {expected}", terms[2]);
    }

    #[test]
    fn robot_and_its_simulation_agree_and_an_empty_list_of_gaits_is_refused() {
        let (simulated, real) = (task(true), task(false));
        assert_eq!(simulated.spec().hash(), real.spec().hash());
        assert!(!real.spec().reward_terms.iter().any(|name| name == "contact_force"));
        let none = GaitConfig { gaits: Vec::new(), ..GaitConfig::default() };
        let error = GaitTask::new(none, &go2(), true).expect_err("no gait").to_string();
        assert_eq!(error, "`task.gaits` = [] is not allowed: at least one of trot, pace, bound, pronk");
    }
}
