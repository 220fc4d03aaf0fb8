//! The random sequences on the robot's own wire: fake robot, `twinstep robot` and client, in real time.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rand::RngExt;
use serde_json::Value;
use twinstep_client::{ConnectOptions, Connection, RemoteVecEnv, Secret};
use twinstep_model::{AutoresetMode, ResetRequest, Stream, VecEnv, stream};
use twinstep_robot::{Client, OperatorRequest};

use super::sequence::{Actions, Event, events};
use crate::robot_pair::RobotPair;

/// Sequences are cut after this time [ms].
const MAX_MS: u64 = 10_000;
/// Time in which the robot's process finds the robot.
const DISCOVERY: Duration = Duration::from_secs(20);
/// Interval at which the states of the robot are looked at.
const LOOK: Duration = Duration::from_millis(10);
/// Time in which the last messages of a robot that is not armed any more arrive.
const IN_FLIGHT: Duration = Duration::from_millis(300);
/// Time in which the line that reports a state arrives, also on a machine whose cores are all busy.
const LATE_LINE: Duration = Duration::from_secs(2);
/// Longest time without a command while the robot is armed [ms].
pub const MAX_GAP_MS: u64 = 10;

/// What one sequence showed.
pub struct WireRun {
    /// Number of the sequence.
    pub index: u64,
    /// Number of events.
    pub events: usize,
    /// Commands that the robot executed.
    pub accepted: u64,
    /// Steps that the client got.
    pub steps: u64,
    /// Longest time that a moving command stayed in force, on the robot's clock [ms].
    pub largest_gap_ms: u64,
    /// What was not true.
    pub violations: Vec<String>,
}

/// Runs the beginning of a sequence. The same seed and index give the same events as on the accelerated clock.
pub fn run(program: &Path, seed: u64, index: u64) -> Result<WireRun, String> {
    let mut pair = RobotPair::start(program, &["--released"], &[])?;
    let client = ClientThread::start(&pair.endpoint, stream(seed, "robot_faults_actions", index));
    let stopper = Connection::open(&ConnectOptions::new(&pair.endpoint, 1), Secret::random());
    let stopper = stopper.map_err(|error| error.to_string())?;
    let mut watcher = Watcher::default();
    // The first request of a sequence is for a robot that is observed, which it is here after the discovery.
    watcher.wait_for_states(&mut pair)?;
    let (start, mut done) = (Instant::now(), 0);
    for (at, event) in events(seed, index).into_iter().take_while(|(at, _)| *at < MAX_MS) {
        while start.elapsed() < Duration::from_millis(at) {
            watcher.look(&mut pair)?;
            std::thread::sleep(LOOK);
        }
        watcher.look(&mut pair)?;
        match event {
            Event::Request(request) => {
                watcher.requests.push((Instant::now(), request));
                pair.robot.write_line(&format!("{request:?}").to_lowercase())?;
            }
            Event::Line(line) => {
                watcher.note_line(line);
                let answer = pair.inject(line)?;
                if !answer.starts_with("ok") {
                    return Err(format!("`{line}`: {answer}"));
                }
            }
            Event::Actions(actions) => client.set(|order| order.actions = actions),
            Event::Client(present) => client.set(|order| order.client = present),
            Event::Stop(true) => stopper.stop_robot().map_err(|error| error.to_string())?,
            Event::Stop(false) => {}
        }
        done += 1;
    }
    watcher.look(&mut pair)?;
    let steps = client.end();
    let statistics = pair.ask("statistics")?;
    let number = |name: &str| statistics[name].as_u64().unwrap_or_default();
    watcher.check_statistics(&statistics);
    Ok(WireRun {
        index,
        events: done,
        accepted: number("accepted"),
        steps,
        largest_gap_ms: number("largest_gap_ms"),
        violations: watcher.violations,
    })
}

/// Compares the states of the robot with what was asked of it.
struct Watcher {
    state: String,
    since: Instant,
    /// Requests that no change of state has used, with the time at which they were typed.
    requests: Vec<(Instant, OperatorRequest)>,
    /// Commands that the robot had executed a while after it ceased to be armed.
    accepted: Option<u64>,
    has_power: bool,
    /// True while another program commands the robot, too.
    has_stranger: bool,
    /// True if another program ever did.
    had_stranger: bool,
    violations: Vec<String>,
}

impl Default for Watcher {
    fn default() -> Self {
        Self {
            state: "disconnected".to_owned(),
            since: Instant::now(),
            requests: Vec::new(),
            accepted: None,
            has_power: true,
            has_stranger: false,
            had_stranger: false,
            violations: Vec::new(),
        }
    }
}

fn is_armed(state: &str) -> bool {
    !["starting", "disconnected", "observe"].contains(&name(state))
}

/// Returns the name of a state without its fault.
fn name(state: &str) -> &str {
    state.split(':').next().unwrap_or(state)
}

impl Watcher {
    /// Takes in a fault that was injected.
    fn note_line(&mut self, line: &str) {
        self.has_power &= line != "power cut";
        self.has_stranger = line == "foreign writer on" || (self.has_stranger && line != "clear");
        self.had_stranger |= self.has_stranger;
    }

    /// Waits until states of the robot arrive.
    fn wait_for_states(&mut self, pair: &mut RobotPair) -> Result<(), String> {
        let end = Instant::now() + DISCOVERY;
        while self.state != "observe" {
            if Instant::now() > end {
                return Err(format!("no states arrived within {DISCOVERY:?}; last state `{}`", self.state));
            }
            std::thread::sleep(LOOK);
            self.look(pair)?;
        }
        Ok(())
    }

    fn look(&mut self, pair: &mut RobotPair) -> Result<(), String> {
        for state in pair.new_states() {
            self.change(&state);
        }
        // The robot does not know whose command it executes.
        if is_armed(&self.state) || self.has_stranger || self.since.elapsed() < IN_FLIGHT {
            self.accepted = None;
            return Ok(());
        }
        let accepted = pair.ask("statistics")?["accepted"].as_u64().unwrap_or_default();
        // The robot may have been armed while it was asked.
        let is_same = pair.new_states().iter().all(|state| self.change(state));
        if let Some(before) = self.accepted.filter(|before| is_same && *before != accepted) {
            // The line with the new state arrives after the first commands, and later on a busy machine.
            std::thread::sleep(LATE_LINE);
            if pair.new_states().iter().all(|state| self.change(state)) {
                self.violations.push(format!("{} commands were executed in `{}`", accepted - before, self.state));
            }
        }
        self.accepted = Some(accepted);
        Ok(())
    }

    /// Takes in a new state. Returns true if it is as armed as the last one.
    fn change(&mut self, state: &str) -> bool {
        use OperatorRequest::{Arm, Disarm, Stand};
        let (before, after) = (name(&self.state).to_owned(), name(state).to_owned());
        // A robot executes a request at once or never; the line of the change may be late.
        self.requests.retain(|(at, _)| at.elapsed() < 2 * LATE_LINE);
        let asked = |wanted| self.requests.iter().any(|(_, request)| *request == wanted);
        let wrong = [
            (!is_armed(&before) && is_armed(&after) && !asked(Arm), "without arming"),
            (is_armed(&before) && !is_armed(&after) && !asked(Disarm), "without disarming"),
            (before == "damp" && after == "stand_up" && !asked(Stand), "without a request"),
            (before == "fault" && after != "fault" && !asked(Arm) && !asked(Disarm), "without arming"),
        ];
        for (_, how) in wrong.into_iter().filter(|(is_wrong, _)| *is_wrong) {
            self.violations.push(format!("`{}` became `{state}` {how}", self.state));
        }
        let is_same = is_armed(&before) == is_armed(&after);
        // The line of a change may come after further requests, which the next changes use.
        let used =
            [(!is_armed(&before) || before == "fault", Arm), (!is_armed(&after), Disarm), (after == "stand_up", Stand)];
        let used = used.into_iter().find(|(is_used, _)| *is_used).map(|(_, request)| request);
        if let Some(last) = self.requests.iter().position(|(_, request)| before != after && Some(*request) == used) {
            self.requests.drain(..=last);
        }
        (self.state, self.since) = (state.to_owned(), Instant::now());
        is_same
    }

    fn check_statistics(&mut self, statistics: &Value) {
        if self.has_power && !self.had_stranger && statistics["refused"] != 0 {
            self.violations.push(format!("the robot refused commands: {statistics}"));
        }
        if statistics["largest_excess_rad"].as_f64().is_none_or(|excess| excess > 0.0) {
            self.violations.push(format!("a command was outside a joint's range: {statistics}"));
        }
    }
}

/// What the client is to do.
#[derive(Clone, Copy)]
struct Order {
    client: Client,
    actions: Actions,
}

/// A client that follows its orders as far as the robot allows.
struct ClientThread {
    order: Arc<Mutex<Order>>,
    ends: Arc<AtomicBool>,
    thread: JoinHandle<u64>,
}

impl ClientThread {
    fn start(endpoint: &str, random: Stream) -> Self {
        let order = Arc::new(Mutex::new(Order { client: Client::Connected, actions: Actions::Silent }));
        let ends = Arc::new(AtomicBool::new(false));
        let options = ConnectOptions {
            autoreset: AutoresetMode::Disabled,
            interrupted: Arc::clone(&ends),
            timeout: Duration::from_secs(2),
            ..ConnectOptions::new(endpoint, 1)
        };
        let (shared, ending) = (Arc::clone(&order), Arc::clone(&ends));
        let thread = std::thread::spawn(move || act(&options, random, &shared, &ending));
        Self { order, ends, thread }
    }

    fn set(&self, change: impl FnOnce(&mut Order)) {
        change(&mut self.order.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Ends the client and returns the number of its steps.
    fn end(self) -> u64 {
        self.ends.store(true, Ordering::Release);
        self.thread.join().unwrap_or_default()
    }
}

fn act(options: &ConnectOptions, mut random: Stream, order: &Mutex<Order>, ends: &AtomicBool) -> u64 {
    let (mut env, mut steps, mut is_reset): (Option<RemoteVecEnv>, u64, bool) = (None, 0, false);
    while !ends.load(Ordering::Acquire) {
        let present = *order.lock().unwrap_or_else(PoisonError::into_inner);
        if present.client == Client::Absent {
            (env, is_reset) = (None, false);
        }
        if present.client == Client::Absent || present.actions == Actions::Silent {
            std::thread::sleep(LOOK);
            continue;
        }
        if present.client == Client::EndsEpisode {
            is_reset = false;
            order.lock().unwrap_or_else(PoisonError::into_inner).client = Client::Connected;
        }
        // Its errors are the robot's right: it is not ready, or has refused.
        let Some(remote) = env.as_mut() else {
            env = RemoteVecEnv::connect(options).ok();
            continue;
        };
        if !is_reset {
            is_reset = remote.reset(&ResetRequest::default()).is_ok();
            continue;
        }
        match step(remote, present.actions, &mut random) {
            Ok(is_over) => (steps, is_reset) = (steps + 1, !is_over),
            Err(()) => is_reset = false,
        }
    }
    steps
}

/// Makes one step. Returns true if the episode is over.
fn step(env: &mut RemoteVecEnv, actions: Actions, random: &mut Stream) -> Result<bool, ()> {
    let mut values: Vec<f32> = (0..env.spec().action_len()).map(|_| random.random_range(-1.0..1.0)).collect();
    match actions {
        Actions::Nan => values[3] = f32::NAN,
        Actions::Infinite => values[3] = f32::INFINITY,
        Actions::Huge => values.iter_mut().for_each(|value| *value *= 1e6),
        Actions::Rare => std::thread::sleep(Duration::from_millis(90)),
        Actions::Late | Actions::Early => {
            let tick = env.real_time().map_or(0, |report| report.tick);
            env.set_action_tick(if actions == Actions::Late { tick.saturating_sub(1) } else { tick + 1 });
        }
        Actions::Silent | Actions::Fresh | Actions::Repeated => {}
    }
    let batch = env.step(&values).map_err(drop)?;
    Ok(batch.done(0))
}
