//! Robots of any tree in rapier, one world per robot.

use rayon::prelude::*;
use twinstep_dynamics::SimdCommands;
use twinstep_model::TreeModel;

use crate::actuator_input::ActuatorInput;
use crate::ground_shapes::GroundShapes;
use crate::robot_world::{RobotWorld, WorldRobot};
use crate::tree_engine::{TreeCommand, TreeEngine, TreeReadings};
use crate::tree_error::TreeError;
use crate::{Placement, SimConfig};

/// Robots of one tree.
pub struct RapierTrees {
    worlds: Vec<RobotWorld>,
    config: SimConfig,
    ground: GroundShapes,
    actuator_dt: f64,
    /// Index in the tree of each collision shape of a world.
    shapes: Vec<usize>,
}

impl RapierTrees {
    /// Creates robots in a state.
    pub fn new(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_dt: f64,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Self {
        let ground = GroundShapes::new(&config.terrain.ground());
        let model = WorldRobot::of_tree(robot, actuator_dt);
        let worlds = (0..num_robots).map(|_| RobotWorld::new(&model, config, &ground, initial_state)).collect();
        Self { worlds, config: *config, ground, actuator_dt, shapes: model.shapes_of_tree }
    }
}

impl TreeEngine for RapierTrees {
    fn place(&mut self, robot: usize, model: &TreeModel, state: &Placement) -> Result<(), TreeError> {
        let model = WorldRobot::of_tree(model, self.actuator_dt);
        self.worlds[robot] = RobotWorld::new(&model, &self.config, &self.ground, state);
        Ok(())
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), TreeError> {
        self.worlds[robot].push(velocity);
        Ok(())
    }

    fn read(&self, robot: usize, readings: &mut TreeReadings) {
        read(&self.worlds[robot], &self.shapes, readings);
    }

    fn advance(
        &mut self,
        commands: &[TreeCommand],
        [periods, steps]: [usize; 2],
        states: &mut [TreeReadings],
        parallel: bool,
    ) -> Result<(), TreeError> {
        let Self { worlds, shapes, .. } = self;
        let one = |(world, (command, readings)): (&mut RobotWorld, (&TreeCommand, &mut TreeReadings))| {
            let mut input = SimdCommands::zero::<f64>(command.q.len());
            let TreeCommand { q, dq, tau_ff, kp, kd } = command;
            input.set_targets::<f64>(0, q, dq, tau_ff, [kp, kd]);
            for _ in 0..periods {
                readings.tau = world.actuator_period(ActuatorInput::Commands(input.clone()), steps);
            }
            read(world, shapes, readings);
        };
        if parallel {
            worlds.par_iter_mut().zip(commands.par_iter().zip(states)).for_each(one);
        } else {
            worlds.iter_mut().zip(commands.iter().zip(states)).for_each(one);
        }
        Ok(())
    }
}

fn read(world: &RobotWorld, shapes: &[usize], readings: &mut TreeReadings) {
    let (base, state) = (world.read_base(), &mut readings.state);
    state.base_position = base.position.map(f64::from);
    state.base_orientation = base.orientation.map(f64::from);
    state.base_linear_velocity = base.linear_velocity.map(f64::from);
    state.base_angular_velocity = base.angular_velocity.map(f64::from);
    (state.q, state.dq) = world.read_joints();
    for (shape, force) in shapes.iter().zip(world.shape_forces()) {
        readings.shape_force[*shape] = f64::from(force);
    }
}
