//! Attacks on `twinstep robot` and on servers: the rows of `results/safety.md`.
//!
//! `cargo build --release --workspace && target/release/safety all`

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use twinstep_tests::safety::{Row, packets, recordings, robots, servers, signals, stops};

/// Attack `twinstep robot`, in front of a fake Go2, and servers; print what was measured as rows of a table.
///
/// Run it as root on a computer without other work: it sets limits, mounts a small disk and uses real-time priorities.
#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    part: Part,
    /// Seed of the random choices.
    #[arg(long, default_value_t = 1, global = true)]
    seed: u64,
}

#[derive(Clone, Copy, Subcommand)]
enum Part {
    /// End or suspend the process in each state.
    Signals {
        /// Number of cases.
        #[arg(long, default_value_t = 90)]
        cases: usize,
    },
    /// Stop a standing robot while something keeps the process busy.
    Stops {
        /// Number of stops for each way and load.
        #[arg(long, default_value_t = 3)]
        repeats: usize,
    },
    /// Send forged packets to the DDS sockets.
    Packets {
        /// Number of packets.
        #[arg(long, default_value_t = 1_000_000)]
        count: usize,
    },
    /// Put a second robot on the domain.
    Robots {
        /// Number of repetitions.
        #[arg(long, default_value_t = 5)]
        repeats: usize,
    },
    /// Kill recordings.
    Recordings {
        /// Number of recordings.
        #[arg(long, default_value_t = 200)]
        count: usize,
    },
    /// Harm a server.
    Servers {
        /// Time with clients that do not read [min].
        #[arg(long, default_value_t = 10.0)]
        minutes: f64,
    },
    /// All parts with their defaults.
    All,
}

fn main() -> ExitCode {
    let Arguments { part, seed } = Arguments::parse();
    let parts = match part {
        Part::All => vec![
            Part::Signals { cases: 90 },
            Part::Stops { repeats: 3 },
            Part::Packets { count: 1_000_000 },
            Part::Robots { repeats: 5 },
            Part::Recordings { count: 200 },
            Part::Servers { minutes: 10.0 },
        ],
        part => vec![part],
    };
    println!("| attack | measured | bound |\n|---|---|---|");
    let mut code = ExitCode::SUCCESS;
    for part in parts {
        match run(part, seed) {
            Ok(rows) => rows.iter().for_each(|row| println!("{}", row.line())),
            Err(error) => {
                eprintln!("error: {error}");
                code = ExitCode::FAILURE;
            }
        }
    }
    code
}

fn run(part: Part, seed: u64) -> Result<Vec<Row>, String> {
    let own = std::env::current_exe().map_err(|error| error.to_string())?;
    let program: PathBuf = own.with_file_name("twinstep");
    let progress = |text: &str| eprintln!("{text}");
    match part {
        Part::Signals { cases } => Ok(signals::run(&program, cases, seed, &progress)),
        Part::Stops { repeats } => Ok(stops::run(&program, repeats, &progress)),
        Part::Packets { count } => packets::run(&program, count, seed),
        Part::Robots { repeats } => Ok(robots::run(&program, repeats)),
        Part::Recordings { count } => recordings::run(&program, count, seed, &progress),
        Part::Servers { minutes } => Ok(vec![
            servers::oversized(&program)?,
            servers::rollouts(&program, 20.0)?,
            servers::silent_clients(&program, minutes)?,
        ]),
        Part::All => Ok(Vec::new()),
    }
}
