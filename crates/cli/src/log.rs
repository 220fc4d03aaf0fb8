//! `twinstep log`: describes or converts a measured log.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;
use twinstep_logs::{ColumnMap, Log, LogError, LogSummary, overwritten_file};

use crate::exit::{CommandResult, Failure, input, other};

/// Describe a measured log, or convert it.
///
/// A log is a folder with a data file and meta.json, or the data file itself: data.csv, data.csv.gz or data.parquet
/// with meta.json in the same folder (walk.json for walk.csv). It may also be a recording of the robot's topics /lowstate and
/// /lowcmd, in any namespace: an MCAP file, or a folder of rosbag2 with its parts (*.mcap, *.db3). A recording needs no
/// meta.json; an optional one contains the mounting of the base.
///
/// The description has channels with units and empty cells; rate, jitter and gaps; segments; for each joint the range
/// of position, speed and torque and the distance to its limits; falls; and for each effect of the catalogue whether it
/// is identifiable from the log (yes, weak, no) and why. docs/logs.md explains the columns and meta.json.
///
/// With --convert it writes the log in the format of the given file name instead. CSV and Parquet keep everything. MCAP
/// keeps the fields of the robot's messages (no `pos_*`, `vel_*`, `contact_*`), in single precision.
///
/// Examples: `twinstep log data/go2_air_chirp` and `twinstep log robot.mcap --convert walk.parquet`
#[derive(clap::Args)]
pub struct Args {
    /// Measured log: a data file, or a folder that contains one.
    log: PathBuf,
    /// Read columns that have other names or units, as this map says (TOML): a line `q_FL_hip = { column = "pos0", unit = "deg" }`
    /// for each, or with a star for several, `"dq_*" = { column = "vel_*", unit = "rpm" }` (docs/logs.md).
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
    /// Write the log to this file: *.parquet, *.csv, *.csv.gz or *.mcap, or a folder, which gets data.parquet and
    /// meta.json.
    #[arg(long, value_name = "FILE")]
    convert: Option<PathBuf>,
    /// Print the description as one JSON object.
    #[arg(long)]
    json: bool,
}

/// The output would overwrite a file of the input log.
#[derive(Debug, thiserror::Error)]
#[error("`--convert {}` would replace `{}`, which belongs to the log itself\n  name another file or folder", .to.display(), .of_log.display())]
struct SameFile {
    to: PathBuf,
    of_log: PathBuf,
}

/// Output of `--json`.
#[derive(Serialize)]
struct Report<'a> {
    log: &'a Path,
    #[serde(flatten)]
    description: LogSummary,
    #[serde(skip_serializing_if = "Option::is_none")]
    converted: Option<Converted<'a>>,
}

/// Result of a conversion.
#[derive(Serialize)]
struct Converted<'a> {
    to: &'a Path,
    rows: usize,
    /// Columns that the format does not support.
    left_out: Vec<String>,
}

/// Describes or converts the log.
pub fn run(args: &Args) -> CommandResult {
    let map = args.map.as_ref().map_or_else(|| Ok(ColumnMap::default()), ColumnMap::read).map_err(input)?;
    let log = open(&args.log, &map).map_err(input)?;
    let converted = args.convert.as_deref().map(|to| convert(&log, &args.log, to)).transpose()?;
    if args.json {
        let report = Report { log: &args.log, description: log.describe(), converted };
        return print(&format!("{}\n", serde_json::to_string(&report).map_err(other)?));
    }
    match converted {
        Some(converted) => print(&conversion_summary(&converted, &log)),
        None => print(&format!("{}\n{}", args.log.display(), log.describe())),
    }
}

/// Writes to stdout. A pipe that the reader closed, as `head` does, is not an error.
fn print(text: &str) -> CommandResult {
    match std::io::stdout().write_all(text.as_bytes()) {
        Err(cause) if cause.kind() != ErrorKind::BrokenPipe => Err(other(cause)),
        _ => Ok(()),
    }
}

/// Returns a summary of the conversion.
fn conversion_summary(converted: &Converted<'_>, log: &Log) -> String {
    let mut lines = vec![format!("wrote {} ({} rows)", converted.to.display(), converted.rows)];
    if !converted.left_out.is_empty() {
        lines.push(format!("omitted, not supported by the format: {}", converted.left_out.join(", ")));
    }
    if !log.ignored().is_empty() {
        lines.push(format!("omitted, not a column of a log: {}", log.ignored().join(", ")));
    }
    lines.extend(log.read_warnings().iter().map(|note| format!("note: {note}")));
    lines.join("\n") + "\n"
}

/// Opens a measured log, or a motion file, which has no measurements, or a recording of states without commands.
fn open(path: &Path, map: &ColumnMap) -> Result<Log, LogError> {
    let nothing_measured = |motion: &Log| motion.joints().iter().all(|joint| motion.q(joint).is_none());
    let nothing_commanded = |states: &Log| states.joints().iter().all(|joint| states.q_cmd(joint).is_none());
    let motion = || Log::open_commands(path).ok().filter(nothing_measured);
    let states = || Log::open_states(path, map).ok().filter(nothing_commanded);
    Log::open_mapped(path, map).or_else(|error| motion().or_else(states).ok_or(error))
}

fn convert<'a>(log: &Log, from: &Path, to: &'a Path) -> Result<Converted<'a>, Failure> {
    if let Some(of_log) = overwritten_file(from, to).map_err(input)? {
        return Err(input(SameFile { to: to.to_owned(), of_log }));
    }
    log.write(to).map_err(input)?;
    Ok(Converted { to, rows: log.rows(), left_out: log.unsupported_columns(to) })
}
