//! The batch engine: many Go2 in SIMD lanes.
//!
//! The Go2 is one fixed tree whose mass matrix is an arrow ([`twinstep_model::lanes`]), and robots differ in numbers
//! alone, so that eight or sixteen of them fill one register. Contacts and joint limits are MuJoCo's soft constraints
//! ([`contact`], [`rows`]) against the [`ground`]. A [`group::Group`] holds the robots of one register; [`lanes`] steps groups on all cores in
//! the widest registers of the processor; [`BatchBackend`] is the engine.
//!
//! Every instruction set gives the same bits, and so does every batch size and thread count; see
//! [`twinstep_model::lanes::Lane`].

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]
#![allow(clippy::needless_range_loop, reason = "indices of matrices read as in the textbook")]

mod contact;
mod ground;
mod group;
mod lanes;
mod rows;

use twinstep_model::lanes::InstructionSet;
use twinstep_model::{
    Actuator, ActuatorSnapshot, Backend, BackendError, Command, Ground, InitialState, RobotModel, RobotStates,
};

pub use lanes::SimdPrecision;

use crate::rapier::{BackendBuildError, check_lengths};
use crate::{SimConfig, SimConfigError};
use group::{LaneSnapshot, StepCount};
pub(crate) use lanes::robots as lane_robots;
use lanes::{ActuatorInputs, BatchSimulator};

/// Many Go2 in SIMD lanes.
pub struct BatchBackend {
    robot: RobotModel,
    config: SimConfig,
    ground: Ground,
    robots: Box<dyn BatchSimulator>,
    states: RobotStates,
    /// In place of the robots' own drives, which are part of the lanes.
    drive: Option<Box<dyn Actuator>>,
    /// None with one thread: then the caller's does the work.
    pool: Option<rayon::ThreadPool>,
}

/// The state of one robot; restoring it continues bit for bit.
#[derive(Clone)]
pub struct BatchSnapshot {
    lane: LaneSnapshot,
    state: RobotStates,
    drive: Option<ActuatorSnapshot>,
}

impl BatchBackend {
    /// `num_robots` robots that stand in their default pose, in single precision and the processor's widest registers.
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BackendBuildError> {
        Self::with_precision(robot, config, num_robots, SimdPrecision::Single(InstructionSet::best()))
    }

    /// As [`BatchBackend::new`], with other numbers.
    ///
    /// # Panics
    /// If the processor lacks the instructions that `lanes` names.
    pub fn with_precision(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        lanes: SimdPrecision,
    ) -> Result<Self, BackendBuildError> {
        config.check(&robot.control)?;
        check_tree(&robot)?;
        let pool = if config.threads == 1 { None } else { Some(crate::rapier::thread_pool(config.threads)?) };
        let ground = config.terrain.ground();
        let placement = InitialState::standing_on(&ground, &robot, robot.control.default_pose_f32(), 0.0);
        let robots = lanes::robots(lanes, &robot, &config, &ground, &placement, num_robots);
        let mut states = RobotStates::new(num_robots);
        for index in 0..num_robots {
            robots.read(index, &mut states);
        }
        Ok(Self { robot, config, ground, robots, states, drive: None, pool })
    }

    /// The same robots with another drive than their own; each is to be placed anew.
    #[must_use]
    pub fn with_actuator(self, drive: Box<dyn Actuator>) -> Self {
        Self { drive: Some(drive), ..self }
    }

    fn check_index(&self, robot: usize) -> Result<(), BackendError> {
        let num_robots = self.num_robots();
        if robot < num_robots { Ok(()) } else { Err(BackendError::RobotOutOfRange { robot, num_robots }) }
    }

    fn after_place(&mut self, robot: usize, placement: &InitialState) {
        self.robots.read(robot, &mut self.states);
        self.states.epistemic_uncertainty[robot] = 0.0;
        if let Some(drive) = &mut self.drive {
            drive.reset(robot, placement.actuator_seed);
        }
    }

    fn first_diverged(&self, active: &[bool]) -> Option<BackendError> {
        let active = (0..active.len()).filter(|robot| active[*robot]);
        let mut diverged = active.filter_map(|robot| Some((robot, self.states.first_not_finite(robot)?)));
        let (robot, quantity) = diverged.next()?;
        Some(BackendError::Diverged { robot, quantity, more: diverged.count() })
    }
}

/// Runs `work` on the threads of `pool`, or on this one.
fn on<R: Send>(pool: Option<&rayon::ThreadPool>, work: impl FnOnce() -> R + Send) -> R {
    match pool {
        Some(pool) => pool.install(work),
        None => work(),
    }
}

/// The engine knows the Go2's tree: hip about x, thigh and calf about y.
fn check_tree(robot: &RobotModel) -> Result<(), SimConfigError> {
    let on_axes = robot.legs.iter().all(|leg| leg.origins[1].x == 0.0 && leg.origins[1].z == 0.0);
    if on_axes {
        return Ok(());
    }
    Err(SimConfigError {
        field: "engine",
        value: "batch".to_owned(),
        allowed: format!("`{}` has a thigh that is not on the hip's y axis; use `rapier`", robot.name),
    })
}

impl Backend for BatchBackend {
    type Snapshot = BatchSnapshot;

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
        for (robot, placement) in placements {
            self.robots.place(*robot, &self.robot, placement);
            self.after_place(*robot, placement);
        }
        Ok(())
    }

    fn reset_with_model(&mut self, robot: usize, model: &RobotModel, placement: &InitialState) -> Result<(), BackendError> {
        self.check_index(robot)?;
        self.robots.place(robot, model, placement);
        self.after_place(robot, placement);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], drive_periods: usize) -> Result<(), BackendError> {
        check_lengths(commands, active, self.num_robots())?;
        let steps = self.config.steps_per_drive_period(&self.robot.control);
        let Self { robots, states, drive, pool, .. } = self;
        let pool = pool.as_ref();
        let mut finite = true;
        if let Some(drive) = drive {
            let mut tau = states.tau.clone();
            for _ in 0..drive_periods {
                on(pool, || drive.torques(commands, active, states, &mut tau))?;
                let period = StepCount { drive_periods: 1, steps };
                finite &= robots.advance(pool, ActuatorInputs::Torques(&tau), active, period, states);
            }
            if let Some(doubt) = drive.uncertainty() {
                on(pool, || doubt.evaluate(active, &mut states.epistemic_uncertainty));
            }
        } else {
            finite = robots.advance(pool, ActuatorInputs::Commands(commands), active, StepCount { drive_periods, steps }, states);
        }
        let diverged = if finite { None } else { self.first_diverged(active) };
        diverged.map_or(Ok(()), Err)
    }

    fn snapshot(&self, robot: usize) -> BatchSnapshot {
        let mut state = RobotStates::new(1);
        state.copy_robot(0, &self.states, robot);
        let drive = self.drive.as_ref().map(|drive| drive.snapshot(robot));
        BatchSnapshot { lane: self.robots.snapshot(robot), state, drive }
    }

    fn restore(&mut self, robot: usize, snapshot: &BatchSnapshot) {
        self.robots.restore(robot, &snapshot.lane);
        self.states.copy_robot(robot, &snapshot.state, 0);
        if let (Some(drive), Some(memory)) = (&mut self.drive, &snapshot.drive) {
            drive.restore(robot, memory);
        }
    }
}
