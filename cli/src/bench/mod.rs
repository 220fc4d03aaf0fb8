//! `twinstep bench`: our numbers beside their references, in one run.

mod ensemble;
mod identify;
mod pace;
mod peers;
mod remote;
mod sim;
mod tcp;
mod transport;

use std::path::PathBuf;

use serde::Serialize;

use crate::exit::{CommandResult, Signals};

/// Measure Twinstep on this machine, side by side with the references, in one run.
///
/// Machines are noisy: read the ratios, and medians over repeats; absolute numbers hold for this moment only.
#[derive(clap::Args)]
pub struct Args {
    /// What to measure; everything without.
    #[arg(value_enum)]
    what: Option<What>,
    /// Print one JSON object and nothing else on stdout.
    #[arg(long)]
    json: bool,
    /// Length of one measuring window [s]; each case takes the median of several.
    #[arg(long, default_value_t = 1.0, value_name = "S", value_parser = window)]
    window_s: f64,
    /// Python for what `sim` and `identify` measure beside, MuJoCo and EnvPool: `pip install "./clients/python[bench]"`;
    /// and `ensemble`, PyTorch: `pip install torch`. What it lacks is left out.
    #[arg(long, default_value = "python3", value_name = "PATH")]
    python: PathBuf,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// Round trips without physics, beside a raw TCP ping-pong with the same payloads.
    Transport,
    /// Physics: env-steps/s on one core at each setting, beside MuJoCo and EnvPool, and the accuracy it buys.
    Sim,
    /// Environments with physics: over Zenoh, beside the same in process.
    Remote,
    /// Identification: closed-loop rollouts of the built-in recording beside MuJoCo, and the time of a whole search.
    Identify,
    /// Learned drives: networks beside PyTorch's and burn's, and robots that they drive.
    Ensemble,
    /// The other end of the TCP ping-pong.
    #[value(hide = true)]
    TcpEcho,
}

fn window(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "a number of seconds is wanted".to_owned())?;
    if (0.01..=60.0).contains(&seconds) { Ok(seconds) } else { Err("0.01 to 60 s".to_owned()) }
}

/// One measured number.
#[derive(Clone, Serialize)]
pub struct Measurement {
    /// What was measured.
    pub case: String,
    /// The number.
    pub value: f64,
    /// Its unit.
    pub unit: &'static str,
    /// What it is compared with.
    pub reference: Option<String>,
    /// Ours to the reference, > 1 is better.
    pub ratio: Option<f64>,
}

#[derive(Serialize)]
struct Results {
    rows: Vec<Measurement>,
    machine: Machine,
}

#[derive(Serialize)]
struct Machine {
    cpu: String,
    cores: usize,
    os: &'static str,
    arch: &'static str,
}

/// Measures and prints.
pub fn run(args: &Args) -> CommandResult {
    if args.what == Some(What::TcpEcho) {
        return tcp::echo();
    }
    let signals = Signals::listen()?;
    let wanted = |what| args.what.is_none_or(|one| one == what);
    let mut rows = Vec::new();
    if wanted(What::Transport) {
        rows.extend(transport::measure(args.window_s, &signals)?);
    }
    if wanted(What::Sim) {
        rows.extend(sim::measure(&args.python, args.window_s, &signals)?);
    }
    if wanted(What::Remote) {
        rows.extend(remote::measure(args.window_s, &signals)?);
    }
    if wanted(What::Identify) {
        rows.extend(identify::measure(&args.python, args.window_s, &signals)?);
    }
    if wanted(What::Ensemble) {
        rows.extend(ensemble::measure(&args.python, args.window_s, &signals)?);
    }
    let results = Results { rows, machine: machine() };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&results).map_err(crate::exit::other)?);
    } else {
        print(&results);
    }
    Ok(())
}

fn print(results: &Results) {
    for row in &results.rows {
        let decimals = match row.value.abs() {
            ..1.0 => 5,
            ..100.0 => 2,
            _ => 0,
        };
        let value = format!("{:.decimals$}", row.value);
        let comparison = match (&row.reference, row.ratio) {
            (Some(reference), Some(ratio)) => format!("  {ratio:.3} of {reference}"),
            (Some(reference), None) => format!("  against {reference}"),
            _ => String::new(),
        };
        println!("{:<52} {value:>10} {:<14}{comparison}", row.case, row.unit);
    }
    let machine = &results.machine;
    println!("\n{}, {} cores, {} {}", machine.cpu, machine.cores, machine.os, machine.arch);
}

fn machine() -> Machine {
    let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpuinfo.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    Machine {
        cpu: model.map_or_else(|| "unknown CPU".to_owned(), |(_, name)| name.to_owned()),
        cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        os: std::env::consts::OS,
        arch: std::env::consts::ARCH,
    }
}
