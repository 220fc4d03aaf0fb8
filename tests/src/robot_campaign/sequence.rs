//! Random sequences of requests, actions and faults.

use std::collections::BTreeMap;
use std::fmt;

use rand::RngExt;
use twinstep_model::{PerJoint, Stream, stream};
use twinstep_robot::{Client, OperatorRequest, State};

use super::invariants::Checker;
use super::table::{self, Injection};
use crate::robot_rig::Rig;

/// Requests of the operator.
const REQUESTS: [OperatorRequest; 6] = [
    OperatorRequest::Arm,
    OperatorRequest::Stand,
    OperatorRequest::Sit,
    OperatorRequest::Damp,
    OperatorRequest::Disarm,
    OperatorRequest::Go,
];
/// Lines that end every fault that can end.
const REPAIR: [&str; 4] = ["clear", "controller off", "battery 80", "heat FL_calf 30"];
/// Time that is simulated after the last event [ms].
const AFTER_MS: u64 = 2500;

/// What a client sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Actions {
    /// Nothing.
    Silent,
    /// A random action in each tick.
    Fresh,
    /// The actions of the tick before the present one.
    Late,
    /// The actions of the next tick.
    Early,
    /// An action in each step, so ten in a tick.
    Repeated,
    /// An action in every fifth tick.
    Rare,
    /// Actions with a NaN.
    Nan,
    /// Actions with an infinite number.
    Infinite,
    /// Actions up to a million.
    Huge,
}

impl Actions {
    const ALL: [Actions; 9] = [
        Actions::Silent,
        Actions::Fresh,
        Actions::Late,
        Actions::Early,
        Actions::Repeated,
        Actions::Rare,
        Actions::Nan,
        Actions::Infinite,
        Actions::Huge,
    ];
}

/// What happens to the robot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event {
    /// The operator requests something.
    Request(OperatorRequest),
    /// The fake robot has a fault.
    Line(&'static str),
    /// The client changes what it sends.
    Actions(Actions),
    /// The client comes, goes or ends its episode.
    Client(Client),
    /// A stop is requested, or no longer.
    Stop(bool),
}

impl fmt::Display for Event {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Event::Request(request) => write!(formatter, "operator: {request:?}"),
            Event::Line(line) => write!(formatter, "robot: {line}"),
            Event::Actions(actions) => write!(formatter, "actions: {actions:?}"),
            Event::Client(client) => write!(formatter, "client: {client:?}"),
            Event::Stop(on) => write!(formatter, "stop requested: {on}"),
        }
    }
}

/// Result of one or of many sequences.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// Number of sequences.
    pub sequences: u64,
    /// Number of steps of 2 ms in each state.
    pub steps: BTreeMap<&'static str, u64>,
    /// Number of faults by name.
    pub faults: BTreeMap<&'static str, u64>,
    /// Number of events.
    pub events: u64,
    /// Number of accepted and of refused requests.
    pub requests: [u64; 2],
    /// Number of executed and of refused actions.
    pub actions: [u64; 2],
    /// Number of messages on `rt/lowcmd` that the robot executed.
    pub commands: u64,
    /// First sequence that violates an invariant.
    pub counterexample: Option<Counterexample>,
}

/// A sequence that violates an invariant.
#[derive(Clone, Debug)]
pub struct Counterexample {
    /// Number of the sequence.
    pub index: u64,
    /// Events before the violation, with their time [ms].
    pub events: Vec<(u64, Event)>,
    /// Time of the violation [ms].
    pub at_ms: u64,
    /// What is not true.
    pub violation: String,
}

impl Tally {
    /// Adds the result of other sequences.
    pub fn add(&mut self, other: Tally) {
        self.sequences += other.sequences;
        for (sum, counts) in [(&mut self.steps, other.steps), (&mut self.faults, other.faults)] {
            for (name, count) in counts {
                *sum.entry(name).or_default() += count;
            }
        }
        self.events += other.events;
        self.commands += other.commands;
        for side in 0..2 {
            self.requests[side] += other.requests[side];
            self.actions[side] += other.actions[side];
        }
        let index = |example: &Option<Counterexample>| example.as_ref().map_or(u64::MAX, |example| example.index);
        if index(&other.counterexample) < index(&self.counterexample) {
            self.counterexample = other.counterexample;
        }
    }

    fn count(&mut self, rig: &Rig, had_request: bool, had_action: bool, had_fault: bool) {
        let output = &rig.output;
        *self.steps.entry(output.state.name()).or_default() += 1;
        if let (false, Some(fault)) = (had_fault, &output.fault) {
            *self.faults.entry(table::fault_name(fault)).or_default() += 1;
        }
        if had_request {
            self.requests[usize::from(output.request_refused.is_some())] += 1;
        }
        if had_action {
            self.actions[usize::from(output.action_refused.is_some())] += 1;
        }
    }
}

/// Returns the events of a sequence with their times [ms]. They depend only on the seed and the index.
pub fn events(seed: u64, index: u64) -> Vec<(u64, Event)> {
    let mut random = stream(seed, "robot_faults", index);
    let lines: Vec<_> = table::injections()
        .filter_map(|injection| if let Injection::Line(line) = injection { Some(line) } else { None })
        .collect();
    let (mut at, mut events) = (0, Vec::new());
    get_up(&mut random, &mut at, &mut events);
    for _ in 0..random.random_range(5..30) {
        at += match random.random_range(0..4) {
            0 => 0,
            3 => random.random_range(100..1000),
            _ => random.random_range(2..100),
        };
        match random.random_range(0..100) {
            0..35 => events.push((at, Event::Request(pick(&mut random, &REQUESTS)))),
            35..55 => events.push((at, Event::Line(pick(&mut random, &lines)))),
            55..70 => events.push((at, Event::Actions(pick(&mut random, &Actions::ALL)))),
            70..78 => {
                let clients = [Client::Absent, Client::Connected, Client::Connected, Client::EndsEpisode];
                events.push((at, Event::Client(pick(&mut random, &clients))));
            }
            78..83 => events.push((at, Event::Stop(random.random()))),
            _ => {
                repair(at, &mut events);
                get_up(&mut random, &mut at, &mut events);
            }
        }
    }
    events
}

fn pick<T: Copy>(random: &mut Stream, values: &[T]) -> T {
    values[random.random_range(0..values.len())]
}

/// Appends the way from `observe` to `run`, up to a random place.
fn get_up(random: &mut Stream, at: &mut u64, events: &mut Vec<(u64, Event)>) {
    let way = [
        (1200, Event::Request(OperatorRequest::Arm)),
        (100, Event::Request(OperatorRequest::Stand)),
        (3300, Event::Actions(Actions::Fresh)),
    ];
    for (after, event) in way {
        *at += after;
        events.push((*at, event));
        if random.random_range(0..5) == 0 {
            return;
        }
    }
    *at += 500;
}

/// Appends the end of every fault.
fn repair(at: u64, events: &mut Vec<(u64, Event)>) {
    events.extend(REPAIR.map(|line| (at, Event::Line(line))));
    let others = [Event::Stop(false), Event::Client(Client::Connected), Event::Actions(Actions::Silent)];
    events.extend(others.map(|event| (at, event)));
    // From a fault it is armed again; from other states it lies down.
    events.push((at, Event::Request(OperatorRequest::Damp)));
}

/// Runs a sequence.
pub fn run(seed: u64, index: u64) -> Tally {
    let (mut rig, mut tally) = (Rig::default(), Tally { sequences: 1, ..Tally::default() });
    let mut checker = Checker::new(&rig);
    let mut random = stream(seed, "robot_faults_actions", index);
    let (events, mut actions, mut next) = (events(seed, index), Actions::Silent, 0);
    let end = events.last().map_or(0, |(at, _)| at + AFTER_MS);
    for ms in (2..=end).step_by(2) {
        // A step takes one request; a second one waits for the next step.
        while let Some((_, event)) = events.get(next).filter(|(at, _)| *at < ms) {
            if matches!(event, Event::Request(_)) && rig.input.request.is_some() {
                break;
            }
            apply(*event, &mut rig, &mut checker, &mut actions);
            (next, tally.events) = (next + 1, tally.events + 1);
        }
        send(actions, &mut rig, &mut random);
        let had = (rig.input.request.is_some(), rig.input.action.is_some(), rig.output.fault.is_some());
        let violation = checker.step(&mut rig).err();
        tally.count(&rig, had.0, had.1, had.2);
        if rig.input.client == Client::EndsEpisode {
            rig.input.client = Client::Connected;
        }
        if let Some(violation) = violation {
            let events = events[..next].to_vec();
            tally.counterexample = Some(Counterexample { index, events, at_ms: ms, violation });
            break;
        }
    }
    tally.commands = rig.robot.statistics().accepted;
    tally
}

fn apply(event: Event, rig: &mut Rig, checker: &mut Checker, actions: &mut Actions) {
    match event {
        Event::Request(request) => rig.input.request = Some(request),
        Event::Line(line) => {
            rig.inject(line);
            checker.motors_disobey = (checker.motors_disobey && line != "clear") || table::disturbs_motors(line);
        }
        Event::Actions(style) => *actions = style,
        Event::Client(client) => rig.input.client = client,
        Event::Stop(on) => rig.input.stop_requested = on,
    }
}

/// Sends what the client sends in this step.
fn send(actions: Actions, rig: &mut Rig, random: &mut Stream) {
    let (tick, begins) = (rig.next_tick(), rig.tick_begins());
    let is_due = match actions {
        Actions::Silent => false,
        Actions::Repeated => true,
        Actions::Rare => begins && tick.is_multiple_of(5),
        _ => begins,
    };
    if !is_due {
        return;
    }
    let mut values: PerJoint = std::array::from_fn(|_| random.random_range(-1.0..1.0));
    let joint = random.random_range(0..values.len());
    match actions {
        Actions::Nan => values[joint] = f32::NAN,
        Actions::Infinite => values[joint] = f32::INFINITY,
        Actions::Huge => values = values.map(|value| 1e6 * value),
        _ => {}
    }
    match actions {
        Actions::Late => rig.act_for(tick.saturating_sub(1), values),
        Actions::Early => rig.act_for(tick + 1, values),
        _ => rig.act(values),
    }
}

/// Returns the share of the steps in which the robot was armed, 0 to 1.
pub fn armed_share(tally: &Tally) -> f64 {
    let all: u64 = tally.steps.values().sum();
    let unarmed =
        [State::Disconnected, State::Observe].map(|state| tally.steps.get(state.name()).copied().unwrap_or(0));
    1.0 - unarmed.iter().sum::<u64>() as f64 / all.max(1) as f64
}
