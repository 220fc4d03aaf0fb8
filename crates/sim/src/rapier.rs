//! The rapier engine: one world per robot, stepped on all cores.

use std::sync::Arc;

use rayon::prelude::*;
use twinstep_dynamics::SimdCommands;
use twinstep_model::{
    Actuator, ActuatorMode, ActuatorSnapshot, Backend, BackendError, Command, Ground, GroundTruth, InitialState,
    Measured, PerJoint, Restorable, RobotModel, RobotStates, Simulator,
};

use crate::actuator_input::ActuatorInput;
use crate::checks::{check_floating, check_lengths};
use crate::ground_shapes::GroundShapes;
use crate::robot_world::{RobotWorld, WorldRobot, WorldSnapshot, foot_shape, is_upper_body};
use crate::thread_pool::thread_pool;
use crate::{BackendBuildError, Placement, SimConfig};

/// Backend that simulates each robot in a rapier3d world.
pub struct RapierBackend {
    robot: RobotModel,
    config: SimConfig,
    ground: Ground,
    ground_shapes: GroundShapes,
    worlds: Vec<RobotWorld>,
    states: RobotStates,
    /// External actuator. `None`: analytic actuators only.
    actuator: Option<Box<dyn Actuator>>,
    pool: Arc<rayon::ThreadPool>,
}

/// State of one robot. After a restore the simulation continues bit for bit.
#[derive(Clone)]
pub struct RobotSnapshot {
    world: WorldSnapshot,
    state: RobotStates,
    actuator: Option<ActuatorSnapshot>,
}

impl RapierBackend {
    /// Creates `num_robots` robots that stand in their default pose.
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BackendBuildError> {
        config.check(robot.control.actuator_hz)?;
        let config = config.at_actuator_rate(robot.control.actuator_hz);
        let pool = thread_pool(config.threads)?;
        let ground = config.terrain.ground();
        let ground_shapes = GroundShapes::new(&ground);
        let initial_state = InitialState::standing_on(&ground, &robot, robot.control.default_pose_f32(), 0.0);
        let (world_robot, placement) = (WorldRobot::of_quadruped(&robot), Placement::from(&initial_state));
        let worlds =
            (0..num_robots).map(|_| RobotWorld::new(&world_robot, &config, &ground_shapes, &placement)).collect();
        let states = RobotStates::new(num_robots);
        let mut this = Self { robot, config, ground, ground_shapes, worlds, states, actuator: None, pool };
        for index in 0..num_robots {
            this.read_state(index);
        }
        Ok(this)
    }

    /// Adds an external actuator to all robots, which replaces theirs or adds to them. Reset every robot afterwards.
    #[must_use]
    pub fn with_actuator(self, actuator: Box<dyn Actuator>) -> Self {
        Self { actuator: Some(actuator), ..self }
    }

    fn check_index(&self, robot: usize) -> Result<(), BackendError> {
        let num_robots = self.worlds.len();
        if robot < num_robots { Ok(()) } else { Err(BackendError::RobotOutOfRange { robot, num_robots }) }
    }

    fn reset_robot(&mut self, robot: usize, model: &RobotModel, initial_state: &InitialState) {
        let (model, placement) = (WorldRobot::of_quadruped(model), Placement::from(initial_state));
        self.worlds[robot] = RobotWorld::new(&model, &self.config, &self.ground_shapes, &placement);
        if let Some(actuator) = &mut self.actuator {
            actuator.reset(robot, initial_state.actuator_seed);
        }
        self.read_state(robot);
        self.states.measured.stamp[robot] = 0.0;
        self.states.measured.tau[robot] = PerJoint::default();
        self.states.truth.epistemic_uncertainty[robot] = 0.0;
    }

    fn read_state(&mut self, robot: usize) {
        let (world, RobotStates { measured, truth }) = (&self.worlds[robot], &mut self.states);
        read_joints(world, &mut measured.q[robot], &mut measured.dq[robot]);
        let base = world.read_base();
        measured.orientation[robot] = base.orientation;
        measured.gyro[robot] = base.gyro;
        truth.base_position[robot] = base.position;
        truth.base_linear_velocity[robot] = base.linear_velocity;
        truth.base_angular_velocity[robot] = base.angular_velocity;
        let forces: Vec<f32> = world.shape_forces().collect();
        truth.foot_force[robot] = std::array::from_fn(|leg| forces[foot_shape(leg)]);
        truth.body_contact[robot] =
            forces.iter().enumerate().any(|(shape, force)| is_upper_body(shape) && *force > 0.0);
    }

    /// Advances all active robots by one actuator period.
    fn actuator_period(&mut self, commands: &[Command], active: &[bool], steps: usize) -> Result<(), BackendError> {
        let external = match &mut self.actuator {
            Some(actuator) => {
                let mut tau = self.states.measured.tau.clone();
                self.pool.install(|| actuator.torques(commands, active, &self.states.measured, &mut tau))?;
                Some((actuator.mode(), tau))
            }
            None => None,
        };
        let input = |robot: usize| match &external {
            Some((ActuatorMode::Replace(_), tau)) => ActuatorInput::Torques(wide(&tau[robot])),
            Some((ActuatorMode::AddAt(tap), tau)) => {
                ActuatorInput::Residual(commands_of(&commands[robot]), *tap, wide(&tau[robot]))
            }
            None => ActuatorInput::Commands(commands_of(&commands[robot])),
        };
        let measured = &mut self.states.measured;
        let robots = (&mut self.worlds, &mut measured.tau, &mut measured.q, &mut measured.dq, active);
        self.pool.install(|| {
            let robots = robots.into_par_iter().enumerate().filter(|(_, (.., active))| **active);
            robots.for_each(|(robot, (world, tau, q, dq, _))| {
                narrow(tau, &world.actuator_period(input(robot), steps));
                read_joints(world, q, dq);
            });
        });
        Ok(())
    }

    fn check_finite(&self, active: &[bool]) -> Result<(), BackendError> {
        let diverged = (0..self.worlds.len()).filter(|robot| active[*robot]).filter_map(|robot| {
            let quantity = self.states.first_not_finite(robot);
            quantity.or_else(|| self.worlds[robot].diverged().then_some("dq")).map(|quantity| (robot, quantity))
        });
        let robots: Vec<_> = diverged.collect();
        if robots.is_empty() { Ok(()) } else { Err(BackendError::Diverged { robots }) }
    }
}

fn commands_of(command: &Command) -> SimdCommands<Vec<f64>> {
    let mut commands = SimdCommands::zero::<f64>(command.q.len());
    commands.set::<f64>(0, command);
    commands
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|value| f64::from(*value)).collect()
}

fn narrow(read: &mut [f32], values: &[f64]) {
    read.iter_mut().zip(values).for_each(|(read, value)| *read = *value as f32);
}

fn read_joints(world: &RobotWorld, q: &mut PerJoint, dq: &mut PerJoint) {
    let readings = world.read_joints();
    narrow(q, &readings.0);
    narrow(dq, &readings.1);
}

impl Backend for RapierBackend {
    fn robot(&self) -> &RobotModel {
        &self.robot
    }

    fn measured(&self) -> &Measured {
        &self.states.measured
    }

    fn ground_truth(&self) -> Option<&GroundTruth> {
        Some(&self.states.truth)
    }

    fn ground(&self) -> Ground {
        self.ground.clone()
    }

    fn reset(&mut self, initial_states: &[(usize, InitialState)]) -> Result<(), BackendError> {
        for (robot, _) in initial_states {
            self.check_index(*robot)?;
        }
        let model = self.robot.clone();
        for (robot, initial_state) in initial_states {
            self.reset_robot(*robot, &model, initial_state);
        }
        Ok(())
    }

    fn reset_with_model(
        &mut self,
        robot: usize,
        model: &RobotModel,
        initial_state: &InitialState,
    ) -> Result<(), BackendError> {
        self.check_index(robot)?;
        self.reset_robot(robot, model, initial_state);
        Ok(())
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), BackendError> {
        self.check_index(robot)?;
        check_floating(robot, &self.config)?;
        self.worlds[robot].push(velocity);
        self.read_state(robot);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        let robots = self.num_robots();
        check_lengths(commands, active, robots)?;
        let steps = self.config.steps_per_actuator_period(self.robot.control.actuator_hz);
        for _ in 0..actuator_periods {
            self.actuator_period(commands, active, steps)?;
        }
        if let Some(evaluator) = self.actuator.as_mut().and_then(|actuator| actuator.uncertainty()) {
            self.pool.install(|| evaluator.evaluate(active, &mut self.states.truth.epistemic_uncertainty));
        }
        let elapsed = actuator_periods as f64 * self.robot.control.actuator_dt();
        for robot in (0..robots).filter(|robot| active[*robot]) {
            self.read_state(robot);
            self.states.measured.stamp[robot] += elapsed;
        }
        self.check_finite(active)
    }
}

impl Simulator for RapierBackend {
    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn set_derating(&mut self, robot: usize, factors: &PerJoint) {
        self.worlds[robot].set_derating(factors);
    }
}

impl Restorable for RapierBackend {
    type Snapshot = RobotSnapshot;

    fn snapshot(&self, robot: usize) -> RobotSnapshot {
        let mut state = RobotStates::new(1);
        state.copy_robot(0, &self.states, robot);
        let actuator = self.actuator.as_ref().map(|actuator| actuator.snapshot(robot));
        RobotSnapshot { world: self.worlds[robot].snapshot(), state, actuator }
    }

    fn restore(&mut self, robot: usize, snapshot: &RobotSnapshot) {
        self.worlds[robot].restore(&snapshot.world);
        self.states.copy_robot(robot, &snapshot.state, 0);
        if let (Some(actuator), Some(state)) = (&mut self.actuator, &snapshot.actuator) {
            actuator.restore(robot, state);
        }
    }
}
