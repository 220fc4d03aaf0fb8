//! Timing of `twinstep robot` on the robot's own wire, with the fake Go2 in a process of its own.
//!
//! `cargo build --release --workspace && target/release/robot_timing --out results/robot_timing.md`

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::Value;
use twinstep_robot::{Histogram, real_time_thread};
use twinstep_tests::process::Process;
use twinstep_tests::robot_pair::RobotPair;

/// Period of the control loop, and of the thread that it is compared with.
const PERIOD: Duration = Duration::from_millis(2);
/// Time for which a client is frozen: the robot has sat down before.
const FROZEN: Duration = Duration::from_secs(3);
/// What is done to the clients, in turn.
const ENDS: [End; 3] = [End::Killed, End::Frozen, End::Interrupted];

/// Measure how punctual `twinstep robot` is, with a fake Go2 and an agent in processes of their own.
///
/// First an agent walks undisturbed. Then agents walk for some seconds each, and are killed (SIGKILL), frozen (SIGSTOP)
/// and interrupted (SIGINT) in turn; the robot sits down by itself, the operator makes it stand again, and the next agent
/// connects. Meanwhile a thread with the same scheduling sleeps 2 ms again and again: its lateness is that of this
/// computer, whatever program runs.
///
/// Ctrl-C ends the present part and prints what was measured.
#[derive(Parser)]
#[command(verbatim_doc_comment)]
struct Arguments {
    /// Time of the undisturbed walk [s].
    #[arg(long, default_value_t = 120.0, value_name = "S")]
    walk: f64,
    /// Time with disturbed clients [min].
    #[arg(long, default_value_t = 10.0, value_name = "MINUTES")]
    minutes: f64,
    /// Policy that walks.
    #[arg(long, default_value = "data/policies/walk.safetensors", value_name = "FILE")]
    policy: PathBuf,
    /// Write the results to this file, too.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// How a client ends.
#[derive(Clone, Copy)]
enum End {
    Killed,
    Frozen,
    Interrupted,
}

/// What was measured in one part.
struct Part {
    seconds: f64,
    clients: usize,
    /// Timing of the control loop, as its operator request `timing` gives it.
    robot: Value,
    /// Statistics of the fake robot.
    fake: Value,
    /// Lateness of this computer.
    host: Histogram,
}

fn main() -> ExitCode {
    match measure(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(arguments: &Arguments) -> Result<(), Box<dyn std::error::Error>> {
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::clone(&stop))?;
    let program = std::env::current_exe()?.with_file_name("twinstep");
    let walk = part(&program, arguments, arguments.walk, &[], &stop)?;
    let disturbed = part(&program, arguments, 60.0 * arguments.minutes, &ENDS, &stop)?;
    let text = document(&walk, &disturbed);
    print!("{text}");
    if let Some(file) = &arguments.out {
        std::fs::write(file, &text).map_err(|error| format!("{}: {error}", file.display()))?;
    }
    Ok(())
}

/// Runs clients for some seconds, each with the next of `ends`; one undisturbed client if there is none.
fn part(
    program: &Path,
    arguments: &Arguments,
    seconds: f64,
    ends: &[End],
    stop: &AtomicBool,
) -> Result<Part, Box<dyn std::error::Error>> {
    let bar = ProgressBar::new(seconds as u64);
    bar.set_style(ProgressStyle::with_template("{bar:40} {human_pos}/{human_len} s, {eta} left, {msg}")?);
    let mut pair = RobotPair::start(program, &["--released"], &[])?;
    pair.stand()?;
    let (host, start) = (HostClock::start()?, Instant::now());
    let mut clients = 0;
    let has_time = || start.elapsed().as_secs_f64() < seconds && !stop.load(Ordering::Relaxed);
    while has_time() {
        let mut client = client(program, &arguments.policy, &pair.endpoint)?;
        clients += 1;
        bar.set_message(format!("client {clients}"));
        let life = if ends.is_empty() { seconds } else { 2.0 + (clients % 4) as f64 };
        let born = Instant::now();
        while born.elapsed().as_secs_f64() < life && has_time() {
            std::thread::sleep(Duration::from_millis(50));
            bar.set_position(start.elapsed().as_secs());
        }
        match ends.get(clients % ends.len().max(1)) {
            Some(End::Killed) => drop(client.kill()),
            Some(End::Frozen) => {
                client.freeze()?;
                std::thread::sleep(FROZEN);
                client.thaw()?;
                drop(client.kill());
            }
            Some(End::Interrupted) | None => {
                client.interrupt()?;
                client.exit_code(Duration::from_secs(10));
            }
        }
        if has_time() {
            stand_again(&mut pair)?;
        }
    }
    bar.finish_and_clear();
    let robot = pair.operator("timing")?;
    let robot = serde_json::from_str(robot.trim_start_matches("ok "))?;
    let fake = pair.ask("statistics")?;
    Ok(Part { seconds: start.elapsed().as_secs_f64(), clients, robot, fake, host: host.end() })
}

fn client(program: &Path, policy: &Path, endpoint: &str) -> Result<Process, String> {
    let policy = policy.display().to_string();
    let arguments = ["run", &policy, "--endpoint", endpoint, "--velocity", "0.4,0,0.2"];
    Process::start(program, &arguments.map(str::to_owned))
}

/// Waits until the robot has sat down or stands, and makes it stand.
fn stand_again(pair: &mut RobotPair) -> Result<(), String> {
    let end = Instant::now() + Duration::from_secs(10);
    while !["fault", "ready"].iter().any(|state| pair.state().starts_with(state)) {
        if Instant::now() > end {
            return Err(format!("the robot stays in `{}` without a client", pair.state()));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    if pair.state().starts_with("fault") {
        // A robot whose client is lost in the middle of a step may have fallen over.
        pair.inject("set upright")?;
        pair.insist("arm")?;
        pair.insist("stand")?;
        pair.wait_for("ready", Duration::from_secs(10))?;
    }
    Ok(())
}

/// A thread that sleeps 2 ms again and again.
struct HostClock {
    ends: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<Histogram>,
}

impl HostClock {
    fn start() -> std::io::Result<Self> {
        let ends = Arc::new(AtomicBool::new(false));
        let shared = Arc::clone(&ends);
        let thread = real_time_thread::spawn("host clock", move || {
            let (mut lateness, mut due) = (Histogram::default(), Instant::now());
            while !shared.load(Ordering::Relaxed) {
                due += PERIOD;
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                let now = Instant::now();
                lateness.add(now.saturating_duration_since(due));
                if now.saturating_duration_since(due) > PERIOD {
                    due = now;
                }
            }
            lateness
        })?;
        Ok(Self { ends, thread })
    }

    fn end(self) -> Histogram {
        self.ends.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}

fn document(walk: &Part, disturbed: &Part) -> String {
    let command = std::env::args().skip(1).collect::<Vec<_>>().join(" ");
    let mut text = format!(
        "# Timing of `twinstep robot`\n\nThe fake Go2, the robot's process and the agent (`twinstep run`) are processes of \
         their own, on DDS and Zenoh. {} cores, x86-64 Linux, 2026-11.\n\n```sh\ncargo build --release --workspace\n\
         target/release/robot_timing {command}\n```\n\nThe thread in the last rows does nothing but sleep 2 ms, with the same \
         scheduling as the control loop: what it is late by is the computer's.\n\n| | undisturbed walk | clients killed, \
         frozen, interrupted |\n|---|---|---|\n",
        std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
    );
    let mut row = |name: &str, value: &dyn Fn(&Part) -> String| {
        let _ = writeln!(text, "| {name} | {} | {} |", value(walk), value(disturbed));
    };
    row("time [s], clients", &|part| format!("{:.0}, {}", part.seconds, part.clients));
    for (name, key) in [
        ("state to command, p50 / p99 / largest [ms]", "state_to_command"),
        ("jitter of the ticks", "tick_jitter"),
        ("lateness of the loop: time since the step before, less 2 ms", "lateness"),
        ("lateness of its timer, where no state arrived in time", "timer_lateness"),
        ("time between two commands", "gaps"),
    ] {
        row(name, &|part| {
            let entry = |quantile: &str| part.robot[key][quantile].as_f64().unwrap_or(f64::NAN);
            format!("{:.2} / {:.2} / {:.1}", entry("p50_ms"), entry("p99_ms"), entry("max_ms"))
        });
    }
    row("steps of the timer", &|part| part.robot["timer_lateness"]["count"].to_string());
    row("times above 10 ms between two commands, of", &|part| {
        format!("{} of {}", part.robot["gaps"]["above_10_ms"], part.robot["gaps"]["count"])
    });
    row("commands that the robot refused", &|part| part.fake["refused"].to_string());
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    row("lateness of the thread that sleeps, p50 / p99 / largest [ms]", &|part| {
        let [p50, p99] = [0.5, 0.99].map(|share| ms(part.host.quantile(share)));
        format!("{p50:.2} / {p99:.2} / {:.1}", ms(part.host.max()))
    });
    row("times above 8 ms that it was late, of", &|part| {
        format!("{} of {}", part.host.count_above(Duration::from_millis(8)), part.host.count())
    });
    text
}
