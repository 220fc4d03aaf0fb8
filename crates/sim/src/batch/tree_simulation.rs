//! Robots of any tree in the batch engine.

use rayon::prelude::*;
use twinstep_dynamics::SimdCommands;
use twinstep_dynamics::tree::TreeEquations;
use twinstep_model::{Ground, TreeModel};
use twinstep_simd::{InstructionSet, SimdFloat, SimdTask, with_f32, with_f64};

use super::actuator_input::ActuatorInput;
use super::robot_batch::{Placement, RobotBatch, SensorReadings, StepCount, Workspace, WorkspaceShape};
use super::simulator::{SimdPrecision, advance};
use crate::{BackendBuildError, SimConfig};

/// Robots of any tree, one per SIMD lane. All have the same tree; their numbers may differ.
pub struct TreeSimulation {
    batches: Box<dyn TreeBatches>,
    states: Vec<TreeReadings>,
    pool: Option<std::sync::Arc<rayon::ThreadPool>>,
    /// Physics steps per actuator period.
    steps: usize,
}

/// Commands of one robot of `n` joints for one actuator period. Each has an entry for each joint.
///
/// The torque of each joint is `kp (q − q_measured) + kd (dq − dq_measured) + tau_ff`, clipped to the joint's limit.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeCommand {
    /// Commanded position [rad or m].
    pub q: Vec<f32>,
    /// Commanded velocity [rad/s or m/s].
    pub dq: Vec<f32>,
    /// Feed-forward torque [N·m or N].
    pub tau_ff: Vec<f32>,
    /// Position gain [N·m/rad or N/m].
    pub kp: Vec<f32>,
    /// Velocity gain [N·m·s/rad or N·s/m].
    pub kd: Vec<f32>,
}

impl TreeCommand {
    /// Returns a command that holds `q` [rad or m] with gains `kp` and `kd` on every joint.
    pub fn hold(q: Vec<f32>, kp: f32, kd: f32) -> Self {
        let n = q.len();
        Self { q, dq: vec![0.0; n], tau_ff: vec![0.0; n], kp: vec![kp; n], kd: vec![kd; n] }
    }
}

/// Sensor readings and true state of one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeReadings {
    /// Pose and velocity of the base, and readings of the encoders.
    pub state: Placement,
    /// Estimated torque of each joint, mean over the last actuator period [N·m or N].
    pub tau: Vec<f64>,
    /// Normal force on each contact point in the last step [N], in the order of [`TreeModel::points`].
    pub point_force: Vec<f64>,
}

impl TreeSimulation {
    /// Creates `num_robots` robots in a state, whose actuators have the rate `actuator_hz` [Hz].
    ///
    /// The base of `robot` moves if `config` says floating and the robot's tree does not fix it.
    pub fn new(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_hz: f64,
        precision: SimdPrecision,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Result<Self, BackendBuildError> {
        config.check(actuator_hz)?;
        let config = &config.at_actuator_rate(actuator_hz);
        let pool = if config.threads == 1 { None } else { Some(crate::thread_pool::thread_pool(config.threads)?) };
        let task = MakeBatches { robot, config, actuator_dt: 1.0 / actuator_hz, initial_state, num_robots };
        let batches = match precision {
            SimdPrecision::Single(instructions) => with_f32(instructions, task),
            SimdPrecision::Double => with_f64(InstructionSet::best(), task),
        };
        let states = (0..num_robots).map(|robot| batches.read(robot)).collect();
        Ok(Self { batches, states, pool, steps: config.steps_per_actuator_period(actuator_hz) })
    }

    /// Returns the number of robots.
    pub fn num_robots(&self) -> usize {
        self.states.len()
    }

    /// Resets a robot to a state, with the parameters of `model`.
    pub fn reset(&mut self, robot: usize, model: &TreeModel, state: &Placement) {
        self.batches.place(robot, model, state);
        self.states[robot] = self.batches.read(robot);
    }

    /// Advances every robot by `actuator_periods` under its command.
    pub fn step(&mut self, commands: &[TreeCommand], actuator_periods: usize) {
        let count = StepCount { actuator_periods, steps: self.steps };
        let Self { batches, states, pool, .. } = self;
        match pool {
            Some(pool) => pool.install(|| batches.advance(commands, count, states, true)),
            None => batches.advance(commands, count, states, false),
        }
    }

    /// Returns the readings of every robot.
    pub fn states(&self) -> &[TreeReadings] {
        &self.states
    }
}

/// Batches of any register type.
trait TreeBatches: Send + Sync {
    fn place(&mut self, robot: usize, model: &TreeModel, state: &Placement);
    fn read(&self, robot: usize) -> TreeReadings;
    fn advance(&mut self, commands: &[TreeCommand], count: StepCount, states: &mut [TreeReadings], parallel: bool);
}

struct MakeBatches<'a> {
    robot: &'a TreeModel,
    config: &'a SimConfig,
    actuator_dt: f64,
    initial_state: &'a Placement,
    num_robots: usize,
}

impl SimdTask for MakeBatches<'_> {
    type Output = Box<dyn TreeBatches>;

    fn run<T: SimdFloat>(self) -> Self::Output {
        let ground: Ground = self.config.terrain.ground();
        let batch = RobotBatch::new(self.robot, self.actuator_dt, self.config, &ground, self.initial_state);
        let (shape, count) = (batch.workspace_shape(), self.num_robots.div_ceil(T::LANES));
        Box::new(Trees::<T> { shape, batches: vec![batch; count] })
    }
}

type TreeBatch<T> = RobotBatch<T, TreeEquations<T>>;
/// A batch, the commands of its robots and their readings.
type Robots<'a, T> = (&'a mut TreeBatch<T>, (&'a [TreeCommand], &'a mut [TreeReadings]));

struct Trees<T: SimdFloat> {
    batches: Vec<TreeBatch<T>>,
    shape: WorkspaceShape<T, TreeEquations<T>>,
}

impl<T: SimdFloat> TreeBatches for Trees<T> {
    fn place(&mut self, robot: usize, model: &TreeModel, state: &Placement) {
        self.batches[robot / T::LANES].place(robot % T::LANES, model, state);
    }

    fn read(&self, robot: usize) -> TreeReadings {
        let batch = &self.batches[robot / T::LANES];
        let sample = batch.sample();
        let joints = batch.tau().len();
        let mut readings = TreeReadings {
            state: Placement::at_rest(0.0, vec![0.0; joints]),
            tau: vec![0.0; joints],
            point_force: vec![0.0; batch.num_points()],
        };
        read(batch, &sample, robot % T::LANES, &mut readings);
        readings
    }

    fn advance(&mut self, commands: &[TreeCommand], count: StepCount, states: &mut [TreeReadings], parallel: bool) {
        let Self { batches, shape } = self;
        let one = |workspace: &mut Workspace<T, TreeEquations<T>>, (batch, (commands, states)): Robots<'_, T>| {
            let mut input = SimdCommands::zero(batch.tau().len());
            for (lane, TreeCommand { q, dq, tau_ff, kp, kd }) in commands.iter().enumerate() {
                input.set_targets(lane, q, dq, tau_ff, [kp, kd]);
            }
            let sample = advance(batch, &ActuatorInput::Commands(input), count, workspace);
            for (lane, readings) in states.iter_mut().enumerate() {
                read(batch, &sample, lane, readings);
            }
        };
        if parallel && batches.len() > 1 {
            let robots = commands.par_chunks(T::LANES).zip(states.par_chunks_mut(T::LANES));
            batches.par_iter_mut().zip(robots).for_each_init(|| shape.workspace(), one);
        } else {
            let mut workspace = shape.workspace();
            let robots = commands.chunks(T::LANES).zip(states.chunks_mut(T::LANES));
            batches.iter_mut().zip(robots).for_each(|robots| one(&mut workspace, robots));
        }
    }
}

fn read<T: SimdFloat>(
    batch: &TreeBatch<T>,
    sample: &SensorReadings<T, Vec<T>>,
    lane: usize,
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
    for (point, force) in readings.point_force.iter_mut().enumerate() {
        *force = batch.point_force(lane, point);
    }
}

fn get<T: SimdFloat>(read: &mut [f64], values: &[T], lane: usize) {
    for (read, value) in read.iter_mut().zip(values) {
        *read = value.get(lane);
    }
}
