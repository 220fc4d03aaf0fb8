//! Messages of a bag that rosbag2 recorded in the storage format `sqlite3` (`*.db3`).
//!
//! Tables `topics` (id, name, type, serialization_format) and `messages` (topic_id, timestamp [ns], data).

use std::path::Path;

use rusqlite::{Connection, OpenFlags};

use crate::LogError;

/// Largest message [bytes].
const MAX_MESSAGE: i64 = 1 << 20;

/// Entry of a file.
pub(super) enum Entry<'a> {
    Topic {
        id: u16,
        topic: String,
        kind: String,
        encoding: String,
    },
    /// Time of arrival [ns].
    Message {
        topic: u16,
        time: u64,
        data: &'a [u8],
    },
}

/// Gives all topics of a file and then its messages, in the order of arrival.
pub(super) fn read(file: &Path, mut take: impl FnMut(Entry) -> Result<(), LogError>) -> Result<(), LogError> {
    let failed = |cause: rusqlite::Error| LogError::Sqlite { file: file.into(), cause: cause.to_string() };
    // Without the flag a file that does not exist would be made.
    let bag = Connection::open_with_flags(file, OpenFlags::SQLITE_OPEN_READ_ONLY).map_err(failed)?;
    let mut topics = bag.prepare("SELECT id, name, type, serialization_format FROM topics").map_err(failed)?;
    let mut rows = topics.query([]).map_err(failed)?;
    while let Some(row) = rows.next().map_err(failed)? {
        let (id, topic): (i64, String) = (row.get(0).map_err(failed)?, row.get(1).map_err(failed)?);
        let (kind, encoding): (String, String) = (row.get(2).map_err(failed)?, row.get(3).map_err(failed)?);
        if let Ok(id) = u16::try_from(id) {
            take(Entry::Topic { id, topic, kind, encoding })?;
        }
    }
    // Longer messages are of other topics, or damage.
    let mut messages = bag
        .prepare("SELECT topic_id, timestamp, data FROM messages WHERE length(data) <= ?1 ORDER BY timestamp, id")
        .map_err(failed)?;
    let mut rows = messages.query([MAX_MESSAGE]).map_err(failed)?;
    while let Some(row) = rows.next().map_err(failed)? {
        let (id, time): (i64, i64) = (row.get(0).map_err(failed)?, row.get(1).map_err(failed)?);
        let data = row.get_ref(2).map_err(failed)?;
        if let (Ok(topic), Ok(time), Ok(data)) = (u16::try_from(id), u64::try_from(time), data.as_blob()) {
            take(Entry::Message { topic, time, data })?;
        }
    }
    Ok(())
}
