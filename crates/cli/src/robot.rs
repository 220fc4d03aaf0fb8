//! `twinstep robot`: the real Go2 behind the protocol of the simulation server.

use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde::Deserialize;
use twinstep_effects::ModelFile;
use twinstep_env_server::{Server, ServerConfig, ServerError};
use twinstep_envs::{TaskConfig, WalkConfig};
use twinstep_model::{PerJoint, RobotModel};
use twinstep_robot::dds::Dds;
use twinstep_robot::{Recorder, RobotHandle, SafetyConfig, control_loop, interface_address, watch};
use twinstep_viewer::Hub;

use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::fake_process::FakeProcess;
use crate::frame_feed::FrameFeed;
use crate::onboard_policy::OnboardPolicy;
use crate::robot_env_factory::RobotEnvFactory;
use crate::robot_view::RobotView;
use crate::web_view::ViewArgs;
use crate::{operator, operator_screen};

/// Largest `safety.state_timeout_ms` with a real robot.
const MAX_STATE_TIMEOUT_MS: u64 = 30;
/// Interval at which signals and the robot's state are looked at.
const TICK: Duration = Duration::from_millis(20);

/// Put the real Go2, or a fake one, behind the protocol of `twinstep serve`.
///
/// Agents connect to it as to a simulation: only the endpoint changes. This process owns the motors: it holds, sits down or
/// damps the robot by itself when actions are missing, and keeps every command inside the limits. docs/robot.md has the
/// first day with a real robot, step by step.
///
/// The operator has a screen with a key for each request: release, arm, stand, sit, damp, disarm, stop. Nothing moves before
/// `arm` and `stand`. Ctrl-C damps the motors and ends.
///
/// Without a terminal the same requests are read from stdin, one word a line, with `status`, `help` and `quit`. Then it prints
/// one line to stdout when the server is ready: `listening ENDPOINT`; then a line for every change of state.
///
/// Examples: `twinstep robot --fake` and `twinstep robot --interface eth0 --record walk.mcap`
#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("wire").required(true).args(["interface", "fake"])))]
pub struct Args {
    /// Network interface to the robot, by name or address.
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// DDS domain: 0 on the robot, 1 in the vendor's simulator.
    #[arg(long, default_value_t = 0, requires = "interface")]
    domain: u16,
    /// Start a fake robot in a process of its own and use it, to rehearse without hardware.
    #[arg(long)]
    fake: bool,
    /// Model file of the fake robot. Default: the ideal Go2.
    #[arg(long, value_name = "FILE", requires = "fake")]
    model: Option<PathBuf>,
    /// Run this policy next to the control loop instead of serving clients, with the velocity of the remote control.
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// Record every message of the robot to this MCAP file, which must not exist.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Config file (TOML) with [server], [task] and [safety]. Flags override its values.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Name of the robot, by which clients find it. Default: go2.
    #[arg(long)]
    name: Option<String>,
    /// Zenoh endpoint to listen on; port 0 selects a free port. An address that others can reach needs users or TLS.
    /// Default: tcp/127.0.0.1:7447.
    #[arg(long, value_name = "ENDPOINT")]
    listen: Option<String>,
    /// Zenoh configuration file (JSON5) for TLS, users and access control; see examples/security.
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    #[command(flatten)]
    view: ViewArgs,
}

/// The config file of a robot.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobotConfig {
    pub server: ServerConfig,
    pub task: TaskConfig,
    pub safety: SafetyConfig,
}

impl RobotConfig {
    /// Reads the config file, if there is one, and checks it.
    pub fn load(path: Option<&Path>) -> Result<Self, Failure> {
        let config: Self = match path {
            Some(path) => {
                let content = std::fs::read_to_string(path)
                    .map_err(|error| text(&format!("cannot read the config file {}: {error}", path.display())))?;
                toml::from_str(&content).map_err(|error| text(&format!("{}: {error}", path.display())))?
            }
            None => Self::default(),
        };
        config.safety.check().map_err(input)?;
        config.task.check().map_err(input)?;
        Ok(config)
    }

    /// Returns the settings of the task `walk`, the only one of a robot.
    pub fn walk(&self) -> Result<WalkConfig, Failure> {
        match &self.task {
            TaskConfig::Walk(walk) => Ok(walk.clone()),
            other => Err(text(&format!("`task.name` = \"{}\" has no robot: use \"walk\"", other.name()))),
        }
    }
}

/// Serves the robot until a signal or `quit`.
pub fn run(args: &Args) -> CommandResult {
    let config = args.config()?;
    let robot = ModelFile::default().robot_model().map_err(input)?;
    let task = config.walk()?;
    let signals = Signals::listen()?;
    args.view.check()?;
    let fake = if args.fake { Some(FakeProcess::start(args.model.as_deref(), &[])?) } else { None };
    let (domain, address) = match (&fake, &args.interface) {
        (Some(fake), _) => (fake.domain, IpAddr::V4(Ipv4Addr::LOCALHOST)),
        (None, Some(name)) => (args.domain, checked_address(name, &config.safety)?),
        (None, None) => return Err(text("`--interface` or `--fake` is needed")),
    };
    let recording = args.record.as_deref().map(Recorder::start).transpose().map_err(input)?;
    let (recorder, recorder_thread) = recording.unzip();
    let handle = RobotHandle::default();
    stop_on_panic(&handle);
    let dds = Dds::join(domain, address).map_err(input)?;
    let control = control_loop::start(&robot, config.safety, &dds, handle.clone(), recorder).map_err(input)?;
    let watch = watch::start(&dds, handle.clone()).map_err(other)?;
    let view = RobotView::start(&args.view, &robot, &handle);
    let outcome = view.and_then(|view| {
        let outcome = args.serve(&config.server, (robot, task), &handle, view.hub(), &signals);
        handle.end();
        view.join();
        outcome
    });
    handle.end();
    let _ = (control.join(), watch.join());
    let recorded = recorder_thread.map_or(Ok(()), |thread| thread.join().unwrap_or(Ok(())));
    outcome.and(recorded.map_err(other))
}

impl Args {
    fn config(&self) -> Result<RobotConfig, Failure> {
        let mut config = RobotConfig::load(self.config.as_deref())?;
        let server = &mut config.server;
        if let Some(name) = &self.name {
            server.name.clone_from(name);
        }
        if let Some(listen) = &self.listen {
            server.listen.clone_from(listen);
        }
        server.zenoh = self.zenoh.clone().or(server.zenoh.take());
        server.envs = 1;
        Ok(config)
    }

    fn serve(
        &self,
        server: &ServerConfig,
        (robot, task): (RobotModel, WalkConfig),
        handle: &RobotHandle,
        hub: &Arc<Hub>,
        signals: &Signals,
    ) -> CommandResult {
        let torque_limits = &robot.torque_limits();
        let factory = RobotEnvFactory { robot, task, handle: handle.clone() };
        if let Some(path) = &self.policy {
            let policy = OnboardPolicy::start(path, &factory)?;
            let place = format!("policy {}", path.display());
            let result = watch_robot(handle, torque_limits, &place, &Vec::new, signals);
            handle.end();
            policy.join();
            return result;
        }
        let server = Server::start(server, Arc::new(factory)).map_err(|error| match error {
            ServerError::ZenohConfig { .. } | ServerError::Setting { .. } => input(error),
            _ => other(error),
        })?;
        let feed = FrameFeed::start(server.frame_publisher().map_err(other)?, Arc::clone(hub))?;
        let place = format!("listening {}", server.endpoints().first().cloned().unwrap_or_default());
        let result = watch_robot(handle, torque_limits, &place, &|| server.clients(), signals);
        feed.stop();
        server.shutdown();
        result
    }
}

/// Serves the operator at the terminal until a signal or `quit`. Then damps the motors.
///
/// A person at a terminal has a screen with keys. Without one, requests are read from stdin and every change of state is
/// printed to stdout.
fn watch_robot(
    handle: &RobotHandle,
    torque_limits: &PerJoint,
    place: &str,
    clients: &dyn Fn() -> Vec<String>,
    signals: &Signals,
) -> CommandResult {
    let result = if operator_screen::is_possible() {
        operator_screen::run(handle, torque_limits, place, clients, signals)
    } else {
        operator::print_line(place);
        print_states(handle, signals)
    };
    handle.stop();
    result
}

/// Executes what is read from stdin and prints every change of state, until a signal or `quit`.
fn print_states(handle: &RobotHandle, signals: &Signals) -> CommandResult {
    eprintln!("type `help` for what the operator can do; Ctrl-C damps the motors and ends");
    let quits = operator::listen(handle);
    let mut shown = String::new();
    loop {
        let board = handle.board();
        let line = operator::state_line(&board);
        if line != shown {
            operator::print_line(&line);
            shown = line;
        }
        match signals.check() {
            Ok(false) if board.has_ended => {
                return Err(Failure::Other(miette::miette!("the control loop failed; the motors are damped")));
            }
            Ok(false) if quits.try_recv().is_ok() => return Ok(()),
            Ok(false) => std::thread::sleep(TICK),
            ended => return ended.map(drop),
        }
    }
}

/// Damps the motors when any thread of this process panics.
fn stop_on_panic(handle: &RobotHandle) {
    let (handle, report) = (handle.clone(), std::panic::take_hook());
    std::panic::set_hook(Box::new(move |panic| {
        handle.stop();
        report(panic);
    }));
}

/// Returns the address of an interface. A real robot is not behind loopback, and its silence must be noticed in time.
pub fn checked_address(name: &str, safety: &SafetyConfig) -> Result<IpAddr, Failure> {
    let address = interface_address(name).map_err(input)?;
    check_timeout(name, address, safety)?;
    Ok(address)
}

fn check_timeout(name: &str, address: IpAddr, safety: &SafetyConfig) -> CommandResult {
    let timeout = safety.state_timeout_ms;
    if !address.is_loopback() && timeout > MAX_STATE_TIMEOUT_MS {
        return Err(text(&format!(
            "`safety.state_timeout_ms` = {timeout} is allowed on this machine alone, with a fake robot; on `{name}` at most \
             {MAX_STATE_TIMEOUT_MS}"
        )));
    }
    Ok(())
}

/// Returns the failure of invalid input.
pub fn text(message: &str) -> Failure {
    Failure::Input(miette::Report::msg(message.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_silence_of_the_robot_is_allowed_on_this_machine_alone() {
        let safety = SafetyConfig { state_timeout_ms: 150, ..SafetyConfig::default() };
        let robot = IpAddr::V4(Ipv4Addr::new(192, 168, 123, 222));
        let Err(Failure::Input(report)) = check_timeout("eth0", robot, &safety) else { panic!("it is refused") };
        assert!(report.to_string().contains("`safety.state_timeout_ms` = 150"), "{report}");
        assert!(check_timeout("lo", IpAddr::V4(Ipv4Addr::LOCALHOST), &safety).is_ok());
        assert!(check_timeout("eth0", robot, &SafetyConfig::default()).is_ok());
    }
}
