//! The safety state machine.

use std::time::Duration;

use twinstep_model::{Command, Joint, NUM_JOINTS, PerJoint, RobotModel};

use crate::SafetyConfig;
use crate::command::{CommandLimits, SafeCommand};
use crate::config::ConfigError;
use crate::fault::{Fault, Reaction};
use crate::input::{Action, ActionRefused, Client, Input, OperatorRequest, Output, RequestRefused};
use crate::monitor::Monitor;
use crate::state::State;
use crate::trajectory::Trajectory;
use crate::watchdog::Watchdog;

/// Crouched pose of every leg: hip, thigh, calf [rad]. Source: the vendor's example `go2_stand_example`.
const CROUCH: [f32; 3] = [0.0, 1.36, -2.65];
/// Time in which the gains change from those of the policy to those of standing.
const GAIN_RAMP: Duration = Duration::from_millis(500);
/// Time for which damping is sent before commands may cease: the motors keep the last command that reaches them.
const MIN_DAMPING: Duration = Duration::from_millis(100);
/// Time for which the robot may be away from the standing pose after its motion to it.
const STAND_PATIENCE: Duration = Duration::from_secs(1);

/// The safety state machine: decides which command is sent, from all that happened since the last step.
///
/// It has no clock, no thread and no network, so it behaves the same on an accelerated clock. The table in the
/// [crate's documentation](crate) has its states.
#[derive(Clone, Debug)]
pub struct SafetyMachine {
    config: SafetyConfig,
    limits: CommandLimits,
    /// Position and velocity gain of the policy.
    gains: [PerJoint; 2],
    action_scale: f32,
    default_pose: PerJoint,
    crouched_pose: PerJoint,
    policy_dt: Duration,
    damping: SafeCommand,
    monitor: Monitor,
    mode: Mode,
    fault: Option<Fault>,
    /// False after a fault, until the operator lets the client act again.
    is_permitted: bool,
    now: Duration,
    /// Since when damping has been sent.
    damping_since: Option<Duration>,
}

/// State, with what only this state needs.
#[derive(Clone, Debug, PartialEq)]
enum Mode {
    Disconnected,
    Observe,
    Damp,
    StandUp(Trajectory),
    Ready,
    Run(Target),
    Hold(Target, Duration),
    Sit(Trajectory),
    Fault,
}

/// What the last action commands.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Target {
    /// Policy period of the action.
    tick: u64,
    /// Commanded positions [rad].
    q: PerJoint,
    /// Action that gives these positions.
    applied: PerJoint,
}

impl SafetyMachine {
    /// Returns a machine without connection, for a robot with `robot.control`.
    pub fn new(robot: &RobotModel, config: SafetyConfig) -> Result<Self, ConfigError> {
        config.check()?;
        let limits = CommandLimits::new(robot, &config);
        let (control, default_pose) = (&robot.control, robot.control.default_pose_f32());
        let hold = control.hold(default_pose);
        limits.check(&hold)?;
        // The position does not matter at a gain of 0, but it must be in the limits like every other.
        let damping = limits.check(&Command::hold(default_pose, 0.0, config.damping_kd))?;
        Ok(Self {
            gains: [hold.kp, hold.kd],
            action_scale: control.action_scale as f32,
            default_pose,
            crouched_pose: limits.clamp(Joint::map_kinds(CROUCH[0], CROUCH[1], CROUCH[2])),
            policy_dt: Duration::from_secs_f64(control.policy_dt()),
            damping,
            monitor: Monitor::new(robot, &config),
            mode: Mode::Disconnected,
            fault: None,
            is_permitted: true,
            now: Duration::ZERO,
            damping_since: None,
            limits,
            config,
        })
    }

    /// Returns the present state.
    pub fn state(&self) -> State {
        match self.mode {
            Mode::Disconnected => State::Disconnected,
            Mode::Observe => State::Observe,
            Mode::Damp => State::Damp,
            Mode::StandUp(_) => State::StandUp,
            Mode::Ready => State::Ready,
            Mode::Run(_) => State::Run,
            Mode::Hold(..) => State::Hold,
            Mode::Sit(_) => State::Sit,
            Mode::Fault => State::Fault,
        }
    }

    /// Returns the command of the damping mode.
    pub(crate) fn damping(&self) -> SafeCommand {
        self.damping
    }

    /// Advances to `input.now` and returns the command to send.
    ///
    /// Faults come first, then the operator, then the client.
    pub fn step(&mut self, input: &Input) -> Output {
        let dt = input.now.saturating_sub(self.now);
        self.now = input.now;
        self.monitor.update(input);
        self.connect();
        let fault = self.monitor.fault(self.state(), input);
        if let Some(fault) = fault {
            self.react(fault);
        }
        let request_refused = input.request.and_then(|request| match fault {
            // The motors keep their last command: damping is sent before the operator can disarm the robot. And one who
            // arms it again has seen the fault.
            Some(fault) if self.mode == Mode::Fault => Some(RequestRefused::Fault(fault)),
            _ => self.execute(request, input).err(),
        });
        if input.client == Client::EndsEpisode {
            self.end_episode();
        }
        let action_refused = input.action.and_then(|action| self.act(&action, input.client).err());
        self.advance(dt);
        let command = self.command();
        let is_damped = matches!(self.mode, Mode::Damp | Mode::Fault);
        self.damping_since = if is_damped { self.damping_since.or(Some(self.now)) } else { None };
        let target = self.target();
        Output {
            state: self.state(),
            command,
            fault: self.fault,
            tick: self.tick(),
            missed_ticks: target.map_or(0, |target| self.missed_ticks(target)),
            applied: target.map(|target| target.applied),
            request_refused,
            action_refused,
            is_permitted: self.is_permitted,
        }
    }

    fn connect(&mut self) {
        match self.mode {
            Mode::Disconnected if self.monitor.is_connected() => self.mode = Mode::Observe,
            Mode::Observe if self.monitor.is_stale() => self.mode = Mode::Disconnected,
            _ => {}
        }
    }

    fn react(&mut self, fault: Fault) {
        // The first fault is the cause; those after it may be its consequences.
        self.fault.get_or_insert(fault);
        self.is_permitted = false;
        match (fault.reaction(), &self.mode) {
            (Reaction::Sit, Mode::Sit(_)) => {}
            (Reaction::Sit, _) => self.sit(),
            (Reaction::Damp, _) => self.mode = Mode::Fault,
        }
    }

    fn execute(&mut self, request: OperatorRequest, input: &Input) -> Result<(), RequestRefused> {
        let state = self.state();
        let wrong_state = |possible| Err(RequestRefused::WrongState { state, possible });
        match (request, state) {
            (OperatorRequest::Arm, State::Observe | State::Fault) => self.arm(input)?,
            (OperatorRequest::Arm, _) => return wrong_state("observe, fault"),
            (OperatorRequest::Stand, State::Damp) => self.stand(input)?,
            (OperatorRequest::Stand, _) => return wrong_state("damp"),
            (OperatorRequest::Sit, State::StandUp | State::Ready | State::Run | State::Hold) => self.sit(),
            (OperatorRequest::Sit, _) => return wrong_state("stand_up, ready, run, hold"),
            (OperatorRequest::Damp, _) if state.is_moving() => self.mode = self.damping_mode(),
            (OperatorRequest::Damp, _) => return wrong_state("stand_up, ready, run, hold, sit"),
            (OperatorRequest::Disarm, State::Damp | State::Fault) => self.disarm()?,
            (OperatorRequest::Disarm, _) => return wrong_state("damp, fault"),
            (OperatorRequest::Go, State::Ready) if self.is_permitted => return Err(RequestRefused::Permitted),
            (OperatorRequest::Go, State::Ready) => self.is_permitted = true,
            (OperatorRequest::Go, _) => return wrong_state("ready"),
        }
        Ok(())
    }

    fn arm(&mut self, input: &Input) -> Result<(), RequestRefused> {
        let Some(reading) = self.monitor.reading().filter(|_| self.monitor.is_connected()) else {
            return Err(RequestRefused::StateRate);
        };
        // A new writer takes the motors back from the watchdog.
        let watchdog = if input.watchdog == Watchdog::TookOver { Watchdog::Idle } else { input.watchdog };
        if let Some(fault) = self.monitor.fault(State::Damp, &Input { watchdog, ..input.clone() }) {
            return Err(RequestRefused::Fault(fault));
        }
        if !self.monitor.is_quiet() {
            return Err(RequestRefused::RecentForeignWriter);
        }
        let (percent, min) = (reading.charge, self.config.arm_min_charge_percent);
        if percent < min {
            return Err(RequestRefused::Charge { percent, min });
        }
        let max = self.config.arm_max_temperature_c;
        for (joint, celsius) in Joint::ALL.into_iter().zip(reading.temperature) {
            if i16::from(celsius) > max {
                return Err(RequestRefused::Temperature { joint, celsius, max });
            }
        }
        (self.mode, self.fault) = (Mode::Damp, None);
        Ok(())
    }

    fn disarm(&mut self) -> Result<(), RequestRefused> {
        if self.damping_since.is_none_or(|since| self.now.saturating_sub(since) < MIN_DAMPING) {
            return Err(RequestRefused::BarelyDamped);
        }
        self.mode = Mode::Observe;
        Ok(())
    }

    fn stand(&mut self, input: &Input) -> Result<(), RequestRefused> {
        if let Some(fault) = self.monitor.fault(State::StandUp, input) {
            return Err(RequestRefused::Fault(fault));
        }
        let Some(reading) = self.monitor.reading() else { return Err(RequestRefused::StateRate) };
        let (degrees, max) = (reading.tilt.to_degrees(), self.config.stand_max_tilt_deg);
        if degrees > max {
            return Err(RequestRefused::Tilt { degrees, max });
        }
        for (joint, dq) in Joint::ALL.into_iter().zip(reading.dq) {
            if dq.abs() > self.config.stand_max_speed_rad_s {
                return Err(RequestRefused::Moving { joint, speed: dq.abs() });
            }
        }
        let start = self.limits.clamp(reading.q);
        let crouch = (self.crouched_pose, Duration::from_secs_f64(self.config.crouch_s));
        self.mode = Mode::StandUp(Trajectory::new(start, vec![crouch, self.standing_pose()]));
        Ok(())
    }

    /// Returns the standing pose [rad] with the time to reach it.
    fn standing_pose(&self) -> (PerJoint, Duration) {
        (self.default_pose, Duration::from_secs_f64(self.config.stand_s))
    }

    fn sit(&mut self) {
        if let Some(q) = self.commanded_pose() {
            let crouch = (self.crouched_pose, Duration::from_secs_f64(self.config.stand_s));
            self.mode = Mode::Sit(Trajectory::new(q, vec![crouch]));
        }
    }

    fn end_episode(&mut self) {
        if let Some(Target { q, .. }) = self.target() {
            self.mode = Mode::StandUp(Trajectory::new(q, vec![self.standing_pose()]));
        }
    }

    /// Executes an action for the present policy period.
    fn act(&mut self, action: &Action, client: Client) -> Result<(), ActionRefused> {
        let (state, current) = (self.state(), self.tick());
        let tick = action.tick;
        if !matches!(state, State::Ready | State::Run | State::Hold) {
            return Err(ActionRefused::NotReady { state });
        }
        if client != Client::Connected {
            return Err(ActionRefused::NoClient);
        }
        if !self.is_permitted {
            return Err(ActionRefused::NotPermitted);
        }
        // An action that waited in a queue responds to an observation that is not true any more.
        if tick < current {
            return Err(ActionRefused::OldTick { tick, current });
        }
        if tick > current {
            return Err(ActionRefused::FutureTick { tick, current });
        }
        if self.target().is_some_and(|target| target.tick == tick) {
            return Err(ActionRefused::Repeated { tick });
        }
        for (joint, value) in Joint::ALL.into_iter().zip(action.values) {
            if !value.is_finite() {
                return Err(ActionRefused::NotFinite { joint, value });
            }
        }
        let last = self.target().map_or(self.default_pose, |target| target.q);
        let step = self.config.max_target_step_rad;
        let wanted: PerJoint = std::array::from_fn(|joint| {
            let q = self.default_pose[joint] + self.action_scale * action.values[joint].clamp(-1.0, 1.0);
            q.clamp(last[joint] - step, last[joint] + step)
        });
        let q = self.limits.clamp(wanted);
        let applied = std::array::from_fn(|joint| (q[joint] - self.default_pose[joint]) / self.action_scale);
        self.mode = Mode::Run(Target { tick, q, applied });
        Ok(())
    }

    /// Lets time pass: motions, missing actions.
    fn advance(&mut self, dt: Duration) {
        if let Mode::StandUp(trajectory) | Mode::Sit(trajectory) = &mut self.mode {
            trajectory.advance(dt);
        }
        match &self.mode {
            Mode::StandUp(trajectory) => {
                if let Some(waited) = trajectory.finished_for() {
                    self.finish_standing(waited);
                }
            }
            Mode::Sit(trajectory) if trajectory.finished_for().is_some() => self.mode = self.damping_mode(),
            Mode::Run(target) | Mode::Hold(target, _) => {
                let target = *target;
                let missed = self.missed_ticks(target);
                if missed >= self.config.sit_after_missed_ticks {
                    self.react(Fault::ActionLate { missed });
                } else if missed >= self.config.hold_after_missed_ticks && self.state() == State::Run {
                    self.mode = Mode::Hold(target, self.now);
                }
            }
            _ => {}
        }
    }

    fn finish_standing(&mut self, waited: Duration) {
        let Some(reading) = self.monitor.reading() else { return };
        let error = |joint: &Joint| (reading.q[joint.index()] - self.default_pose[joint.index()]).abs();
        let farthest = Joint::ALL.into_iter().map(|joint| (joint, error(&joint)));
        let farthest = farthest.max_by(|(_, first), (_, second)| first.total_cmp(second));
        match farthest {
            Some((joint, error)) if error > self.config.stand_tolerance_rad => {
                if waited >= STAND_PATIENCE {
                    self.react(Fault::StandFailed { joint, error });
                }
            }
            _ => self.mode = Mode::Ready,
        }
    }

    fn command(&mut self) -> Option<SafeCommand> {
        let Some(q) = self.commanded_pose() else {
            return self.state().is_armed().then_some(self.damping);
        };
        let standing = self.standing_share();
        let blend = |policy: &PerJoint, kinds: [f32; 3]| {
            let stand = Joint::map_kinds(kinds[0], kinds[1], kinds[2]);
            std::array::from_fn(|joint| policy[joint] + standing * (stand[joint] - policy[joint]))
        };
        let (kp, kd) = (blend(&self.gains[0], self.config.stand_kp), blend(&self.gains[1], self.config.stand_kd));
        let command = Command { q, dq: [0.0; NUM_JOINTS], tau_ff: [0.0; NUM_JOINTS], kp, kd };
        Some(self.limits.check(&command).unwrap_or_else(|error| {
            self.react(Fault::UnsafeCommand(error));
            self.damping
        }))
    }

    /// Returns the commanded positions [rad]; `None` if the robot holds no pose.
    fn commanded_pose(&self) -> Option<PerJoint> {
        match &self.mode {
            Mode::Disconnected | Mode::Observe | Mode::Damp | Mode::Fault => None,
            Mode::StandUp(trajectory) | Mode::Sit(trajectory) => Some(trajectory.pose()),
            Mode::Ready => Some(self.default_pose),
            Mode::Run(target) | Mode::Hold(target, _) => Some(target.q),
        }
    }

    /// Returns the share of the standing gains, from 0 for the policy's gains to 1.
    fn standing_share(&self) -> f32 {
        match self.mode {
            Mode::Run(_) => 0.0,
            Mode::Hold(_, since) => (self.now.saturating_sub(since).as_secs_f32() / GAIN_RAMP.as_secs_f32()).min(1.0),
            _ => 1.0,
        }
    }

    /// Returns the mode after a motion that ends in damping.
    fn damping_mode(&self) -> Mode {
        if self.fault.is_some() { Mode::Fault } else { Mode::Damp }
    }

    fn target(&self) -> Option<Target> {
        match self.mode {
            Mode::Run(target) | Mode::Hold(target, _) => Some(target),
            _ => None,
        }
    }

    fn tick(&self) -> u64 {
        (self.now.as_nanos() / self.policy_dt.as_nanos()) as u64
    }

    fn missed_ticks(&self, target: Target) -> u64 {
        self.tick().saturating_sub(target.tick + 1)
    }
}
