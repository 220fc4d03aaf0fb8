//! Measured logs of a robot: commands and measurements, row by row.
//!
//! A log is a data file (`data.parquet`, `data.csv` or `data.csv.gz`) with its metadata (`meta.json`) in the same
//! folder, or an MCAP file with the robot's messages. The main types are:
//!
//! - [`Log`]: a log in memory, read with [`Log::open`] or created with [`Log::new`], and written with [`Log::write`].
//!   Its contents are always validated.
//! - [`Meta`]: the metadata: rates, segments, location of the torque sensor, noise.
//! - [`LogError`]: a problem of a log with file, column and row, and how to fix it.
//! - [`LogSummary`]: contents, timing and joint motion of a log, the consequences of missing channels, and the effects
//!   that are identifiable.
//!
//! Terms: a *segment* is a named range of rows with one mount of the base; an *episode* is a range of rows between two
//! resets of the robot; a *motion file* is a log with command columns only.
//!
//! ```
//! use twinstep_logs::Log;
//!
//! let log = Log::open(concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/go2_air_chirp"))?;
//! for (segment, rows) in log.segments() {
//!     println!("{}: {} rows", segment.name, rows.len());
//! }
//! let (q, q_cmd) = (log.q("FL_thigh").expect("a Go2 joint"), log.q_cmd("FL_thigh").expect("a Go2 joint"));
//! println!("initial position error: {:.3} rad", q[0] - q_cmd[0]);
//! if log.tau_measured("FL_thigh").is_none() {
//!     println!("{}", log.describe());
//! }
//! # Ok::<(), twinstep_logs::LogError>(())
//! ```
//!
//! Reading begins in `read` and passes through these modules: `files` finds the files; `csv_table`, `parquet_table` or `mcap_file` reads the
//! cells; `columns` parses the column names; `check` validates the log.

mod check;
mod column_map;
mod columns;
mod contacts;
mod csv_table;
mod describe;
mod describe_text;
mod error;
mod excitation;
mod falls;
mod files;
mod go2_message;
mod identifiability;
mod limited;
mod log;
mod log_writer;
mod mcap_file;
mod meta;
mod missing_channels;
pub mod operating_conditions;
mod parquet_checks;
mod parquet_table;
mod problems;
mod read;
pub mod recording;
mod repeats;
pub mod replay;
mod resample;
mod statistics;
mod summary;
mod table;
mod write;

pub use column_map::ColumnMap;
pub use error::{CellLocation, LogError};
pub use excitation::{Excitation, SpeedSource, TorqueSource};
pub use falls::Fall;
pub use files::overwritten_file;
pub use log::Log;
pub use log_writer::LogWriter;
pub use mcap_file::{McapRecorder, RecordedTopic};
pub use meta::{Gain, Meta, Segment, TorqueSensor};
pub use problems::Problem;
pub use repeats::{Repeats, TooSlowForMotion};
pub use resample::ResampleError;
pub use summary::{
    ChannelDescription, Identifiability, IdentifiabilityLevel, LogSummary, MissingChannel, SegmentDescription, Timing,
};
pub use twinstep_unitree::CdrError;
