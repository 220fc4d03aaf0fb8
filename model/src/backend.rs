//! The seams below an environment: who steps the robots, and who turns commands into torque.

use std::any::Any;
use std::sync::Arc;

use crate::{Command, Ground, PerJoint, InitialState, RobotModel, RobotStates};

/// Many robots that are commanded and observed together: a simulator, a replayed log or the real robot.
pub trait Backend: Send {
    /// The full state of one robot; restoring it continues bit for bit as if nothing had happened.
    type Snapshot: Clone + Send;

    /// Number of robots.
    fn num_robots(&self) -> usize {
        self.states().q.len()
    }

    /// The nominal robot.
    fn robot(&self) -> &RobotModel;

    /// States after the last [`Backend::reset`] or [`Backend::step`].
    fn states(&self) -> &RobotStates;

    /// The ground that the robots stand on.
    fn ground(&self) -> Ground {
        Ground::FLAT
    }

    /// Puts nominal robots down anew; each pair is a robot's index and its place.
    fn reset(&mut self, placements: &[(usize, InitialState)]) -> Result<(), BackendError>;

    /// Puts one robot down anew as `model`: the nominal robot with other numbers. It is that until its next reset.
    fn reset_with_model(&mut self, robot: usize, model: &RobotModel, placement: &InitialState) -> Result<(), BackendError>;

    /// Advances every robot that is `active` by `drive_periods` periods of the drive under its command.
    ///
    /// `commands` and `active` have one entry a robot. The others stay as they are.
    fn step(&mut self, commands: &[Command], active: &[bool], drive_periods: usize) -> Result<(), BackendError>;

    /// The full state of `robot`.
    fn snapshot(&self, robot: usize) -> Self::Snapshot;

    /// Puts `robot` back into the state of `snapshot`.
    fn restore(&mut self, robot: usize, snapshot: &Self::Snapshot);
}

/// The drives of many robots: turns commands and measured states into joint torque, once a drive period.
///
/// Batch first, so that a learned drive serves all robots with one forward pass.
pub trait Actuator: Send {
    /// Writes the torque of each joint [N·m] into `tau`, for every robot that is `active`.
    ///
    /// Nothing is changed where it fails. Called on a backend's own threads, if it has any to share.
    fn torques(
        &mut self,
        commands: &[Command],
        active: &[bool],
        states: &RobotStates,
        tau: &mut [PerJoint],
    ) -> Result<(), BackendError>;

    /// Forgets what the drive remembers of `robot`; what is random in it begins anew from `seed`.
    fn reset(&mut self, robot: usize, seed: u64);

    /// Everything that the drive remembers of `robot`.
    fn snapshot(&self, robot: usize) -> ActuatorSnapshot;

    /// Puts `robot` back into the state of `snapshot`, which a drive of the same kind made.
    fn restore(&mut self, robot: usize, snapshot: &ActuatorSnapshot);

    /// What this drive does not know about itself, if it can tell.
    fn uncertainty(&mut self) -> Option<&mut dyn EpistemicUncertainty> {
        None
    }
}

/// How little is known about what robots do; to be rewarded while data are collected (U2E equation 13).
pub trait EpistemicUncertainty: Send {
    /// Writes what is unknown about each `active` robot [nat], as it is after its last drive period; the others stay.
    fn evaluate(&mut self, active: &[bool], uncertainty: &mut [f32]);
}

/// What a drive remembers of one robot; only the drive knows what it is.
#[derive(Clone)]
pub struct ActuatorSnapshot(Arc<dyn Any + Send + Sync>);

impl ActuatorSnapshot {
    /// Holds `memory`.
    pub fn new(memory: impl Any + Send + Sync) -> Self {
        Self(Arc::new(memory))
    }

    /// What it holds, if that is of this type.
    pub fn get<T: Any>(&self) -> Option<&T> {
        self.0.downcast_ref()
    }
}

/// Why a backend could not do what it was asked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BackendError {
    /// An argument has the wrong number of entries.
    #[error("`{field}` has {given} entries, but there are {wanted} robots")]
    WrongLength {
        /// The argument.
        field: &'static str,
        /// How many entries it has.
        given: usize,
        /// How many it must have.
        wanted: usize,
    },
    /// A robot index is too large.
    #[error("robot {robot} does not exist; there are {num_robots}")]
    RobotOutOfRange {
        /// The index that was asked for.
        robot: usize,
        /// The number of robots.
        num_robots: usize,
    },
    /// The drive cannot follow a command; nothing was stepped.
    #[error("the drive of robot {robot} cannot follow its command: {reason}; nothing was stepped")]
    UnsupportedCommand {
        /// The robot.
        robot: usize,
        /// Why not.
        reason: String,
    },
    /// The simulation of some robots gave numbers that are not finite; the others were stepped.
    #[error("the simulation of robot {robot} diverged: `{quantity}` is not finite ({more} more); place it anew")]
    Diverged {
        /// The first robot that diverged.
        robot: usize,
        /// Its first quantity that is not finite.
        quantity: &'static str,
        /// How many other robots diverged in the same step.
        more: usize,
    },
}
