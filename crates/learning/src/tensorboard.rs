//! Event files of TensorBoard: scalars over environment steps.
//!
//! A file is a sequence of records: length, checksum of the length, an `Event` in Protocol Buffers, checksum of the event
//! (TensorFlow's `record_writer.h` and `event.proto`).

use std::fs::File;
use std::io::{Result, Write};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// An event file that is being written.
#[derive(Debug)]
pub struct EventFile(File);

impl EventFile {
    /// Creates a file in `folder`, whose name TensorBoard recognises.
    pub fn create(folder: &Path) -> Result<Self> {
        let seconds = now().floor() as u64;
        let file = File::create(folder.join(format!("events.out.tfevents.{seconds}.twinstep")))?;
        let mut events = Self(file);
        let mut event = header(0);
        // Field 3: version of the file.
        bytes(&mut event, 3, b"brain.Event:2");
        events.record(&event)?;
        Ok(events)
    }

    /// Writes scalars with their names.
    pub fn write(&mut self, env_steps: u64, scalars: &[(&str, f64)]) -> Result<()> {
        let mut summary = Vec::new();
        for (name, value) in scalars {
            let mut entry = Vec::new();
            bytes(&mut entry, 1, name.as_bytes());
            // Field 2, 32 bits: the value.
            entry.push(2 << 3 | 5);
            entry.extend_from_slice(&(*value as f32).to_le_bytes());
            bytes(&mut summary, 1, &entry);
        }
        let mut event = header(env_steps);
        bytes(&mut event, 5, &summary);
        self.record(&event)
    }

    fn record(&mut self, event: &[u8]) -> Result<()> {
        let len = (event.len() as u64).to_le_bytes();
        let record = [&len[..], &masked_crc(&len).to_le_bytes(), event, &masked_crc(event).to_le_bytes()].concat();
        self.0.write_all(&record)
    }
}

/// Returns the time since 1970 [s].
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// Returns an event with time and step.
fn header(env_steps: u64) -> Vec<u8> {
    let mut event = vec![1 << 3 | 1];
    event.extend_from_slice(&now().to_le_bytes());
    event.push(2 << 3);
    varint(&mut event, env_steps);
    event
}

fn varint(message: &mut Vec<u8>, mut number: u64) {
    while number >= 0x80 {
        message.push(number as u8 | 0x80);
        number >>= 7;
    }
    message.push(number as u8);
}

fn bytes(message: &mut Vec<u8>, field: u8, content: &[u8]) {
    message.push(field << 3 | 2);
    varint(message, content.len() as u64);
    message.extend_from_slice(content);
}

/// Returns the checksum of a record: CRC-32C, rotated and shifted.
fn masked_crc(content: &[u8]) -> u32 {
    crc32c(content).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// Returns the cyclic redundancy check of Castagnoli.
fn crc32c(content: &[u8]) -> u32 {
    let step = |crc: u32, byte: &u8| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| (crc >> 1) ^ (0x82f6_3b78 & (crc & 1).wrapping_neg()))
    };
    !content.iter().fold(u32::MAX, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksum_is_that_of_rfc_3720() {
        assert_eq!(crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
    }

    #[test]
    fn records_follow_each_other() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut events = EventFile::create(folder.path()).expect("a file");
        events.write(1000, &[("velocity_rms", 0.25)]).expect("written");
        let path = std::fs::read_dir(folder.path()).expect("a folder").next().expect("a file").expect("read").path();
        let content = std::fs::read(path).expect("read");
        let mut rest = &content[..];
        let mut records = Vec::new();
        while !rest.is_empty() {
            let len = u64::from_le_bytes(rest[..8].try_into().expect("eight bytes")) as usize;
            records.push(&rest[12..12 + len]);
            assert_eq!(masked_crc(&rest[12..12 + len]).to_le_bytes(), rest[12 + len..16 + len]);
            rest = &rest[16 + len..];
        }
        let contains = |record: &[u8], part: &[u8]| record.windows(part.len()).any(|window| window == part);
        assert_eq!(records.len(), 2);
        assert!(contains(records[1], b"velocity_rms") && contains(records[1], &0.25f32.to_le_bytes()));
    }
}
