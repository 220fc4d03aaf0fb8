//! The batch engine: one robot per SIMD lane.
//!
//! The robots of a batch have the same kinematic tree and differ only in parameter values. One SIMD register therefore holds eight or
//! sixteen robots. The engine is written for any [`StepEquations`](twinstep_dynamics::StepEquations): those of any tree, or those of a
//! quadruped, which are faster.
//!
//! - [`batch_robot`]: what the engine needs of a robot.
//! - [`surface`]: what of a robot touches the ground. [`contact`], [`rows`], [`ground`] and [`field`]: contacts, joint limits and joint friction as MuJoCo's soft constraints.
//! - [`group`]: a [`robot_batch::RobotBatch`] is the state of the robots in one register.
//! - [`simulator`]: steps batches on all cores, in the widest registers of the processor.
//! - [`BatchBackend`]: the engine for quadrupeds. [`trees`]: robots of any tree.
//!
//! The results are bitwise equal for any instruction set, batch size and number of threads; see
//! [`twinstep_simd::SimdFloat`].

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]
#![allow(clippy::needless_range_loop, reason = "matrix indices as in the textbook")]

mod batch_robot;
mod contact;
mod field;
mod ground;
mod robot_batch;
mod rows;
mod simulator;
mod surface;
mod trees;
mod workspace;

use std::sync::Arc;

use twinstep_model::{
    Actuator, ActuatorSnapshot, Backend, BackendError, Command, Ground, GroundTruth, InitialState, Measured, PerJoint,
    Restorable, RobotModel, RobotStates, Simulator,
};
use twinstep_simd::InstructionSet;

pub use simulator::SimdPrecision;
pub(crate) use trees::tree_batches;

use crate::BackendBuildError;
use crate::actuator_input::ActuatorInputs;
use crate::checks::{check_floating, check_lengths};
use crate::{SimConfig, SimConfigError};
use robot_batch::LaneSnapshot;
pub(crate) use robot_batch::StepCount;
pub(crate) use simulator::{BatchSimulator, batch_simulator};

/// Backend that simulates one robot per SIMD lane.
pub struct BatchBackend {
    robot: RobotModel,
    config: SimConfig,
    ground: Ground,
    robots: Box<dyn BatchSimulator>,
    states: RobotStates,
    /// External actuator. `None`: analytic actuators only.
    actuator: Option<Box<dyn Actuator>>,
    /// `None` if there is one thread: the caller's.
    pool: Option<Arc<rayon::ThreadPool>>,
}

/// State of one robot. After a restore the simulation continues bit for bit.
#[derive(Clone)]
pub struct BatchSnapshot {
    lane: LaneSnapshot,
    state: RobotStates,
    actuator: Option<ActuatorSnapshot>,
}

impl BatchBackend {
    /// Creates `num_robots` robots that stand in their default pose, in single precision and the widest registers.
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BackendBuildError> {
        Self::with_precision(robot, config, num_robots, SimdPrecision::Single(InstructionSet::best()))
    }

    /// Creates robots like [`BatchBackend::new`], in the given precision.
    pub fn with_precision(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        precision: SimdPrecision,
    ) -> Result<Self, BackendBuildError> {
        config.check(robot.control.actuator_hz)?;
        let config = config.at_actuator_rate(robot.control.actuator_hz);
        check_tree(&robot)?;
        let pool = if config.threads == 1 { None } else { Some(crate::thread_pool::thread_pool(config.threads)?) };
        let ground = config.terrain.ground();
        let initial_state = InitialState::standing_on(&ground, &robot, robot.control.default_pose_f32(), 0.0);
        let robots = batch_simulator(precision, &robot, &config, &ground, &initial_state, num_robots);
        let mut states = RobotStates::new(num_robots);
        for index in 0..num_robots {
            robots.read(index, &mut states);
        }
        Ok(Self { robot, config, ground, robots, states, actuator: None, pool })
    }

    /// Adds an external actuator to all robots, which replaces theirs or adds to them. Reset every robot afterwards.
    #[must_use]
    pub fn with_actuator(self, actuator: Box<dyn Actuator>) -> Self {
        Self { actuator: Some(actuator), ..self }
    }

    fn check_index(&self, robot: usize) -> Result<(), BackendError> {
        let num_robots = self.num_robots();
        if robot < num_robots { Ok(()) } else { Err(BackendError::RobotOutOfRange { robot, num_robots }) }
    }

    fn after_reset(&mut self, robot: usize, initial_state: &InitialState) {
        self.robots.read(robot, &mut self.states);
        self.states.measured.stamp[robot] = 0.0;
        self.states.truth.epistemic_uncertainty[robot] = 0.0;
        if let Some(actuator) = &mut self.actuator {
            actuator.reset(robot, initial_state.actuator_seed);
        }
    }

    fn check_finite(&self, active: &[bool]) -> Result<(), BackendError> {
        let active = (0..active.len()).filter(|robot| active[*robot]);
        let robots: Vec<_> = active.filter_map(|robot| Some((robot, self.states.first_not_finite(robot)?))).collect();
        if robots.is_empty() { Ok(()) } else { Err(BackendError::Diverged { robots }) }
    }
}

/// Runs `work` on the threads of `pool`, or on the current thread.
fn on<R: Send>(pool: Option<&rayon::ThreadPool>, work: impl FnOnce() -> R + Send) -> R {
    match pool {
        Some(pool) => pool.install(work),
        None => work(),
    }
}

/// Checks that the robot has the kinematic tree of the Go2: hip about x, thigh and calf about y.
fn check_tree(robot: &RobotModel) -> Result<(), SimConfigError> {
    let on_axes = robot.legs.iter().all(|leg| leg.origins[1].x == 0.0 && leg.origins[1].z == 0.0);
    if on_axes {
        return Ok(());
    }
    Err(SimConfigError {
        field: "engine",
        value: "batch".to_owned(),
        allowed: format!("the thighs of `{}` are not on the y axes of the hips; use `rapier`", robot.name),
    })
}

impl Backend for BatchBackend {
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
        for (robot, initial_state) in initial_states {
            self.robots.place(*robot, &self.robot, initial_state);
            self.after_reset(*robot, initial_state);
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
        self.robots.place(robot, model, initial_state);
        self.after_reset(robot, initial_state);
        Ok(())
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), BackendError> {
        self.check_index(robot)?;
        check_floating(robot, &self.config)?;
        self.robots.push(robot, velocity);
        self.robots.read(robot, &mut self.states);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        check_lengths(commands, active, self.num_robots())?;
        let steps = self.config.steps_per_actuator_period(self.robot.control.actuator_hz);
        let Self { robots, states, actuator, pool, .. } = self;
        let pool = pool.as_deref();
        let mut finite = true;
        if let Some(actuator) = actuator {
            let mut tau = states.measured.tau.clone();
            for _ in 0..actuator_periods {
                on(pool, || actuator.torques(commands, active, &states.measured, &mut tau))?;
                let period = StepCount { actuator_periods: 1, steps };
                let inputs = ActuatorInputs::of(actuator.mode(), commands, &tau);
                finite &= robots.advance(pool, inputs, active, period, states);
            }
            if let Some(evaluator) = actuator.uncertainty() {
                on(pool, || evaluator.evaluate(active, &mut states.truth.epistemic_uncertainty));
            }
        } else {
            finite = robots.advance(
                pool,
                ActuatorInputs::Commands(commands),
                active,
                StepCount { actuator_periods, steps },
                states,
            );
        }
        let elapsed = actuator_periods as f64 * self.robot.control.actuator_dt();
        for (stamp, _) in states.measured.stamp.iter_mut().zip(active).filter(|(_, active)| **active) {
            *stamp += elapsed;
        }
        if finite { Ok(()) } else { self.check_finite(active) }
    }
}

impl Simulator for BatchBackend {
    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn set_derating(&mut self, robot: usize, factors: &PerJoint) {
        self.robots.set_derating(robot, factors);
    }
}

impl Restorable for BatchBackend {
    type Snapshot = BatchSnapshot;

    fn snapshot(&self, robot: usize) -> BatchSnapshot {
        let mut state = RobotStates::new(1);
        state.copy_robot(0, &self.states, robot);
        let actuator = self.actuator.as_ref().map(|actuator| actuator.snapshot(robot));
        BatchSnapshot { lane: self.robots.snapshot(robot), state, actuator }
    }

    fn restore(&mut self, robot: usize, snapshot: &BatchSnapshot) {
        self.robots.restore(robot, &snapshot.lane);
        self.states.copy_robot(robot, &snapshot.state, 0);
        if let (Some(actuator), Some(state)) = (&mut self.actuator, &snapshot.actuator) {
            actuator.restore(robot, state);
        }
    }
}
