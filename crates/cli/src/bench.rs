//! `twinstep bench`: measures Twinstep and its baselines in one run.

use std::path::PathBuf;

use twinstep_bench::{
    BenchError, Machine, Results, ensemble, identify, remote, remote_training, robots, sim, tcp, transport, view,
};

use crate::exit::{CommandResult, Failure, Signals, other};

/// Measure the speed and accuracy of Twinstep and of its baselines on this machine.
///
/// Absolute numbers depend on the load of the machine. Compare ratios, and medians over several runs.
///
/// Example: `twinstep bench sim --window-s 0.5 --python .venv/bin/python`
#[derive(clap::Args)]
pub struct Args {
    /// Benchmark to run. Default: all.
    #[arg(value_enum)]
    what: Option<What>,
    /// Print one JSON object and nothing else on stdout.
    #[arg(long)]
    json: bool,
    /// Length of one measuring window [s]. Each case is the median of several windows.
    #[arg(long, default_value_t = 1.0, value_name = "S", value_parser = window)]
    window_s: f64,
    /// Python interpreter for the baselines. `sim` and `identify` use MuJoCo and EnvPool (`pip install
    /// "./clients/python[bench]"`), `ensemble` uses PyTorch (`pip install torch`). Missing baselines are skipped.
    #[arg(long, default_value = "python3", value_name = "PATH")]
    python: PathBuf,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// Round trips without physics, compared with a raw TCP ping-pong of the same payloads.
    Transport,
    /// Physics: env-steps/s on one core at each setting, and accuracy, compared with MuJoCo and EnvPool.
    Sim,
    /// Robots of any tree: env-steps/s on one core, compared with MuJoCo.
    Robots,
    /// Environments with physics over Zenoh, and training on them by rollouts, compared with the same in process.
    Remote,
    /// Identification: closed-loop rollouts of the built-in recording compared with MuJoCo, and one whole run.
    Identify,
    /// Actuator networks: speed compared with PyTorch and burn, and robots simulated with them.
    Ensemble,
    /// Robots in the browser: processor time of a page, and what it costs a training.
    View,
    /// Echo server of the TCP ping-pong.
    #[value(hide = true)]
    TcpEcho,
}

fn window(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "must be a number of seconds".to_owned())?;
    if (0.01..=60.0).contains(&seconds) { Ok(seconds) } else { Err("must be 0.01 to 60 s".to_owned()) }
}

/// Runs the selected benchmarks and prints the results.
pub fn run(args: &Args) -> CommandResult {
    if args.what == Some(What::TcpEcho) {
        return tcp::echo().map_err(failure);
    }
    let signals = Signals::listen()?;
    let interrupted = || signals.check().unwrap_or(true);
    let selected = |what| args.what.is_none_or(|one| one == what);
    let mut rows = Vec::new();
    if selected(What::Transport) {
        rows.extend(transport::measure(args.window_s, &interrupted).map_err(failure)?);
    }
    if selected(What::Sim) {
        rows.extend(sim::measure(&args.python, args.window_s, &interrupted).map_err(failure)?);
    }
    if selected(What::Robots) {
        rows.extend(robots::measure(&args.python, args.window_s, &interrupted).map_err(failure)?);
    }
    if selected(What::Remote) {
        rows.extend(remote::measure(args.window_s, &interrupted).map_err(failure)?);
        rows.extend(remote_training::measure(args.window_s, &interrupted).map_err(failure)?);
    }
    if selected(What::Identify) {
        rows.extend(identify::measure(&args.python, args.window_s, &interrupted).map_err(failure)?);
    }
    if selected(What::Ensemble) {
        rows.extend(ensemble::measure(&args.python, args.window_s, &interrupted).map_err(failure)?);
    }
    if selected(What::View) {
        rows.extend(view::measure(args.window_s, &interrupted).map_err(failure)?);
    }
    let results = Results { rows, machine: Machine::this() };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&results).map_err(other)?);
    } else {
        print(&results);
    }
    Ok(())
}

fn failure(error: BenchError) -> Failure {
    match error {
        BenchError::Interrupted => Failure::Interrupted,
        error @ BenchError::Failed(_) => other(error),
    }
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
            (Some(reference), None) => format!("  compared with {reference}"),
            _ => String::new(),
        };
        println!("{:<52} {value:>10} {:<14}{comparison}", row.case, row.unit);
    }
    let machine = &results.machine;
    println!("\n{}, {} cores, {} {}", machine.cpu, machine.cores, machine.os, machine.arch);
}
