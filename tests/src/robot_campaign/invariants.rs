//! What is true after every step, whatever the robot, the operator and the client do.

use std::time::Duration;

use twinstep_model::PerJoint;
use twinstep_robot::{ActionRefused, Client, CommandLimits, OperatorRequest, Output, SafetyConfig, State};

use crate::robot_rig::{Rig, robot_at_500_hz};

/// Longest time without a command while the robot is armed.
const MAX_GAP: Duration = Duration::from_millis(10);
/// Time after the last state within which an armed robot is in damping.
const MAX_STATE_AGE: Duration = Duration::from_millis(40);
/// Largest change of a commanded position from one command to the next, with a rounding error [rad].
const MAX_STEP: f32 = 0.5001;

/// Steps a rig, and checks every step.
pub struct Checker {
    limits: CommandLimits,
    last_command_at: Duration,
    last_reading_at: Duration,
    /// True while a fault of the motors can explain that they do not execute their commands.
    pub motors_disobey: bool,
}

impl Checker {
    /// Returns a checker for a rig as it is now.
    pub fn new(rig: &Rig) -> Self {
        let limits = CommandLimits::new(&robot_at_500_hz(), &SafetyConfig::default());
        Self { limits, last_command_at: rig.input.now, last_reading_at: rig.input.now, motors_disobey: false }
    }

    /// Advances a rig by 2 ms. The error is the sentence that is not true.
    pub fn step(&mut self, rig: &mut Rig) -> Result<(), String> {
        let before = rig.output;
        let request = rig.input.request;
        let action = rig.input.action;
        let accepted = rig.robot.statistics().accepted;
        rig.step();
        let executed = request.filter(|_| rig.output.request_refused.is_none());
        if !rig.input.readings.is_empty() {
            self.last_reading_at = rig.input.now;
        }
        self.check_command(rig, before.command.map(|command| command.command().q))?;
        self.check_messages(rig, accepted)?;
        check_state(rig, &before, executed)?;
        self.check_surroundings(rig)?;
        let is_finite = action.is_none_or(|action| action.values.iter().all(|value| value.is_finite()));
        if !is_finite && rig.output.action_refused.is_none() {
            return Err("an action that is not finite was executed".to_owned());
        }
        match rig.output.applied {
            Some(applied) if !applied.iter().all(|value| value.is_finite()) => {
                Err("an applied action is not finite".into())
            }
            _ => Ok(()),
        }
    }

    /// Checks that a command is inside the limits, is sent while the robot is armed, and has no jump.
    fn check_command(&mut self, rig: &Rig, last: Option<PerJoint>) -> Result<(), String> {
        let Output { state, command, .. } = rig.output;
        if command.is_some() != state.is_armed() {
            return Err(format!("in `{state}` a command is sent: {}", command.is_some()));
        }
        let Some(command) = command else {
            self.last_command_at = rig.input.now;
            return Ok(());
        };
        let gap = rig.input.now.saturating_sub(self.last_command_at);
        self.last_command_at = rig.input.now;
        if gap > MAX_GAP {
            return Err(format!("no command was sent for {} ms", gap.as_millis()));
        }
        self.limits.check(command.command()).map_err(|error| error.to_string())?;
        // Standing up begins at the measured pose.
        let Some(last) = last.filter(|_| state.is_moving() && !matches!(state, State::StandUp)) else { return Ok(()) };
        let jump = command.command().q.iter().zip(last).map(|(q, last)| (q - last).abs()).fold(0.0, f32::max);
        if jump > MAX_STEP {
            return Err(format!("a commanded position jumps by {jump} rad in `{state}`"));
        }
        Ok(())
    }

    /// Checks what the robot received, and that its motors are free while it is not armed.
    fn check_messages(&self, rig: &Rig, accepted: u64) -> Result<(), String> {
        let (statistics, state) = (rig.robot.statistics(), rig.output.state);
        if statistics.largest_excess_rad > 0.0 {
            return Err(format!("a command was {} rad outside a joint's range", statistics.largest_excess_rad));
        }
        if rig.robot.is_powered() && statistics.refused > 0 {
            return Err(format!("the robot refused a command: {:?}", statistics.first_refused));
        }
        if u128::from(statistics.largest_gap_ms) > MAX_GAP.as_millis() {
            return Err(format!("a moving command stayed in force for {} ms", statistics.largest_gap_ms));
        }
        if state.is_armed() {
            return Ok(());
        }
        if statistics.accepted > accepted {
            return Err(format!("a command was executed in `{state}`"));
        }
        let motors = rig.robot.motor_command();
        let is_free = motors.kp.iter().chain(&motors.tau_ff).all(|value| *value == 0.0);
        if !is_free && rig.input.controller_released && !self.motors_disobey {
            return Err(format!("the motors hold a position in `{state}`"));
        }
        Ok(())
    }

    /// Checks that an armed robot that this process does not control is in damping.
    fn check_surroundings(&self, rig: &Rig) -> Result<(), String> {
        let state = rig.output.state;
        if !state.is_armed() || state == State::Fault {
            return Ok(());
        }
        let age = rig.input.now.saturating_sub(self.last_reading_at);
        if age > MAX_STATE_AGE {
            return Err(format!("the robot is in `{state}` {} ms after the last state", age.as_millis()));
        }
        let reasons = [
            (rig.input.stop_requested, "a stop is requested"),
            (rig.input.foreign_writers > 0, "another writer exists"),
            (!rig.input.controller_released, "the built-in controller is active"),
            (rig.input.client == Client::Absent && matches!(state, State::Run | State::Hold), "the client is lost"),
        ];
        let reason = reasons.into_iter().find(|(is_true, _)| *is_true);
        reason.map_or(Ok(()), |(_, reason)| Err(format!("{reason}, and the robot is in `{state}`")))
    }
}

/// Checks that a fault stays until arming, and that only requests of the operator arm and move the robot.
fn check_state(rig: &Rig, before: &Output, executed: Option<OperatorRequest>) -> Result<(), String> {
    let after = &rig.output;
    let is_armed_now = executed == Some(OperatorRequest::Arm);
    if before.fault.is_some() && after.fault != before.fault && !is_armed_now {
        return Err(format!("the fault {:?} became {:?} without arming", before.fault, after.fault));
    }
    if after.state.is_armed() && !before.state.is_armed() && !is_armed_now {
        return Err(format!("`{}` became `{}` without arming", before.state, after.state));
    }
    let stands_up = after.state.is_moving() && !before.state.is_moving();
    if stands_up && executed != Some(OperatorRequest::Stand) {
        return Err(format!("`{}` became `{}` without a request", before.state, after.state));
    }
    let is_acting = |state| matches!(state, State::Run | State::Hold);
    if is_acting(after.state) && after.fault.is_some() {
        return Err(format!("the robot is in `{}` with a fault", after.state));
    }
    match after.action_refused {
        Some(ActionRefused::NotReady { .. }) if is_acting(before.state) && is_acting(after.state) => {
            Err("an action was refused because of its state in `run`".to_owned())
        }
        _ => Ok(()),
    }
}
