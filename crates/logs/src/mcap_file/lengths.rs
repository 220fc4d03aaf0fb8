//! Lengths in an MCAP file, checked before memory of these lengths is reserved.

use mcap::McapError;
use mcap::records::op;

/// Longest piece that is read from the file at once [bytes]. A record that claims to be long is read in pieces, so that
/// no more memory is reserved than the file has bytes.
pub(crate) const MAX_READ: usize = 64 << 10;
/// Largest length of a chunk or record [bytes].
const MAX_LENGTH: u64 = 1 << 30;
/// Length of a chunk that is accepted in a file of any length [bytes].
const MIN_LENGTH: u64 = 16 << 20;
/// Largest ratio of the length of a chunk to that of its compressed file.
const MAX_COMPRESSION: u64 = 1024;

/// Returns the limit of the length of chunks and records in a file of this length [bytes]. Longer ones are damage.
pub(crate) fn length_limit(file_length: u64) -> usize {
    file_length.saturating_mul(MAX_COMPRESSION).clamp(MIN_LENGTH, MAX_LENGTH) as usize
}

/// Returns true if records with this opcode belong to a log.
pub(crate) fn is_used(opcode: u8) -> bool {
    matches!(opcode, op::SCHEMA | op::CHANNEL | op::MESSAGE | op::METADATA)
}

/// Checks that the texts and maps of a record are not longer than the record.
///
/// The parser reserves memory for a text before it reads it.
pub(crate) fn check_texts(opcode: u8, record: &[u8]) -> Result<(), McapError> {
    let fits = match opcode {
        op::SCHEMA => texts(record.get(2..), 2).is_some(),
        op::CHANNEL => texts(record.get(4..), 2).is_some_and(map_fits),
        op::METADATA => texts(Some(record), 1).is_some_and(map_fits),
        _ => true,
    };
    if fits { Ok(()) } else { Err(McapError::UnexpectedEoc) }
}

/// Returns what follows `count` texts, or `None` if one is longer than the rest of the record.
fn texts(record: Option<&[u8]>, count: usize) -> Option<&[u8]> {
    (0..count).try_fold(record?, |rest, _| {
        let (length, rest) = rest.split_first_chunk::<4>()?;
        rest.get(u32::from_le_bytes(*length) as usize..)
    })
}

fn map_fits(record: &[u8]) -> bool {
    let Some((length, rest)) = record.split_first_chunk::<4>() else { return false };
    let Some(mut entries) = rest.get(..u32::from_le_bytes(*length) as usize) else { return false };
    while !entries.is_empty() {
        match texts(Some(entries), 2) {
            Some(rest) => entries = rest,
            None => return false,
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
    }

    #[test]
    fn text_that_is_longer_than_its_record_is_refused() {
        let map = text(&String::from_utf8([text("key"), text("value")].concat()).expect("ASCII"));
        let channel = [vec![0; 4], text("/lowstate"), text("cdr"), map.clone()].concat();
        let metadata = [text("twinstep_log"), map].concat();
        let schema = [vec![0; 2], text("LowState"), text("ros2msg"), text("")].concat();
        for (opcode, record) in [(op::CHANNEL, channel), (op::METADATA, metadata), (op::SCHEMA, schema)] {
            assert!(check_texts(opcode, &record).is_ok());
            let mut longer = record.clone();
            // The most significant byte of the length of the first text.
            let first = record.iter().position(|byte| *byte != 0).expect("a length");
            longer[first + 3] = 0x7f;
            assert!(check_texts(opcode, &longer).is_err(), "opcode {opcode}");
        }
    }

    #[test]
    fn limit_is_proportional_to_the_file() {
        assert_eq!([0, 1 << 17, 1 << 40].map(length_limit), [16 << 20, 128 << 20, 1 << 30]);
    }
}
