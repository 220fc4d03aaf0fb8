//! Soak test of a server: thousands of clients that close, disconnect, freeze, return or are killed.
//!
//! `cargo build --release --workspace && target/release/soak --minutes 30`

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_model::stream;
use twinstep_tests::soak::report;
use twinstep_tests::soak::run::{Event, Plan, SoakResult, run};
use twinstep_tests::soak::visit::{Fate, Visitor, run_client};

/// Let clients come to a real server for minutes, and check that it releases everything they used.
///
/// Each client connects, leases 1 to 8 environments, resets and steps. Its end is drawn at random: it closes its lease,
/// disconnects during a step, is killed, its connection is cut, or it stops reading while the server replies. Some
/// connect again or reclaim their lease with id and secret. The server's memory, threads and open files are sampled
/// every second. At the end all environments must be free, and threads and open files as many as before.
///
/// Exit code 1 if a client failed, or if leases, threads or open files were leaked. Ctrl-C ends the test early and
/// prints the result so far.
#[derive(Parser)]
#[command(args_conflicts_with_subcommands = true)]
struct Arguments {
    /// Time for which clients come [min].
    #[arg(long, default_value_t = 30.0, value_name = "MIN")]
    minutes: f64,
    /// Number of clients at the same time.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=64))]
    lanes: u16,
    /// Seed of the clients and of the server.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Longest pause of a client that stops reading [s]. After 2 s Zenoh closes its link.
    #[arg(long, default_value_t = 1.5, value_name = "S")]
    max_pause_s: f64,
    /// Only clients with this end: closes, disconnects, returns, killed, killed-and-returns, cut, cut-and-returns,
    /// frozen or frozen-and-returns. May be given several times. Default: all.
    #[arg(long = "only", value_enum, value_name = "END", hide_possible_values = true)]
    fates: Vec<Fate>,
    /// Task of the server: walk or counter.
    #[arg(long, default_value = "walk")]
    task: String,
    /// The program `twinstep`. Default: the one in the folder of this program.
    #[arg(long, value_name = "FILE")]
    twinstep: Option<PathBuf>,
    /// Write the tables to this file, too.
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    #[command(subcommand)]
    role: Option<Role>,
}

#[derive(Subcommand)]
enum Role {
    /// Client process: leases and steps until it is killed.
    #[command(hide = true)]
    Client { endpoint: String, num_envs: usize },
    /// One client from its connection to its end. Prints the reason of a failure.
    #[command(hide = true)]
    Visit { fate: Fate, seed: u64, pause_ms: u64, endpoint: String },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match &arguments.role {
        Some(Role::Client { endpoint, num_envs }) => run_client(endpoint, *num_envs).map(|()| true).map_err(Into::into),
        Some(Role::Visit { fate, seed, pause_ms, endpoint }) => visit(*fate, *seed, *pause_ms, endpoint),
        None => soak(&arguments),
    };
    match result {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn visit(fate: Fate, seed: u64, pause_ms: u64, endpoint: &str) -> Result<bool, Box<dyn std::error::Error>> {
    // Ctrl-C reaches the whole process group; the program that started this client waits for its end.
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::default())?;
    let max_pause = Duration::from_millis(pause_ms);
    let visitor = Visitor { endpoint: endpoint.to_owned(), program: std::env::current_exe()?, max_pause };
    let outcome = visitor.visit(fate, &mut stream(seed, fate.name(), 0));
    if let Err(reason) = &outcome {
        println!("{reason}");
    }
    Ok(outcome.is_ok())
}

fn soak(arguments: &Arguments) -> Result<bool, Box<dyn std::error::Error>> {
    let program = std::env::current_exe()?;
    let plan = Plan {
        twinstep: arguments.twinstep.clone().unwrap_or_else(|| program.with_file_name("twinstep")),
        program,
        task: arguments.task.clone(),
        duration: Duration::try_from_secs_f64(60.0 * arguments.minutes)?,
        lanes: usize::from(arguments.lanes),
        seed: arguments.seed,
        max_pause: Duration::try_from_secs_f64(arguments.max_pause_s)?,
        fates: if arguments.fates.is_empty() { Fate::ALL.to_vec() } else { arguments.fates.clone() },
    };
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::clone(&stop))?;
    let result = run_with_progress(&plan, &stop)?;
    let text = report::text(&plan, &result);
    std::io::stdout().write_all(text.as_bytes())?;
    if let Some(file) = &arguments.table {
        std::fs::write(file, &text)?;
    }
    Ok(result.is_clean())
}

fn run_with_progress(plan: &Plan, stop: &AtomicBool) -> Result<SoakResult, Box<dyn std::error::Error>> {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} s, {eta} left: {msg}")?;
    let bar = ProgressBar::new(plan.duration.as_secs()).with_style(style);
    bar.set_message("one client of each kind");
    let clients = AtomicU64::new(0);
    let result = run(plan, stop, |event| match event {
        Event::Client(_) => drop(clients.fetch_add(1, Ordering::Relaxed)),
        Event::Sample(sample) => {
            bar.inc(1);
            let (clients, seconds) = (clients.load(Ordering::Relaxed), bar.position());
            let rate = clients as f64 / seconds.max(1) as f64;
            let memory = sample.resident_kib >> 10;
            bar.set_message(format!("{clients} clients, {rate:.1}/s, {memory} MiB, {} threads", sample.threads));
        }
    })?;
    bar.finish_and_clear();
    Ok(result)
}
