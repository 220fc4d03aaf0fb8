//! Errors of logs: what is wrong, where, and how to fix it.

use std::fmt;
use std::path::PathBuf;

use crate::CdrError;

/// Location of a cell in a data file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CellLocation {
    /// Data file.
    pub file: PathBuf,
    /// Name of the column.
    pub column: String,
    /// Data row, from 1, without the header.
    pub row: usize,
    /// Line of a text file, from 1, with the header.
    pub line: Option<u64>,
}

impl fmt::Display for CellLocation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "`{}`, column `{}`, row {}", self.file.display(), self.column, self.row)?;
        self.line.map_or(Ok(()), |line| write!(formatter, " (line {line})"))
    }
}

/// Reason why a log cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// There is no data file.
    #[error(
        "there is no log at `{path}`\n  \
         pass a folder with meta.json and one of data.parquet, data.csv, data.csv.gz and data.mcap, or a data file"
    )]
    NoData {
        /// Path of the log.
        path: PathBuf,
    },
    /// A folder has, or would have, several data files.
    #[error(
        "`{folder}` must have one data file, not {found}\n  keep one of them, or pass the path of the data file",
        found = .found.join(" and ")
    )]
    SeveralDataFiles {
        /// The folder.
        folder: PathBuf,
        /// Names of the data files.
        found: Vec<String>,
    },
    /// The folder of a new log has files already.
    #[error("`{folder}` is not empty\n  name a new folder: a log is not overwritten")]
    FolderNotEmpty {
        /// The folder.
        folder: PathBuf,
    },
    /// The extension of a data file is unknown.
    #[error(
        "the format of `{file}` is unknown\n  name it *.parquet, *.csv, *.csv.gz or *.mcap; docs/logs.md says how to \
         convert *.npz and *.db3"
    )]
    UnknownFormat {
        /// The file.
        file: PathBuf,
    },
    /// The metadata file is missing.
    #[error(
        "`{expected}`, the metadata of `{data}`, is missing\n  its minimal content is {{\"rate_hz\": 200, \
         \"tau_sensor\": \"none\", \"segments\": [{{\"name\": \"walk\", \"base\": \"floating\"}}]}}"
    )]
    NoMeta {
        /// The data file.
        data: PathBuf,
        /// Expected path of the metadata.
        expected: PathBuf,
    },
    /// A file cannot be read, or its compression is damaged.
    #[error("cannot read `{file}`: {cause}{}", hint_of_damage(.cause))]
    Read {
        /// The file.
        file: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write `{file}`: {cause}")]
    Write {
        /// The file.
        file: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// A file is not valid Parquet, or uses a feature that the reader does not support.
    #[error("`{file}` is not a valid Parquet file: {cause}\n  it may be truncated or damaged: copy or write it again")]
    Parquet {
        /// The file.
        file: PathBuf,
        /// Error of the Parquet library.
        cause: parquet::errors::ParquetError,
    },
    /// The metadata are not JSON, or have unknown or missing keys or values of the wrong type.
    #[error("`{file}`: {cause}")]
    MetaSyntax {
        /// The metadata file.
        file: PathBuf,
        /// Problem with key, line and expected values.
        cause: serde_json::Error,
    },
    /// A value of the metadata is out of range.
    #[error("`{file}`: `{key}` = {value}, but it must be {expected}")]
    MetaValue {
        /// The metadata file.
        file: PathBuf,
        /// The key.
        key: String,
        /// Value of the key.
        value: String,
        /// Allowed values.
        expected: &'static str,
    },
    /// The number of cells in a row differs from the header's.
    #[error(
        "`{file}`, row {row} (line {line}) has {cells} cells, but the header has {columns}\n  \
         write an empty cell for a missing value; a row has one comma less than columns"
    )]
    RaggedRow {
        /// The data file.
        file: PathBuf,
        /// Data row, from 1.
        row: usize,
        /// Line, from 1.
        line: u64,
        /// Number of cells in the row.
        cells: usize,
        /// Number of cells in the header.
        columns: usize,
    },
    /// A cell is text.
    #[error("{place}: `{text}` is not a number\n  a missing value in an optional column is an empty cell")]
    NotANumber {
        /// Location of the cell.
        place: CellLocation,
        /// Content of the cell.
        text: String,
    },
    /// A cell is empty in a column that must not have missing values.
    #[error(
        "{place} is empty or NaN, but it must be a finite number\n  \
         remove the row, or fill the cell with the value that was in force"
    )]
    MissingCell {
        /// Location of the cell.
        place: CellLocation,
    },
    /// A cell is infinite.
    #[error("{place} is {value}, but it must be finite\n  a missing value in an optional column is an empty cell")]
    NotFinite {
        /// Location of the cell.
        place: CellLocation,
        /// Content of the cell.
        value: f64,
    },
    /// `segment` or `episode` is not an index.
    #[error("{place} is {value}, but it must be a whole number from 0\n  omit the column if it is constant")]
    NotAnIndex {
        /// Location of the cell.
        place: CellLocation,
        /// Content of the cell.
        value: f64,
    },
    /// Time does not increase.
    #[error(
        "{place}: {t} s follows {before} s, but time must increase within a segment of an episode\n  \
         increment `episode` at every reset of the robot"
    )]
    TimeNotIncreasing {
        /// Location of the cell.
        place: CellLocation,
        /// Time of the row [s].
        t: f64,
        /// Time of the previous row [s].
        before: f64,
    },
    /// The segment of a row is not in the metadata.
    #[error(
        "{place}: segment {segment} is not in `segments` of the meta file, which has {described} entries, counted from \
         0\n  add {{\"name\": …, \"base\": \"fixed\" or \"floating\"}} to `segments`, or correct the column"
    )]
    UnknownSegment {
        /// Location of the cell.
        place: CellLocation,
        /// Content of the cell.
        segment: u32,
        /// Number of segments in the metadata.
        described: usize,
    },
    /// A gain is negative.
    #[error(
        "{place}: the gain {gain} is negative\n  kp [N·m/rad] and kd [N·m·s/rad] act as kp·(q_cmd − q) + kd·(dq_cmd − \
         dq): change its sign"
    )]
    NegativeGain {
        /// Location of the cell.
        place: CellLocation,
        /// Content of the cell.
        gain: f64,
    },
    /// The orientation is not a unit quaternion.
    #[error(
        "{place}: the quaternion's norm is {norm:.4}, but it must be within 0.01 of 1\n  quat_w, quat_x, quat_y, \
         quat_z rotate base coordinates into world coordinates; leave the cells empty if the orientation is unknown"
    )]
    QuaternionNorm {
        /// Location of the cell in `quat_w`.
        place: CellLocation,
        /// The norm.
        norm: f64,
    },
    /// A required column is missing.
    #[error("`{file}` has no column `{column}` ({what}); its columns are {columns}{}", found_instead(.similar.as_deref(), .column))]
    MissingColumn {
        /// The data file.
        file: PathBuf,
        /// The missing column.
        column: String,
        /// Content of the missing column.
        what: &'static str,
        /// Names of the file's columns, shortened.
        columns: String,
        /// Column that probably has this content.
        similar: Option<String>,
    },
    /// The name of a joint resembles one of the Go2's, for example with a unit appended.
    #[error(
        "`{file}`, column `{column}`: the Go2 has no joint `{joint}`\n  \
         rename the column to `{meant}`, in {unit}; column names do not contain units"
    )]
    JointName {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
        /// Joint in the name of the column.
        joint: String,
        /// Probable name of the column.
        meant: String,
        /// Unit of the column.
        unit: &'static str,
    },
    /// An MCAP file is damaged.
    #[error(
        "`{file}` is not a valid MCAP file: {cause}\n  \
         it may be truncated or damaged: check it with `mcap doctor`, repair it with `mcap recover`"
    )]
    Mcap {
        /// The file.
        file: PathBuf,
        /// Error of the MCAP library.
        cause: mcap::McapError,
    },
    /// An MCAP file lacks a required topic.
    #[error(
        "`{file}` has no message on {expected}; its topics are {topics}\n  \
         record both /lowstate and /lowcmd (or rt/lowstate and rt/lowcmd): a log needs measurements and commands"
    )]
    McapTopic {
        /// The file.
        file: PathBuf,
        /// The missing topic.
        expected: &'static str,
        /// Topics of the file.
        topics: String,
    },
    /// A bag in the format of SQLite cannot be read.
    #[error("`{file}` is not a bag of rosbag2 in the format sqlite3: {cause}")]
    Sqlite {
        /// The file.
        file: PathBuf,
        /// Error of SQLite.
        cause: String,
    },
    /// A map of columns is invalid, or does not fit the file.
    #[error("map of columns, `{file}`: {reason}")]
    ColumnMap {
        /// The map, or the file.
        file: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The messages of a topic of the robot have another type or encoding.
    #[error("`{file}`, topic `{topic}` has messages {found}, but they must be unitree_go/msg/{name} as cdr")]
    McapType {
        /// The file.
        file: PathBuf,
        /// The topic.
        topic: String,
        /// Type and encoding of the messages.
        found: String,
        /// Expected type.
        name: &'static str,
    },
    /// A message is not of the type of its topic.
    #[error(
        "`{file}`, topic `{topic}`, message {message}: {cause}\n  the robot's firmware or the recorder may use another version of the message"
    )]
    McapMessage {
        /// The file.
        file: PathBuf,
        /// The topic.
        topic: String,
        /// Number of the message in its topic, from 1.
        message: usize,
        /// Problem of the message.
        cause: CdrError,
    },
    /// A measured log of unknown gains cannot be written as MCAP.
    #[error(
        "cannot write `{file}`: the gains of the joint `{joint}` are unknown, and a command in MCAP has gains; write Parquet \
         or CSV, or state `kp` and `kd`"
    )]
    GainsNotInMcap {
        /// The file.
        file: PathBuf,
        /// The joint.
        joint: String,
    },
    /// A number is out of the range of the robot's messages.
    #[error("{place}: {value} is out of the range of the robot's message, {range}\n  write Parquet or CSV instead")]
    NotInMcap {
        /// Location of the cell in the log to write.
        place: CellLocation,
        /// Content of the cell.
        value: f64,
        /// Range of the message's field.
        range: &'static str,
    },
    /// The robot's messages do not contain a joint.
    #[error("`{file}`: the messages of the Go2 have no joint `{joint}`\n  write Parquet or CSV instead")]
    NotAGo2Joint {
        /// The file to write.
        file: PathBuf,
        /// The joint.
        joint: String,
    },
    /// A joint lacks a required column.
    #[error(
        "`{file}` has no column `{column}`, which the joint `{joint}` needs\n  \
         add it, or list the joints without `{joint}` in `joints` of the meta file"
    )]
    MissingJointColumn {
        /// The data file.
        file: PathBuf,
        /// The missing column.
        column: String,
        /// The joint.
        joint: String,
    },
    /// Two columns have the same name.
    #[error("`{file}` has the column `{column}` twice; rename or remove one")]
    DuplicateColumn {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
    },
    /// A Parquet column does not contain plain numbers.
    #[error("`{file}`, column `{column}` is {found}; store it as DOUBLE, FLOAT, INT32, INT64 or BOOLEAN")]
    ColumnType {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
        /// Type of the column.
        found: String,
    },
    /// A column is shorter or longer than `t`.
    #[error("`{file}`, column `{column}` has {rows} rows, but `t` has {expected}")]
    UnequalColumns {
        /// The data file.
        file: PathBuf,
        /// The column.
        column: String,
        /// Number of rows of the column.
        rows: usize,
        /// Number of rows of `t`.
        expected: usize,
    },
    /// The log has no rows.
    #[error("`{file}` has no rows; a log needs at least one")]
    Empty {
        /// The data file.
        file: PathBuf,
    },
}

/// Returns how to fix a file that is truncated or damaged.
fn hint_of_damage(cause: &std::io::Error) -> &'static str {
    use std::io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    match cause.kind() {
        InvalidData | InvalidInput | UnexpectedEof => "\n  it may be truncated or damaged: copy or write it again",
        _ => "",
    }
}

/// Returns how to fix a file in which a required column has another name.
fn found_instead(similar: Option<&str>, column: &str) -> String {
    similar.map_or_else(String::new, |similar| format!("\n  if it is `{similar}`, rename that to `{column}`"))
}
