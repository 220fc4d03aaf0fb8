//! What moves the actuators of a batch in a step: commands, torques of an external actuator, or both.

use std::ops::Range;

use twinstep_dynamics::SimdCommands;
use twinstep_model::{ActuatorMode, ActuatorTap, Command, PerJoint};
use twinstep_simd::SimdFloat;

/// Input of the actuators of all robots.
#[derive(Clone, Copy)]
pub enum ActuatorInputs<'a> {
    /// Commands to the actuators of the robot model, one per robot.
    Commands(&'a [Command]),
    /// Joint torques of an external actuator, one entry per robot [N·m].
    Torques(&'a [PerJoint]),
    /// Commands, and joint torques of an external actuator that are added at a tap, one entry per robot [N·m].
    Residual { commands: &'a [Command], tap: ActuatorTap, tau: &'a [PerJoint] },
}

impl<'a> ActuatorInputs<'a> {
    /// Returns the input for the torques of an external actuator.
    pub fn of(mode: ActuatorMode, commands: &'a [Command], tau: &'a [PerJoint]) -> Self {
        match mode {
            ActuatorMode::Replace(_) => Self::Torques(tau),
            ActuatorMode::AddAt(tap) => Self::Residual { commands, tap, tau },
        }
    }

    /// Returns the inputs of a range of robots.
    pub fn range(self, robots: Range<usize>) -> Self {
        match self {
            Self::Commands(commands) => Self::Commands(&commands[robots]),
            Self::Torques(tau) => Self::Torques(&tau[robots]),
            Self::Residual { commands, tap, tau } => {
                Self::Residual { commands: &commands[robots.clone()], tap, tau: &tau[robots] }
            }
        }
    }
}

/// Input of the actuators of one batch. `J` has a number for each joint.
#[allow(clippy::large_enum_variant, reason = "created once per step and never moved")]
pub enum ActuatorInput<J> {
    /// Commands to the actuators of the robot model.
    Commands(SimdCommands<J>),
    /// Joint torques of an external actuator [N·m].
    Torques(J),
    /// Commands, and joint torques of an external actuator that are added at a tap [N·m].
    Residual(SimdCommands<J>, ActuatorTap, J),
}

impl<T: SimdFloat> ActuatorInput<[T; 12]> {
    /// Creates the input of at most `T::LANES` robots.
    pub fn of(inputs: ActuatorInputs) -> Self {
        match inputs {
            ActuatorInputs::Commands(commands) => Self::Commands(SimdCommands::new(commands)),
            ActuatorInputs::Torques(tau) => Self::Torques(torques(tau)),
            ActuatorInputs::Residual { commands, tap, tau } => {
                Self::Residual(SimdCommands::new(commands), tap, torques(tau))
            }
        }
    }
}

/// Returns the torques of the robots, one per lane.
fn torques<T: SimdFloat>(tau: &[PerJoint]) -> [T; 12] {
    let mut given = [T::splat(0.0); 12];
    for (lane, tau) in tau.iter().enumerate() {
        for (given, tau) in given.iter_mut().zip(tau) {
            given.set(lane, f64::from(*tau));
        }
    }
    given
}
