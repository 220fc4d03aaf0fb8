//! Fault campaign of the safety state machine with the fake Go2.
//!
//! `cargo build --release --workspace && target/release/robot_faults --sequences 1000 --out results/robot_faults.md`

use std::fmt::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use rayon::prelude::*;
use twinstep_tests::robot_campaign::report;
use twinstep_tests::robot_campaign::sequence::{self, Tally};
use twinstep_tests::robot_campaign::table::{self, Cell, STATES};
use twinstep_tests::robot_campaign::wire::{self, WireRun};

/// Inject faults into a fake Go2 and check the reactions of the safety state machine.
///
/// First the table: each fault of the fake robot and of its surroundings is injected in each state (observe, damp,
/// stand_up, ready, run, hold, sit). Fault, time, reaction and end are compared with the table in the documentation of
/// the `robot` crate.
///
/// Then random sequences of requests, actions and faults. After every step of 2 ms these must be true: commands are
/// inside the limits, none is refused, an armed robot gets one every 10 ms, one that is not armed gets none and is free,
/// stale states are in damping after 40 ms, and a fault stays until arming.
///
/// The clock is accelerated: one core simulates about half a minute per second. Sequence number I depends only on the seed
/// and I. Ctrl-C stops after the runs in progress and prints what was found. Exit code 1 if anything is violated.
///
/// Examples:
///   robot_faults                                      the table and 100 sequences
///   robot_faults --sequences 100000 --no-table        only sequences
///   robot_faults --sequences 0 --no-table --wire 200  sequences on the wire
///   robot_faults --seed 7 --first 42 --sequences 1 --no-table    a counterexample again
///   RAYON_NUM_THREADS=1 robot_faults                  on one core
#[derive(Parser)]
#[command(verbatim_doc_comment)]
struct Arguments {
    /// Number of random sequences.
    #[arg(long, default_value_t = 100, value_name = "N")]
    sequences: u64,
    /// Number of the first sequence.
    #[arg(long, default_value_t = 0, value_name = "I")]
    first: u64,
    /// Seed of the sequences.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Stop the sequences after this time [min].
    #[arg(long, value_name = "MINUTES")]
    minutes: Option<f64>,
    /// Run this many sequences on the robot's own wire, in real time, 10 s of each.
    #[arg(long, default_value_t = 0, value_name = "N")]
    wire: u64,
    /// Leave out the table.
    #[arg(long)]
    no_table: bool,
    /// Write the results to this file, too.
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

fn main() -> ExitCode {
    match campaign(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn campaign(arguments: &Arguments) -> Result<bool, Box<dyn std::error::Error>> {
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::clone(&stop))?;
    let since = Instant::now();
    let cells = if arguments.no_table { Vec::new() } else { run_table(&stop)? };
    let table_time = since.elapsed();
    let since = Instant::now();
    let tally = run_sequences(arguments, &stop)?;
    let mut text = document(arguments, &cells, table_time, &tally, since.elapsed());
    let wire = run_on_wire(arguments, &stop)?;
    text += &report::wire(&wire);
    print!("{text}");
    if let Some(file) = &arguments.out {
        std::fs::write(file, &text).map_err(|error| format!("{}: {error}", file.display()))?;
    }
    let is_clean = wire.iter().all(|run| run.violations.is_empty());
    Ok(report::violations(&cells).is_empty() && tally.counterexample.is_none() && is_clean)
}

fn progress(len: u64, noun: &str) -> Result<ProgressBar, Box<dyn std::error::Error>> {
    let template = format!("{{bar:40}} {{human_pos}}/{{human_len}} {noun}, {{per_sec}}, {{eta}} left");
    Ok(ProgressBar::new(len).with_style(ProgressStyle::with_template(&template)?))
}

/// Returns the complete rows of the table.
fn run_table(stop: &AtomicBool) -> Result<Vec<Cell>, Box<dyn std::error::Error>> {
    let injections: Vec<_> = table::injections().collect();
    let bar = progress((injections.len() * STATES.len()) as u64, "cells")?;
    let rows: Vec<Option<Vec<Cell>>> = injections
        .par_iter()
        .map(|injection| {
            let cell = |state| {
                let cell = (!stop.load(Ordering::Relaxed)).then(|| table::run(*injection, state));
                bar.inc(1);
                cell
            };
            STATES.into_iter().map(cell).collect()
        })
        .collect();
    bar.finish_and_clear();
    Ok(rows.into_iter().flatten().flatten().collect())
}

fn run_sequences(arguments: &Arguments, stop: &AtomicBool) -> Result<Tally, Box<dyn std::error::Error>> {
    let bar = progress(arguments.sequences, "sequences")?;
    let (since, limit) = (Instant::now(), arguments.minutes.map_or(f64::INFINITY, |minutes| 60.0 * minutes));
    let run = |index| {
        if stop.load(Ordering::Relaxed) || since.elapsed().as_secs_f64() > limit {
            return Tally::default();
        }
        let tally = sequence::run(arguments.seed, index);
        bar.inc(1);
        tally
    };
    let sum = |mut first: Tally, second| {
        first.add(second);
        first
    };
    let numbers = arguments.first..arguments.first + arguments.sequences;
    let tally = numbers.into_par_iter().map(run).reduce(Tally::default, sum);
    bar.finish_and_clear();
    Ok(tally)
}

/// Runs sequences on the wire, two at a time: each has three processes that mostly sleep.
fn run_on_wire(arguments: &Arguments, stop: &AtomicBool) -> Result<Vec<WireRun>, Box<dyn std::error::Error>> {
    let program = std::env::current_exe()?.with_file_name("twinstep");
    let bar = progress(arguments.wire, "sequences on the wire")?;
    let next = AtomicU64::new(arguments.first);
    let end = arguments.first + arguments.wire;
    let lane = || {
        let mut runs = Vec::new();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            if index >= end || stop.load(Ordering::Relaxed) {
                return Ok::<_, String>(runs);
            }
            runs.push(wire::run(&program, arguments.seed, index)?);
            bar.inc(1);
        }
    };
    let lanes =
        std::thread::scope(|scope| [scope.spawn(lane), scope.spawn(lane)].map(std::thread::ScopedJoinHandle::join));
    bar.finish_and_clear();
    let mut runs = Vec::new();
    for lane in lanes {
        runs.extend(lane.map_err(|_| "a sequence on the wire panicked")??);
    }
    runs.sort_by_key(|run| run.index);
    Ok(runs)
}

fn document(arguments: &Arguments, cells: &[Cell], table_time: Duration, tally: &Tally, time: Duration) -> String {
    let command = std::env::args().skip(1).collect::<Vec<_>>().join(" ");
    let violations = report::violations(cells);
    let mut text = format!(
        "# Faults of the robot\n\nThe safety state machine of `crates/robot` with the fake Go2, on an accelerated clock. \
         Seed {}, {} threads, 2026-11, x86-64 Linux, other programs running.\n\n```sh\ncargo build --release \
         --workspace\ntarget/release/robot_faults {command}\n```\n\n",
        arguments.seed,
        rayon::current_num_threads(),
    );
    if !cells.is_empty() {
        let _ = write!(
            text,
            "## Each fault in each state\n\n{} cells in {:.0} s, {} violations. An entry has the fault, the time from the \
             injection to it and the state that follows, or – if nothing follows; then motors and height of the trunk \
             after 4 s. The client of a robot in `run` continues to send actions; that of a robot in `hold` sends none, \
             so that `actions late` follows. For mistakes of wiring and software (`mistake …`, but `checksum wrong`, `imu \
             upside down` and `encoder degrees`) the specification has no reaction: there only the rules of the \
             sequences are checked.\n\n{}\n",
            cells.len(),
            table_time.as_secs_f64(),
            violations.len(),
            report::table(cells),
        );
    }
    for violation in &violations {
        let _ = writeln!(text, "- VIOLATED: {violation}");
    }
    if tally.sequences > 0 {
        let _ = write!(
            text,
            "## Random sequences\n\n{:.0} s, {:.1} sequences/s.\n\n{}",
            time.as_secs_f64(),
            tally.sequences as f64 / time.as_secs_f64(),
            report::sequences(tally),
        );
    }
    if let Some(found) = &tally.counterexample {
        let _ = write!(text, "\n```text\nVIOLATED: {}```\n", report::counterexample(arguments.seed, found));
    }
    text
}
