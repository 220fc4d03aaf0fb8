//! `twinstep preflight`: checks the robot and its contract with a policy before torque flows.

use std::io::BufRead;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use serde::Serialize;
use twinstep_agent::{AgentError, LoadedPolicy};
use twinstep_env_server::task_spec;
use twinstep_robot::dds::Dds;
use twinstep_robot::preflight::{Activity, Finding, PreflightReport, compare};
use twinstep_robot::preflight_loop::{self, Event};
use twinstep_robot::{RobotHandle, watch};

use crate::exit::{CommandResult, Failure, input, other};
use crate::fake_process::FakeProcess;
use crate::robot::{RobotConfig, checked_address, report_panics, start_motors};
use crate::stop_signals::StopSignals;

/// Time in which the service of the built-in controller answers.
const ANSWER: Duration = Duration::from_secs(2);
/// Interval at which signals are looked at.
const TICK: Duration = Duration::from_millis(50);

/// Check a robot, and its contract with a policy, before a policy moves it.
///
/// First it observes: network, other programs, built-in controller, battery, temperatures, IMU. Then, if you type `yes`, it
/// moves one joint at a time by 0.1 rad and the whole robot on its feet, and compares commands, encoders, torques and IMU:
/// order, signs, scales, zeros, gains, frames. A policy is compared with the robot without moving it. Every finding has a
/// name, what it is known from, and how to mend it. docs/robot.md lists the names.
///
/// Lay the robot on its belly with 1 m of space, release its built-in controller (`twinstep robot`, `release`), and keep the
/// remote control in your hand: L2 + B stops it. It takes 20 s. The exit code is 0 if nothing is wrong, and 1 if something is.
///
/// Examples: `twinstep preflight --fake` and `twinstep preflight --interface eth0 --policy walk/policy.safetensors`
#[derive(clap::Args)]
#[command(group(clap::ArgGroup::new("wire").required(true).args(["interface", "fake"])))]
pub struct Args {
    /// Network interface to the robot, by name or address.
    #[arg(long, value_name = "NAME")]
    interface: Option<String>,
    /// DDS domain: 0 on the robot, 1 in the vendor's simulator.
    #[arg(long, default_value_t = 0, requires = "interface")]
    domain: u16,
    /// Check a fake robot in a process of its own.
    #[arg(long)]
    fake: bool,
    /// Policy to compare with the robot.
    #[arg(long, value_name = "FILE")]
    policy: Option<PathBuf>,
    /// Mapping of the ONNX policy of another program (TOML).
    #[arg(long, value_name = "FILE", requires = "policy")]
    mapping: Option<PathBuf>,
    /// Contract of the robot's endpoint, as for `twinstep robot`: a policy, a mapping or a TOML file with [control].
    #[arg(long, value_name = "FILE")]
    contract: Option<PathBuf>,
    /// Config file (TOML) with [task], [safety] and [control], as for `twinstep robot`.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print one JSON object on stdout and nothing else.
    #[arg(long)]
    json: bool,
}

/// What `--json` prints.
#[derive(Serialize)]
struct JsonReport<'a> {
    findings: Vec<JsonFinding<'a>>,
    left_out: Vec<String>,
    stopped_by: Option<String>,
}

#[derive(Serialize)]
struct JsonFinding<'a> {
    id: &'a str,
    what: &'a str,
    evidence: &'a str,
    remedy: &'a str,
}

/// Makes the checks and prints the findings.
pub fn run(args: &Args) -> CommandResult {
    let handle = RobotHandle::default();
    let signals = StopSignals::listen(&handle)?;
    let config = RobotConfig::load(args.config.as_deref(), args.contract.as_deref())?;
    let robot = config.robot()?;
    let spec = task_spec(&config.task, &robot, false).map_err(input)?;
    let mut findings = Vec::new();
    if let Some(path) = &args.policy {
        let policy = LoadedPolicy::read(path, args.mapping.as_deref()).map_err(input)?;
        findings.extend(match policy.bind(&spec) {
            Ok(_) => Vec::new(),
            Err(AgentError::Disagreement { differences, .. }) => compare(&differences),
            Err(error) => return Err(input(error)),
        });
    }
    let fake = if args.fake { Some(FakeProcess::start(None, &["--released"])?) } else { None };
    let (domain, address) = match (&fake, &args.interface) {
        (Some(fake), _) => (fake.domain, IpAddr::V4(Ipv4Addr::LOCALHOST)),
        (None, name) => (args.domain, checked_address(name.as_deref().unwrap_or_default(), &config.safety)?),
    };
    confirm(&handle, &signals)?;
    let dds = Dds::join(domain, address).map_err(input)?;
    let watch = watch::start(&dds, handle.clone()).map_err(other)?;
    let asked = Instant::now();
    while !handle.controller_released() && !handle.is_ending() && asked.elapsed() < ANSWER {
        std::thread::sleep(TICK);
    }
    report_panics(&handle);
    let motors = start_motors(&dds, &config.safety)?;
    let events = preflight_loop::start(&robot, config.safety, &dds, motors, handle.clone()).map_err(other)?;
    let report = loop {
        if handle.is_ending() {
            // The motors are damped until the thread ends.
            while events.recv().is_ok() {}
            return Err(Failure::Interrupted);
        }
        match events.recv_timeout(TICK) {
            Ok(Event::Activity(activity)) => eprintln!("{}", activity_text(activity)),
            Ok(Event::Report(report)) => break report,
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                return Err(Failure::Other(miette::miette!("preflight failed; its commands have ceased")));
            }
        }
    };
    handle.end();
    let _ = watch.join();
    findings.extend(report.findings.iter().cloned());
    print_report(&findings, &report, args.json)
}

/// Waits for the operator's `yes`, or a signal.
fn confirm(handle: &RobotHandle, signals: &StopSignals) -> CommandResult {
    eprintln!("the robot will move its legs for 20 s: it lies on its belly, with 1 m of space; type yes");
    let (answer, answers) = channel();
    std::thread::spawn(move || {
        let mut line = String::new();
        let _ = std::io::stdin().lock().read_line(&mut line);
        let _ = answer.send(line);
    });
    loop {
        match answers.recv_timeout(TICK) {
            Ok(line) if line.trim() == "yes" => return Ok(()),
            Err(RecvTimeoutError::Timeout) if handle.is_ending() => {
                return signals.outcome().and(Err(Failure::Interrupted));
            }
            Err(RecvTimeoutError::Timeout) => {}
            Ok(_) | Err(RecvTimeoutError::Disconnected) => {
                return Err(Failure::Input(miette::miette!("not confirmed: nothing was sent")));
            }
        }
    }
}

fn activity_text(activity: Activity) -> String {
    match activity {
        Activity::Observe => "observes".to_owned(),
        Activity::Damp => "damps the joints".to_owned(),
        Activity::TestJoint(joint) => format!("moves {joint}"),
        Activity::Rise => "rises or lies down".to_owned(),
        Activity::TestStance => "moves on its feet".to_owned(),
        Activity::Finished => "has ended".to_owned(),
    }
}

fn print_report(findings: &[Finding], report: &PreflightReport, json: bool) -> CommandResult {
    if json {
        let one = |finding: &Finding| {
            let Finding { id, what, evidence, remedy, .. } = finding.clone();
            (id, what, evidence, remedy)
        };
        let texts: Vec<_> = findings.iter().map(one).collect();
        let report = JsonReport {
            findings: texts
                .iter()
                .map(|(id, what, evidence, remedy)| JsonFinding { id, what, evidence, remedy })
                .collect(),
            left_out: report.left_out.iter().map(ToString::to_string).collect(),
            stopped_by: report.stopped_by.map(|fault| fault.to_string()),
        };
        println!("{}", serde_json::to_string(&report).map_err(other)?);
    } else {
        for finding in findings {
            println!("{finding}\n");
        }
        for left_out in &report.left_out {
            println!("{left_out}");
        }
        if let Some(fault) = report.stopped_by {
            println!("the motions were ended: {fault}");
        }
        if findings.is_empty() {
            println!("nothing is wrong");
        }
    }
    match (findings.len(), report.stopped_by) {
        (0, None) => Ok(()),
        (count, _) => {
            Err(Failure::Other(miette::miette!("{count} findings: mend them before a policy moves the robot")))
        }
    }
}
