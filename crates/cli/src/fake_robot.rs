//! `twinstep fake-robot`: a Go2 that is simulated behind its own DDS topics.

use std::io::{BufRead, Write};
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, channel};

use serde::Serialize;
use twinstep_effects::ModelFile;
use twinstep_model::{Backend, RobotModel};
use twinstep_robot::dds::Dds;
use twinstep_robot::fake::{FakeConfig, FakeRobot, FakeStatistics};
use twinstep_robot::fake_wire::FakeWire;
use twinstep_robot::{interface_address, real_time_thread};
use twinstep_sim::{BatchBackend, Engine, MujocoBackend, RapierBackend, SimConfig};

use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::serve::engine;

/// Rate of the robot's states and of its motors' control [Hz].
const STATE_HZ: f64 = 500.0;

/// Friction of the gears of a limp robot [N·m].
const GEAR_FRICTION: f32 = 0.6;

/// Simulate a Go2 behind its own DDS topics.
///
/// It checks every command as the robot does, and has motors, battery, heat, remote control, IMU and the service that
/// selects the built-in controller. Other programs for the Go2 can be tried on it too.
///
/// Faults and mistakes of the wiring are read from stdin, one per line: `heat FL_calf 90`, `battery 10`, `remote lost`,
/// `stale 100`, `loss 0.1`, `foreign writer on`, `power cut`, `clear`. docs/robot.md lists them all. `pose` prints position
/// and tilt of the trunk, `statistics` what was received, both as one JSON object.
///
/// When states are sent, it prints one line to stdout: `ready DOMAIN`.
///
/// Example: `twinstep fake-robot --domain 7 --model fitted.toml`, then `twinstep robot --interface lo --domain 7`
#[derive(clap::Args)]
pub struct Args {
    /// DDS domain.
    #[arg(long, default_value_t = 1)]
    domain: u16,
    /// Network interface, by name or address. Default: this machine only.
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// Model file of the robot: effects that the nominal robot lacks. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Physics engine: batch, rapier or mujoco.
    #[arg(long, value_parser = engine, default_value = "batch")]
    engine: Engine,
    /// Publish position and velocity of the trunk on rt/sportmodestate also without the built-in controller, as a motion
    /// capture would. A recording then has them.
    #[arg(long)]
    motion_capture: bool,
    /// The built-in controller is released already.
    #[arg(long)]
    released: bool,
    /// Seed of the noise of the sensors.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop when stdin closes.
    #[arg(long)]
    until_stdin_closes: bool,
}

/// What `pose` prints.
#[derive(Serialize)]
struct PoseReport {
    /// Position of the trunk [m].
    position: Option<[f32; 3]>,
    /// Rotation world-from-base, `[w, x, y, z]`.
    orientation: [f32; 4],
    /// Joint position [rad].
    q: [f32; 12],
}

/// What `statistics` prints.
#[derive(Serialize)]
struct StatisticsReport {
    accepted: u64,
    ignored: u64,
    refused: u64,
    first_refused: Option<String>,
    largest_gap_ms: u64,
    largest_excess_rad: f32,
    dampings: u64,
    damping_delay_ms: u64,
}

/// Simulates until a signal.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen_unhurried()?;
    let address = args.interface.as_deref().map_or(Ok(IpAddr::V4(Ipv4Addr::LOCALHOST)), interface_address);
    let dds = Dds::join(args.domain, address.map_err(input)?).map_err(input)?;
    let backend = args.backend()?;
    let config = FakeConfig {
        seed: args.seed,
        controller_active: !args.released,
        motion_capture: args.motion_capture,
        gear_friction_nm: GEAR_FRICTION,
        ..FakeConfig::default()
    };
    let robot = FakeRobot::new(backend, config).map_err(input)?;
    let (domain, until_stdin_closes) = (args.domain, args.until_stdin_closes);
    let thread = real_time_thread::spawn("fake", move || simulate(robot, dds, domain, until_stdin_closes, &signals));
    thread.map_err(other)?.join().unwrap_or_else(|_| Err(Failure::Other(miette::miette!("the simulation panicked"))))
}

fn simulate(robot: FakeRobot, dds: Dds, domain: u16, until_stdin_closes: bool, signals: &Signals) -> CommandResult {
    let mut wire = FakeWire::new(robot, dds).map_err(other)?;
    wire.step().map_err(other)?;
    println!("ready {domain}");
    std::io::stdout().flush().map_err(other)?;
    let lines = read_lines();
    loop {
        if signals.check()? {
            return Ok(());
        }
        match lines.try_recv() {
            Ok(Some(line)) => {
                println!("{}", answer(wire.robot(), &line));
                std::io::stdout().flush().map_err(other)?;
            }
            Ok(None) if until_stdin_closes => return Ok(()),
            _ => {}
        }
        wire.step().map_err(other)?;
    }
}

impl Args {
    fn backend(&self) -> Result<Box<dyn Backend>, Failure> {
        let file = self.model.as_ref().map_or_else(|| Ok(ModelFile::default()), ModelFile::load).map_err(input)?;
        let robot = with_state_rate(file.robot_model().map_err(input)?);
        let config = SimConfig { engine: self.engine, threads: 1, ..SimConfig::default() };
        Ok(match self.engine {
            Engine::Batch => Box::new(BatchBackend::new(robot, config, 1).map_err(input)?),
            Engine::Rapier => Box::new(RapierBackend::new(robot, config, 1).map_err(input)?),
            Engine::Mujoco => Box::new(MujocoBackend::new(robot, config, 1).map_err(input)?),
        })
    }
}

/// Returns the robot with motors that are controlled at the rate of its states.
fn with_state_rate(mut robot: RobotModel) -> RobotModel {
    (robot.control.actuator_hz, robot.control.decimation) = (STATE_HZ, 1);
    robot
}

/// Reads the lines of stdin; `None` is its end.
fn read_lines() -> Receiver<Option<String>> {
    let (sender, lines) = channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            let _ = sender.send(Some(line));
        }
        let _ = sender.send(None);
    });
    lines
}

/// Executes a line and returns the answer.
fn answer(robot: &mut FakeRobot, line: &str) -> String {
    match line.trim() {
        "statistics" => {
            let FakeStatistics {
                accepted,
                ignored,
                refused,
                first_refused,
                largest_gap_ms,
                largest_excess_rad,
                dampings,
                damping_delay_ms,
            } = robot.statistics();
            let report = StatisticsReport {
                accepted: *accepted,
                ignored: *ignored,
                refused: *refused,
                first_refused: first_refused.as_ref().map(ToString::to_string),
                largest_gap_ms: *largest_gap_ms,
                largest_excess_rad: *largest_excess_rad,
                dampings: *dampings,
                damping_delay_ms: *damping_delay_ms,
            };
            serde_json::to_string(&report).unwrap_or_default()
        }
        "pose" => {
            let measured = robot.backend().measured();
            let position = robot.backend().ground_truth().map(|truth| truth.base_position[0]);
            let report = PoseReport { position, orientation: measured.orientation[0], q: measured.q[0] };
            serde_json::to_string(&report).unwrap_or_default()
        }
        line => match line.parse().map_err(|error: twinstep_robot::fake::UnknownFault| error.to_string()) {
            Ok(fault) => match robot.inject(fault) {
                Ok(()) => format!("ok {line}"),
                Err(error) => format!("error {error}"),
            },
            Err(error) => format!("error {error}"),
        },
    }
}
