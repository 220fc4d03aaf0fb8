//! Measured logs of a robot: what it was told and what it did, row by row.
//!
//! A log is a data file (`data.parquet`, `data.csv` or `data.csv.gz`) and a description beside it (`meta.json`), or an
//! MCAP file with the robot's own messages. Four types carry the crate:
//!
//! - [`Log`] is a log in memory, read with [`Log::open`] or made with [`Log::new`], and written with [`Log::write`].
//!   Whatever way it came, everything in it is checked, so that nothing later has to ask.
//! - [`Meta`] is its description: rates, segments, where the torque was measured, noise.
//! - [`LogError`] says what is wrong with a log, in which file, column and row, and how to mend it.
//! - [`Description`] says what a log holds, how regular its timing is, how far its joints moved, and which conclusions
//!   the channels it lacks will cost.
//!
//! ```
//! use twinstep_logs::Log;
//!
//! let log = Log::open(concat!(env!("CARGO_MANIFEST_DIR"), "/../data/go2_air_chirp"))?;
//! for (segment, rows) in log.segments() {
//!     println!("{}: {} rows", segment.name, rows.len());
//! }
//! let (q, q_cmd) = (log.q("FL_thigh").expect("this robot's joint"), log.q_cmd("FL_thigh").expect("the same"));
//! println!("it starts {:.3} rad from its command", q[0] - q_cmd[0]);
//! if log.tau_measured("FL_thigh").is_none() {
//!     println!("{}", log.describe());
//! }
//! # Ok::<(), twinstep_logs::LogError>(())
//! ```
//!
//! Inside, a file goes through `files` (which files?), `csv_table`, `parquet_table` or `mcap_file` (which cells?), `columns` (which
//! names mean something?) and `check` (is it a log?).

mod absence;
mod cdr;
mod check;
mod columns;
mod conclusions;
mod csv_table;
mod describe;
mod describe_text;
mod error;
mod excitation;
mod falls;
mod files;
mod go2_message;
mod log;
mod mcap_file;
mod meta;
mod parquet_table;
mod table;
mod write;

pub use cdr::CdrError;
pub use conclusions::{Identifiability, IdentifiabilityLevel};
pub use describe::{MissingChannel, ChannelDescription, LogSummary, SegmentDescription, Timing};
pub use error::{LogError, CellLocation};
pub use excitation::{Excitation, SpeedSource, TorqueSource};
pub use falls::Fall;
pub use files::overwritten_file;
pub use log::Log;
pub use meta::{BaseMount, Gain, Meta, Segment, TorqueSensor};
