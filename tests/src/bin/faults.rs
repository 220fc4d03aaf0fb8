//! Injects faults into real processes and checks that no step is executed twice, skipped or invented.
//!
//! `cargo build --release --workspace && target/release/faults --faults 1000`

use std::process::ExitCode;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_tests::fault::Fault;
use twinstep_tests::fault_injection::{self, FaultPlan};
use twinstep_tests::roles::Role;
use twinstep_tests::test_bed::TestBedConfig;

/// Inject faults into servers, clients and routers, and count the failures.
///
/// Each test bed has a server of counters and a client that checks every observation. Every second one also has a
/// router between them. Exit code 1 if a step was executed twice, skipped or invented, or if a client did not continue.
#[derive(Parser)]
#[command(args_conflicts_with_subcommands = true)]
struct Arguments {
    /// Number of faults.
    #[arg(long, default_value_t = 1000)]
    faults: usize,
    /// Number of test beds in parallel.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=64))]
    lanes: u16,
    /// Seed of the faults and their times.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Inject only this fault: its number in the table of all faults, from 1. May be given several times.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=10))]
    only: Vec<u8>,
    /// Program and first arguments of another client in place of the Rust one. The endpoint is appended.
    #[arg(long, num_args = 1.., value_name = "COMMAND")]
    client: Option<Vec<String>>,
    /// Role of one process of a test bed, which starts these itself.
    #[command(subcommand)]
    role: Option<Role>,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match &arguments.role {
        Some(role) => role.run().map(|()| true),
        None => inject(&arguments),
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

fn inject(arguments: &Arguments) -> Result<bool, Box<dyn std::error::Error>> {
    let program = std::env::current_exe()?;
    let plan = FaultPlan {
        commands: TestBedConfig { program, server: Vec::new(), client: arguments.client.clone() },
        faults: arguments.faults,
        kinds: match &arguments.only[..] {
            [] => Fault::ALL.to_vec(),
            only => only.iter().map(|number| Fault::ALL[usize::from(number - 1)]).collect(),
        },
        lanes: usize::from(arguments.lanes),
        seed: arguments.seed,
    };
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} faults, {per_sec}, {eta} left: {msg}")?;
    let bar = ProgressBar::new(arguments.faults as u64).with_style(style);
    let since = Instant::now();
    let report = fault_injection::run(&plan, &AtomicBool::new(false), |fault| {
        bar.set_message(fault.name());
        bar.inc(1);
    });
    bar.finish_and_clear();
    println!("{report}\nseed {}, {:.0} s", arguments.seed, since.elapsed().as_secs_f64());
    for (fault, evidence) in &report.failures {
        println!("FAILED {}: {evidence}", fault.name());
    }
    for problem in &report.unfinished {
        println!("UNFINISHED test bed: {problem}");
    }
    Ok(report.failures.is_empty() && report.unfinished.is_empty())
}
