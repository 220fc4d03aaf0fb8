//! Detects faults in the robot's states and surroundings.

use std::time::Duration;

use twinstep_model::{Joint, NUM_JOINTS, PerJoint, RobotModel};
use twinstep_unitree::{Button, Remote};

use crate::SafetyConfig;
use crate::clock_check::ClockCheck;
use crate::command::scaled_range;
use crate::fault::Fault;
use crate::imu_check::ImuCheck;
use crate::input::{Client, Input};
use crate::reading::Reading;
use crate::state::State;
use crate::watchdog::Watchdog;

/// Interval in which states are counted.
const RATE_INTERVAL: Duration = Duration::from_millis(500);
/// Time for which no other writer of `rt/lowcmd` must exist before arming.
const QUIET_TIME: Duration = Duration::from_secs(1);
/// Interval in which lost messages are counted.
const LOSS_INTERVAL: Duration = Duration::from_secs(1);
/// Longest time between two steps that counts as silence of the robot. In a longer one this process did not run, and the
/// states that arrived meanwhile are not read yet.
const MAX_SILENT_STEP: Duration = Duration::from_millis(5);
/// Number of checks in a row after which an old state is a fault: one alone may be a late thread.
const STALE_CHECKS: u32 = 2;

/// Latest measurements, with what must be remembered of earlier ones.
#[derive(Clone, Debug)]
pub(crate) struct Monitor {
    config: SafetyConfig,
    /// Lowest and highest allowed measured position [rad].
    position_limits: [[f32; 2]; NUM_JOINTS],
    /// Highest allowed lasting torque [N·m].
    max_torque: PerJoint,
    reading: Option<Reading>,
    /// Measurements that arrived at the last step, oldest first. Each is looked at: a button may be released in the newest.
    recent: Vec<Reading>,
    clock: ClockCheck,
    /// Jump of the robot's clock at the last step [ticks].
    clock_jump: Option<i64>,
    /// Time between the last two steps.
    pause: Duration,
    /// Time of the last state of another robot.
    other_robot_at: Option<Duration>,
    /// True once the robot's clock has changed from one state to the next. That of the vendor's simulator never does.
    clock_runs: bool,
    imu: ImuCheck,
    now: Duration,
    /// Time of this loop since the last state.
    silence: Duration,
    stale_checks: u32,
    /// Start of the present interval and number of states in it.
    interval: (Duration, u32),
    /// True if the last complete interval had enough states.
    rate_is_met: bool,
    /// Since when no other writer exists.
    quiet_since: Option<Duration>,
    remote_at: Option<Duration>,
    /// Since when the torque of each joint is too high.
    overload_since: [Option<Duration>; NUM_JOINTS],
    /// Start of the interval in which lost messages are counted, and their number at its start.
    loss_interval: Option<(Duration, u32)>,
}

impl Monitor {
    pub fn new(robot: &RobotModel, config: &SafetyConfig) -> Self {
        Self {
            position_limits: robot.joints.map(|joint| scaled_range(joint.range, config.max_joint_limit_factor)),
            max_torque: robot.torque_limits().map(|limit| limit * config.max_torque_factor),
            config: config.clone(),
            reading: None,
            recent: Vec::new(),
            clock: ClockCheck::default(),
            clock_jump: None,
            pause: Duration::ZERO,
            other_robot_at: None,
            clock_runs: false,
            imu: ImuCheck::default(),
            now: Duration::ZERO,
            silence: Duration::ZERO,
            stale_checks: 0,
            interval: (Duration::ZERO, 0),
            rate_is_met: false,
            quiet_since: None,
            remote_at: None,
            overload_since: [None; NUM_JOINTS],
            loss_interval: None,
        }
    }

    /// Takes in what happened since the last step.
    pub fn update(&mut self, input: &Input) {
        self.pause = input.now.saturating_sub(self.now);
        self.silence += self.pause.min(MAX_SILENT_STEP);
        self.now = input.now;
        if input.other_robot {
            self.other_robot_at = Some(self.now);
        }
        self.clock_jump = None;
        self.recent.clear();
        self.quiet_since = if input.foreign_writers == 0 { self.quiet_since.or(Some(input.now)) } else { None };
        for reading in &input.readings {
            if self.is_new(reading) {
                self.add(reading.clone());
            }
        }
        if self.recent.is_empty() && self.silence > Duration::from_millis(self.config.state_timeout_ms) {
            self.stale_checks = self.stale_checks.saturating_add(1);
            self.rate_is_met &= !self.is_stale();
        }
        let (start, states) = self.interval;
        let elapsed = self.now.saturating_sub(start);
        if elapsed >= RATE_INTERVAL {
            let needed = f64::from(self.config.min_state_hz) * elapsed.as_secs_f64();
            self.rate_is_met = !self.is_stale() && f64::from(states) >= needed;
            self.interval = (self.now, 0);
        }
    }

    /// Returns false for a state that was sent again: its clock stands still.
    fn is_new(&mut self, reading: &Reading) -> bool {
        let changed = self.reading.as_ref().is_none_or(|last| last.tick != reading.tick);
        self.clock_runs |= changed && self.reading.is_some();
        changed || !self.clock_runs
    }

    fn add(&mut self, reading: Reading) {
        self.silence = Duration::ZERO;
        self.stale_checks = 0;
        if self.clock_runs {
            self.clock_jump = self.clock_jump.or(self.clock.add(self.now, reading.tick));
        }
        self.interval.1 += 1;
        if reading.remote.is_some() {
            self.remote_at = Some(self.now);
        }
        for ((since, tau), limit) in self.overload_since.iter_mut().zip(reading.tau).zip(self.max_torque) {
            *since = if tau.abs() <= limit { None } else { since.or(Some(self.now)) };
        }
        let is_over = |(start, count): &(Duration, u32)| {
            self.now.saturating_sub(*start) > LOSS_INTERVAL || reading.lost_messages < *count
        };
        self.loss_interval =
            self.loss_interval.filter(|interval| !is_over(interval)).or(Some((self.now, reading.lost_messages)));
        self.imu.add(self.now, &reading);
        self.recent.push(reading.clone());
        self.reading = Some(reading);
    }

    /// Returns the latest measurements; `None` before the first.
    pub fn reading(&self) -> Option<&Reading> {
        self.reading.as_ref()
    }

    /// Returns true if the last state is too old.
    pub fn is_stale(&self) -> bool {
        self.stale_checks >= STALE_CHECKS
    }

    /// Returns true if states arrive at the needed rate.
    pub fn is_connected(&self) -> bool {
        self.rate_is_met
    }

    /// Returns true if no other writer of `rt/lowcmd` has existed for a while.
    pub fn is_quiet(&self) -> bool {
        self.quiet_since.is_some_and(|since| self.now.saturating_sub(since) >= QUIET_TIME)
    }

    fn has_other_robot(&self) -> bool {
        self.other_robot_at.is_some_and(|at| self.now.saturating_sub(at) < QUIET_TIME)
    }

    fn remote_is_lost(&self) -> bool {
        let timeout = Duration::from_millis(self.config.remote_timeout_ms);
        self.config.remote_required && self.remote_at.is_none_or(|at| self.now.saturating_sub(at) > timeout)
    }

    /// Returns the first fault that counts in `state`.
    pub fn fault(&self, state: State, input: &Input) -> Option<Fault> {
        let writers = input.foreign_writers;
        let surroundings = [
            input.stop_requested.then_some(Fault::StopRequested),
            watchdog_fault(state, input.watchdog),
            (self.pause > Duration::from_millis(self.config.max_pause_ms))
                .then_some(Fault::Pause { ms: self.pause.as_millis() as u64 }),
            (!input.can_send).then_some(Fault::CannotSend),
            (writers > 0).then_some(Fault::ForeignWriter { writers }),
            self.has_other_robot().then_some(Fault::OtherRobot),
            self.clock_jump.map(|ticks| Fault::ClockJump { ticks }),
            (!input.controller_released).then_some(Fault::ControllerActive),
            self.is_stale().then_some(Fault::StateStale { age_ms: self.silence.as_millis() as u64 }),
        ];
        let last = self.reading.as_ref().filter(|_| self.recent.is_empty());
        let measured = self.recent.iter().chain(last).flat_map(|reading| self.measured_faults(reading)).flatten();
        let missing = [
            self.remote_is_lost().then_some(Fault::RemoteLost),
            (input.client == Client::Absent).then_some(Fault::ClientLost),
        ];
        surroundings
            .into_iter()
            .flatten()
            .chain(measured)
            .chain(missing.into_iter().flatten())
            .find(|fault| fault.counts_in(state))
    }

    fn measured_faults(&self, reading: &Reading) -> [Option<Fault>; 8] {
        let config = &self.config;
        let is_stop = |remote: &Remote| remote.is_pressed(Button::L2) && remote.is_pressed(Button::B);
        let lost = self.loss_interval.map_or(0, |(_, count)| reading.lost_messages.saturating_sub(count));
        let outside = |joint: &Joint| {
            let [low, high] = self.position_limits[joint.index()];
            !(low..=high).contains(&reading.q[joint.index()])
        };
        let overloaded = |joint: &Joint| {
            let time = Duration::from_millis(config.max_torque_ms);
            self.overload_since[joint.index()].is_some_and(|since| self.now.saturating_sub(since) > time)
        };
        let hot = |joint: &Joint| i16::from(reading.temperature[joint.index()]) > config.max_temperature_c;
        let first = |is_wrong: &dyn Fn(&Joint) -> bool| Joint::ALL.into_iter().find(is_wrong);
        let (degrees, disagreement) = (reading.tilt.to_degrees(), self.imu.degrees());
        [
            reading.remote.as_ref().is_some_and(is_stop).then_some(Fault::RemoteStop),
            (lost > config.max_lost_messages).then_some(Fault::MessagesLost { count: lost }),
            (!(..=config.max_tilt_deg).contains(&degrees)).then_some(Fault::Tilt { degrees }),
            (!(..=config.max_imu_disagreement_deg).contains(&disagreement))
                .then_some(Fault::ImuDisagrees { degrees: disagreement }),
            first(&outside).map(|joint| Fault::JointLimit { joint, q: reading.q[joint.index()] }),
            first(&overloaded).map(|joint| Fault::Torque { joint, tau: reading.tau[joint.index()] }),
            first(&hot).map(|joint| Fault::Temperature { joint, celsius: reading.temperature[joint.index()] }),
            (!(config.min_voltage_v..).contains(&reading.voltage)).then_some(Fault::Voltage { volts: reading.voltage }),
        ]
    }
}

/// Returns the fault of the watchdog. A robot that moves needs one that guards it.
fn watchdog_fault(state: State, watchdog: Watchdog) -> Option<Fault> {
    match watchdog {
        Watchdog::Guarding => None,
        Watchdog::Idle => state.is_moving().then_some(Fault::WatchdogGone),
        Watchdog::Missing => Some(Fault::WatchdogGone),
        Watchdog::TookOver => Some(Fault::WatchdogTookOver),
    }
}
