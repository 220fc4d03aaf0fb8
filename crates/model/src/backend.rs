//! Interfaces below an environment: [`Backend`] steps robots, [`Actuator`] computes their torques.

use std::any::Any;
use std::sync::Arc;

use crate::{
    Command, Ground, GroundTruth, InitialState, Measured, PerJoint, RealTimeReport, ResetCause, RobotModel,
    RobotSample, RobotStates,
};

/// Batch of robots that are commanded and observed together: a simulator, a replayed log or the real robot.
pub trait Backend: Send {
    /// Returns the number of robots.
    fn num_robots(&self) -> usize {
        self.measured().q.len()
    }

    /// Returns the nominal robot.
    fn robot(&self) -> &RobotModel;

    /// Returns the sensor readings after the last [`Backend::reset`] or [`Backend::step`].
    fn measured(&self) -> &Measured;

    /// Returns what the sensors do not measure. `None` on a real robot.
    fn ground_truth(&self) -> Option<&GroundTruth> {
        None
    }

    /// Returns the ground under the robots; flat if it is not known.
    fn ground(&self) -> Ground {
        Ground::FLAT
    }

    /// Prepares robots for a reset, which follows at once if this succeeds.
    ///
    /// A simulator has nothing to prepare. A real robot fails with [`BackendError::Waiting`] until it stands.
    fn prepare_reset(&mut self, _cause: ResetCause) -> Result<(), BackendError> {
        Ok(())
    }

    /// Resets robots to initial states, with the nominal model. Each pair is a robot's index and its initial state.
    ///
    /// A real robot stays as it is.
    fn reset(&mut self, initial_states: &[(usize, InitialState)]) -> Result<(), BackendError>;

    /// Resets one robot to an initial state, with the parameters of `model` until its next reset.
    ///
    /// Fails with [`BackendError::FixedParameters`] on a real robot.
    fn reset_with_model(
        &mut self,
        robot: usize,
        _model: &RobotModel,
        _initial_state: &InitialState,
    ) -> Result<(), BackendError> {
        Err(BackendError::FixedParameters { robot })
    }

    /// Adds `velocity` to the linear velocity of a robot's base, in the world frame [m/s].
    ///
    /// Fails with [`BackendError::CannotPush`] if the base is fixed, and on a real robot.
    fn push(&mut self, robot: usize, _velocity: [f32; 3]) -> Result<(), BackendError> {
        Err(BackendError::CannotPush { robot, reason: "it is not simulated" })
    }

    /// Advances every `active` robot by `actuator_periods` actuator periods under its command.
    ///
    /// `commands` and `active` have one entry per robot. Inactive robots do not change.
    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError>;

    /// Returns the report after the last reset or step. `None` in a simulation, which has no real time.
    fn real_time(&self) -> Option<&RealTimeReport> {
        None
    }

    /// Returns the samples of a robot that samples itself since the last call, one per actuator period.
    ///
    /// `None` in a simulation: its caller steps one period at a time and reads the states between them.
    fn take_samples(&mut self) -> Option<Vec<RobotSample>> {
        None
    }

    /// Sets the policy period for which the commands of the next step are, instead of that of the last observation.
    fn set_action_tick(&mut self, _tick: u64) {}

    /// Returns the velocity command of the operator: forward [m/s], left [m/s], yaw rate [rad/s]. `None` in a
    /// simulation, where the task has its own.
    fn velocity_command(&self) -> Option<[f32; 3]> {
        None
    }
}

/// Backend whose robots are simulated.
pub trait Simulator: Backend {
    /// Returns the states after the last [`Backend::reset`] or [`Backend::step`].
    fn states(&self) -> &RobotStates;

    /// Sets the factors on the torque of each joint of `robot`, for supply voltage and motor temperature, until its
    /// next reset.
    fn set_derating(&mut self, robot: usize, factors: &PerJoint);
}

/// Simulator in this process, whose full state can be saved and restored.
pub trait Restorable: Simulator {
    /// Full state of one robot. After [`Restorable::restore`] the robot continues bit for bit as from the snapshot.
    type Snapshot: Clone + Send;

    /// Returns the full state of `robot`.
    fn snapshot(&self, robot: usize) -> Self::Snapshot;

    /// Restores the state of `robot` from `snapshot`.
    fn restore(&mut self, robot: usize, snapshot: &Self::Snapshot);
}

/// How the torques of an [`Actuator`] enter the chain from command to motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActuatorMode {
    /// They replace the chain up to this tap.
    Replace(ActuatorTap),
    /// They are added to the torque of the analytic actuators at this tap.
    AddAt(ActuatorTap),
}

/// Place in the chain from command to motion at which a torque is measured or added.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActuatorTap {
    /// Torque that the motor current shows, before torque constant, gear and friction.
    Current,
    /// Torque at the joint output, behind gear, friction and rotor.
    Output,
}

/// Actuators of a batch of robots: computes joint torques from commands and measured states, once per actuator period.
///
/// The interface is batched, so that an actuator network evaluates all robots in one forward pass.
pub trait Actuator: Send {
    /// Returns whether the torques replace those of the analytic actuators or are added to them.
    fn mode(&self) -> ActuatorMode {
        ActuatorMode::Replace(ActuatorTap::Current)
    }

    /// Writes the torque of each joint [N·m] into `tau`, for every `active` robot.
    ///
    /// If it fails, nothing changes. A backend with a thread pool calls it on that pool.
    fn torques(
        &mut self,
        commands: &[Command],
        active: &[bool],
        measured: &Measured,
        tau: &mut [PerJoint],
    ) -> Result<(), BackendError>;

    /// Resets the state of the actuators of `robot` and seeds their random numbers with `seed`.
    fn reset(&mut self, robot: usize, seed: u64);

    /// Returns the full state of the actuators of `robot`.
    fn snapshot(&self, robot: usize) -> ActuatorSnapshot;

    /// Restores the state of the actuators of `robot` from `snapshot`, which the same type of actuator must have made.
    fn restore(&mut self, robot: usize, snapshot: &ActuatorSnapshot);

    /// Returns the estimator of the epistemic uncertainty. Returns `None` if the actuator has none.
    fn uncertainty(&mut self) -> Option<&mut dyn EpistemicUncertainty> {
        None
    }
}

/// Estimates epistemic uncertainty, a reward term for data collection (U2E, eq. 13).
pub trait EpistemicUncertainty: Send {
    /// Writes the epistemic uncertainty [nat] of each `active` robot after its last actuator period. Entries of other
    /// robots do not change.
    fn evaluate(&mut self, active: &[bool], uncertainty: &mut [f32]);
}

/// Opaque state of the actuators of one robot.
#[derive(Clone)]
pub struct ActuatorSnapshot(Arc<dyn Any + Send + Sync>);

impl ActuatorSnapshot {
    /// Creates a snapshot that contains `memory`.
    pub fn new(memory: impl Any + Send + Sync) -> Self {
        Self(Arc::new(memory))
    }

    /// Returns the contents if they have type `T`, else `None`.
    pub fn get<T: Any>(&self) -> Option<&T> {
        self.0.downcast_ref()
    }
}

/// Error of a backend.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BackendError {
    /// An argument has the wrong number of entries.
    #[error("`{field}` has {given} entries; {expected} are expected, one per robot")]
    WrongLength {
        /// The argument.
        field: &'static str,
        /// Number of entries of the argument.
        given: usize,
        /// Expected number of entries.
        expected: usize,
    },
    /// A robot index is too large.
    #[error("robot {robot} does not exist; the number of robots is {num_robots}")]
    RobotOutOfRange {
        /// Requested index.
        robot: usize,
        /// Number of robots.
        num_robots: usize,
    },
    /// The actuator does not support a command. No robot was stepped.
    #[error("the actuator of robot {robot} does not support its command: {reason}; no robot was stepped")]
    UnsupportedCommand {
        /// The robot.
        robot: usize,
        /// What is not supported.
        reason: String,
    },
    /// The physical parameters of a real robot cannot be changed.
    #[error("robot {robot} is not simulated, so its parameters cannot be randomised")]
    FixedParameters {
        /// The robot.
        robot: usize,
    },
    /// The velocity of the base cannot be changed.
    #[error("robot {robot} cannot be pushed: {reason}")]
    CannotPush {
        /// The robot.
        robot: usize,
        /// Why not.
        reason: &'static str,
    },
    /// The robot is not ready for an episode. Nothing was changed; the same request succeeds later.
    #[error("the robot is not ready: {reason}")]
    Waiting {
        /// What it waits for.
        reason: String,
    },
    /// No message of the robot arrived in time. No command is executed until it answers again.
    #[error("the link to robot {robot} is lost: its last message is {silent_ms} ms old")]
    LostLink {
        /// The robot.
        robot: usize,
        /// Age of its last message [ms].
        silent_ms: u32,
    },
    /// The robot reports a fault, or a safety check stopped it.
    #[error("robot {robot} has stopped: {reason}")]
    Fault {
        /// The robot.
        robot: usize,
        /// What the robot or the check reported.
        reason: String,
    },
    /// The command arrived after the policy period for which it was computed. It was not executed.
    #[error("the command of robot {robot} was {late_ms} ms late and was not executed")]
    MissedDeadline {
        /// The robot.
        robot: usize,
        /// Delay behind the deadline [ms].
        late_ms: u32,
    },
    /// The engine cannot simulate an effect of the robot's model. The robot was not reset.
    #[error("engine `{engine}` cannot simulate the effect `{effect}` of robot {robot}; use `batch` or `rapier`")]
    UnsupportedEffect {
        /// The robot.
        robot: usize,
        /// The engine.
        engine: &'static str,
        /// The effect, as named in the catalogue.
        effect: &'static str,
    },
    /// The process of an engine exited, does not reply or violates the protocol. Its robots are lost.
    #[error("the process of engine `{engine}` failed: {reason}; its robots are lost, create them again")]
    EngineProcess {
        /// The engine.
        engine: &'static str,
        /// What the process did.
        reason: String,
    },
    /// The simulation of some robots diverged to values that are not finite. The other robots were stepped.
    #[error(
        "the simulation of robot {} diverged: `{}` is not finite ({} more robots); reset it",
        robots[0].0, robots[0].1, robots.len() - 1
    )]
    Diverged {
        /// The robots that diverged, at least one, each with its first quantity that is not finite.
        robots: Vec<(usize, &'static str)>,
    },
}
