//! Logs as MCAP, or as rosbag2 writes them: reading and writing the robot's `/lowstate` and `/lowcmd`, one row per state.
//!
//! - [`messages`]: the messages of a file, and the metadata of a file that `Log::write` wrote.
//! - [`lengths`]: limits of the lengths in a file.
//! - [`rows`]: each state with the command in force.
//! - [`columns`]: the columns of these rows; [`base_state`]: those of the base; [`clock`]: times by the sender's clock.
//! - [`mod@read`], [`mod@write`]: a log from a file, and a file from a log.
//! - [`sqlite`]: the messages of a bag in the storage format `sqlite3`.
//! - [`recorder`]: a file from the messages of a robot while they arrive.

mod base_state;
mod clock;
mod columns;
mod lengths;
mod messages;
mod read;
mod recorder;
mod rows;
mod sqlite;
mod whole_records;
mod write;

use serde::{Deserialize, Serialize};

pub(crate) use lengths::length_limit;
pub(crate) use read::read;
pub use recorder::{McapRecorder, RecordedTopic};
pub(crate) use write::{unsupported_columns, write};

/// Topic with the start of each segment of each episode, in files that `Log::write` wrote.
const PART_TOPIC: &str = "/twinstep/part";
/// Name of the MCAP metadata record with `meta` and `columns` as JSON, in files that `Log::write` wrote.
const METADATA: &str = "twinstep_log";
/// Value of a missing foot force, which no sensor reports.
const NO_FORCE: i16 = i16::MIN;
/// Value of a missing temperature, which no sensor reports.
const NO_TEMPERATURE: u8 = u8::MAX;
/// Nanoseconds in a second.
const NANOSECONDS: f64 = 1e9;

/// Start of a segment of an episode.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct SegmentStart {
    segment: u32,
    episode: u32,
    /// Time of the first row in the log [s].
    t: f64,
}
