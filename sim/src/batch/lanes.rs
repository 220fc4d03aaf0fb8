//! Groups of one lane type, below one seam: which lanes run is chosen when a backend is made.

use rayon::ThreadPool;
use rayon::prelude::*;
#[cfg(not(target_arch = "x86_64"))]
use twinstep_model::lanes::F32x4 as Baseline;
#[cfg(target_arch = "x86_64")]
use twinstep_model::lanes::{Avx2F32, Avx2F64, Avx512F32, Sse2F32 as Baseline};
use twinstep_model::lanes::{SimdCommands, InstructionSet, SimdFloat};
use twinstep_model::{Command, Ground, HistoryStep, PerJoint, InitialState, RobotModel, RobotStates, RobotStatesMut};

use super::group::{RobotBatch, ActuatorInput, LaneSnapshot, SensorReadings, Workspace, StepCount};
use crate::SimConfig;

/// Which numbers robots are simulated in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimdPrecision {
    /// Single precision in the registers of these instructions: for learning.
    Single(InstructionSet),
    /// Double precision in the widest registers of this processor: for identification.
    Double,
}

/// What turns into torque, for all robots.
#[derive(Clone, Copy)]
pub enum ActuatorInputs<'a> {
    /// Commands that the robots' own drives follow, one a robot.
    Commands(&'a [Command]),
    /// Torques [N·m], one entry a robot, held.
    Torques(&'a [PerJoint]),
}

/// Robots in groups of any lane type.
pub trait BatchSimulator: Send + Sync {
    /// Places `robot` anew.
    fn place(&mut self, robot: usize, model: &RobotModel, placement: &InitialState);
    /// Copies the state of `robot` out.
    fn read(&self, robot: usize, states: &mut RobotStates);
    /// Advances the active robots on the threads of `pool`, or on this one, and copies their states out. True if all
    /// numbers are finite.
    fn advance(
        &mut self,
        pool: Option<&ThreadPool>,
        inputs: ActuatorInputs,
        active: &[bool],
        time: StepCount,
        states: &mut RobotStates,
    ) -> bool;
    /// Lets the drives remember what robots did in drive periods of `steps` physics steps before they were placed.
    fn remember(&mut self, past: &[&[HistoryStep]], steps: usize);
    /// Plays commands, one a drive period of `steps` physics steps, through every robot on this thread. What a robot
    /// does is written to entries 1 and up of its record.
    fn play(&mut self, commands: &[&[Command]], steps: usize, records: &mut [RobotStates]);
    /// The full state of `robot`.
    fn snapshot(&self, robot: usize) -> LaneSnapshot;
    /// Puts `robot` back.
    fn restore(&mut self, robot: usize, snapshot: &LaneSnapshot);
}

/// `num_robots` robots that stand as `placement` says.
///
/// # Panics
/// If the processor lacks the instructions that `lanes` names.
pub fn robots(
    lanes: SimdPrecision,
    model: &RobotModel,
    config: &SimConfig,
    ground: &Ground,
    placement: &InitialState,
    num_robots: usize,
) -> Box<dyn BatchSimulator> {
    let instructions = match lanes {
        SimdPrecision::Single(instructions) => instructions,
        SimdPrecision::Double => InstructionSet::best(),
    };
    assert!(InstructionSet::available().contains(&instructions), "this processor has no {instructions:?}");
    macro_rules! of {
        ($lane:ty, $advance:ident) => {
            Box::new(Groups::<$lane> {
                groups: vec![Group::new(model, config, ground, placement); num_robots.div_ceil(<$lane>::LANES)],
                advance: $advance,
            })
        };
    }
    match lanes {
        #[cfg(target_arch = "x86_64")]
        SimdPrecision::Single(InstructionSet::Avx512) => of!(Avx512F32, advance_avx512),
        #[cfg(target_arch = "x86_64")]
        SimdPrecision::Single(InstructionSet::Avx2) => of!(Avx2F32, advance_avx2),
        #[cfg(target_arch = "x86_64")]
        SimdPrecision::Double if instructions >= InstructionSet::Avx2 => of!(Avx2F64, advance_avx2_double),
        SimdPrecision::Single(_) => of!(Baseline, advance_baseline),
        SimdPrecision::Double => of!(f64, advance_baseline),
    }
}

/// Advances one group.
type Advance<T> = fn(&mut RobotBatch<T>, &ActuatorInput<T>, StepCount, &mut Workspace<T>) -> SensorReadings<T>;

struct RobotBatches<T> {
    groups: Vec<RobotBatch<T>>,
    advance: Advance<T>,
}

impl<T: SimdFloat> BatchSimulator for RobotBatches<T> {
    fn place(&mut self, robot: usize, model: &RobotModel, placement: &InitialState) {
        self.groups[robot / T::LANES].place(robot % T::LANES, model, placement);
    }

    fn read(&self, robot: usize, states: &mut RobotStates) {
        let mut all = states.all_mut();
        let group = &self.groups[robot / T::LANES];
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
        let (lanes, advance) = (T::LANES, self.advance);
        let mut chunks: Vec<_> = states.chunks_mut(lanes).collect();
        let one = |scratch: &mut Workspace<T>,
                   (index, (group, states)): (usize, (&mut RobotBatch<T>, &mut RobotStatesMut))| {
            let robots = index * lanes..(index * lanes + lanes).min(active.len());
            let input = match inputs {
                ActuatorInputs::Commands(commands) => ActuatorInput::Commands(SimdCommands::new(&commands[robots.clone()])),
                ActuatorInputs::Torques(tau) => ActuatorInput::torques(&tau[robots.clone()]),
            };
            advance_active(group, advance, &input, &active[robots], time, scratch, states)
        };
        match pool {
            Some(pool) if self.groups.len() > 1 => pool.install(|| {
                let groups = self.groups.par_iter_mut().zip(&mut chunks).enumerate();
                groups.map_init(Workspace::empty, one).reduce(|| true, |finite, other| finite && other)
            }),
            _ => {
                let mut scratch = Workspace::empty();
                let groups = self.groups.iter_mut().zip(&mut chunks).enumerate();
                // Every group is to be stepped, also after one that is not finite.
                groups.map(|group| one(&mut scratch, group)).filter(|finite| !finite).count() == 0
            }
        }
    }

    fn remember(&mut self, past: &[&[HistoryStep]], steps: usize) {
        for (group, past) in self.groups.iter_mut().zip(past.chunks(T::LANES)) {
            group.replay_history(past, steps);
        }
    }

    fn play(&mut self, commands: &[&[Command]], steps: usize, records: &mut [RobotStates]) {
        let mut scratch = Workspace::empty();
        let robots = commands.chunks(T::LANES).zip(records.chunks_mut(T::LANES));
        for (group, (commands, records)) in self.groups.iter_mut().zip(robots) {
            let mut records: Vec<_> = records.iter_mut().map(RobotStates::all_mut).collect();
            let mut now = SimdCommands::new(&[]);
            let time = StepCount { drive_periods: 1, steps };
            for period in 0..commands.iter().map(|commands| commands.len()).max().unwrap_or(0) {
                for lane in 0..T::LANES {
                    // A robot without commands does as the last: left to fall, it would touch what no other touches.
                    if let Some(command) = commands[lane.min(commands.len() - 1)].get(period) {
                        now.set(lane, command);
                    }
                }
                // Who is done runs on unrecorded, which costs nothing: lanes do not touch each other.
                let sample = (self.advance)(group, &ActuatorInput::Commands(now), time, &mut scratch);
                for (lane, record) in records.iter_mut().enumerate().filter(|(lane, _)| period < commands[*lane].len())
                {
                    read(group, &sample, lane, record, period + 1);
                }
            }
        }
    }

    fn snapshot(&self, robot: usize) -> LaneSnapshot {
        self.groups[robot / T::LANES].clone().snapshot(robot % T::LANES)
    }

    fn restore(&mut self, robot: usize, snapshot: &LaneSnapshot) {
        self.groups[robot / T::LANES].restore(robot % T::LANES, snapshot);
    }
}

/// Advances the active robots of a group and copies them out; the others stay as they are. True if all numbers are
/// finite.
fn advance_active<T: SimdFloat>(
    group: &mut RobotBatch<T>,
    advance: Advance<T>,
    input: &ActuatorInput<T>,
    active: &[bool],
    time: StepCount,
    scratch: &mut Workspace<T>,
    states: &mut RobotStatesMut,
) -> bool {
    if active.iter().all(|active| !active) {
        return true;
    }
    let asleep = (0..active.len()).filter(|lane| !active[*lane]);
    let asleep: Vec<_> = asleep.map(|lane| (lane, group.snapshot(lane))).collect();
    let sample = advance(group, input, time, scratch);
    for (lane, snapshot) in asleep {
        group.restore(lane, &snapshot);
    }
    let mut finite = true;
    for lane in (0..active.len()).filter(|lane| active[*lane]) {
        read(group, &sample, lane, states, lane);
        finite &= is_finite(states, lane);
    }
    finite
}

/// Copies one robot of a group out to entry `at`.
fn read<T: SimdFloat>(group: &RobotBatch<T>, sample: &SensorReadings<T>, lane: usize, states: &mut RobotStatesMut, at: usize) {
    let state = group.state();
    states.base_position[at] = values(&sample.position.0, lane);
    states.base_orientation[at] = values(&sample.orientation, lane);
    states.base_linear_velocity[at] = values(&state.linear_velocity.0, lane);
    states.base_angular_velocity[at] = std::array::from_fn(|axis| group.gyro(lane, axis) as f32);
    states.q[at] = values(&sample.q, lane);
    states.dq[at] = values(&sample.dq, lane);
    states.tau[at] = values(group.tau(), lane);
    states.foot_force[at] = std::array::from_fn(|leg| group.foot_force(lane, leg) as f32);
    states.body_contact[at] = group.body_contact(lane);
}

/// True if all numbers of a robot are finite.
fn is_finite(states: &RobotStatesMut, robot: usize) -> bool {
    // What is not finite anywhere makes the sum so; a sum of finite numbers as small as these is finite.
    let sum = |values: &[f32]| values.iter().sum::<f32>();
    let trunk = sum(&states.base_position[robot]) + sum(&states.base_orientation[robot]);
    let velocity = sum(&states.base_linear_velocity[robot]) + sum(&states.base_angular_velocity[robot]);
    (trunk + velocity + sum(&states.q[robot]) + sum(&states.dq[robot]) + sum(&states.tau[robot])).is_finite()
}

fn values<T: SimdFloat, const N: usize>(values: &[T; N], lane: usize) -> [f32; N] {
    let mut read = [0.0; N];
    for (read, value) in read.iter_mut().zip(values) {
        *read = value.get(lane) as f32;
    }
    read
}

/// A function that advances a group, with the instructions that its lanes are made of.
macro_rules! entry {
    ($safe:ident, $entry:ident, $feature:literal, $lane:ty) => {
        #[cfg(target_arch = "x86_64")]
        fn $safe(
            group: &mut Group<$lane>,
            input: &Input<$lane>,
            time: Time,
            scratch: &mut Scratch<$lane>,
        ) -> Sample<$lane> {
            // SAFETY: `robots` has made sure that the processor has them.
            #[allow(unsafe_code)]
            unsafe {
                $entry(group, input, time, scratch)
            }
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = $feature)]
        fn $entry(
            group: &mut Group<$lane>,
            input: &Input<$lane>,
            time: Time,
            scratch: &mut Scratch<$lane>,
        ) -> Sample<$lane> {
            group.advance(input, time, scratch)
        }
    };
}

entry!(advance_avx512, enter_avx512, "avx512f", Avx512F32);
entry!(advance_avx2, enter_avx2, "avx2", Avx2F32);
entry!(advance_avx2_double, enter_avx2_double, "avx2", Avx2F64);

fn advance_baseline<T: SimdFloat>(
    group: &mut RobotBatch<T>,
    input: &ActuatorInput<T>,
    time: StepCount,
    scratch: &mut Workspace<T>,
) -> SensorReadings<T> {
    group.advance(input, time, scratch)
}
