//! Fuzzing of the messages of the protocol and of every file that users give to the program.
//!
//! `cargo build --release --workspace && target/release/fuzz --table results/fuzz.md`

use std::alloc::System;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use cap::Cap;
use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_tests::fuzz::campaign::{self, FormatResult, Plan, temporary_folder};
use twinstep_tests::fuzz::format::Format;
use twinstep_tests::fuzz::report;
use twinstep_tests::fuzz::worker::{self, Batch};

/// Limits the memory that reading an input may need.
#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// Change valid messages and files at random, and read them as the program does.
///
/// Every message of the protocol is decoded and converted as by its client or server. Every kind of file is read by the
/// functions behind the command line. A reader may refuse an input, but must not panic, overflow the stack, hang, or
/// need more memory than a constant plus a multiple of the input's length. Inputs that do are saved, and the exit code
/// is 1.
///
/// Input number N of a format depends only on the seed and N. Ctrl-C stops after the batches in progress and prints the
/// table of what was read.
///
/// Examples:
///   fuzz --inputs 2000                                 a short run of everything
///   fuzz --format step_request --inputs 10000000       one message
///   fuzz --replay target/fuzz/log_csv-1-77.bin         read a saved input again
#[derive(Parser)]
#[command(args_conflicts_with_subcommands = true, verbatim_doc_comment)]
struct Arguments {
    /// Number of inputs of each format of files. Default: 1000000. A tenth for zenoh_config, whose reader is Zenoh's.
    #[arg(long, value_name = "N")]
    inputs: Option<u64>,
    /// Number of inputs of all messages together. Default: --inputs for each, or 10000000.
    #[arg(long, value_name = "N")]
    messages: Option<u64>,
    /// Read only this format. May be given several times. A wrong name prints all.
    #[arg(long, value_name = "NAME")]
    format: Vec<String>,
    /// Seed of the inputs.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Number of worker processes at the same time.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=64))]
    threads: u16,
    /// Folder of saved inputs.
    #[arg(long, value_name = "DIR", default_value = "target/fuzz")]
    out: PathBuf,
    /// Write the table to this file, too.
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    /// Read one saved input. Its name begins with the name of its format.
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,
    #[command(subcommand)]
    role: Option<Role>,
}

#[derive(Subcommand)]
enum Role {
    /// Worker process: reads a batch and prints its result as JSON.
    #[command(hide = true)]
    Worker {
        #[arg(long)]
        format: String,
        #[arg(long)]
        folder: PathBuf,
        #[arg(long)]
        seed: u64,
        #[arg(long)]
        first: u64,
        #[arg(long)]
        count: u64,
        /// Prints the index of each input before it is read.
        #[arg(long)]
        each: bool,
    },
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match (&arguments.role, &arguments.replay) {
        (Some(role), _) => work(role).map(|()| true),
        (None, Some(file)) => replay(file),
        (None, None) => fuzz(&arguments),
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

fn named(name: &str) -> Result<Format, String> {
    let names = Format::all().into_iter().map(Format::name).collect::<Vec<_>>().join(", ");
    Format::named(name).ok_or_else(|| format!("there is no format `{name}`; possible: {names}"))
}

fn work(role: &Role) -> Result<(), Box<dyn std::error::Error>> {
    let Role::Worker { format, folder, seed, first, count, each } = role;
    // Ctrl-C reaches the whole process group; the program that started this worker waits for its result.
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::default())?;
    worker::store_panics();
    let batch = Batch { format: named(format)?, seed: *seed, first: *first, count: *count };
    let result = worker::run(&ALLOCATOR, batch, folder, |index| {
        if *each {
            println!("{index}");
        }
    });
    println!("{}", serde_json::to_string(&result)?);
    Ok(())
}

fn replay(file: &std::path::Path) -> Result<bool, Box<dyn std::error::Error>> {
    let name = file.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let format = named(name.split('-').next().unwrap_or_default())?;
    let (input, folder) = (std::fs::read(file)?, temporary_folder()?);
    let (outcome, memory) = worker::read_within_limit(&ALLOCATOR, format, &input, folder.path());
    let limit = format.memory_limit().of(input.len());
    println!("{} bytes as {}: {outcome:?}, {memory} bytes of memory of {limit}", input.len(), format.name());
    Ok(outcome.is_ok())
}

fn fuzz(arguments: &Arguments) -> Result<bool, Box<dyn std::error::Error>> {
    let formats = if arguments.format.is_empty() {
        Format::all()
    } else {
        arguments.format.iter().map(|name| named(name)).collect::<Result<_, _>>()?
    };
    let messages = formats.iter().filter(|format| format.is_message()).count().max(1) as u64;
    let of_files = arguments.inputs.unwrap_or(1_000_000);
    let of_messages = arguments.messages.or(arguments.inputs.map(|inputs| inputs * messages)).unwrap_or(10_000_000);
    let inputs = |format: Format| match format {
        Format::Wire(_) => of_messages.div_ceil(messages),
        Format::Zenoh => of_files.div_ceil(10),
        _ => of_files,
    };
    let plan = Plan {
        program: std::env::current_exe()?,
        formats: formats.into_iter().map(|format| (format, inputs(format))).collect(),
        seed: arguments.seed,
        threads: usize::from(arguments.threads),
        out: arguments.out.clone(),
    };
    let stop = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGINT, Arc::clone(&stop))?;
    let since = Instant::now();
    let results = run_with_progress(&plan, &stop)?;
    let table = report::table(&results, plan.seed, plan.threads, since.elapsed());
    std::io::stdout().write_all(table.as_bytes())?;
    if let Some(file) = &arguments.table {
        std::fs::write(file, &table)?;
    }
    Ok(results.iter().all(|result| result.findings.is_empty()))
}

fn run_with_progress(plan: &Plan, stop: &AtomicBool) -> Result<Vec<FormatResult>, Box<dyn std::error::Error>> {
    let style = ProgressStyle::with_template("{bar:30} {human_pos}/{human_len} inputs, {per_sec}, {eta} left: {msg}")?;
    let bar = ProgressBar::new(plan.formats.iter().map(|(_, inputs)| inputs).sum()).with_style(style);
    let results = campaign::run(plan, stop, |format, inputs| {
        bar.set_message(format.name());
        bar.inc(inputs);
    })?;
    bar.finish_and_clear();
    Ok(results)
}
