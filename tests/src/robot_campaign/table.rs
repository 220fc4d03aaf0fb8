//! Each fault in each state, compared with the table in the documentation of the `robot` crate.

use twinstep_model::Command;
use twinstep_robot::{Client, Fault, Reaction, State};

use super::invariants::Checker;
use crate::robot_rig::{Rig, TICK_MS};

/// States in which faults are injected.
pub const STATES: [State; 7] =
    [State::Observe, State::Damp, State::StandUp, State::Ready, State::Run, State::Hold, State::Sit];
/// Time after the injection in which the robot is watched [ms].
const WATCHED_MS: u64 = 4000;
/// Largest height of the base of a robot that lies on its belly [m].
const LYING: f32 = 0.15;
/// Smallest height of the base of a robot that stands [m].
const STANDING: f32 = 0.28;

/// What is injected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Injection {
    /// A line of the fake robot.
    Line(&'static str),
    /// A client or the process requests a stop.
    StopRequested,
    /// The client does not live any more.
    ClientLost,
    /// The client sends no actions.
    ActionsMissing,
}

/// States in which a fault counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scope {
    /// Every armed state.
    Armed,
    /// Armed states but `damp`.
    Moving,
    /// `run` and `hold`.
    Acting,
}

/// A row of the table of faults: fault, reaction, scope, and time within which it is found [ms].
#[derive(Clone, Copy, Debug)]
struct Rule(&'static str, Reaction, Scope, u64);

const STALE: Rule = Rule("stale state", Reaction::Damp, Scope::Armed, 40);
const WRITER: Rule = Rule("another writer", Reaction::Damp, Scope::Armed, 10);
const CONTROLLER: Rule = Rule("controller active", Reaction::Damp, Scope::Armed, 10);
const REMOTE_STOP: Rule = Rule("L2 + B", Reaction::Damp, Scope::Armed, 10);
const STOP: Rule = Rule("stop requested", Reaction::Damp, Scope::Armed, 10);
const LOST: Rule = Rule("lost messages", Reaction::Damp, Scope::Armed, 10);
const TILT: Rule = Rule("tilt", Reaction::Damp, Scope::Moving, 10);
const JOINT_LIMIT: Rule = Rule("joint limit", Reaction::Damp, Scope::Moving, 10);
const TEMPERATURE: Rule = Rule("temperature", Reaction::Sit, Scope::Moving, 10);
const VOLTAGE: Rule = Rule("voltage", Reaction::Sit, Scope::Moving, 10);
const REMOTE_LOST: Rule = Rule("remote lost", Reaction::Sit, Scope::Moving, 1010);
const CLIENT_LOST: Rule = Rule("client lost", Reaction::Sit, Scope::Acting, 10);
const LATE: Rule = Rule("actions late", Reaction::Sit, Scope::Acting, 11 * TICK_MS);

/// Injections with the row of the table of faults that is for them; `None` if nothing may happen.
const CASES: [(Injection, Option<Rule>); 34] = [
    (Injection::Line("stale 100"), Some(STALE)),
    (Injection::Line("stale 10000"), Some(STALE)),
    (Injection::Line("loss 1"), Some(STALE)),
    (Injection::Line("delay 30"), Some(STALE)),
    (Injection::Line("power cut"), Some(STALE)),
    (Injection::Line("mistake checksum wrong"), Some(STALE)),
    (Injection::Line("foreign writer on"), Some(WRITER)),
    (Injection::Line("controller on"), Some(CONTROLLER)),
    (Injection::Line("remote L2+B"), Some(REMOTE_STOP)),
    (Injection::StopRequested, Some(STOP)),
    (Injection::Line("messages lost"), Some(LOST)),
    (Injection::Line("fall"), Some(TILT)),
    (Injection::Line("mistake imu upside down"), Some(TILT)),
    (Injection::Line("joint out FL_hip"), Some(JOINT_LIMIT)),
    (Injection::Line("joint out RR_calf"), Some(JOINT_LIMIT)),
    (Injection::Line("mistake encoder degrees"), Some(JOINT_LIMIT)),
    (Injection::Line("heat FL_calf 90"), Some(TEMPERATURE)),
    (Injection::Line("voltage 20"), Some(VOLTAGE)),
    (Injection::Line("battery 0"), Some(VOLTAGE)),
    (Injection::Line("remote lost"), Some(REMOTE_LOST)),
    (Injection::ClientLost, Some(CLIENT_LOST)),
    (Injection::ActionsMissing, Some(LATE)),
    (Injection::Line("stale 10"), None),
    (Injection::Line("loss 0.1"), None),
    (Injection::Line("delay 6"), None),
    (Injection::Line("reorder"), None),
    (Injection::Line("remote A"), None),
    (Injection::Line("remote none"), None),
    (Injection::Line("remote stick 1 -1 1"), None),
    (Injection::Line("battery 30"), None),
    (Injection::Line("heat FL_calf 80"), None),
    (Injection::Line("foreign writer off"), None),
    (Injection::Line("controller off"), None),
    (Injection::Line("clear"), None),
];

/// Mistakes of wiring and software. Preflight is there to find them; here only the invariants are checked.
const MISTAKES: [&str; 25] = [
    "mistake legs swapped FL FR",
    "mistake commands swapped FL RR",
    "mistake joint mirrored FL_hip",
    "mistake encoder sign FL_thigh",
    "mistake encoder scale FL_thigh 2",
    "mistake joint offset FL_calf 0.3",
    "mistake encoder offset FL_calf 0.3",
    "mistake encoder dead FL_thigh",
    "mistake motor frozen FL_thigh",
    "mistake motor dead FL_calf",
    "mistake motor weak FL_calf 0.3",
    "mistake gains stale FL_calf",
    "mistake velocity sign FL_calf",
    "mistake velocity scale FL_calf 3",
    "mistake torque sign FL_calf",
    "mistake quaternion xyzw",
    "mistake quaternion inverted",
    "mistake gyro swapped",
    "mistake gyro degrees",
    "mistake gyro sign x",
    "mistake accelerometer g",
    "mistake accelerometer sign",
    "mistake imu turned 90",
    "mistake states slow",
    "mistake clock stopped",
];

/// What the motors do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motors {
    /// They hold or change positions.
    Holding,
    /// Damping.
    Damping,
    /// No gains, only the drag of the gears.
    Limp,
}

/// What happened after a fault in a state.
#[derive(Clone, Debug)]
pub struct Cell {
    /// Injection.
    pub injection: Injection,
    /// State of the injection.
    pub state: State,
    /// Name of the fault, with the time from the injection to it [ms].
    pub fault: Option<(&'static str, u64)>,
    /// State in the step of the fault.
    pub reaction: Option<State>,
    /// Time from the injection to the first damping command [ms].
    pub damping_ms: Option<u64>,
    /// State after four seconds.
    pub end: State,
    /// Motors after four seconds.
    pub motors: Motors,
    /// Height of the base after four seconds [m].
    pub height: f32,
    /// What differs from the specification; empty if nothing does.
    pub violations: Vec<String>,
}

/// Returns every injection of the table.
pub fn injections() -> impl Iterator<Item = Injection> {
    CASES.into_iter().map(|(injection, _)| injection).chain(MISTAKES.map(Injection::Line))
}

impl Injection {
    /// Returns its name.
    pub fn name(self) -> &'static str {
        match self {
            Injection::Line(line) => line,
            Injection::StopRequested => "stop requested",
            Injection::ClientLost => "client lost",
            Injection::ActionsMissing => "actions missing",
        }
    }

    fn start(self, rig: &mut Rig) {
        match self {
            Injection::Line(line) => rig.inject(line),
            Injection::StopRequested => rig.input.stop_requested = true,
            Injection::ClientLost => rig.input.client = Client::Absent,
            Injection::ActionsMissing => {}
        }
    }
}

/// Returns the name of a fault in the results.
pub fn fault_name(fault: &Fault) -> &'static str {
    match fault {
        Fault::StateStale { .. } => STALE.0,
        Fault::ForeignWriter { .. } => WRITER.0,
        Fault::ControllerActive => CONTROLLER.0,
        Fault::RemoteStop => REMOTE_STOP.0,
        Fault::StopRequested => STOP.0,
        Fault::MessagesLost { .. } => LOST.0,
        Fault::Tilt { .. } => TILT.0,
        Fault::ImuDisagrees { .. } => "accelerometer and orientation disagree",
        Fault::JointLimit { .. } => JOINT_LIMIT.0,
        Fault::Torque { .. } => "torque",
        Fault::UnsafeCommand(_) => "unsafe command",
        Fault::Temperature { .. } => TEMPERATURE.0,
        Fault::Voltage { .. } => VOLTAGE.0,
        Fault::RemoteLost => REMOTE_LOST.0,
        Fault::ClientLost => CLIENT_LOST.0,
        Fault::ActionLate { .. } => LATE.0,
        Fault::StandFailed { .. } => "stand failed",
        Fault::OtherRobot => "other robot",
        Fault::ClockJump { .. } => "clock jump",
        Fault::Pause { .. } => "pause",
        Fault::WatchdogTookOver => "watchdog took over",
        Fault::WatchdogGone => "no watchdog",
        Fault::CannotSend => "commands cannot be sent",
    }
}

/// Returns true if motors do not execute their commands after a line.
pub fn disturbs_motors(line: &str) -> bool {
    line.starts_with("mistake") || line == "messages lost"
}

/// Returns what the motors do.
fn motors(command: &Command, is_powered: bool) -> Motors {
    if !is_powered {
        Motors::Limp
    } else if command.kp.iter().any(|kp| *kp > 0.0) {
        Motors::Holding
    } else if command.kd.iter().all(|kd| *kd > 1.0) {
        Motors::Damping
    } else {
        Motors::Limp
    }
}

/// Injects a fault in a state and watches the robot for four seconds.
///
/// The client of a robot in `run` continues to send actions. That of a robot in `hold` sends none.
pub fn run(injection: Injection, state: State) -> Cell {
    let mut rig = Rig::in_state(state);
    let mut checker = Checker::new(&rig);
    checker.motors_disobey = disturbs_motors(injection.name());
    injection.start(&mut rig);
    let (mut fault, mut reaction, mut damping_ms, mut violations) = (None, None, None, Vec::new());
    for ms in (2..=WATCHED_MS).step_by(2) {
        if state == State::Run && injection != Injection::ActionsMissing && rig.tick_begins() {
            rig.act([0.1; 12]);
        }
        if let Err(violation) = checker.step(&mut rig) {
            violations.push(format!("{ms} ms: {violation}"));
            break;
        }
        if let (None, Some(found)) = (fault, &rig.output.fault) {
            (fault, reaction) = (Some((fault_name(found), ms)), Some(rig.output.state));
        }
        let is_damping = rig.output.command.is_some_and(|command| command.command().kp == [0.0; 12]);
        if is_damping {
            damping_ms.get_or_insert(ms);
        }
    }
    let motors = motors(rig.robot.motor_command(), rig.robot.is_powered());
    let (end, height) = (rig.output.state, rig.height());
    let mut cell = Cell { injection, state, fault, reaction, damping_ms, end, motors, height, violations };
    if let Some((_, rule)) = CASES.iter().find(|(other, _)| *other == injection) {
        let found = cell.compare(rule.as_ref());
        cell.violations.extend(found);
    }
    cell
}

/// Returns the rule that is in force in a state; `None` if no fault follows.
fn rule_in(rule: Option<&Rule>, state: State) -> Option<Rule> {
    let counts = |rule: &&Rule| match rule.2 {
        Scope::Armed => state.is_armed(),
        Scope::Moving => state.is_moving(),
        Scope::Acting => matches!(state, State::Run | State::Hold),
    };
    // The client of a robot in `hold` sends nothing; the seven ticks until that is a fault are the shorter time.
    let late = (state == State::Hold).then_some(LATE);
    let first = rule.filter(counts).copied().filter(|rule| late.is_none() || rule.3 <= LATE.3);
    first.or(late)
}

impl Cell {
    /// Returns what differs from the specification.
    fn compare(&self, rule: Option<&Rule>) -> Option<String> {
        let name = self.fault.map(|(name, _)| name);
        let Some(Rule(expected, reaction, _, within_ms)) = rule_in(rule, self.state) else {
            return self.compare_without_fault();
        };
        if name != Some(expected) {
            return Some(format!("the fault is {name:?}, not `{expected}`"));
        }
        let after_ms = self.fault.map_or(0, |(_, ms)| ms);
        if after_ms > within_ms {
            return Some(format!("the fault is found after {after_ms} ms, not within {within_ms} ms"));
        }
        let first = if reaction == Reaction::Damp { State::Fault } else { State::Sit };
        if self.reaction != Some(first) || self.end != State::Fault {
            return Some(format!("`{first}` and `fault` should follow, not {:?} and `{}`", self.reaction, self.end));
        }
        if reaction == Reaction::Damp && self.damping_ms.is_none_or(|ms| ms > within_ms) {
            return Some(format!("damping begins after {:?} ms", self.damping_ms));
        }
        let lies = self.height < LYING;
        (reaction == Reaction::Sit && !lies).then(|| format!("it should lie, but is at {} m", self.height))
    }

    fn compare_without_fault(&self) -> Option<String> {
        if let Some((name, ms)) = self.fault {
            return Some(format!("no fault should follow, but `{name}` does after {ms} ms"));
        }
        let end = match self.state {
            State::StandUp => State::Ready,
            State::Sit => State::Damp,
            state => state,
        };
        let is_disconnected = self.state == State::Observe && self.end == State::Disconnected;
        if self.end != end && !is_disconnected {
            return Some(format!("it should end in `{end}`, not `{}`", self.end));
        }
        let stands = matches!(end, State::Ready | State::Run);
        (stands && self.height < STANDING).then(|| format!("it should stand, but is at {} m", self.height))
    }
}
