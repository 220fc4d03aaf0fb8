//! Batches of robots of any tree, behind one trait, so that the register type can be chosen at run time.

use rayon::prelude::*;
use twinstep_dynamics::SimdCommands;
use twinstep_dynamics::tree::TreeEquations;
use twinstep_model::TreeModel;
use twinstep_simd::{InstructionSet, SimdFloat, SimdTask, with_f32, with_f64};

use super::robot_batch::{RobotBatch, SensorReadings, StepCount};
use super::simulator::{SimdPrecision, advance};
use super::workspace::{Workspace, WorkspaceShape};
use crate::actuator_input::ActuatorInput;
use crate::tree_engine::{TreeCommand, TreeEngine, TreeReadings};
use crate::tree_error::TreeError;
use crate::{Placement, SimConfig};

/// Creates robots of any tree in a state.
pub fn tree_batches(
    precision: SimdPrecision,
    robot: &TreeModel,
    config: &SimConfig,
    actuator_dt: f64,
    num_robots: usize,
    initial_state: &Placement,
) -> Box<dyn TreeEngine> {
    let task = MakeBatches { robot, config, actuator_dt, initial_state, num_robots };
    match precision {
        SimdPrecision::Single(instructions) => with_f32(instructions, task),
        SimdPrecision::Double => with_f64(InstructionSet::best(), task),
    }
}

struct MakeBatches<'a> {
    robot: &'a TreeModel,
    config: &'a SimConfig,
    actuator_dt: f64,
    initial_state: &'a Placement,
    num_robots: usize,
}

impl SimdTask for MakeBatches<'_> {
    type Output = Box<dyn TreeEngine>;

    fn run<T: SimdFloat>(self) -> Self::Output {
        let ground = self.config.terrain.ground();
        let batch = RobotBatch::new(self.robot, self.actuator_dt, self.config, &ground, self.initial_state);
        let (shape, count) = (batch.workspace_shape(), self.num_robots.div_ceil(T::LANES));
        let shapes = self.robot.points.iter().map(|point| point.shape).collect();
        Box::new(Trees::<T> { workspace: shape.workspace(), shape, batches: vec![batch; count], shapes })
    }
}

type TreeBatch<T> = RobotBatch<T, TreeEquations<T>>;
/// A batch, the commands of its robots and their readings.
type Robots<'a, T> = (&'a mut TreeBatch<T>, (&'a [TreeCommand], &'a mut [TreeReadings]));

struct Trees<T: SimdFloat> {
    batches: Vec<TreeBatch<T>>,
    shape: WorkspaceShape<T, TreeEquations<T>>,
    /// Workspace of steps on one thread.
    workspace: Workspace<T, TreeEquations<T>>,
    /// Shape of each contact point.
    shapes: Vec<usize>,
}

impl<T: SimdFloat> TreeEngine for Trees<T> {
    fn place(&mut self, robot: usize, model: &TreeModel, state: &Placement) -> Result<(), TreeError> {
        self.batches[robot / T::LANES].place(robot % T::LANES, model, state);
        Ok(())
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), TreeError> {
        self.batches[robot / T::LANES].push(robot % T::LANES, velocity);
        Ok(())
    }

    fn read(&self, robot: usize, readings: &mut TreeReadings) {
        let batch = &self.batches[robot / T::LANES];
        read(batch, &batch.sample(), robot % T::LANES, &self.shapes, readings);
    }

    fn advance(
        &mut self,
        commands: &[TreeCommand],
        [actuator_periods, steps]: [usize; 2],
        states: &mut [TreeReadings],
        parallel: bool,
    ) -> Result<(), TreeError> {
        let count = StepCount { actuator_periods, steps };
        let Self { batches, shape, workspace, shapes } = self;
        let one = |workspace: &mut Workspace<T, TreeEquations<T>>, (batch, (commands, states)): Robots<'_, T>| {
            let mut input = SimdCommands::zero(batch.tau().len());
            for (lane, TreeCommand { q, dq, tau_ff, kp, kd }) in commands.iter().enumerate() {
                input.set_targets(lane, q, dq, tau_ff, [kp, kd]);
            }
            let sample = advance(batch, &ActuatorInput::Commands(input), count, workspace);
            for (lane, readings) in states.iter_mut().enumerate() {
                read(batch, &sample, lane, shapes, readings);
            }
        };
        if parallel && batches.len() > 1 {
            let robots = commands.par_chunks(T::LANES).zip(states.par_chunks_mut(T::LANES));
            batches.par_iter_mut().zip(robots).for_each_init(|| shape.workspace(), one);
        } else {
            let robots = commands.chunks(T::LANES).zip(states.chunks_mut(T::LANES));
            batches.iter_mut().zip(robots).for_each(|robots| one(workspace, robots));
        }
        Ok(())
    }
}

fn read<T: SimdFloat>(
    batch: &TreeBatch<T>,
    sample: &SensorReadings<T, Vec<T>>,
    lane: usize,
    shapes: &[usize],
    readings: &mut TreeReadings,
) {
    let (state, truth) = (&mut readings.state, batch.state());
    get(&mut state.base_position, &sample.position.0, lane);
    get(&mut state.base_orientation, &sample.orientation, lane);
    get(&mut state.base_linear_velocity, &truth.linear_velocity.0, lane);
    get(&mut state.base_angular_velocity, &truth.angular_velocity.0, lane);
    get(&mut state.q, &sample.q, lane);
    get(&mut state.dq, &sample.dq, lane);
    get(&mut readings.tau, batch.tau().as_ref(), lane);
    readings.shape_force.fill(0.0);
    for (point, shape) in shapes.iter().enumerate() {
        readings.shape_force[*shape] += batch.point_force(lane, point);
    }
}

fn get<T: SimdFloat>(read: &mut [f64], values: &[T], lane: usize) {
    for (read, value) in read.iter_mut().zip(values) {
        *read = value.get(lane);
    }
}
