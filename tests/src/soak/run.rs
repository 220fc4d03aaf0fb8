//! The server, its clients in parallel, and the result.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use rand::RngExt;
use twinstep_client::{ConnectOptions, Connection, Secret};
use twinstep_model::stream;
use twinstep_protocol::message::{HelloReply, HelloRequest};
use twinstep_protocol::{PROTOCOL, decode, encode, keys};

use super::monitor::Sample;
use super::visit::Fate;
use crate::process::Process;

/// Environments of the server.
const ENVS: usize = 1024;
/// Period of the samples.
const PERIOD: Duration = Duration::from_secs(1);
/// Maximum duration of one client.
const MAX_VISIT: Duration = Duration::from_mins(3);
/// Maximum time until leases, threads and connections of the last clients are released.
const SETTLING: Duration = Duration::from_mins(1);

/// Settings of a soak test.
#[derive(Clone, Debug)]
pub struct Plan {
    /// This program, with the role `client`.
    pub program: PathBuf,
    /// The program `twinstep`.
    pub twinstep: PathBuf,
    /// Task of the server.
    pub task: String,
    /// Time for which clients come.
    pub duration: Duration,
    /// Number of clients at the same time.
    pub lanes: usize,
    /// Seed of the clients.
    pub seed: u64,
    /// Longest pause of a client that stops reading.
    pub max_pause: Duration,
    /// Ends of clients, drawn uniformly.
    pub fates: Vec<Fate>,
}

/// Result of a soak test.
#[derive(Clone, Debug, Default)]
pub struct SoakResult {
    /// Number of clients by their end.
    pub clients: BTreeMap<Fate, usize>,
    /// Fate and evidence of every failure.
    pub failures: Vec<(Fate, String)>,
    /// State of the server after one client of each kind, once it has settled.
    pub before: Sample,
    /// State of the server after all clients, once it has settled.
    pub after: Sample,
    /// Longest time of a reply to `hello`, which another client requests every second.
    pub longest_hello: Duration,
    /// Samples while clients came, one per second.
    pub samples: Vec<Sample>,
    /// Number of environments that are not free at the end.
    pub leaked_envs: u64,
    /// Number of environment steps that the server executed.
    pub env_steps: u64,
}

impl SoakResult {
    /// Returns true if no client failed and nothing was leaked that can be counted.
    pub fn is_clean(&self) -> bool {
        let same = self.after.threads <= self.before.threads && self.after.files <= self.before.files;
        self.failures.is_empty() && self.leaked_envs == 0 && same
    }
}

/// What is reported during the run.
#[derive(Clone, Copy, Debug)]
pub enum Event {
    /// A client has ended.
    Client(Fate),
    /// The server was sampled.
    Sample(Sample),
}

/// Runs a soak test. Ends early once `stop` is true.
pub fn run(plan: &Plan, stop: &AtomicBool, progress: impl Fn(Event) + Sync) -> Result<SoakResult, String> {
    let arguments = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--task", &plan.task];
    let mut arguments = arguments.map(str::to_owned).to_vec();
    arguments.extend(["--envs".to_owned(), ENVS.to_string(), "--seed".to_owned(), plan.seed.to_string()]);
    let (server, endpoint) = Process::listening(&plan.twinstep, &arguments)?;
    let observer = Observer::connect(&endpoint, server.id())?;
    let mut result = SoakResult::default();
    // The first clients start threads and fill buffers that stay.
    for fate in plan.fates.iter().copied() {
        run_visit(plan, fate, plan.seed, &endpoint).map_err(|reason| format!("client `{}`: {reason}", fate.name()))?;
    }
    result.before = observer.settle(None)?.0;
    std::thread::scope(|scope| {
        let (sender, ended) = channel();
        let end = Instant::now() + plan.duration;
        let (observer, longest_hello) = (&observer, &mut result.longest_hello);
        scope.spawn(move || {
            while !is_over(end, stop) {
                let since = Instant::now();
                // A failure is a time as well: that of the client's timeout.
                drop(observer.hello());
                *longest_hello = since.elapsed().max(*longest_hello);
                std::thread::sleep(PERIOD);
            }
        });
        for lane in 0..plan.lanes {
            let (sender, endpoint) = (sender.clone(), &endpoint);
            scope.spawn(move || run_lane(plan, lane, endpoint, &|| is_over(end, stop), &sender));
        }
        drop(sender);
        let mut next_sample = Instant::now();
        loop {
            let wait = next_sample.saturating_duration_since(Instant::now());
            match ended.recv_timeout(wait) {
                Ok((fate, failure)) => {
                    *result.clients.entry(fate).or_default() += 1;
                    result.failures.extend(failure.map(|evidence| (fate, evidence)));
                    progress(Event::Client(fate));
                }
                Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => return Ok::<_, String>(()),
                Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {}
            }
            if Instant::now() >= next_sample && !is_over(end, stop) {
                let sample = Sample::of(server.id())?;
                result.samples.push(sample);
                progress(Event::Sample(sample));
            }
            if Instant::now() >= next_sample {
                next_sample += PERIOD;
            }
        }
    })?;
    let (after, hello) = observer.settle(Some(result.before))?;
    result.after = after;
    (result.leaked_envs, result.env_steps) = (hello.max_envs - hello.free_envs, hello.env_steps);
    Ok(result)
}

fn is_over(end: Instant, stop: &AtomicBool) -> bool {
    Instant::now() >= end || stop.load(Ordering::Acquire)
}

/// Runs clients one after another.
fn run_lane(
    plan: &Plan,
    lane: usize,
    endpoint: &str,
    is_over: &dyn Fn() -> bool,
    ended: &Sender<(Fate, Option<String>)>,
) {
    let mut random = stream(plan.seed, "soak", lane as u64);
    while !is_over() {
        let fate = plan.fates[random.random_range(0..plan.fates.len())];
        let outcome = run_visit(plan, fate, random.random(), endpoint);
        if ended.send((fate, outcome.err())).is_err() {
            break;
        }
    }
}

/// Runs one client in a process of its own, as the sessions of one process share Zenoh's threads.
fn run_visit(plan: &Plan, fate: Fate, seed: u64, endpoint: &str) -> Result<(), String> {
    let pause = plan.max_pause.as_millis().to_string();
    let arguments = ["visit", fate.name(), &seed.to_string(), &pause, endpoint].map(str::to_owned);
    let mut client = Process::start(&plan.program, &arguments)?;
    let line = client.line(MAX_VISIT).unwrap_or_default();
    match client.exit_code(MAX_VISIT) {
        Some(0) => Ok(()),
        Some(code) => Err(format!("exit code {code}: {line}")),
        None => Err(format!("its process did not end within {} s", MAX_VISIT.as_secs())),
    }
}

/// A client that stays connected and asks for the number of free environments.
struct Observer {
    connection: Connection,
    server: u32,
}

impl Observer {
    fn connect(endpoint: &str, server: u32) -> Result<Self, String> {
        let connection = Connection::open(&ConnectOptions::new(endpoint, 1), Secret::random());
        Ok(Self { connection: connection.map_err(|error| error.to_string())?, server })
    }

    fn hello(&self) -> Result<HelloReply, String> {
        let text = |error: &dyn std::fmt::Display| error.to_string();
        let request = encode(&HelloRequest { protocol: PROTOCOL, client: "soak".to_owned() });
        let key = keys::hello(self.connection.sid());
        let reply = self.connection.request(&key, request).map_err(|error| text(&error))?;
        decode(&reply.to_bytes()).map_err(|error| text(&error))
    }

    /// Waits until all environments are free and threads and files no longer decrease, or are not more than those of
    /// `before`. Gives up after [`SETTLING`].
    fn settle(&self, before: Option<Sample>) -> Result<(Sample, HelloReply), String> {
        /// Number of equal samples after which threads and files count as constant. Idle threads of Zenoh's runtime
        /// end after 10 s.
        const EQUAL: usize = 15;
        let since = Instant::now();
        let mut last = Sample::default();
        let mut equal = 0;
        loop {
            let (sample, hello) = (Sample::of(self.server)?, self.hello()?);
            let is_same = (sample.threads, sample.files) == (last.threads, last.files);
            equal = if is_same { equal + 1 } else { 0 };
            let is_back = before.is_some_and(|b| sample.threads <= b.threads && sample.files <= b.files);
            let is_free = hello.free_envs == hello.max_envs;
            if since.elapsed() > SETTLING || (is_free && (is_back || equal >= EQUAL)) {
                return Ok((sample, hello));
            }
            last = sample;
            std::thread::sleep(PERIOD);
        }
    }
}
