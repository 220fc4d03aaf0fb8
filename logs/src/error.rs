//! What can be wrong with a log: what, where, and how to mend it.

use std::fmt;
use std::path::PathBuf;

use crate::CdrError;

/// One cell of a data file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CellLocation {
    /// The data file.
    pub file: PathBuf,
    /// The column's name.
    pub column: String,
    /// The data row, from 1; a header is not counted.
    pub row: usize,
    /// The line of a text file, from 1; the header is counted.
    pub line: Option<u64>,
}

impl fmt::Display for CellLocation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "`{}`, column `{}`, row {}", self.file.display(), self.column, self.row)?;
        self.line.map_or(Ok(()), |line| write!(formatter, " (line {line})"))
    }
}

/// Why a log cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// There is no data file.
    #[error(
        "no log is at `{path}`\n  \
         give a folder with meta.json and one of data.parquet, data.csv, data.csv.gz and data.mcap, or the data file itself"
    )]
    NoData {
        /// Where it was looked for.
        path: PathBuf,
    },
    /// A folder has, or would have, more than one data file.
    #[error(
        "`{folder}` would be ambiguous: it holds {found}\n  keep one of them, or name the data file itself",
        found = .found.join(" and ")
    )]
    SeveralDataFiles {
        /// The folder.
        folder: PathBuf,
        /// The data files' names.
        found: Vec<String>,
    },
    /// A data file's name ends in nothing that is known.
    #[error("the format of `{file}` is unknown\n  name it *.parquet, *.csv, *.csv.gz or *.mcap")]
    UnknownFormat {
        /// The file.
        file: PathBuf,
    },
    /// There is no description beside the data.
    #[error(
        "`{wanted}` is missing beside `{data}`\n  the least it says is {{\"rate_hz\": 200, \"tau_sensor\": \
         \"none\", \"segments\": [{{\"name\": \"walk\", \"base\": \"floating\"}}]}}"
    )]
    NoMeta {
        /// The data file.
        data: PathBuf,
        /// The description's expected place.
        wanted: PathBuf,
    },
    /// The system refused to read a file, or its compression is damaged.
    #[error("cannot read `{file}`: {cause}{}", hint_of_damage(.cause))]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's answer.
        cause: std::io::Error,
    },
    /// The system refused to write a file.
    #[error("cannot write `{file}`: {cause}")]
    Write {
        /// The file.
        file: PathBuf,
        /// The system's answer.
        cause: std::io::Error,
    },
    /// A file is no valid Parquet, or uses what this reader lacks.
    #[error("`{file}` is no whole Parquet file: {cause}\n  it may have been cut off or damaged: copy or write it anew")]
    Parquet {
        /// The file.
        file: PathBuf,
        /// The Parquet library's answer.
        cause: parquet::errors::ParquetError,
    },
    /// The description is no JSON, or has unknown, missing or wrongly typed keys.
    #[error("`{file}`: {cause}")]
    MetaSyntax {
        /// The description.
        file: PathBuf,
        /// Key, line and what is possible there.
        cause: serde_json::Error,
    },
    /// A value of the description is out of range.
    #[error("`{file}`: `{key}` = {value}, but it must be {expected}")]
    MetaValue {
        /// The description.
        file: PathBuf,
        /// The key.
        key: String,
        /// Its value.
        value: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// A row has another number of cells than the header.
    #[error(
        "`{file}`, row {row} (line {line}) has {cells} cells, but the header has {columns}\n  write an empty cell where nothing is known, and one comma fewer than columns"
    )]
    RaggedRow {
        /// The data file.
        file: PathBuf,
        /// The data row, from 1.
        row: usize,
        /// The line, from 1.
        line: u64,
        /// Cells in that row.
        cells: usize,
        /// Cells in the header.
        columns: usize,
    },
    /// A cell is text.
    #[error("{place}: `{text}` is not a number\n  leave a cell of an optional column empty where nothing is known")]
    NotANumber {
        /// Where.
        place: CellLocation,
        /// The cell.
        text: String,
    },
    /// A cell is empty in a column that needs every one.
    #[error(
        "{place} is empty or NaN, but it must be a finite number\n  leave the row out, or fill the cell with what was in force"
    )]
    MissingCell {
        /// Where.
        place: CellLocation,
    },
    /// A cell is infinite.
    #[error(
        "{place} is {value}, but it must be finite\n  leave a cell of an optional column empty where nothing is known"
    )]
    NotFinite {
        /// Where.
        place: CellLocation,
        /// The cell.
        value: f64,
    },
    /// `segment` or `episode` is no index.
    #[error("{place} is {value}, but it must be a whole number from 0\n  leave the column out where it never changes")]
    NotAnIndex {
        /// Where.
        place: CellLocation,
        /// The cell.
        value: f64,
    },
    /// Time stands still or runs backwards.
    #[error(
        "{place}: {t} s follows {before} s, but time must increase within a segment of an episode\n  \
         count `episode` up where the robot was re-placed"
    )]
    TimeNotIncreasing {
        /// Where.
        place: CellLocation,
        /// The cell [s].
        t: f64,
        /// The cell before it [s].
        before: f64,
    },
    /// A row's segment is not described.
    #[error(
        "{place}: segment {segment} is not in `segments` of the meta file, which has {described}, counted from 0\n  add {{\"name\": …, \"base\": \"fixed\" or \"floating\"}} to `segments`, or correct the column"
    )]
    UnknownSegment {
        /// Where.
        place: CellLocation,
        /// The cell.
        segment: u32,
        /// Number of described segments.
        described: usize,
    },
    /// A gain is negative.
    #[error(
        "{place}: a gain of {gain} is negative\n  kp [N·m/rad] and kd [N·m·s/rad] act as kp·(q_cmd − q) + kd·(dq_cmd − dq): change its sign"
    )]
    NegativeGain {
        /// Where.
        place: CellLocation,
        /// The cell.
        gain: f64,
    },
    /// The orientation is no unit quaternion.
    #[error(
        "{place}: the quaternion's norm is {norm:.4}, but it must be within 0.01 of 1\n  quat_w, quat_x, quat_y, quat_z turn the trunk's frame into the world's; leave the cells empty where it is unknown"
    )]
    QuaternionNorm {
        /// Where; the column is `quat_w`.
        place: CellLocation,
        /// The norm.
        norm: f64,
    },
    /// A column that every log needs is missing.
    #[error("`{file}` has no column `{column}` ({what}); its columns are {columns}{}", found_instead(.similar.as_deref(), .column))]
    MissingColumn {
        /// The data file.
        file: PathBuf,
        /// The missing column.
        column: String,
        /// What it holds.
        what: &'static str,
        /// The columns it has, shortened.
        columns: String,
        /// A column that may be meant.
        similar: Option<String>,
    },
    /// A joint's name is nearly one of the Go2's, as with a unit behind it.
    #[error(
        "`{file}`, column `{column}`: the Go2 has no joint `{joint}`\n  \
         call the column `{meant}`, in {unit}; columns carry no unit in their names"
    )]
    JointName {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
        /// The joint in its name.
        joint: String,
        /// The column that is meant.
        meant: String,
        /// Its unit.
        unit: &'static str,
    },
    /// An MCAP file is damaged.
    #[error(
        "`{file}` as MCAP: {cause}\n  it may have been cut off or damaged: `mcap doctor` and `mcap recover` tell more"
    )]
    Mcap {
        /// The file.
        file: PathBuf,
        /// The MCAP library's answer.
        cause: mcap::McapError,
    },
    /// An MCAP file lacks a topic that a log needs.
    #[error(
        "`{file}` has no message on {wanted}; its topics are {topics}\n  \
         record both /lowstate and /lowcmd (or rt/lowstate and rt/lowcmd): a log needs what was told beside what was done"
    )]
    McapTopic {
        /// The file.
        file: PathBuf,
        /// The topic.
        wanted: &'static str,
        /// The topics it has.
        topics: String,
    },
    /// The topic is the robot's, and its messages are not.
    #[error("`{file}`, topic `{topic}` has messages {found}, but they must be unitree_go/msg/{name} as cdr")]
    McapType {
        /// The file.
        file: PathBuf,
        /// The topic.
        topic: String,
        /// Type and encoding of its messages.
        found: String,
        /// What they should be.
        name: &'static str,
    },
    /// A message is not what its topic says.
    #[error(
        "`{file}`, topic `{topic}`, message {message}: {cause}\n  the robot's firmware or the recorder may use another version of the message"
    )]
    McapMessage {
        /// The file.
        file: PathBuf,
        /// The topic.
        topic: String,
        /// The message's number in its topic, from 1.
        message: usize,
        /// What is wrong with its bytes.
        cause: CdrError,
    },
    /// A number does not fit into the robot's messages.
    #[error(
        "{place}: {value} does not fit into the robot's message, which holds {range}\n  write Parquet or CSV instead"
    )]
    NotInMcap {
        /// Where, in the log to write.
        place: CellLocation,
        /// The cell.
        value: f64,
        /// What fits.
        range: &'static str,
    },
    /// The robot's messages have no place for a joint.
    #[error(
        "`{file}`: joint `{joint}` is none of the Go2's, so its messages have no place for it\n  write Parquet or CSV instead"
    )]
    NotAGo2Joint {
        /// The file to write.
        file: PathBuf,
        /// The joint.
        joint: String,
    },
    /// A joint lacks a column that every joint needs.
    #[error(
        "`{file}` has no column `{column}`, which the joint `{joint}` needs\n  \
         add it, or let `joints` of the meta file list the joints without `{joint}`"
    )]
    MissingJointColumn {
        /// The data file.
        file: PathBuf,
        /// The missing column.
        column: String,
        /// The joint.
        joint: String,
    },
    /// A joint has no gain.
    #[error(
        "`{file}` has no `{gain}` for the joint `{joint}`\n  \
         add a column `{gain}` or `{gain}_{joint}`, or `\"{gain}\"` to the meta file"
    )]
    NoGain {
        /// The data file.
        file: PathBuf,
        /// `kp` or `kd`.
        gain: &'static str,
        /// The joint.
        joint: String,
    },
    /// Two columns have one name.
    #[error("`{file}` has the column `{column}` twice; rename or remove one")]
    DuplicateColumn {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
    },
    /// A Parquet column holds no plain numbers.
    #[error("`{file}`, column `{column}` is {found}; store it as DOUBLE, FLOAT, INT32, INT64 or BOOLEAN")]
    ColumnType {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
        /// Its type.
        found: String,
    },
    /// A column is shorter or longer than `t`.
    #[error("`{file}`, column `{column}` has the length {rows}, but `t` has {expected}")]
    UnequalColumns {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
        /// Its rows.
        rows: usize,
        /// The rows of `t`.
        expected: usize,
    },
    /// There is no row.
    #[error("`{file}` has no rows; a log needs at least one under its header")]
    Empty {
        /// The data file.
        file: PathBuf,
    },
}

/// What to do about a file that ends inside its compression.
fn hint_of_damage(cause: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    match cause.kind() {
        InvalidData | InvalidInput | UnexpectedEof => "\n  it may have been cut off or damaged: copy or write it anew",
        _ => "",
    }
}

/// How to mend a file in which a needed column has another name.
fn found_instead(similar: Option<&str>, column: &str) -> String {
    similar.map_or_else(String::new, |similar| format!("\n  is it `{similar}`? call it `{column}`"))
}
