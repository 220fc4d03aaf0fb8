//! `twinstep serve`: environments behind Zenoh until told to stop.

use std::io::{Read, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_env_server::{Config, Server, ServerError, SimEnvFactory};
use twinstep_envs::TaskName;
use twinstep_sim::Engine;

use crate::exit::{CommandResult, Signals, input, other};

/// How often the server looks for signals and tells its rate.
const TICK: Duration = Duration::from_millis(50);

/// Serve simulated Go2 environments over Zenoh.
///
/// Agents lease environments and call `reset` and `step`: from Rust (`twinstep-client`) or, by `protocol/SPEC.md`, from
/// any language with a Zenoh client. Listens on this machine only unless told otherwise. Ctrl-C finishes the step in
/// progress and tells the clients.
///
/// Prints one line to stdout once it answers: `listening ENDPOINT`.
#[derive(clap::Args)]
pub struct Args {
    /// Config file (TOML) with [server], [task], [sim] and [randomise]; flags go before its values.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The robot's name; clients find the server by it.
    #[arg(long)]
    name: Option<String>,
    /// What the robots are asked to do: walk, or counter (no physics; measures the transport).
    #[arg(long, value_parser = task_name)]
    task: Option<TaskName>,
    /// The most robots hosted in all; each client's lease asks for its number.
    #[arg(long, value_name = "N")]
    envs: Option<usize>,
    /// Model file of the robot; the ideal Go2 without.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Zenoh endpoint to listen at; port 0 takes a free one. [default: tcp/127.0.0.1:7447]
    #[arg(long, value_name = "ENDPOINT")]
    listen: Option<String>,
    /// Router to connect to; may be given several times.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Zenoh configuration (JSON5) for TLS, users and access control; see examples/security.
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Move large messages through shared memory when both ends are on this machine.
    #[arg(long)]
    shared_memory: bool,
    /// Who integrates the equations of motion: rapier (the reference) or batch (many robots in SIMD lanes, fast).
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Rate of the physics [Hz]; a multiple of the actuator's 200. Without: rapier 200, batch 1000.
    #[arg(long, value_name = "HZ")]
    physics_hz: Option<u32>,
    /// Threads that step robots; 0 takes all cores.
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Draw every value of the model file that has an interval from it, anew in each episode.
    #[arg(long)]
    randomise_effects: bool,
    /// Time that a lost client's environments wait for it [s].
    #[arg(long, value_name = "S")]
    lease_grace_s: Option<f64>,
    /// Seed of environments that no client seeds.
    #[arg(long)]
    seed: Option<u64>,
    /// Stop when stdin closes: for programs that start a server and must not leave it behind.
    #[arg(long)]
    until_stdin_closes: bool,
}

/// Serves until a signal or, if asked, the end of stdin.
pub fn run(args: &Args) -> CommandResult {
    let config = args.config()?;
    let signals = Signals::listen()?;
    let host = SimEnvFactory::new(config.clone()).map_err(input)?;
    let server = Server::start(&config.server, Arc::new(host)).map_err(|error| match error {
        ServerError::ZenohConfig { .. } | ServerError::Setting { .. } | ServerError::Host(_) => input(error),
        _ => other(error),
    })?;
    let endpoint = listening_endpoint(&server, &config);
    println!("listening {endpoint}");
    std::io::stdout().flush().map_err(other)?;
    eprintln!(
        "robot `{}`, task {:?}, up to {} environments, server {}; Ctrl-C stops it",
        config.server.name,
        config.task.name,
        config.server.envs,
        server.sid()
    );
    let stdin_closed = if args.until_stdin_closes { watch_stdin() } else { Arc::default() };
    let outcome = watch(&server, &signals, &stdin_closed);
    server.shutdown();
    outcome
}

impl Args {
    fn config(&self) -> Result<Config, crate::exit::Failure> {
        let mut config = match &self.config {
            Some(path) => Config::load(path).map_err(input)?,
            None => Config::default(),
        };
        let server = &mut config.server;
        set(&mut server.name, self.name.as_ref());
        set(&mut server.listen, self.listen.as_ref());
        set(&mut server.envs, self.envs.as_ref());
        set(&mut server.lease_grace_s, self.lease_grace_s.as_ref());
        if !self.connect.is_empty() {
            server.connect.clone_from(&self.connect);
        }
        server.model = self.model.clone().or(server.model.take());
        server.zenoh = self.zenoh.clone().or(server.zenoh.take());
        server.seed = self.seed.or(server.seed);
        server.shared_memory |= self.shared_memory;
        set(&mut config.task.name, self.task.as_ref());
        set(&mut config.sim.engine, self.engine.as_ref());
        config.sim.physics_hz = self.physics_hz.or(config.sim.physics_hz);
        config.randomise.effects |= self.randomise_effects;
        set(&mut config.sim.threads, self.threads.as_ref());
        config.check().map_err(input)?;
        Ok(config)
    }
}

fn set<T: Clone>(value: &mut T, flag: Option<&T>) {
    if let Some(flag) = flag {
        value.clone_from(flag);
    }
}

fn task_name(text: &str) -> Result<TaskName, String> {
    match text {
        "walk" => Ok(TaskName::Walk),
        "counter" => Ok(TaskName::Counter),
        _ => Err("the tasks are walk and counter".to_owned()),
    }
}

/// The engine of that name.
pub fn engine(text: &str) -> Result<Engine, String> {
    match text {
        "rapier" => Ok(Engine::Rapier),
        "batch" => Ok(Engine::Batch),
        _ => Err("the engines are rapier and batch".to_owned()),
    }
}

/// The endpoint with the port that the system gave, or the one that was asked for.
fn listening_endpoint(server: &Server, config: &Config) -> String {
    let asked = &config.server.listen;
    let address = asked.rsplit_once(':').map_or(asked.as_str(), |(address, _)| address);
    let endpoints = server.endpoints();
    endpoints.iter().find(|endpoint| endpoint.starts_with(address)).unwrap_or(asked).clone()
}

fn watch_stdin() -> Arc<AtomicBool> {
    let closed = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&closed);
    std::thread::spawn(move || {
        let mut ignored = [0; 256];
        while matches!(std::io::stdin().read(&mut ignored), Ok(1..)) {}
        flag.store(true, Ordering::Release);
    });
    closed
}

/// Shows the rate until it is time to stop.
fn watch(server: &Server, signals: &Signals, stdin_closed: &AtomicBool) -> CommandResult {
    let style = ProgressStyle::with_template("{spinner} {msg}").expect("the template is valid");
    let line = ProgressBar::new_spinner().with_style(style);
    let mut mark = (Instant::now(), 0);
    while !signals.check()? && !stdin_closed.load(Ordering::Acquire) {
        std::thread::sleep(TICK);
        if mark.0.elapsed() >= Duration::from_secs(1) {
            let steps = server.env_steps();
            let rate = (steps - mark.1) as f64 / mark.0.elapsed().as_secs_f64();
            line.set_message(format!("{rate:.0} env-steps/s, {steps} in all"));
            line.tick();
            mark = (Instant::now(), steps);
        }
    }
    line.finish_and_clear();
    Ok(())
}
