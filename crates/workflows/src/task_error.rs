//! Error of one robot in the task of its policy, as one number.

use twinstep_envs::{ControlledRobot, JumpConfig, TaskConfig, TrackConfig};
use twinstep_measures::{AttitudeFollowing, JUMP_S, Jumping, Measure, MeasureError, Run, Tracking, Walking, measure};
use twinstep_model::{EnvSpec, RobotModel, VecEnv};
use twinstep_policy::Policy;

use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::train_config::TrainConfig;

/// What is measured of the robots of a task.
pub enum TaskError {
    /// Velocity error from 1 s after each new command [m/s], of `walk` and `gait`: no robot follows a step of the command at once.
    Velocity(Box<ControlledRobot>),
    /// Distance from the path [m], of `track`.
    Path(Box<TrackConfig>),
    /// Distance of the landing from the target [m], of `jump`.
    Landing(Box<JumpConfig>, Box<RobotModel>),
    /// Sum of the errors of roll and pitch [rad], of `attitude`.
    Attitude,
}

/// Error of a robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RobotError {
    /// Error in the unit of [`TaskError::unit`]; `None` if the robot fell before there was one.
    pub error: Option<f64>,
    /// True if the robot fell.
    pub has_fallen: bool,
}

impl TaskError {
    /// Returns what is measured in the task of these settings, and the task with which it is measured.
    pub fn of(config: &TrainConfig) -> Result<(Self, TaskConfig), Failure> {
        let task = config.task.with_default_settings();
        match &config.task {
            TaskConfig::Walk(_) | TaskConfig::Gait(_) => {
                Ok((Self::Velocity(Box::new(config.robots(1)?.control())), task))
            }
            TaskConfig::Track(_) => {
                let [circle, ..] = Tracking::tasks(true);
                Ok((Self::Path(Box::new(circle.clone())), TaskConfig::Track(circle)))
            }
            TaskConfig::Jump(trained) => {
                let mut targets = Jumping::tasks(trained);
                let middle = targets.remove(targets.len() / 2);
                let robot = Box::new(config.quadruped()?);
                Ok((Self::Landing(Box::new(middle.clone()), robot), TaskConfig::Jump(middle)))
            }
            TaskConfig::Attitude(_) => Ok((Self::Attitude, TaskConfig::Attitude(AttitudeFollowing::task()))),
            unknown => Err(Failure::Input(miette::miette!(
                "a policy of `{}` has no task error: walk, gait, track, jump or attitude",
                unknown.name()
            ))),
        }
    }

    /// Returns the unit of the error.
    pub fn unit(&self) -> &'static str {
        match self {
            Self::Velocity(_) => "m/s",
            Self::Path(_) | Self::Landing(..) => "m",
            Self::Attitude => "rad",
        }
    }

    /// Returns what the error is.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Velocity(_) => "velocity error from 1 s after each new command, RMS",
            Self::Path(_) => "distance from the path, RMS",
            Self::Landing(..) => "distance of the landing from the target",
            Self::Attitude => "sum of the errors of roll and pitch",
        }
    }

    /// Fails if the error cannot be measured at an endpoint.
    pub fn check_task(&self) -> Result<(), Failure> {
        if !matches!(self, Self::Path(_) | Self::Landing(..)) {
            return Ok(());
        }
        Err(Failure::Input(miette::miette!(
            "`--endpoint` is for policies of `walk`, `gait` and `attitude`: an endpoint draws the paths and targets of the \
             others itself\n  leave it out, and the gain is predicted"
        )))
    }

    /// Fails if environments of this spec do not observe what is measured.
    pub fn check(&self, spec: &EnvSpec) -> Result<(), Failure> {
        match self {
            Self::Velocity(robot) => Walking::new(spec, 1, &robot.feet, &robot.torque_limits).map(drop).map_err(input),
            Self::Attitude => AttitudeFollowing::new(spec).map(drop).map_err(input),
            Self::Path(_) | Self::Landing(..) => self.check_task(),
        }
    }

    /// Measures one robot, the only one of `env`, under the mean action of `policy`.
    pub fn measure(
        &self,
        policy: &Policy,
        env: &mut dyn VecEnv,
        run: Run,
        observer: &Observer,
    ) -> Result<RobotError, Failure> {
        let of = |error: f64, up: f64| RobotError { error: error.is_finite().then_some(error), has_fallen: up < 1.0 };
        Ok(match self {
            Self::Velocity(robot) => {
                let walking = Walking::new(env.spec(), 1, &robot.feet, &robot.torque_limits).map_err(input)?;
                let found = measured(policy, env, walking, run, observer)?;
                // No robot has exactly no error: there was no step a second after a command.
                let error = Some(found.settled_velocity_rms).filter(|error| *error > 0.0);
                of(error.unwrap_or(f64::NAN), found.up)
            }
            Self::Path(task) => {
                let tracking = Tracking::new(env.spec(), task);
                let found = measured(policy, env, tracking, run, observer)?;
                of(found.position_rms, found.up)
            }
            Self::Landing(task, robot) => {
                let jumping = Jumping::new(env.spec(), 1, robot, task);
                let found = measured(policy, env, jumping, Run { seconds: JUMP_S, ..run }, observer)?;
                of(found.distance, found.up)
            }
            Self::Attitude => {
                let attitude = AttitudeFollowing::new(env.spec()).map_err(input)?;
                let found = measured(policy, env, attitude, run, observer)?;
                of(found.l_attitude, found.up)
            }
        })
    }
}

fn measured<M: Measure>(
    policy: &Policy,
    env: &mut dyn VecEnv,
    new: M,
    run: Run,
    observer: &Observer,
) -> Result<M::Found, Failure> {
    measure(policy, env, new, run, |_| matches!(observer.check(), Ok(false))).map_err(|error| match error {
        MeasureError::Stopped => Failure::Interrupted,
        MeasureError::Env(_) => observer.check().err().unwrap_or_else(|| other(error)),
        MeasureError::OtherSpec { .. } | MeasureError::Missing(_) => input(error),
    })
}
