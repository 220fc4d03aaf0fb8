//! `twinstep robot`: the real Go2 behind the protocol of the simulation server.

use std::net::{IpAddr, Ipv4Addr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rustix::mm::MlockAllFlags;
use serde::Deserialize;
use twinstep_agent::read_contract;
use twinstep_effects::{ControlTable, ModelFile, parse_toml};
use twinstep_env_server::{Server, ServerConfig, ServerError, check_measurable};
use twinstep_envs::TaskConfig;
use twinstep_model::{PerJoint, RobotModel};
use twinstep_robot::dds::Dds;
use twinstep_robot::{
    MotorLink, Recorder, RobotHandle, SafetyConfig, SafetyMachine, control_loop, interface_address, watch,
};
use twinstep_viewer::Hub;

use crate::exit::{CommandResult, Failure, input, other};
use crate::fake_process::FakeProcess;
use crate::frame_feed::FrameFeed;
use crate::onboard_policy::OnboardPolicy;
use crate::robot_env_factory::RobotEnvFactory;
use crate::robot_view::RobotView;
use crate::stop_signals::StopSignals;
use crate::web_view::ViewArgs;
use crate::{line_printer, operator, operator_screen};

/// Largest times of `[safety]` with a real robot [ms].
const MAX_STATE_TIMEOUT_MS: u64 = 30;
const MAX_PAUSE_MS: u64 = 50;
const MAX_WATCHDOG_TIMEOUT_MS: u64 = 20;
/// Interval at which the robot's state is looked at.
const TICK: Duration = Duration::from_millis(20);

/// Put the real Go2, or a fake one, behind the protocol of `twinstep serve`.
///
/// Agents connect to it as to a simulation: only the endpoint changes. This process owns the motors: it holds, sits down or
/// damps the robot by itself when actions are missing, and keeps every command inside the limits. docs/robot.md has the
/// first day with a real robot, step by step.
///
/// The operator has a screen with a key for each request: release, arm, stand, sit, damp, disarm, go, stop. Nothing moves before
/// `arm` and `stand`. Ctrl-C, a lost ssh link and a closed terminal damp the motors and end. A second process, the watchdog,
/// damps them if this one stops for any reason.
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
    /// Mapping of the ONNX policy of another program (TOML), for --policy.
    #[arg(long, value_name = "FILE", requires = "policy")]
    mapping: Option<PathBuf>,
    /// Take gains, default pose, action scale and rates from this policy, mapping (TOML) or file with a table [control]. Clients
    /// whose policy has other ones are refused. Default: those of --policy, of the config file, or of the built-in Go2.
    #[arg(long, value_name = "FILE")]
    contract: Option<PathBuf>,
    /// Record every message of the robot to this MCAP file, which must not exist.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Config file (TOML) with [server], [task], [safety] and [control]. Flags override its values.
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
    /// The contract of the policy. Default: that of the built-in Go2.
    pub control: Option<ControlTable>,
}

impl RobotConfig {
    /// Reads the config file, if there is one, and checks it.
    pub fn load(path: Option<&Path>, contract: Option<&Path>) -> Result<Self, Failure> {
        let mut config: Self = match path {
            Some(path) => {
                let content = std::fs::read_to_string(path)
                    .map_err(|error| text(&format!("cannot read the config file {}: {error}", path.display())))?;
                parse_toml(&content).map_err(|error| text(&format!("{}: {error}", path.display())))?
            }
            None => Self::default(),
        };
        config.safety.check().map_err(input)?;
        config.task.check().map_err(input)?;
        check_measurable(&config.task).map_err(input)?;
        if let Some(contract) = contract {
            config.control = Some(read_contract(contract).map_err(input)?);
        }
        Ok(config)
    }

    /// Returns the robot with the contract of the policy, whose gains must be within `[safety]`.
    pub fn robot(&self) -> Result<RobotModel, Failure> {
        let file = ModelFile::default().with_control(&self.control.clone().unwrap_or_default()).map_err(input)?;
        let robot = file.robot_model().map_err(input)?;
        SafetyMachine::new(&robot, self.safety.clone()).map_err(input)?;
        Ok(robot)
    }
}

/// Serves the robot until a signal or `quit`.
pub fn run(args: &Args) -> CommandResult {
    let config = args.config()?;
    let robot = config.robot()?;
    args.view.check()?;
    let handle = RobotHandle::default();
    let signals = StopSignals::listen(&handle)?;
    line_printer::start().map_err(other)?;
    lock_memory();
    let fake = if args.fake { Some(FakeProcess::start(args.model.as_deref(), &[])?) } else { None };
    let (domain, address) = match (&fake, &args.interface) {
        (Some(fake), _) => (fake.domain, IpAddr::V4(Ipv4Addr::LOCALHOST)),
        (None, Some(name)) => (args.domain, checked_address(name, &config.safety)?),
        (None, None) => return Err(text("`--interface` or `--fake` is needed")),
    };
    let recording = args.record.as_deref().map(Recorder::start).transpose().map_err(input)?;
    let (recorder, recorder_thread) = recording.unzip();
    report_panics(&handle);
    let dds = Dds::join(domain, address).map_err(input)?;
    let motors = start_motors(&dds, &config.safety)?;
    let control =
        control_loop::start(&robot, config.safety.clone(), &dds, motors, handle.clone(), recorder).map_err(input)?;
    let watch = watch::start(&dds, handle.clone()).map_err(other)?;
    let view = RobotView::start(&args.view, &robot, &handle);
    let outcome = view.and_then(|view| {
        let outcome = args.serve(&config, robot, &handle, view.hub());
        handle.end();
        view.join();
        outcome
    });
    handle.end();
    let _ = (control.join(), watch.join());
    let recorded = recorder_thread.map_or(Ok(()), |thread| thread.join().unwrap_or(Ok(())));
    line_printer::flush();
    outcome.and(recorded.map_err(other)).and(signals.outcome())
}

/// Keeps this process in memory: the control loop must not wait for a disk.
fn lock_memory() {
    let flags = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT;
    if let Err(error) = rustix::mm::mlockall(flags) {
        tracing::info!(%error, "the memory of this process is not locked: run as root, or raise `ulimit -l`");
    }
}

/// Starts the watchdog, and returns the way to the motors.
pub fn start_motors(dds: &Dds, safety: &SafetyConfig) -> Result<MotorLink, Failure> {
    let program = std::env::current_exe().map_err(other)?;
    let timeout = Duration::from_millis(safety.watchdog_timeout_ms);
    MotorLink::start(dds, &program, timeout).map_err(other)
}

impl Args {
    /// Returns the file with the contract: by default that of the policy that runs here.
    fn contract(&self) -> Option<&Path> {
        let of_policy = self.mapping.as_deref().or(self.policy.as_deref());
        self.contract.as_deref().or(of_policy)
    }

    fn config(&self) -> Result<RobotConfig, Failure> {
        let mut config = RobotConfig::load(self.config.as_deref(), self.contract())?;
        let server = &mut config.server;
        server.name = self.name.clone().or(server.name.take());
        if let Some(listen) = &self.listen {
            server.listen.clone_from(listen);
        }
        server.zenoh = self.zenoh.clone().or(server.zenoh.take());
        server.envs = 1;
        Ok(config)
    }

    fn serve(&self, config: &RobotConfig, robot: RobotModel, handle: &RobotHandle, hub: &Arc<Hub>) -> CommandResult {
        let torque_limits = &robot.torque_limits();
        let factory = RobotEnvFactory { robot, task: config.task.clone(), handle: handle.clone() };
        if let Some(path) = &self.policy {
            let policy = OnboardPolicy::start(path, self.mapping.as_deref(), &factory)?;
            let place = format!("policy {}", path.display());
            let result = watch_robot(handle, torque_limits, &place, Vec::new);
            handle.end();
            policy.join();
            return result;
        }
        let server = Server::start(&config.server, Arc::new(factory)).map_err(|error| match error {
            ServerError::ZenohConfig { .. } | ServerError::Setting { .. } => input(error),
            _ => other(error),
        })?;
        let feed = FrameFeed::start(server.frame_publisher().map_err(other)?, Arc::clone(hub))?;
        let place = format!("listening {}", server.endpoints().first().cloned().unwrap_or_default());
        let result = watch_robot(handle, torque_limits, &place, server.client_ids());
        feed.stop();
        server.shutdown();
        result
    }
}

/// Serves the operator at the terminal until a signal or `quit`. Then the motors are damped.
///
/// A person at a terminal has a screen with keys. Without one, requests are read from stdin and every change of state is
/// printed to stdout.
fn watch_robot(
    handle: &RobotHandle,
    torque_limits: &PerJoint,
    place: &str,
    clients: impl Fn() -> Vec<String> + Send + 'static,
) -> CommandResult {
    let result = if operator_screen::is_possible() {
        operator_screen::run(handle, *torque_limits, place, clients)
    } else {
        line_printer::print_line(place);
        print_states(handle)
    };
    handle.stop();
    result
}

/// Executes what is read from stdin and prints every change of state, until a signal or `quit`.
fn print_states(handle: &RobotHandle) -> CommandResult {
    line_printer::print_log(b"type `help` for what the operator can do; Ctrl-C damps the motors and ends\n");
    operator::listen(handle).map_err(other)?;
    let mut shown = String::new();
    while !handle.is_ending() {
        let board = handle.board();
        let line = operator::state_line(&board);
        if line != shown {
            line_printer::print_line(&line);
            shown = line;
        }
        if board.has_ended {
            return Err(Failure::Other(miette::miette!("the control loop failed; the watchdog damps the motors")));
        }
        std::thread::sleep(TICK);
    }
    Ok(())
}

/// Lets the watchdog damp the motors when any thread of this process panics.
pub fn report_panics(handle: &RobotHandle) {
    let (handle, report) = (handle.clone(), std::panic::take_hook());
    std::panic::set_hook(Box::new(move |panic| {
        handle.report_panic();
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
    let times = [
        ("state_timeout_ms", safety.state_timeout_ms, MAX_STATE_TIMEOUT_MS),
        ("max_pause_ms", safety.max_pause_ms, MAX_PAUSE_MS),
        ("watchdog_timeout_ms", safety.watchdog_timeout_ms, MAX_WATCHDOG_TIMEOUT_MS),
    ];
    match times.into_iter().find(|(_, value, max)| value > max) {
        Some((key, value, max)) if !address.is_loopback() => Err(text(&format!(
            "`safety.{key}` = {value} is allowed on this machine alone, with a fake robot; on `{name}` at most {max}"
        ))),
        _ => Ok(()),
    }
}

/// Returns the failure of invalid input.
fn text(message: &str) -> Failure {
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
