//! The rapier engine: one world a robot, stepped on all cores.

use rayon::prelude::*;
use twinstep_model::{
    Actuator, ActuatorSnapshot, Backend, BackendError, Command, Ground, PerJoint, InitialState, RobotModel, RobotStates,
};

use crate::ground_shapes::GroundShapes;
use crate::robot_world::{ActuatorInputRef, RobotWorld, WorldSnapshot};
use crate::{SimConfig, SimConfigError};

/// Many Go2 in rapier3d.
pub struct RapierBackend {
    robot: RobotModel,
    config: SimConfig,
    ground: Ground,
    ground_shapes: GroundShapes,
    worlds: Vec<RobotWorld>,
    states: RobotStates,
    /// In place of the robots' own drives.
    drive: Option<Box<dyn Actuator>>,
    pool: rayon::ThreadPool,
}

/// Why a backend could not be built.
#[derive(Debug, thiserror::Error)]
pub enum BackendBuildError {
    /// A setting is not allowed.
    #[error(transparent)]
    Config(#[from] SimConfigError),
    /// The system gave no threads.
    #[error("cannot start {threads} simulation threads: {source}")]
    Threads {
        /// How many were asked for.
        threads: usize,
        /// What the system said.
        source: rayon::ThreadPoolBuildError,
    },
}

/// Threads that step robots; 0 takes all cores.
pub(crate) fn thread_pool(threads: usize) -> Result<rayon::ThreadPool, BackendBuildError> {
    let threads = match threads {
        0 => std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        threads => threads,
    };
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|source| BackendBuildError::Threads { threads, source })
}

/// Fails unless a step has one command and one flag a robot.
pub(crate) fn check_lengths(commands: &[Command], active: &[bool], robots: usize) -> Result<(), BackendError> {
    for (field, given) in [("commands", commands.len()), ("active", active.len())] {
        if given != robots {
            return Err(BackendError::WrongLength { field, given, wanted: robots });
        }
    }
    Ok(())
}

/// The state of one robot; restoring it continues bit for bit.
#[derive(Clone)]
pub struct RobotSnapshot {
    world: WorldSnapshot,
    state: RobotStates,
    drive: Option<ActuatorSnapshot>,
}

impl RapierBackend {
    /// `num_robots` robots that stand in their default pose.
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BackendBuildError> {
        config.check(&robot.control)?;
        let pool = thread_pool(config.threads)?;
        let ground = config.terrain.ground();
        let ground_shapes = GroundShapes::new(&ground);
        let placement = InitialState::standing_on(&ground, &robot, robot.control.default_pose_f32(), 0.0);
        let worlds = (0..num_robots).map(|_| RobotWorld::new(&robot, &config, &ground_shapes, &placement)).collect();
        let states = RobotStates::new(num_robots);
        let mut this = Self { robot, config, ground, ground_shapes, worlds, states, drive: None, pool };
        for index in 0..num_robots {
            this.read_state(index);
        }
        Ok(this)
    }

    /// The same robots with another drive than their own; each is to be placed anew.
    #[must_use]
    pub fn with_actuator(self, drive: Box<dyn Actuator>) -> Self {
        Self { drive: Some(drive), ..self }
    }

    fn check_index(&self, robot: usize) -> Result<(), BackendError> {
        let num_robots = self.worlds.len();
        if robot < num_robots { Ok(()) } else { Err(BackendError::RobotOutOfRange { robot, num_robots }) }
    }

    fn reset_robot(&mut self, robot: usize, model: &RobotModel, placement: &InitialState) {
        self.worlds[robot] = RobotWorld::new(model, &self.config, &self.ground_shapes, placement);
        if let Some(drive) = &mut self.drive {
            drive.reset(robot, placement.actuator_seed);
        }
        self.read_state(robot);
        self.states.tau[robot] = PerJoint::default();
        self.states.epistemic_uncertainty[robot] = 0.0;
    }

    fn read_state(&mut self, robot: usize) {
        let (world, states) = (&self.worlds[robot], &mut self.states);
        world.read_joints(&mut states.q[robot], &mut states.dq[robot]);
        let base = world.read_base();
        states.base_position[robot] = base.position;
        states.base_orientation[robot] = base.orientation;
        states.base_linear_velocity[robot] = base.linear_velocity;
        states.base_angular_velocity[robot] = base.angular_velocity;
        states.foot_force[robot] = world.foot_forces();
        states.body_contact[robot] = world.body_contact();
    }

    /// One drive period of all active robots: torque from the sampled state, held over the physics steps.
    fn actuator_period(&mut self, commands: &[Command], active: &[bool], steps: usize) -> Result<(), BackendError> {
        let given = match &mut self.drive {
            Some(drive) => {
                let mut tau = self.states.tau.clone();
                self.pool.install(|| drive.torques(commands, active, &self.states, &mut tau))?;
                Some(tau)
            }
            None => None,
        };
        let input = |robot: usize| match &given {
            Some(tau) => ActuatorInputRef::Torques(&tau[robot]),
            None => ActuatorInputRef::Command(&commands[robot]),
        };
        let states = &mut self.states;
        let robots = (&mut self.worlds, &mut states.tau, &mut states.q, &mut states.dq, active);
        self.pool.install(|| {
            let robots = robots.into_par_iter().enumerate().filter(|(_, (.., active))| **active);
            robots.for_each(|(robot, (world, tau, q, dq, _))| {
                *tau = world.drive_period(input(robot), steps);
                world.read_joints(q, dq);
            });
        });
        Ok(())
    }

    fn first_diverged(&self, active: &[bool]) -> Option<BackendError> {
        let mut diverged = (0..self.worlds.len()).filter(|robot| active[*robot]).filter_map(|robot| {
            let quantity = self.states.first_not_finite(robot);
            quantity.or_else(|| self.worlds[robot].diverged().then_some("dq")).map(|quantity| (robot, quantity))
        });
        let (robot, quantity) = diverged.next()?;
        Some(BackendError::Diverged { robot, quantity, more: diverged.count() })
    }
}

impl Backend for RapierBackend {
    type Snapshot = RobotSnapshot;

    fn robot(&self) -> &RobotModel {
        &self.robot
    }

    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn ground(&self) -> Ground {
        self.ground.clone()
    }

    fn reset(&mut self, placements: &[(usize, InitialState)]) -> Result<(), BackendError> {
        for (robot, _) in placements {
            self.check_index(*robot)?;
        }
        let model = self.robot.clone();
        for (robot, placement) in placements {
            self.reset_robot(*robot, &model, placement);
        }
        Ok(())
    }

    fn reset_with_model(&mut self, robot: usize, model: &RobotModel, placement: &InitialState) -> Result<(), BackendError> {
        self.check_index(robot)?;
        self.reset_robot(robot, model, placement);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], drive_periods: usize) -> Result<(), BackendError> {
        let robots = self.num_robots();
        check_lengths(commands, active, robots)?;
        let steps = self.config.steps_per_drive_period(&self.robot.control);
        for _ in 0..drive_periods {
            self.actuator_period(commands, active, steps)?;
        }
        if let Some(doubt) = self.drive.as_mut().and_then(|drive| drive.uncertainty()) {
            self.pool.install(|| doubt.evaluate(active, &mut self.states.epistemic_uncertainty));
        }
        for robot in (0..robots).filter(|robot| active[*robot]) {
            self.read_state(robot);
        }
        self.first_diverged(active).map_or(Ok(()), Err)
    }

    fn snapshot(&self, robot: usize) -> RobotSnapshot {
        let mut state = RobotStates::new(1);
        state.copy_robot(0, &self.states, robot);
        let drive = self.drive.as_ref().map(|drive| drive.snapshot(robot));
        RobotSnapshot { world: self.worlds[robot].snapshot(), state, drive }
    }

    fn restore(&mut self, robot: usize, snapshot: &RobotSnapshot) {
        self.worlds[robot].restore(&snapshot.world);
        self.states.copy_robot(robot, &snapshot.state, 0);
        if let (Some(drive), Some(memory)) = (&mut self.drive, &snapshot.drive) {
            drive.restore(robot, memory);
        }
    }
}
