//! Injects faults into real processes and shows that no step is executed twice, skipped or invented.
//!
//! `cargo build --release --workspace && target/release/faults --faults 1000`

use std::process::ExitCode;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_tests::fault_injection::{self, FaultPlan};
use twinstep_tests::roles::Role;
use twinstep_tests::test_bed::TestBedConfig;

/// Kill, freeze and confuse servers, clients and routers, and count what goes wrong.
///
/// Each lane is a server whose counters prove every step, a client that checks every observation, and on every second
/// lane a router between them. Exit code 1 if anything was executed twice, skipped, invented, or did not go on.
#[derive(Parser)]
#[command(args_conflicts_with_subcommands = true)]
struct Arguments {
    /// Number of faults.
    #[arg(long, default_value_t = 1000)]
    faults: usize,
    /// Lanes at once.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u16).range(1..=64))]
    lanes: u16,
    /// Seed of the faults and their moments.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Another client, program and first arguments, in place of the Rust one; it is given the endpoint.
    #[arg(long, num_args = 1.., value_name = "COMMAND")]
    client: Option<Vec<String>>,
    /// One process of a lane; the lanes start these themselves.
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
        lanes: usize::from(arguments.lanes),
        seed: arguments.seed,
    };
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} faults, {per_sec}, {eta} left: {msg}")?;
    let bar = ProgressBar::new(arguments.faults as u64).with_style(style);
    let since = Instant::now();
    let tally = fault_injection::run(&plan, &AtomicBool::new(false), |fault| {
        bar.set_message(fault.name());
        bar.inc(1);
    })?;
    bar.finish_and_clear();
    println!("{tally}\nseed {}, {:.0} s", arguments.seed, since.elapsed().as_secs_f64());
    for (fault, evidence) in &tally.failures {
        println!("FAILED {}: {evidence}", fault.name());
    }
    Ok(tally.failures.is_empty())
}
