//! The batch engine: many Go2 in SIMD lanes.
//!
//! The Go2 is one fixed tree whose mass matrix is an arrow ([`dynamics`]), and robots differ in numbers alone, so that
//! eight of them fill one register ([`lane`]). Contacts and joint limits are MuJoCo's soft constraints ([`contact`]).
//! A [`group::Group`] holds the robots of one register; [`BatchBackend`] steps groups on all cores.
//!
//! Every instruction set gives the same bits, and so does every batch size and thread count; see [`lane`].

#![allow(clippy::inline_always, reason = "what stays out of line is compiled for the oldest processor")]
#![allow(clippy::needless_range_loop, reason = "indices of matrices read as in the textbook")]

mod contact;
mod dispatch;
mod dynamics;
mod group;
mod lane;
mod spatial;

use rayon::prelude::*;
use twinstep_model::{
    Actuator, Backend, BackendError, Command, Ground, PdDrive, PerJoint, Placement, RobotModel, RobotStates,
};

pub use group::LaneSnapshot;

use crate::rapier::BuildError;
use crate::{SimConfig, SimConfigError};
use group::Group;
use lane::{F32x8, Lane};

/// Groups that one thread steps at a time: a drive period of one takes some ten microseconds, about what it takes to
/// wake a thread.
const GROUPS_A_TASK: usize = 4;

/// Many Go2 in SIMD lanes.
pub struct BatchBackend {
    robot: RobotModel,
    config: SimConfig,
    groups: Vec<Group<F32x8>>,
    states: RobotStates,
    drive: Box<dyn Actuator>,
    pool: rayon::ThreadPool,
}

/// The state of one robot; restoring it continues bit for bit.
#[derive(Clone)]
pub struct BatchSnapshot {
    lane: LaneSnapshot,
    state: RobotStates,
}

impl BatchBackend {
    /// `num_robots` robots that stand in their default pose.
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BuildError> {
        let drive = Box::new(PdDrive::new(&robot));
        Self::with_drive(robot, config, num_robots, drive)
    }

    /// As [`BatchBackend::new`], with another drive than the ideal one.
    pub fn with_drive(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        drive: Box<dyn Actuator>,
    ) -> Result<Self, BuildError> {
        config.check(&robot.control)?;
        check_tree(&robot)?;
        config.terrain.check_plane()?;
        let pool = crate::rapier::thread_pool(config.threads)?;
        let placement = Placement::at_rest(0.32, robot.control.default_pose_f32());
        let group = Group::new(&robot, &config, &placement);
        let groups = vec![group; num_robots.div_ceil(F32x8::LANES)];
        let mut this = Self { robot, config, groups, states: RobotStates::new(num_robots), drive, pool };
        for index in 0..num_robots {
            this.read_state(index);
        }
        Ok(this)
    }

    fn read_state(&mut self, robot: usize) {
        let (group, lane) = (&self.groups[robot / F32x8::LANES], robot % F32x8::LANES);
        let (state, states) = (&group.state, &mut self.states);
        states.base_position[robot] = read(&state.position.0, lane);
        states.base_orientation[robot] = read(&state.orientation, lane);
        states.base_linear_velocity[robot] = read(&state.linear_velocity.0, lane);
        states.base_angular_velocity[robot] = read(&state.angular_velocity.0, lane);
        states.q[robot] = read(&state.q, lane);
        states.dq[robot] = read(&state.dq, lane);
        states.foot_force[robot] = std::array::from_fn(|leg| group.foot_force(lane, leg) as f32);
        states.body_contact[robot] = group.body_contact(lane);
    }

    /// One drive period of all active robots: torque from the sampled state, held over the physics steps.
    fn drive_period(&mut self, commands: &[Command], active: &[bool], steps: usize) {
        let mut tau = std::mem::take(&mut self.states.tau);
        self.drive.torques(commands, active, &self.states, &mut tau);
        let lanes = F32x8::LANES;
        let robots = (&mut self.groups, tau.par_chunks(lanes), active.par_chunks(lanes));
        let states = (self.states.q.par_chunks_mut(lanes), self.states.dq.par_chunks_mut(lanes));
        self.pool.install(|| {
            (robots, states).into_par_iter().with_min_len(GROUPS_A_TASK).for_each(|((group, tau, active), (q, dq))| {
                step_active(group, tau, active, steps);
                for lane in 0..active.len() {
                    (q[lane], dq[lane]) = (read(&group.state.q, lane), read(&group.state.dq, lane));
                }
            });
        });
        self.states.tau = tau;
    }

    fn first_diverged(&self, active: &[bool]) -> Option<BackendError> {
        let active = (0..active.len()).filter(|robot| active[*robot]);
        let mut diverged = active.filter_map(|robot| Some((robot, self.states.first_not_finite(robot)?)));
        let (robot, quantity) = diverged.next()?;
        Some(BackendError::Diverged { robot, quantity, more: diverged.count() })
    }
}

/// Steps the active robots of a group; the others stay as they are.
fn step_active(group: &mut Group<F32x8>, tau: &[PerJoint], active: &[bool], steps: usize) {
    if active.iter().all(|active| !active) {
        return;
    }
    let asleep: Vec<_> =
        (0..active.len()).filter(|lane| !active[*lane]).map(|lane| (lane, group.snapshot(lane))).collect();
    let mut torque = [F32x8::splat(0.0); 12];
    for (lane, tau) in tau.iter().enumerate() {
        for (value, tau) in torque.iter_mut().zip(tau) {
            value.set(lane, f64::from(*tau));
        }
    }
    dispatch::step(group, &torque, steps);
    for (lane, snapshot) in asleep {
        group.restore(lane, &snapshot);
    }
}

fn read<const N: usize>(values: &[F32x8; N], lane: usize) -> [f32; N] {
    values.map(|value| value.get(lane) as f32)
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
        self.config.terrain.ground()
    }

    fn reset(&mut self, placements: &[(usize, Placement)]) -> Result<(), BackendError> {
        let num_robots = self.num_robots();
        if let Some((robot, _)) = placements.iter().find(|(robot, _)| *robot >= num_robots) {
            return Err(BackendError::NoSuchRobot { robot: *robot, num_robots });
        }
        for (robot, placement) in placements {
            let robot = *robot;
            self.groups[robot / F32x8::LANES].place(robot % F32x8::LANES, &self.robot, placement);
            self.drive.reset(robot);
            self.read_state(robot);
            self.states.tau[robot] = PerJoint::default();
        }
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], drive_periods: usize) -> Result<(), BackendError> {
        let wanted = self.num_robots();
        for (field, given) in [("commands", commands.len()), ("active", active.len())] {
            if given != wanted {
                return Err(BackendError::WrongLength { field, given, wanted });
            }
        }
        let steps = self.config.steps_per_drive_period(&self.robot.control);
        for _ in 0..drive_periods {
            self.drive_period(commands, active, steps);
        }
        for robot in (0..wanted).filter(|robot| active[*robot]) {
            self.read_state(robot);
        }
        self.first_diverged(active).map_or(Ok(()), Err)
    }

    fn snapshot(&self, robot: usize) -> BatchSnapshot {
        let mut state = RobotStates::new(1);
        state.copy_robot(0, &self.states, robot);
        BatchSnapshot { lane: self.groups[robot / F32x8::LANES].snapshot(robot % F32x8::LANES), state }
    }

    fn restore(&mut self, robot: usize, snapshot: &BatchSnapshot) {
        self.groups[robot / F32x8::LANES].restore(robot % F32x8::LANES, &snapshot.lane);
        self.states.copy_robot(robot, &snapshot.state, 0);
    }
}
