//! The robot as a [`Backend`]: environments step it as they step a simulation.

use std::time::Duration;

use twinstep_model::{
    Backend, BackendError, Command, InitialState, Measured, NUM_JOINTS, PerJoint, RealTimeReport, ResetCause,
    RobotModel, RobotSample, RobotStop,
};
use twinstep_unitree::Remote;

use crate::input::Action;
use crate::resampler::Resampler;
use crate::robot_handle::{Board, RobotHandle};
use crate::state::State;

/// Velocity command at full deflection of the sticks: forward [m/s], left [m/s], yaw rate [rad/s].
const STICK_VELOCITY: [f32; 3] = [1.0, 0.5, 1.0];
/// Deflection below which a stick counts as released.
const DEAD_ZONE: f32 = 0.05;
/// Time without a step of the control loop after which it counts as failed.
const LOOP_TIMEOUT: Duration = Duration::from_millis(500);

/// One robot, driven by a control loop.
///
/// A step hands its action to the loop and returns at the beginning of the next policy period. The robot belongs to the
/// client while the backend exists.
pub struct RobotBackend {
    handle: RobotHandle,
    robot: RobotModel,
    measured: Measured,
    report: RealTimeReport,
    /// Policy period of the next action; `None`: that of the last observation.
    action_tick: Option<u64>,
    remote: Option<Remote>,
    resampler: Resampler,
}

impl RobotBackend {
    /// Takes the robot of a control loop.
    pub fn new(robot: RobotModel, handle: RobotHandle) -> Self {
        handle.set_client(true);
        let report = RealTimeReport {
            tick: 0,
            stamp_ns: 0,
            late_ticks: 0,
            applied: [0.0; NUM_JOINTS],
            refused: None,
            stop: None,
        };
        let period = Duration::from_secs_f64(robot.control.actuator_dt());
        let resampler = Resampler::new(period, robot.control.kp[0] as f32);
        let measured = Measured::default();
        let mut backend = Self { handle, robot, measured, report, action_tick: None, remote: None, resampler };
        backend.observe(&Board::default());
        backend
    }

    /// Takes in the measurements and the state of the loop.
    fn observe(&mut self, board: &Board) {
        let zero = [0.0; NUM_JOINTS];
        let reading = board.reading.as_ref();
        let stamp = reading.map_or(Duration::ZERO, |(at, _)| *at);
        let reading = reading.map(|(_, reading)| reading);
        self.measured = Measured {
            stamp: vec![stamp.as_secs_f64()],
            q: vec![reading.map_or(zero, |reading| reading.q)],
            dq: vec![reading.map_or(zero, |reading| reading.dq)],
            tau: vec![reading.map_or(zero, |reading| reading.tau)],
            orientation: vec![reading.map_or([1.0, 0.0, 0.0, 0.0], |reading| reading.orientation)],
            gyro: vec![reading.map_or([0.0; 3], |reading| reading.gyro)],
            acc: reading.map(|reading| vec![reading.acc]),
            temperature: reading.map(|reading| vec![reading.temperature.map(f32::from)]),
            voltage: reading.map(|reading| vec![reading.voltage]),
            // The robot's counts have no unit.
            foot_force: None,
        };
        self.remote = reading.and_then(|reading| reading.remote);
        self.report = RealTimeReport {
            tick: board.tick,
            stamp_ns: stamp.as_nanos() as u64,
            late_ticks: board.missed_ticks,
            applied: board.applied,
            refused: None,
            stop: stop(board),
        };
    }

    /// Returns the action whose commanded positions are `q`.
    fn action(&self, q: &PerJoint) -> PerJoint {
        let control = &self.robot.control;
        let default_pose = control.default_pose_f32();
        std::array::from_fn(|joint| (q[joint] - default_pose[joint]) / control.action_scale as f32)
    }
}

impl Drop for RobotBackend {
    fn drop(&mut self) {
        self.handle.set_client(false);
    }
}

impl Backend for RobotBackend {
    fn robot(&self) -> &RobotModel {
        &self.robot
    }

    fn measured(&self) -> &Measured {
        &self.measured
    }

    fn prepare_reset(&mut self, cause: ResetCause) -> Result<(), BackendError> {
        let board = self.handle.board();
        let reason = match (board.state, cause) {
            (Some(State::Ready), _) if !board.is_permitted => waits_for(&board),
            (Some(State::Ready), _) | (Some(State::Run | State::Hold), ResetCause::Autoreset) => return Ok(()),
            (Some(State::Run | State::Hold), ResetCause::Request) => {
                self.handle.end_episode();
                "it moves to its standing pose".to_owned()
            }
            _ => waits_for(&board),
        };
        Err(BackendError::Waiting { reason })
    }

    fn reset(&mut self, _initial_states: &[(usize, InitialState)]) -> Result<(), BackendError> {
        self.observe(&self.handle.board());
        self.resampler.restart();
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], _actuator_periods: usize) -> Result<(), BackendError> {
        let explicit = self.action_tick.take();
        if !active[0] {
            return Ok(());
        }
        let before = self.handle.board();
        let tick = explicit.unwrap_or(self.report.tick);
        let number = self.handle.act(Action { tick, values: self.action(&commands[0].q) });
        let next = before.tick + 1;
        let board = self.handle.wait_until(LOOP_TIMEOUT, |board| board.tick >= next && board.action_result.0 >= number);
        if board.has_ended || board.tick < next {
            return Err(BackendError::Fault { robot: 0, reason: "its control loop has ended".to_owned() });
        }
        self.observe(&board);
        let (answered, refusal) = board.action_result;
        self.report.refused = refusal.filter(|_| answered == number).map(|refusal| refusal.to_string());
        Ok(())
    }

    fn real_time(&self) -> Option<&RealTimeReport> {
        Some(&self.report)
    }

    fn take_samples(&mut self) -> Option<Vec<RobotSample>> {
        Some(self.resampler.add(self.handle.take_samples()))
    }

    fn set_action_tick(&mut self, tick: u64) {
        self.action_tick = Some(tick);
    }

    fn velocity_command(&self) -> Option<[f32; 3]> {
        let sticks = self.remote.map_or([0.0; 3], |remote| [remote.ly, -remote.lx, -remote.rx]);
        Some(std::array::from_fn(|axis| {
            let stick = if sticks[axis].is_finite() { sticks[axis].clamp(-1.0, 1.0) } else { 0.0 };
            if stick.abs() < DEAD_ZONE { 0.0 } else { STICK_VELOCITY[axis] * stick }
        }))
    }
}

/// Returns why the robot follows no actions, or `None` if it does.
fn stop(board: &Board) -> Option<RobotStop> {
    match board.state {
        Some(State::Ready) if !board.is_permitted => Some(RobotStop { reason: waits_for(board), terminates: false }),
        Some(State::Ready | State::Run | State::Hold) => None,
        _ => Some(RobotStop {
            reason: board.fault.map_or_else(|| waits_for(board), |fault| fault.to_string()),
            terminates: board.fault.is_some_and(|fault| fault.is_motion()),
        }),
    }
}

/// Returns what a robot waits for before it follows actions.
fn waits_for(board: &Board) -> String {
    if board.state == Some(State::Ready) && !board.is_permitted {
        return "a fault has stopped it, and the operator has not said `go`".to_owned();
    }
    if let Some(fault) = board.fault {
        return format!("{fault}; then the operator arms the robot again");
    }
    match board.state {
        None | Some(State::Disconnected) => "no states arrive: switch it on, check cable and interface",
        Some(State::Observe) => "the operator has not armed it",
        Some(State::Damp) => "the operator has not made it stand",
        Some(State::StandUp) => "it stands up",
        Some(State::Sit) => "it sits down",
        Some(State::Fault) => "it has a fault: the operator arms it again",
        Some(State::Ready | State::Run | State::Hold) => "it begins an episode",
    }
    .to_owned()
}
