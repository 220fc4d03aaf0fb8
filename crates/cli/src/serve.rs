//! `twinstep serve`: serves environments over Zenoh until it is stopped.

use std::io::{Read, Write};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use glam::Quat;
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_agent::read_contract;
use twinstep_env_server::{
    AnyEnvFactory, Config, EnvFactory, Server, ServerConfig, ServerError, SimEnvFactory, TreeEnvFactory,
};
use twinstep_envs::TaskConfig;
use twinstep_model::{AutoresetMode, InitialState, Pose, ResetRequest, RobotModel, Scene};
use twinstep_sim::{Engine, SimConfig};
use twinstep_viewer::{Hub, SceneInfo};

use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::frame_feed::FrameFeed;
use crate::web_view::{ViewArgs, WatchedFactory};

/// Interval at which the server checks for signals.
const TICK: Duration = Duration::from_millis(50);

/// Serve simulated robots over Zenoh: the Go2, quadrupeds like it, and with the tasks `walk` and `pose` any robot.
///
/// Agents lease environments and call `reset` and `step`: from Rust (`twinstep-client`), from Python (`twinstep`) or,
/// as `protocol/SPEC.md` specifies, from any language with a Zenoh client. Default: it listens on this machine only.
/// Ctrl-C completes the step in progress and notifies the clients.
///
/// When the server is ready, it prints one line to stdout: `listening ENDPOINT`.
///
/// Examples: `twinstep serve --envs 1024`, `twinstep serve --config server.toml --model fitted.toml` and
/// `twinstep serve --task pose --model data/robots/g1.toml`
#[derive(clap::Args)]
pub struct Args {
    /// Config file (TOML) with [server], [task], [sim] and [randomise]. Flags override its values.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of the robot, by which clients find the server. Default: go2.
    #[arg(long)]
    name: Option<String>,
    /// Task: walk, track, jump, gait, attitude, getup or explore for quadrupeds like the Go2; pose (its joints follow
    /// targets) for any robot; counter (no physics, to measure the transport). Default: walk.
    #[arg(long, value_parser = task_name)]
    task: Option<&'static str>,
    /// Maximum number of environments of all clients together. Each client requests its number with its lease.
    /// Default: 4096.
    #[arg(long, value_name = "N")]
    envs: Option<usize>,
    /// Model file of the robot, or the name of one in this program, such as spot (docs/robots.md). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Zenoh endpoint to listen on; port 0 selects a free port. Default: tcp/127.0.0.1:7447.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Option<String>,
    /// Zenoh router to connect to. The flag may be repeated.
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
    /// Zenoh configuration file (JSON5) for TLS, users and access control; see examples/security.
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Use shared memory for large messages to clients on the same machine.
    #[arg(long)]
    shared_memory: bool,
    /// Physics engine: rapier (the reference), batch (one robot per SIMD lane, faster), or mujoco (in a Python process;
    /// see docs/physics.md). Default: batch.
    #[arg(long, value_parser = engine)]
    engine: Option<Engine>,
    /// Rate of the physics [Hz], a multiple of the actuators' 200 Hz. Default: 200 with rapier, 1000 with batch and
    /// mujoco.
    #[arg(long, value_name = "HZ")]
    physics_hz: Option<u32>,
    /// Number of threads that step robots; 0 uses all cores. Default: 0.
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Sample every parameter of the model file that has an interval, for every robot in every episode.
    #[arg(long)]
    randomise_effects: bool,
    /// Maximum number of environments that one client may lease. Default: all.
    #[arg(long, value_name = "N")]
    max_envs_per_client: Option<usize>,
    /// Maximum number of steps of a rollout, 0 for none. Default: 128.
    #[arg(long, value_name = "N")]
    max_rollout_steps: Option<usize>,
    /// Time for which the environments of a disconnected client are kept [s]. Default: 10.
    #[arg(long, value_name = "S")]
    lease_grace_s: Option<f64>,
    /// Time without a request after which environments are released even if their client is connected [s]. Default:
    /// never.
    #[arg(long, value_name = "S")]
    lease_idle_s: Option<f64>,
    /// Take gains, default pose, action scale and rates from this policy, mapping (TOML) or file with a table [control].
    #[arg(long, value_name = "FILE")]
    contract: Option<PathBuf>,
    /// Seed of environments that a client does not seed.
    #[arg(long)]
    seed: Option<u64>,
    #[command(flatten)]
    view: ViewArgs,
    /// Stop when stdin closes, for programs that start a server and must not leave it running.
    #[arg(long)]
    until_stdin_closes: bool,
}

/// Serves until a signal or, with `--until-stdin-closes`, the end of stdin.
pub fn run(args: &Args) -> CommandResult {
    // The parent may end at any time from now on.
    let is_orphan = args.until_stdin_closes.then(OrphanCheck::new);
    let config = args.config()?;
    let signals = Signals::listen_unhurried()?;
    let factory = AnyEnvFactory::new(config.clone()).map_err(input)?;
    let name = config.server.name_of(&factory.control().name);
    let scene = match &factory {
        AnyEnvFactory::Quadruped(factory) => scene(&config, factory.robot()),
        AnyEnvFactory::Tree(factory) => tree_scene(&name, factory)?,
    };
    show_and_serve(args, &config, &name, factory, scene, &signals, is_orphan.as_ref())
}

/// Serves the environments of a factory, with a page of its robots.
fn show_and_serve(
    args: &Args,
    config: &Config,
    name: &str,
    factory: impl EnvFactory + 'static,
    scene: SceneInfo,
    signals: &Signals,
    is_orphan: Option<&OrphanCheck>,
) -> CommandResult {
    let hub = Arc::new(Hub::new(scene));
    let _page = args.view.serve(&hub)?;
    let factory = WatchedFactory { factory, hub: Arc::clone(&hub) };
    let server = start(&config.server, Arc::new(factory))?;
    let feed = FrameFeed::start(server.frame_publisher().map_err(other)?, hub)?;
    let outcome = serve(args, config, name, &server, signals, is_orphan);
    feed.stop();
    server.shutdown();
    outcome
}

fn start(config: &ServerConfig, factory: Arc<dyn EnvFactory>) -> Result<Server, Failure> {
    Server::start(config, factory).map_err(|error| match error {
        ServerError::ZenohConfig { .. } | ServerError::Setting { .. } | ServerError::Host(_) => input(error),
        _ => other(error),
    })
}

/// Says where the server listens, and waits until it has to stop.
fn serve(
    args: &Args,
    config: &Config,
    name: &str,
    server: &Server,
    signals: &Signals,
    is_orphan: Option<&OrphanCheck>,
) -> CommandResult {
    let endpoint = listening_endpoint(server, config);
    println!("listening {endpoint}");
    std::io::stdout().flush().map_err(other)?;
    eprintln!(
        "robot `{}`, task `{}`, up to {} environments, server {}; Ctrl-C stops it",
        name,
        config.task.name(),
        config.server.envs,
        server.sid()
    );
    let stdin_closed = if args.until_stdin_closes { watch_stdin() } else { Arc::default() };
    watch(server, signals, &|| stdin_closed.load(Ordering::Acquire) || is_orphan.is_some_and(OrphanCheck::is_orphan))
}

/// Returns a robot that stands at the origin, with the reward terms of its task.
fn scene(config: &Config, robot: &RobotModel) -> SceneInfo {
    let (q, ground) = (robot.control.default_pose_f32(), config.sim.terrain.ground());
    let position = InitialState::standing_on(&ground, robot, q, 0.0).base_position;
    let pose = Pose { position: position.into(), rotation: Quat::IDENTITY };
    let scene = Scene::new(robot, pose, &q, &ground.crop(0.0, 0.0));
    let info = SceneInfo::new(title(&config.server.name_of(&robot.name)), &scene, robot);
    reward_terms(config).map_or(info.clone(), |names| info.with_reward_terms(&names))
}

/// Returns the reward terms of the task; `None` if it has no robots to show. The engine makes no difference.
fn reward_terms(config: &Config) -> Option<Vec<String>> {
    let sim = SimConfig { engine: Engine::Batch, threads: 1, ..config.sim };
    let example = SimEnvFactory::new(Config { sim, ..config.clone() }).ok()?;
    let mut env = example.build(1, AutoresetMode::Disabled, None).ok()?;
    env.reset(&ResetRequest::default()).ok()?;
    env.scene(0).ok()?;
    Some(env.spec().reward_terms.clone())
}

/// Returns a robot of any tree at the start of an episode, with the reward terms of its task.
fn tree_scene(name: &str, factory: &TreeEnvFactory) -> Result<SceneInfo, Failure> {
    let mut env = factory.build(1, AutoresetMode::Disabled, None).map_err(input)?;
    env.reset(&ResetRequest::default()).map_err(other)?;
    let first = env.scene(0).map_err(other)?;
    Ok(SceneInfo::of_tree(title(name), &first, factory.tree()).with_reward_terms(&env.spec().reward_terms))
}

fn title(name: &str) -> String {
    format!("twinstep serve, robot {name}")
}

impl Args {
    fn config(&self) -> Result<Config, Failure> {
        let mut config = match &self.config {
            Some(path) => Config::load(path).map_err(input)?,
            None => Config::default(),
        };
        let server = &mut config.server;
        server.name = self.name.clone().or(server.name.take());
        set(&mut server.listen, self.listen.as_ref());
        set(&mut server.envs, self.envs.as_ref());
        set(&mut server.max_rollout_steps, self.max_rollout_steps.as_ref());
        set(&mut server.lease_grace_s, self.lease_grace_s.as_ref());
        if !self.connect.is_empty() {
            server.connect.clone_from(&self.connect);
        }
        server.model = self.model.clone().or(server.model.take());
        server.zenoh = self.zenoh.clone().or(server.zenoh.take());
        server.max_envs_per_client = self.max_envs_per_client.or(server.max_envs_per_client);
        server.lease_idle_s = self.lease_idle_s.or(server.lease_idle_s);
        server.seed = self.seed.or(server.seed);
        server.shared_memory |= self.shared_memory;
        // The settings of the config file are those of its own task.
        if let Some(task) = self.task.filter(|task| *task != config.task.name()) {
            config.task = TaskConfig::named(task).expect("the flag was checked");
        }
        set(&mut config.sim.engine, self.engine.as_ref());
        config.sim.physics_hz = self.physics_hz.or(config.sim.physics_hz);
        config.randomise.effects |= self.randomise_effects;
        set(&mut config.sim.threads, self.threads.as_ref());
        if let Some(path) = &self.contract {
            config.control = Some(read_contract(path).map_err(input)?);
        }
        config.check().map_err(input)?;
        Ok(config)
    }
}

fn set<T: Clone>(value: &mut T, flag: Option<&T>) {
    if let Some(flag) = flag {
        value.clone_from(flag);
    }
}

fn task_name(text: &str) -> Result<&'static str, String> {
    let names = TaskConfig::NAMES;
    let known = names.into_iter().find(|name| *name == text);
    known.ok_or_else(|| format!("not a task; possible: {}", names.join(", ")))
}

/// Parses the name of an engine.
pub fn engine(text: &str) -> Result<Engine, String> {
    match text {
        "rapier" => Ok(Engine::Rapier),
        "batch" => Ok(Engine::Batch),
        "mujoco" => Ok(Engine::Mujoco),
        _ => Err("must be `rapier`, `batch` or `mujoco`".to_owned()),
    }
}

/// Returns the endpoint with the port that the system assigned, or the requested endpoint.
fn listening_endpoint(server: &Server, config: &Config) -> String {
    let requested = &config.server.listen;
    let address = requested.rsplit_once(':').map_or(requested.as_str(), |(address, _)| address);
    let endpoints = server.endpoints();
    endpoints.iter().find(|endpoint| endpoint.starts_with(address)).unwrap_or(requested).clone()
}

/// Notices the end of the program that started this one. A child that it has forked may keep the pipe to stdin open.
struct OrphanCheck(u32);

impl OrphanCheck {
    fn new() -> Self {
        Self(std::os::unix::process::parent_id())
    }

    fn is_orphan(&self) -> bool {
        std::os::unix::process::parent_id() != self.0
    }
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

/// Shows the step rate until the server has to stop.
fn watch(server: &Server, signals: &Signals, is_over: &dyn Fn() -> bool) -> CommandResult {
    let style = ProgressStyle::with_template("{spinner} {msg}").expect("the template is valid");
    let line = ProgressBar::new_spinner().with_style(style);
    let mut mark = (Instant::now(), 0);
    while !signals.check()? && !is_over() {
        std::thread::sleep(TICK);
        if mark.0.elapsed() >= Duration::from_secs(1) {
            let steps = server.env_steps();
            let rate = (steps - mark.1) as f64 / mark.0.elapsed().as_secs_f64();
            line.set_message(format!("{rate:.0} env-steps/s, {steps} in total"));
            line.tick();
            mark = (Instant::now(), steps);
        }
    }
    line.finish_and_clear();
    Ok(())
}
