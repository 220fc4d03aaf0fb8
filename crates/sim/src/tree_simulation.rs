//! Robots of any tree, in the batch engine or in rapier.

use std::sync::Arc;

use twinstep_model::TreeModel;
use twinstep_simd::InstructionSet;

use crate::batch::{SimdPrecision, tree_batches};
use crate::rapier_trees::RapierTrees;
use crate::thread_pool::thread_pool;
use crate::tree_engine::{TreeCommand, TreeEngine, TreeReadings};
use crate::{BackendBuildError, Engine, Placement, SimConfig, SimConfigError};

/// Simulation of robots of one tree; their numbers may differ.
pub struct TreeSimulation {
    engine: Box<dyn TreeEngine>,
    states: Vec<TreeReadings>,
    pool: Option<Arc<rayon::ThreadPool>>,
    /// Physics steps per actuator period.
    steps: usize,
}

impl TreeSimulation {
    /// Creates `num_robots` robots in a state, whose actuators have the rate `actuator_hz` [Hz], in single precision and the widest
    /// registers.
    ///
    /// The base of `robot` moves if `config` says floating and the robot's tree does not fix it. Fails if the engine of `config` is
    /// MuJoCo, if the robot has no joint, and if a setting is not allowed.
    pub fn new(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_hz: f64,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Result<Self, BackendBuildError> {
        let precision = SimdPrecision::Single(InstructionSet::best());
        Self::with_precision(robot, config, actuator_hz, precision, num_robots, initial_state)
    }

    /// Creates robots like [`TreeSimulation::new`], in the given precision. rapier has single precision only.
    pub fn with_precision(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_hz: f64,
        precision: SimdPrecision,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Result<Self, BackendBuildError> {
        config.check(actuator_hz)?;
        let mut config = config.at_actuator_rate(actuator_hz);
        if let Some(mount) = robot.tree.base.filter(|mount| mount.is_fixed()) {
            config.base = mount;
        }
        let engine: Box<dyn TreeEngine> = match config.engine {
            _ if robot.joints.is_empty() => {
                return Err(refused("robot", &robot.tree.name, "a robot with joints").into());
            }
            Engine::Batch => tree_batches(precision, robot, &config, 1.0 / actuator_hz, num_robots, initial_state),
            Engine::Rapier => Box::new(RapierTrees::new(robot, &config, 1.0 / actuator_hz, num_robots, initial_state)),
            Engine::Mujoco => {
                return Err(refused("engine", "mujoco", "`batch` or `rapier` for a robot of any tree").into());
            }
        };
        let pool = if config.threads == 1 { None } else { Some(thread_pool(config.threads)?) };
        let mut states = vec![TreeReadings::zero(robot); num_robots];
        states.iter_mut().enumerate().for_each(|(robot, readings)| engine.read(robot, readings));
        Ok(Self { engine, states, pool, steps: config.steps_per_actuator_period(actuator_hz) })
    }

    /// Returns the number of robots.
    pub fn num_robots(&self) -> usize {
        self.states.len()
    }

    /// Resets a robot to a state, with the parameters of `model`.
    pub fn reset(&mut self, robot: usize, model: &TreeModel, state: &Placement) {
        self.engine.place(robot, model, state);
        self.engine.read(robot, &mut self.states[robot]);
    }

    /// Advances every robot by `actuator_periods` under its command.
    pub fn step(&mut self, commands: &[TreeCommand], actuator_periods: usize) {
        let Self { engine, states, pool, steps } = self;
        let count = [actuator_periods, *steps];
        match pool {
            Some(pool) => pool.install(|| engine.advance(commands, count, states, true)),
            None => engine.advance(commands, count, states, false),
        }
    }

    /// Returns the readings of every robot.
    pub fn states(&self) -> &[TreeReadings] {
        &self.states
    }
}

fn refused(field: &'static str, value: &str, allowed: &str) -> SimConfigError {
    SimConfigError { field, value: value.to_owned(), allowed: allowed.to_owned() }
}
