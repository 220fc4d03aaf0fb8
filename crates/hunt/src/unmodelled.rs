//! Effects outside the catalogue: laws between the logged commands and the robot.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use twinstep_model::{
    Backend, BackendError, Command, Ground, GroundTruth, InitialState, Joint, Measured, PerJoint, Restorable,
    RobotModel, RobotStates, Simulator,
};

use crate::base_schedule::BaseSchedule;

/// Effect outside the catalogue. Joints are given by their index.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UnmodelledEffect {
    /// A fraction of one joint's torque also acts on another joint, behind the current sensor.
    CrossTalk { from: usize, into: usize, share: f64 },
    /// Friction of this torque [N·m] while the joint moves in its positive direction, none in the other.
    OneWayFriction { joint: usize, torque: f64 },
    /// External torque of this amplitude [N·m] and frequency [Hz].
    Disturbance { joint: usize, amplitude: f64, frequency: f64 },
    /// The position gain grows with the error e [rad] by the factor 1 + `cubic`·e².
    HardeningGain { joint: usize, cubic: f64 },
    /// Encoder whose reading drifts at this rate [rad/s].
    EncoderDrift { joint: usize, rate: f64 },
}

impl UnmodelledEffect {
    /// Samples an effect that is visible with this mounting of the base.
    pub fn draw(place: BaseSchedule, random: &mut impl Rng) -> Self {
        let joint = random.random_range(0..12);
        match random.random_range(0..5) {
            0 => {
                // Between joints of one leg, as with cables and gears.
                let into = 3 * (joint / 3) + (joint + random.random_range(1..3)) % 3;
                UnmodelledEffect::CrossTalk { from: joint, into, share: random.random_range(0.15..0.4) }
            }
            1 => {
                let (amplitude, frequency) = (random.random_range(0.4..1.2), random.random_range(1.0..7.0));
                UnmodelledEffect::Disturbance { joint, amplitude, frequency }
            }
            // Needs large position errors, which occur only in the steps with a fixed base.
            3 if place != BaseSchedule::Floating => {
                UnmodelledEffect::HardeningGain { joint, cubic: random.random_range(8.0..25.0) }
            }
            // With a fixed base, the drift changes only the gravity torque, by the cosine of a small angle.
            4 if place != BaseSchedule::Fixed => {
                UnmodelledEffect::EncoderDrift { joint, rate: random.random_range(0.0015..0.004) }
            }
            _ => UnmodelledEffect::OneWayFriction { joint, torque: random.random_range(0.4..1.2) },
        }
    }

    /// True if `text`, a channel or a sentence, names what the residual of this effect depends on.
    pub fn depends_on(self, text: &str) -> bool {
        let of = |joint: usize, quantities: &[&str]| {
            quantities.iter().any(|quantity| text == format!("{quantity}_{}", Joint::ALL[joint].name()))
        };
        let all = ["q", "dq", "q_cmd", "dq_cmd", "q_error", "tau", "tau_measured", "tau_cmd"];
        match self {
            UnmodelledEffect::CrossTalk { from, .. } => of(from, &all),
            UnmodelledEffect::OneWayFriction { joint, .. } | UnmodelledEffect::HardeningGain { joint, .. } => {
                of(joint, &all)
            }
            UnmodelledEffect::Disturbance { frequency, .. } => {
                frequencies(text).any(|found| (found / frequency - 1.0).abs() < 0.05)
            }
            UnmodelledEffect::EncoderDrift { joint, .. } => text == "t" || of(joint, &["q"]),
        }
    }

    /// Changes `command` as the effect does at `time` [s], given the measured states.
    ///
    /// Returns the part of the torque that the current sensors do not measure, by joint [N·m].
    fn apply(self, command: &mut Command, measured: &Measured, time: f64) -> [f32; 12] {
        let mut unmeasured = [0.0; 12];
        match self {
            UnmodelledEffect::CrossTalk { from, into, share } => {
                unmeasured[into] = share as f32 * measured.tau[0][from];
            }
            UnmodelledEffect::OneWayFriction { joint, torque } => {
                // Full friction from 0.1 rad/s on: a step at rest would chatter at the actuator rate.
                unmeasured[joint] = -(torque as f32) * (measured.dq[0][joint] / 0.1).clamp(0.0, 1.0);
            }
            UnmodelledEffect::Disturbance { joint, amplitude, frequency } => {
                unmeasured[joint] = (amplitude * (TAU * frequency * time).sin()) as f32;
            }
            UnmodelledEffect::HardeningGain { joint, cubic } => {
                let error = command.q[joint] - measured.q[0][joint];
                command.tau_ff[joint] += command.kp[joint] * cubic as f32 * error.powi(3);
            }
            UnmodelledEffect::EncoderDrift { joint, rate } => command.q[joint] -= (rate * time) as f32,
        }
        for (feed_forward, more) in command.tau_ff.iter_mut().zip(unmeasured) {
            *feed_forward += more;
        }
        unmeasured
    }
}

/// Returns the numbers before `Hz` in a text.
fn frequencies(text: &str) -> impl Iterator<Item = f64> + '_ {
    let before = text.match_indices("Hz").map(|(start, _)| text[..start].trim_end());
    before.filter_map(|before| {
        let number = before.rsplit(|character: char| !(character.is_ascii_digit() || character == '.')).next()?;
        number.parse().ok()
    })
}

/// Backend of one robot with an effect outside the catalogue.
pub struct PerturbedBackend<S> {
    inner: S,
    outside: Option<UnmodelledEffect>,
    /// States as the sensors measure them.
    states: RobotStates,
    time: f64,
}

impl<S: Simulator> PerturbedBackend<S> {
    /// Creates the backend with the effect `outside`.
    pub fn new(inner: S, outside: Option<UnmodelledEffect>) -> Self {
        let states = inner.states().clone();
        Self { inner, outside, states, time: 0.0 }
    }

    fn update_measured(&mut self, unmeasured: [f32; 12]) {
        self.states = self.inner.states().clone();
        for (torque, unmeasured) in self.states.measured.tau[0].iter_mut().zip(unmeasured) {
            *torque -= unmeasured;
        }
        if let Some(UnmodelledEffect::EncoderDrift { joint, rate }) = self.outside {
            self.states.measured.q[0][joint] += (rate * self.time) as f32;
        }
    }
}

impl<S: Simulator> Backend for PerturbedBackend<S> {
    fn robot(&self) -> &RobotModel {
        self.inner.robot()
    }

    fn measured(&self) -> &Measured {
        &self.states.measured
    }

    fn ground_truth(&self) -> Option<&GroundTruth> {
        Some(&self.states.truth)
    }

    fn ground(&self) -> Ground {
        self.inner.ground()
    }

    fn reset(&mut self, placements: &[(usize, InitialState)]) -> Result<(), BackendError> {
        self.inner.reset(placements)?;
        self.update_measured([0.0; 12]);
        Ok(())
    }

    fn reset_with_model(
        &mut self,
        robot: usize,
        model: &RobotModel,
        placement: &InitialState,
    ) -> Result<(), BackendError> {
        self.inner.reset_with_model(robot, model, placement)?;
        self.update_measured([0.0; 12]);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        for _ in 0..actuator_periods {
            let mut command = commands[0];
            let unmeasured =
                self.outside.map_or([0.0; 12], |outside| outside.apply(&mut command, &self.states.measured, self.time));
            self.inner.step(&[command], active, 1)?;
            self.time += self.inner.robot().control.actuator_dt();
            self.update_measured(unmeasured);
        }
        Ok(())
    }
}

impl<S: Simulator> Simulator for PerturbedBackend<S> {
    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn set_derating(&mut self, robot: usize, factors: &PerJoint) {
        self.inner.set_derating(robot, factors);
    }
}

impl<S: Restorable> Restorable for PerturbedBackend<S> {
    type Snapshot = (S::Snapshot, RobotStates, f64);

    fn snapshot(&self, robot: usize) -> Self::Snapshot {
        (self.inner.snapshot(robot), self.states.clone(), self.time)
    }

    fn restore(&mut self, robot: usize, (inner, states, time): &Self::Snapshot) {
        self.inner.restore(robot, inner);
        (self.states, self.time) = (states.clone(), *time);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frequency_is_found_in_a_sentence() {
        let law = UnmodelledEffect::Disturbance { joint: 3, amplitude: 0.5, frequency: 3.1 };
        assert!(law.depends_on("a line at 3.05 Hz on FR_hip"));
        assert!(law.depends_on("t@3.1Hz"));
        assert!(!law.depends_on("a line at 6.2 Hz") && !law.depends_on("q_FR_hip"));
    }

    #[test]
    fn cross_talk_depends_on_its_source_joint() {
        let law = UnmodelledEffect::CrossTalk { from: 1, into: 2, share: 0.2 };
        assert!(law.depends_on("tau_FL_thigh") && !law.depends_on("tau_FL_calf"));
    }

    #[test]
    fn one_way_friction_acts_in_the_positive_direction_only() {
        let mut measured = RobotStates::new(1).measured;
        let law = UnmodelledEffect::OneWayFriction { joint: 0, torque: 1.0 };
        for (speed, expected) in [(2.0, -1.0), (0.05, -0.5), (0.0, 0.0), (-2.0, 0.0)] {
            measured.dq[0][0] = speed;
            let mut command = Command::hold([0.0; 12], 30.0, 0.0);
            assert_eq!(law.apply(&mut command, &measured, 0.0)[0], expected, "at {speed} rad/s");
            assert_eq!(command.tau_ff[0], expected);
        }
    }
}
