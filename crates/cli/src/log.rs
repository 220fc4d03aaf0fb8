//! `twinstep log`: a measured log described, or converted.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;
use twinstep_logs::{LogSummary, Log, LogError, overwritten_file};

use crate::exit::{Failure, CommandResult, input, other};

/// Describe a measured log, or convert it.
///
/// A log is a folder with a data file and meta.json, or the data file itself: data.csv, data.csv.gz or data.parquet with
/// meta.json beside it (walk.csv may have walk.json), or an MCAP recording of the robot's own /lowstate and /lowcmd
/// (also rt/lowstate and rt/lowcmd; CDR), which needs no meta.json; one beside it says whether the base was held.
///
/// The description has channels with units and empty cells; rate, jitter and gaps; segments; for each joint how far, how
/// fast and how hard it moved and how near its limits; falls; and for each effect that a real robot may have whether this
/// log can tell of it (can, weakly, cannot) and why. Columns and meta.json are explained in docs/logs.md.
///
/// With --convert it writes the log anew instead: the format is that of the file's name. CSV and Parquet keep everything;
/// MCAP keeps what the robot's messages have (no `pos_*`, `vel_*`, `contact_*`), in single precision.
///
/// Examples: `twinstep log data/go2_air_chirp` and `twinstep log robot.mcap --convert walk.parquet`
#[derive(clap::Args)]
pub struct Args {
    /// The log: a data file, or a folder that holds one.
    log: PathBuf,
    /// Write the log to this file: *.parquet, *.csv, *.csv.gz or *.mcap, or a folder, which gets data.parquet and meta.json.
    #[arg(long, value_name = "FILE")]
    convert: Option<PathBuf>,
    /// Print the description as one JSON object.
    #[arg(long)]
    json: bool,
}

/// The new log would replace the old one.
#[derive(Debug, thiserror::Error)]
#[error("`--convert {}` would replace `{}`, which belongs to the log itself\n  name another file or folder", .to.display(), .of_log.display())]
struct SameFile {
    to: PathBuf,
    of_log: PathBuf,
}

/// What `--json` prints.
#[derive(Serialize)]
struct Report<'a> {
    log: &'a Path,
    #[serde(flatten)]
    description: LogSummary,
    #[serde(skip_serializing_if = "Option::is_none")]
    converted: Option<Converted<'a>>,
}

/// What was written.
#[derive(Serialize)]
struct Converted<'a> {
    to: &'a Path,
    rows: usize,
    /// Columns that the format cannot hold.
    left_out: Vec<String>,
}

/// Describes or converts.
pub fn run(args: &Args) -> CommandResult {
    let log = open(&args.log).map_err(input)?;
    let converted = args.convert.as_deref().map(|to| convert(&log, &args.log, to)).transpose()?;
    if args.json {
        let report = Report { log: &args.log, description: log.describe(), converted };
        return print(&format!("{}\n", serde_json::to_string(&report).map_err(other)?));
    }
    match converted {
        Some(converted) => print(&told(&converted, &log)),
        None => print(&format!("{}\n{}", args.log.display(), log.describe())),
    }
}

/// Writes to stdout, and minds no reader that has seen enough, as `head` has.
fn print(text: &str) -> CommandResult {
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(cause) if cause.kind() != ErrorKind::BrokenPipe => Err(other(cause)),
        _ => Ok(()),
    }
}

/// What was converted, in words.
fn told(converted: &Converted<'_>, log: &Log) -> String {
    let mut lines = vec![format!("wrote {} ({} rows)", converted.to.display(), converted.rows)];
    if !converted.left_out.is_empty() {
        lines.push(format!("left out, as the format has no place for it: {}", converted.left_out.join(", ")));
    }
    if !log.ignored().is_empty() {
        lines.push(format!("left out, as it is no column of a log: {}", log.ignored().join(", ")));
    }
    lines.extend(log.read_warnings().iter().map(|note| format!("note: {note}")));
    lines.join("\n") + "\n"
}

/// Reads a measured log, or a motion, in which nothing was measured.
fn open(path: &Path) -> Result<Log, LogError> {
    let nothing_measured = |motion: &Log| motion.joints().iter().all(|joint| motion.q(joint).is_none());
    Log::open(path).or_else(|error| Log::open_commands(path).ok().filter(nothing_measured).ok_or(error))
}

fn convert<'a>(log: &Log, from: &Path, to: &'a Path) -> Result<Converted<'a>, Failure> {
    if let Some(of_log) = overwritten_file(from, to).map_err(input)? {
        return Err(input(SameFile { to: to.to_owned(), of_log }));
    }
    log.write(to).map_err(input)?;
    Ok(Converted { to, rows: log.rows(), left_out: log.unsupported_columns(to) })
}
