//! Faults, what the robot does about them, and in which states they count.

use twinstep_model::Joint;

use crate::state::State;
use crate::unsafe_command::UnsafeCommand;

/// Reason why the robot stopped. It is kept until the operator arms the robot again.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Fault {
    /// The robot sends no states.
    #[error("the last state of the robot is {age_ms} ms old: check cable, interface and power")]
    StateStale {
        /// Age of the last state [ms].
        age_ms: u64,
    },
    /// A process other than this one commands the motors.
    #[error("{writers} other writers of `rt/lowcmd` exist: stop them")]
    ForeignWriter {
        /// Number of other writers.
        writers: usize,
    },
    /// States of another robot arrive on the same topic.
    #[error("another writer of `rt/lowstate` exists, such as a second robot, a simulator or a replayed log: stop it")]
    OtherRobot,
    /// The robot's clock does not advance as time does.
    #[error("the robot's clock jumped by {ticks} ticks: it was switched off and on, or states are replayed")]
    ClockJump {
        /// Change of the clock from one state to the next.
        ticks: i64,
    },
    /// This process did not run for a while.
    #[error("no command was sent for {ms} ms: this computer is too busy, or the process was suspended")]
    Pause {
        /// Time between two steps [ms].
        ms: u64,
    },
    /// The watchdog damps the motors.
    #[error("the watchdog damps the motors, because the control loop was silent")]
    WatchdogTookOver,
    /// The watchdog does not guard the motors.
    #[error(
        "the watchdog does not guard the motors: wait a second; if it does not come, end this program and start it again"
    )]
    WatchdogGone,
    /// Commands cannot be sent.
    #[error("commands cannot be sent: check cable and interface")]
    CannotSend,
    /// The robot's built-in controller commands the motors.
    #[error("the robot's built-in controller is active: release it")]
    ControllerActive,
    /// The operator pressed L2 and B on the remote control.
    #[error("stopped with L2 + B on the remote control")]
    RemoteStop,
    /// A client asked for a stop, or this process is ending.
    #[error("stopped on request")]
    StopRequested,
    /// Motors do not receive their commands.
    #[error("{count} messages to the motors were lost within a second: check the robot's wiring")]
    MessagesLost {
        /// Number of lost messages.
        count: u32,
    },
    /// The trunk is tilted too far.
    #[error("the trunk is tilted by {degrees:.0}°: set the robot on its feet")]
    Tilt {
        /// Angle to the vertical [°].
        degrees: f32,
    },
    /// Accelerometer and orientation disagree, so that the tilt is not known.
    #[error("accelerometer and orientation disagree by {degrees:.0}° about the vertical: run `twinstep preflight`")]
    ImuDisagrees {
        /// Angle between them [°].
        degrees: f32,
    },
    /// A joint is beyond its end.
    #[error("{joint} is at {q:.2} rad, beyond its range: check the joint and its encoder")]
    JointLimit {
        /// Joint.
        joint: Joint,
        /// Position [rad].
        q: f32,
    },
    /// A motor has been overloaded for too long.
    #[error("the torque of {joint} has been {tau:.1} N·m for too long: free the joint")]
    Torque {
        /// Joint.
        joint: Joint,
        /// Torque [N·m].
        tau: f32,
    },
    /// A command was outside the limits.
    #[error("a computed command is unsafe: {0}")]
    UnsafeCommand(UnsafeCommand),
    /// A motor is too hot.
    #[error("the motor of {joint} has {celsius} °C: let it cool")]
    Temperature {
        /// Joint.
        joint: Joint,
        /// Temperature [°C].
        celsius: u8,
    },
    /// The battery is almost empty.
    #[error("the supply voltage is {volts:.1} V: charge the battery")]
    Voltage {
        /// Supply voltage [V].
        volts: f32,
    },
    /// The remote control is not received.
    #[error("the remote control is not received: switch it on, bring it closer")]
    RemoteLost,
    /// The client is gone.
    #[error("the client is gone")]
    ClientLost,
    /// The client sends no actions.
    #[error("{missed} actions in a row are missing: check client and network")]
    ActionLate {
        /// Number of policy periods without an action.
        missed: u64,
    },
    /// The robot did not reach the standing pose.
    #[error("{joint} is {error:.2} rad away from the standing pose: free the robot and check its gains")]
    StandFailed {
        /// Joint that is farthest away.
        joint: Joint,
        /// Distance [rad].
        error: f32,
    },
}

/// What the robot does about a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reaction {
    /// It sits down, then goes to damping.
    Sit,
    /// Damping at once.
    Damp,
}

impl Fault {
    /// Returns what the robot does about the fault.
    pub fn reaction(&self) -> Reaction {
        match self {
            Fault::StateStale { .. }
            | Fault::ForeignWriter { .. }
            | Fault::OtherRobot
            | Fault::ClockJump { .. }
            | Fault::Pause { .. }
            | Fault::WatchdogTookOver
            | Fault::WatchdogGone
            | Fault::CannotSend
            | Fault::ControllerActive
            | Fault::RemoteStop
            | Fault::StopRequested
            | Fault::MessagesLost { .. }
            | Fault::Tilt { .. }
            | Fault::ImuDisagrees { .. }
            | Fault::JointLimit { .. }
            | Fault::Torque { .. }
            | Fault::UnsafeCommand(_) => Reaction::Damp,
            Fault::Temperature { .. }
            | Fault::Voltage { .. }
            | Fault::RemoteLost
            | Fault::ClientLost
            | Fault::ActionLate { .. }
            | Fault::StandFailed { .. } => Reaction::Sit,
        }
    }

    /// Returns true if the robot's own motion is the fault, so that it ends an episode as a fall does.
    pub fn is_motion(&self) -> bool {
        matches!(self, Fault::Tilt { .. } | Fault::JointLimit { .. })
    }

    /// Returns true if the fault counts in `state`.
    ///
    /// In damping, a robot may be moved by hand, and to sit down would be the greater risk; so there count only faults
    /// that say that this process does not control the motors.
    pub fn counts_in(&self, state: State) -> bool {
        match state {
            State::Disconnected | State::Observe | State::Fault => false,
            State::Damp => matches!(
                self,
                Fault::StateStale { .. }
                    | Fault::ForeignWriter { .. }
                    | Fault::OtherRobot
                    | Fault::ClockJump { .. }
                    | Fault::WatchdogTookOver
                    | Fault::WatchdogGone
                    | Fault::CannotSend
                    | Fault::ControllerActive
                    | Fault::RemoteStop
                    | Fault::StopRequested
                    | Fault::MessagesLost { .. }
            ),
            State::StandUp | State::Ready | State::Sit => !matches!(self, Fault::ClientLost | Fault::ActionLate { .. }),
            State::Run | State::Hold => true,
        }
    }
}
