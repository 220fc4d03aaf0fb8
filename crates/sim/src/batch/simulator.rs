//! Batches of robots behind one trait, so that the register type can be chosen at run time.

use rayon::ThreadPool;
use rayon::prelude::*;
use twinstep_dynamics::quadruped::FactoredDynamics;
use twinstep_dynamics::{SimdCommands, StepEquations};
use twinstep_model::{
    Ground, HistoryStep, InitialState, PerJoint, Precision, RobotModel, RobotStates, RobotStatesMut, RolloutRequest,
};
use twinstep_simd::{InstructionSet, SimdFloat, SimdKernel, SimdTask, with_f32, with_f64};

use super::batch_robot::{BatchRobot, foot_point, is_upper_body};
use super::robot_batch::{LaneSnapshot, RobotBatch, SensorReadings, StepCount};
use super::workspace::{Workspace, WorkspaceShape};
use crate::actuator_input::{ActuatorInput, ActuatorInputs};
use crate::{Placement, SimConfig};

/// Precision of the simulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimdPrecision {
    /// Single precision with this instruction set, for reinforcement learning.
    Single(InstructionSet),
    /// Double precision in the widest registers of the processor, for system identification.
    Double,
}

impl SimdPrecision {
    /// Returns the number of robots that one core steps at once: the lanes of a register.
    pub fn lanes(self) -> usize {
        match self {
            Self::Single(instructions) => with_f32(instructions, LaneCount),
            Self::Double => with_f64(InstructionSet::best(), LaneCount),
        }
    }
}

impl From<Precision> for SimdPrecision {
    /// The widest registers of the processor.
    fn from(precision: Precision) -> Self {
        match precision {
            Precision::Single => Self::Single(InstructionSet::best()),
            Precision::Double => Self::Double,
        }
    }
}

struct LaneCount;

impl SimdTask for LaneCount {
    type Output = usize;

    fn run<T: SimdFloat>(self) -> usize {
        T::LANES
    }
}

/// Robots in batches of any register type.
pub trait BatchSimulator: Send + Sync {
    /// Resets `robot` to an initial state.
    fn place(&mut self, robot: usize, model: &RobotModel, initial_state: &InitialState);
    /// Copies the state of `robot` to `states`.
    fn read(&self, robot: usize, states: &mut RobotStates);
    /// Advances the active robots on the threads of `pool`, or on the current one, and copies their states to `states`.
    ///
    /// Returns true if all numbers are finite.
    fn advance(
        &mut self,
        pool: Option<&ThreadPool>,
        inputs: ActuatorInputs,
        active: &[bool],
        time: StepCount,
        states: &mut RobotStates,
    ) -> bool;
    /// Replays the actuator periods before the initial state into the state of the actuators.
    ///
    /// `past` has one entry per robot; a period has `steps` physics steps.
    fn remember(&mut self, past: &[&[HistoryStep]], steps: usize);
    /// Adds `velocity` to the linear velocity of the base of `robot`, in the world frame [m/s].
    fn push(&mut self, robot: usize, velocity: [f32; 3]);
    /// Sets the factors on the torque of `robot` for supply voltage and motor temperature, until its next reset.
    fn set_derating(&mut self, robot: usize, factors: &PerJoint);
    /// Simulates every robot with the commands of its request on the current thread.
    ///
    /// A period has `steps` physics steps. The state after period `i` is entry `i + 1` of a robot's record.
    fn play(&mut self, requests: &[&RolloutRequest], steps: usize, records: &mut [RobotStates]);
    /// Returns the full state of `robot`.
    fn snapshot(&self, robot: usize) -> LaneSnapshot;
    /// Restores the state of `robot`.
    fn restore(&mut self, robot: usize, snapshot: &LaneSnapshot);
}

/// Creates `num_robots` robots in the state `initial`.
pub fn batch_simulator(
    precision: SimdPrecision,
    model: &RobotModel,
    config: &SimConfig,
    ground: &Ground,
    initial: &InitialState,
    num_robots: usize,
) -> Box<dyn BatchSimulator> {
    let task = MakeBatches { model, config, ground, initial, num_robots };
    match precision {
        SimdPrecision::Single(instructions) => with_f32(instructions, task),
        SimdPrecision::Double => with_f64(InstructionSet::best(), task),
    }
}

struct MakeBatches<'a> {
    model: &'a RobotModel,
    config: &'a SimConfig,
    ground: &'a Ground,
    initial: &'a InitialState,
    num_robots: usize,
}

impl SimdTask for MakeBatches<'_> {
    type Output = Box<dyn BatchSimulator>;

    fn run<T: SimdFloat>(self) -> Self::Output {
        let (actuator_dt, initial) = (self.model.control.actuator_dt(), Placement::from(self.initial));
        let batch = Quadrupeds::<T>::new(self.model, actuator_dt, self.config, self.ground, &initial);
        let shape = batch.workspace_shape();
        Box::new(RobotBatches { shape, batches: vec![batch; self.num_robots.div_ceil(T::LANES)] })
    }
}

type Quadrupeds<T> = RobotBatch<T, FactoredDynamics<T>>;

/// One call of [`RobotBatch::advance`].
struct Advance<'a, T: SimdFloat, E: StepEquations<T>> {
    batch: &'a mut RobotBatch<T, E>,
    input: &'a ActuatorInput<E::Joints>,
    count: StepCount,
    workspace: &'a mut Workspace<T, E>,
}

impl<T: SimdFloat, E: StepEquations<T, Robot: BatchRobot>> SimdKernel for Advance<'_, T, E> {
    type Output = SensorReadings<T, E::Joints>;

    #[inline(always)]
    fn run(self) -> SensorReadings<T, E::Joints> {
        self.batch.advance(self.input, self.count, self.workspace)
    }
}

/// Advances one batch, compiled for the instruction set of its registers.
pub fn advance<T: SimdFloat, E: StepEquations<T, Robot: BatchRobot>>(
    batch: &mut RobotBatch<T, E>,
    input: &ActuatorInput<E::Joints>,
    count: StepCount,
    workspace: &mut Workspace<T, E>,
) -> SensorReadings<T, E::Joints> {
    T::vectorise(Advance { batch, input, count, workspace })
}

struct RobotBatches<T: SimdFloat> {
    batches: Vec<Quadrupeds<T>>,
    shape: WorkspaceShape<T, FactoredDynamics<T>>,
}

impl<T: SimdFloat> BatchSimulator for RobotBatches<T> {
    fn place(&mut self, robot: usize, model: &RobotModel, initial_state: &InitialState) {
        self.batches[robot / T::LANES].place(robot % T::LANES, model, &Placement::from(initial_state));
    }

    fn read(&self, robot: usize, states: &mut RobotStates) {
        let mut all = states.all_mut();
        let group = &self.batches[robot / T::LANES];
        read(group, &group.sample(), robot % T::LANES, &mut all, robot);
    }

    fn advance(
        &mut self,
        pool: Option<&ThreadPool>,
        inputs: ActuatorInputs,
        active: &[bool],
        time: StepCount,
        states: &mut RobotStates,
    ) -> bool {
        let lanes = T::LANES;
        let mut chunks: Vec<_> = states.chunks_mut(lanes).collect();
        let Self { batches, shape } = self;
        let one = |scratch: &mut Workspace<T, FactoredDynamics<T>>,
                   (index, (group, states)): (usize, (&mut Quadrupeds<T>, &mut RobotStatesMut))| {
            let robots = index * lanes..(index * lanes + lanes).min(active.len());
            let input = ActuatorInput::of(inputs.range(robots.clone()));
            advance_active(group, &input, &active[robots], time, scratch, states)
        };
        match pool {
            Some(pool) if batches.len() > 1 => pool.install(|| {
                let groups = batches.par_iter_mut().zip(&mut chunks).enumerate();
                groups.map_init(|| shape.workspace(), one).reduce(|| true, |finite, other| finite && other)
            }),
            _ => {
                let mut scratch = shape.workspace();
                let groups = batches.iter_mut().zip(&mut chunks).enumerate();
                // `count` steps every batch, also after one that diverged.
                groups.map(|group| one(&mut scratch, group)).filter(|finite| !finite).count() == 0
            }
        }
    }

    fn remember(&mut self, past: &[&[HistoryStep]], steps: usize) {
        for (group, past) in self.batches.iter_mut().zip(past.chunks(T::LANES)) {
            group.replay_history(past, steps);
        }
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) {
        self.batches[robot / T::LANES].push(robot % T::LANES, velocity);
    }

    fn set_derating(&mut self, robot: usize, factors: &PerJoint) {
        self.batches[robot / T::LANES].set_derating(robot % T::LANES, factors);
    }

    fn play(&mut self, requests: &[&RolloutRequest], steps: usize, records: &mut [RobotStates]) {
        let mut scratch = self.shape.workspace();
        let robots = requests.chunks(T::LANES).zip(records.chunks_mut(T::LANES));
        for (group, (requests, records)) in self.batches.iter_mut().zip(robots) {
            let mut records: Vec<_> = records.iter_mut().map(RobotStates::all_mut).collect();
            let mut now = SimdCommands::new(&[]);
            let time = StepCount { actuator_periods: 1, steps };
            for period in 0..requests.iter().map(|request| request.commands.len()).max().unwrap_or(0) {
                for lane in 0..T::LANES {
                    // An unused lane copies the last robot. A falling robot would add contacts that cost time.
                    let request = requests[lane.min(requests.len() - 1)];
                    if let Some(command) = request.commands.get(period) {
                        now.set(lane, command);
                    }
                    if let Some(factors) = request.derating.get(period) {
                        group.set_derating(lane, factors);
                    }
                }
                // A robot whose commands have ended is stepped without being recorded. Lanes are independent, so this
                // has no effect on the others.
                let sample = advance(group, &ActuatorInput::Commands(now), time, &mut scratch);
                let recorded = |lane: usize| period < requests[lane].commands.len();
                for (lane, record) in records.iter_mut().enumerate().filter(|(lane, _)| recorded(*lane)) {
                    read(group, &sample, lane, record, period + 1);
                }
            }
        }
    }

    fn snapshot(&self, robot: usize) -> LaneSnapshot {
        self.batches[robot / T::LANES].clone().snapshot(robot % T::LANES)
    }

    fn restore(&mut self, robot: usize, snapshot: &LaneSnapshot) {
        self.batches[robot / T::LANES].restore(robot % T::LANES, snapshot);
    }
}

/// Advances the active robots of a batch and copies their states to `states`. The others do not change.
///
/// Returns true if all numbers are finite.
fn advance_active<T: SimdFloat>(
    group: &mut Quadrupeds<T>,
    input: &ActuatorInput<[T; 12]>,
    active: &[bool],
    time: StepCount,
    scratch: &mut Workspace<T, FactoredDynamics<T>>,
    states: &mut RobotStatesMut,
) -> bool {
    if active.iter().all(|active| !active) {
        return true;
    }
    let inactive = (0..active.len()).filter(|lane| !active[*lane]);
    let inactive: Vec<_> = inactive.map(|lane| (lane, group.snapshot(lane))).collect();
    let sample = advance(group, input, time, scratch);
    for (lane, snapshot) in inactive {
        group.restore(lane, &snapshot);
    }
    let mut finite = true;
    for lane in (0..active.len()).filter(|lane| active[*lane]) {
        read(group, &sample, lane, states, lane);
        finite &= is_finite(states, lane);
    }
    finite
}

/// Copies the state of one robot of a batch to entry `at` of `states`.
fn read<T: SimdFloat>(
    group: &Quadrupeds<T>,
    sample: &SensorReadings<T, [T; 12]>,
    lane: usize,
    states: &mut RobotStatesMut,
    at: usize,
) {
    let state = group.state();
    states.base_position[at] = values(&sample.position.0, lane);
    states.orientation[at] = values(&sample.orientation, lane);
    states.base_linear_velocity[at] = values(&state.linear_velocity.0, lane);
    states.base_angular_velocity[at] = values(&state.angular_velocity.0, lane);
    states.gyro[at] = std::array::from_fn(|axis| group.gyro(lane, axis) as f32);
    states.q[at] = values(&sample.q, lane);
    states.dq[at] = values(&sample.dq, lane);
    states.tau[at] = values(group.tau(), lane);
    states.foot_force[at] = std::array::from_fn(|leg| group.point_force(lane, foot_point(leg)) as f32);
    let mut upper_body = (0..group.num_points()).filter(|point| is_upper_body(*point));
    states.body_contact[at] = upper_body.any(|point| group.point_force(lane, point) > 0.0);
}

/// Returns true if all numbers of a robot are finite.
fn is_finite(states: &RobotStatesMut, robot: usize) -> bool {
    // A sum with a term that is not finite is not finite. The finite terms are too small to overflow.
    let sum = |values: &[f32]| values.iter().sum::<f32>();
    let trunk = sum(&states.base_position[robot]) + sum(&states.orientation[robot]);
    let velocity = sum(&states.base_linear_velocity[robot]) + sum(&states.gyro[robot]);
    (trunk + velocity + sum(&states.q[robot]) + sum(&states.dq[robot]) + sum(&states.tau[robot])).is_finite()
}

fn values<T: SimdFloat, const N: usize>(values: &[T; N], lane: usize) -> [f32; N] {
    let mut read = [0.0; N];
    for (read, value) in read.iter_mut().zip(values) {
        *read = value.get(lane) as f32;
    }
    read
}
