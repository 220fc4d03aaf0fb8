//! What no effect of the catalogue is: laws that only this game knows, between the commands that are logged and the robot.

use std::f64::consts::TAU;

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use twinstep_model::{Backend, BackendError, Command, Ground, InitialState, Joint, RobotModel, RobotStates};

use crate::draw::BaseSchedule;

/// A law outside the catalogue. Joints by their index.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UnmodelledEffect {
    /// A share of one joint's torque acts on another one too, behind the current's sensor.
    CrossTalk { from: usize, into: usize, share: f64 },
    /// Friction of this torque [N·m] while the joint moves in its positive direction, none in the other.
    OneWayFriction { joint: usize, torque: f64 },
    /// A torque from outside, of this amplitude [N·m] and frequency [Hz].
    Disturbance { joint: usize, amplitude: f64, frequency: f64 },
    /// The position gain grows with the error e [rad] by the factor 1 + `cubic`·e².
    HardeningGain { joint: usize, cubic: f64 },
    /// Actuator and log see a position that drifts away [rad/s].
    EncoderDrift { joint: usize, rate: f64 },
}

impl UnmodelledEffect {
    /// Any of them, on a joint that works in this place.
    pub fn draw(place: BaseSchedule, random: &mut impl Rng) -> Self {
        let joint = random.random_range(0..12);
        match random.random_range(0..5) {
            0 => {
                // Along a leg, as cables and gears do it.
                let into = 3 * (joint / 3) + (joint + random.random_range(1..3)) % 3;
                UnmodelledEffect::CrossTalk { from: joint, into, share: random.random_range(0.15..0.4) }
            }
            1 => {
                let (amplitude, frequency) = (random.random_range(0.4..1.2), random.random_range(1.0..7.0));
                UnmodelledEffect::Disturbance { joint, amplitude, frequency }
            }
            // On the ground only steps in the air have errors that are large.
            3 if place != BaseSchedule::Floating => {
                UnmodelledEffect::HardeningGain { joint, cubic: random.random_range(8.0..25.0) }
            }
            // With the trunk held nothing but gravity, by so much as a cosine, shows where an encoder has drifted to.
            4 if place != BaseSchedule::Fixed => {
                UnmodelledEffect::EncoderDrift { joint, rate: random.random_range(0.0015..0.004) }
            }
            _ => UnmodelledEffect::OneWayFriction { joint, torque: random.random_range(0.4..1.2) },
        }
    }

    /// True if `told`, a channel or a sentence, is what this depends on.
    pub fn depends_on(self, told: &str) -> bool {
        let of = |joint: usize, quantities: &[&str]| {
            quantities.iter().any(|quantity| told == format!("{quantity}_{}", Joint::ALL[joint].name()))
        };
        let all = ["q", "dq", "q_cmd", "dq_cmd", "tau", "tau_measured", "tau_cmd"];
        match self {
            UnmodelledEffect::CrossTalk { from, .. } => of(from, &all),
            UnmodelledEffect::OneWayFriction { joint, .. } | UnmodelledEffect::HardeningGain { joint, .. } => {
                of(joint, &all)
            }
            UnmodelledEffect::Disturbance { frequency, .. } => {
                frequencies(told).any(|found| (found / frequency - 1.0).abs() < 0.05)
            }
            UnmodelledEffect::EncoderDrift { joint, .. } => told == "t" || of(joint, &["q"]),
        }
    }

    /// What the robot is told instead of `command`, and the torque in it that no current makes, by joint; `seen` is what
    /// the actuators have measured of it, at `time` [s].
    fn apply(self, command: &mut Command, seen: &RobotStates, time: f64) -> [f32; 12] {
        let mut unseen = [0.0; 12];
        match self {
            UnmodelledEffect::CrossTalk { from, into, share } => unseen[into] = share as f32 * seen.tau[0][from],
            UnmodelledEffect::OneWayFriction { joint, torque } => {
                // Full friction from 0.1 rad/s on: a step at rest would chatter at the actuator rate.
                unseen[joint] = -(torque as f32) * (seen.dq[0][joint] / 0.1).clamp(0.0, 1.0);
            }
            UnmodelledEffect::Disturbance { joint, amplitude, frequency } => {
                unseen[joint] = (amplitude * (TAU * frequency * time).sin()) as f32;
            }
            UnmodelledEffect::HardeningGain { joint, cubic } => {
                let error = command.q[joint] - seen.q[0][joint];
                command.tau_ff[joint] += command.kp[joint] * cubic as f32 * error.powi(3);
            }
            UnmodelledEffect::EncoderDrift { joint, rate } => command.q[joint] -= (rate * time) as f32,
        }
        for (feed_forward, more) in command.tau_ff.iter_mut().zip(unseen) {
            *feed_forward += more;
        }
        unseen
    }
}

/// The numbers before `Hz` in a text.
fn frequencies(text: &str) -> impl Iterator<Item = f64> + '_ {
    let before = text.match_indices("Hz").map(|(place, _)| text[..place].trim_end());
    before.filter_map(|before| {
        let number = before.rsplit(|character: char| !(character.is_ascii_digit() || character == '.')).next()?;
        number.parse().ok()
    })
}

/// A backend of one robot on which a law outside the catalogue acts.
pub struct PerturbedBackend<B> {
    inner: B,
    outside: Option<UnmodelledEffect>,
    /// What sensors show.
    measured: RobotStates,
    time: f64,
}

impl<B: Backend> PerturbedBackend<B> {
    /// The robot of `inner` with `outside`.
    pub fn new(inner: B, outside: Option<UnmodelledEffect>) -> Self {
        let measured = inner.states().clone();
        Self { inner, outside, measured, time: 0.0 }
    }

    fn see(&mut self, unseen: [f32; 12]) {
        self.measured = self.inner.states().clone();
        for (torque, unseen) in self.measured.tau[0].iter_mut().zip(unseen) {
            *torque -= unseen;
        }
        if let Some(UnmodelledEffect::EncoderDrift { joint, rate }) = self.outside {
            self.measured.q[0][joint] += (rate * self.time) as f32;
        }
    }
}

impl<B: Backend> Backend for PerturbedBackend<B> {
    type Snapshot = (B::Snapshot, RobotStates, f64);

    fn robot(&self) -> &RobotModel {
        self.inner.robot()
    }

    fn states(&self) -> &RobotStates {
        &self.measured
    }

    fn ground(&self) -> Ground {
        self.inner.ground()
    }

    fn reset(&mut self, placements: &[(usize, InitialState)]) -> Result<(), BackendError> {
        self.inner.reset(placements)?;
        self.see([0.0; 12]);
        Ok(())
    }

    fn reset_with_model(
        &mut self,
        robot: usize,
        model: &RobotModel,
        placement: &InitialState,
    ) -> Result<(), BackendError> {
        self.inner.reset_with_model(robot, model, placement)?;
        self.see([0.0; 12]);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        for _ in 0..actuator_periods {
            let mut command = commands[0];
            let unseen =
                self.outside.map_or([0.0; 12], |outside| outside.apply(&mut command, &self.measured, self.time));
            self.inner.step(&[command], active, 1)?;
            self.time += self.inner.robot().control.actuator_dt();
            self.see(unseen);
        }
        Ok(())
    }

    fn snapshot(&self, robot: usize) -> Self::Snapshot {
        (self.inner.snapshot(robot), self.measured.clone(), self.time)
    }

    fn restore(&mut self, robot: usize, (inner, seen, time): &Self::Snapshot) {
        self.inner.restore(robot, inner);
        (self.measured, self.time) = (seen.clone(), *time);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_in_the_spectrum_is_found_in_a_sentence() {
        let law = UnmodelledEffect::Disturbance { joint: 3, amplitude: 0.5, frequency: 3.1 };
        assert!(law.depends_on("a line at 3.05 Hz on FR_hip"));
        assert!(law.depends_on("t@3.1Hz"));
        assert!(!law.depends_on("a line at 6.2 Hz") && !law.depends_on("q_FR_hip"));
    }

    #[test]
    fn cross_talk_depends_on_the_joint_that_it_comes_from() {
        let law = UnmodelledEffect::CrossTalk { from: 1, into: 2, share: 0.2 };
        assert!(law.depends_on("tau_FL_thigh") && !law.depends_on("tau_FL_calf"));
    }

    #[test]
    fn one_way_friction_acts_in_the_positive_direction_only() {
        let mut measured = RobotStates::new(1);
        let law = UnmodelledEffect::OneWayFriction { joint: 0, torque: 1.0 };
        for (speed, expected) in [(2.0, -1.0), (0.05, -0.5), (0.0, 0.0), (-2.0, 0.0)] {
            measured.dq[0][0] = speed;
            let mut command = Command::hold([0.0; 12], 30.0, 0.0);
            assert_eq!(law.apply(&mut command, &measured, 0.0)[0], expected, "at {speed} rad/s");
            assert_eq!(command.tau_ff[0], expected);
        }
    }
}
