//! Input and output of a step of the safety state machine.

use std::time::Duration;

use twinstep_model::{Joint, PerJoint};

use crate::command::SafeCommand;
use crate::fault::Fault;
use crate::reading::Reading;
use crate::state::State;
use crate::watchdog::Watchdog;

/// What happened since the last step.
#[derive(Clone, Debug, PartialEq)]
#[allow(clippy::struct_excessive_bools, reason = "the flags are independent")]
pub struct Input {
    /// Time on a monotonic clock, the one that policy ticks are counted on.
    pub now: Duration,
    /// States of the robot that arrived since the last step, oldest first.
    pub readings: Vec<Reading>,
    /// True if a state of another robot arrived since the last step.
    pub other_robot: bool,
    /// Number of other writers of `rt/lowcmd`.
    pub foreign_writers: usize,
    /// What the watchdog does.
    pub watchdog: Watchdog,
    /// False if commands cannot be sent.
    pub can_send: bool,
    /// True if the robot's built-in controller is released.
    pub controller_released: bool,
    /// True while a client asks for a stop or the process is ending.
    pub stop_requested: bool,
    /// Request of the operator at the robot's host.
    pub request: Option<OperatorRequest>,
    /// The client that has the robot.
    pub client: Client,
    /// Action of the client that arrived since the last step.
    pub action: Option<Action>,
}

impl Input {
    /// Returns the input of a step at `now` in which nothing happened: no state arrived, the watchdog guards the motors, the
    /// built-in controller is released, and a client has the robot.
    pub fn quiet(now: Duration) -> Self {
        Self {
            now,
            readings: Vec::new(),
            other_robot: false,
            foreign_writers: 0,
            watchdog: Watchdog::Guarding,
            can_send: true,
            controller_released: true,
            stop_requested: false,
            request: None,
            client: Client::Connected,
            action: None,
        }
    }
}

/// Request of the operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OperatorRequest {
    /// Start to send commands, and forget the last fault.
    Arm,
    /// Move to the standing pose.
    Stand,
    /// Move to the crouched pose.
    Sit,
    /// Damping at once.
    Damp,
    /// Stop sending commands.
    Disarm,
    /// Let the client act again after a fault.
    Go,
}

/// The client that has the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Client {
    /// No client, or it does not live any more.
    Absent,
    /// A client lives.
    Connected,
    /// A client ends its episode: the robot goes back to the standing pose.
    EndsEpisode,
}

/// Action of a client for one policy period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Action {
    /// Policy period for which the action is: [`Output::tick`] of the observation that it responds to.
    pub tick: u64,
    /// Offsets from the default pose, in units of the action scale, −1 to 1; joints in the order of [`Joint::ALL`].
    pub values: PerJoint,
}

/// Result of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Output {
    /// State after the step.
    pub state: State,
    /// Command to send now; `None` exactly if the robot is not armed.
    pub command: Option<SafeCommand>,
    /// Fault that was not yet cleared by arming again.
    pub fault: Option<Fault>,
    /// Number of the present policy period since the clock's zero.
    pub tick: u64,
    /// Number of policy periods in a row that ended without an action; 0 outside [`State::Run`] and [`State::Hold`].
    pub missed_ticks: u64,
    /// Action in force after clipping and limiting, in units of the action scale. Outside [`State::Run`] and
    /// [`State::Hold`] there is none.
    pub applied: Option<PerJoint>,
    /// Reason why the operator's request was not executed.
    pub request_refused: Option<RequestRefused>,
    /// Reason why the action was not executed.
    pub action_refused: Option<ActionRefused>,
    /// False after a fault, until the operator lets the client act again.
    pub is_permitted: bool,
}

/// Reason why a request of the operator was not executed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum RequestRefused {
    /// The request is not possible in this state.
    #[error("not possible in state `{state}`; possible in: {possible}")]
    WrongState {
        /// Present state.
        state: State,
        /// Names of the states in which it is possible.
        possible: &'static str,
    },
    /// States do not arrive often enough.
    #[error("states arrive too rarely: check cable and interface")]
    StateRate,
    /// Another writer of `rt/lowcmd` existed a moment ago.
    #[error("another writer of `rt/lowcmd` existed within the last second: make sure that it is gone")]
    RecentForeignWriter,
    /// It would end in a fault at once.
    #[error("{0}")]
    Fault(Fault),
    /// The motors may not have received damping yet.
    #[error(
        "damping has been sent for less than 0.1 s, and the motors keep the last command that reaches them: try again"
    )]
    BarelyDamped,
    /// The battery's charge is too low.
    #[error("the battery has {percent} %, but {min} % are needed: charge it")]
    Charge {
        /// Charge [%].
        percent: u8,
        /// Lowest allowed charge [%].
        min: u8,
    },
    /// A motor is too hot to start.
    #[error("the motor of {joint} has {celsius} °C, but at most {max} °C are allowed: let it cool")]
    Temperature {
        /// Joint.
        joint: Joint,
        /// Temperature [°C].
        celsius: u8,
        /// Highest allowed temperature [°C].
        max: i16,
    },
    /// The trunk is tilted too far to stand up.
    #[error("the trunk is tilted by {degrees:.0}°, but at most {max:.0}° are allowed: lay the robot on its belly")]
    Tilt {
        /// Angle to the vertical [°].
        degrees: f32,
        /// Largest allowed angle [°].
        max: f32,
    },
    /// The client may act already.
    #[error("no fault has ended the client's permission: it may act")]
    Permitted,
    /// A stop came after the request.
    #[error("a stop came after the request: it is not executed")]
    Stopped,
    /// The control loop did not take the request in time.
    #[error("the control loop did not take the request in time: it is not executed")]
    Expired,
    /// A joint moves.
    #[error("{joint} moves with {speed:.1} rad/s: wait until the robot is at rest")]
    Moving {
        /// Joint.
        joint: Joint,
        /// Speed [rad/s].
        speed: f32,
    },
}

/// Reason why an action was not executed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum ActionRefused {
    /// The robot executes no actions.
    #[error("the robot is in state `{state}`, and executes actions in: ready, run, hold")]
    NotReady {
        /// Present state.
        state: State,
    },
    /// No client has the robot.
    #[error("no client has the robot")]
    NoClient,
    /// A fault has ended the client's permission.
    #[error("a fault stopped the robot: the operator lets the client act again with `go`")]
    NotPermitted,
    /// The policy period of the action is over.
    #[error("the action is for tick {tick}, but {current} is the present one: act on the newest observation")]
    OldTick {
        /// Tick of the action.
        tick: u64,
        /// Present tick.
        current: u64,
    },
    /// The policy period of the action has not begun.
    #[error("the action is for tick {tick}, but {current} is the present one: wait for its observation")]
    FutureTick {
        /// Tick of the action.
        tick: u64,
        /// Present tick.
        current: u64,
    },
    /// The policy period has an action already.
    #[error("tick {tick} has an action already: wait for the next observation")]
    Repeated {
        /// Tick of the action.
        tick: u64,
    },
    /// A number is not finite.
    #[error("the action of {joint} is {value}, which is not a finite number")]
    NotFinite {
        /// Joint.
        joint: Joint,
        /// Value.
        value: f32,
    },
}
