//! States of the safety state machine.

use std::fmt;

/// State of the safety state machine. The table in the [crate's documentation](crate) has the transitions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum State {
    /// No states are received.
    Disconnected,
    /// States are received, nothing is sent.
    Observe,
    /// Armed: damping.
    Damp,
    /// Moves to the standing pose.
    StandUp,
    /// Stands and waits for the actions of a client.
    Ready,
    /// Executes the actions of a client.
    Run,
    /// Holds the pose because actions are missing.
    Hold,
    /// Moves to the crouched pose.
    Sit,
    /// Damping after a fault.
    Fault,
}

impl State {
    /// Every state.
    pub const ALL: [State; 9] = [
        State::Disconnected,
        State::Observe,
        State::Damp,
        State::StandUp,
        State::Ready,
        State::Run,
        State::Hold,
        State::Sit,
        State::Fault,
    ];

    /// Returns true if commands are sent in this state.
    pub fn is_armed(self) -> bool {
        !matches!(self, State::Disconnected | State::Observe)
    }

    /// Returns true if the robot holds or changes its pose in this state.
    pub fn is_moving(self) -> bool {
        matches!(self, State::StandUp | State::Ready | State::Run | State::Hold | State::Sit)
    }

    /// Returns the name in messages.
    pub fn name(self) -> &'static str {
        match self {
            State::Disconnected => "disconnected",
            State::Observe => "observe",
            State::Damp => "damp",
            State::StandUp => "stand_up",
            State::Ready => "ready",
            State::Run => "run",
            State::Hold => "hold",
            State::Sit => "sit",
            State::Fault => "fault",
        }
    }
}

impl fmt::Display for State {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}
