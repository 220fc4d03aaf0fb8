//! A file that only ever ends with a whole record.

use std::fs::File;
use std::io::{Error, Result, Seek, SeekFrom, Write};

/// Keeps what is written in memory until it is flushed, then appends it to a file and waits for the disk.
///
/// A writer of MCAP goes back to the beginning of a chunk to write its length. In the file a chunk appears with its length: a
/// process that is killed, or a computer without power, leaves whole chunks.
pub(super) struct WholeRecords {
    file: File,
    /// Size of the file [bytes].
    written: u64,
    /// What follows.
    pending: Vec<u8>,
    /// Position in `pending` at which the next bytes are written.
    position: usize,
}

impl WholeRecords {
    /// Appends to an empty file.
    pub fn new(file: File) -> Self {
        Self { file, written: 0, pending: Vec::new(), position: 0 }
    }
}

impl Write for WholeRecords {
    fn write(&mut self, bytes: &[u8]) -> Result<usize> {
        let overwritten = bytes.len().min(self.pending.len() - self.position);
        self.pending[self.position..self.position + overwritten].copy_from_slice(&bytes[..overwritten]);
        self.pending.extend_from_slice(&bytes[overwritten..]);
        self.position += bytes.len();
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<()> {
        self.file.write_all(&self.pending)?;
        self.file.sync_data()?;
        self.written += self.pending.len() as u64;
        self.pending.clear();
        self.position = 0;
        Ok(())
    }
}

impl Seek for WholeRecords {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        let end = self.written + self.pending.len() as u64;
        let target = match to {
            SeekFrom::Start(target) => Some(target),
            SeekFrom::End(offset) => end.checked_add_signed(offset),
            SeekFrom::Current(offset) => (self.written + self.position as u64).checked_add_signed(offset),
        };
        let target = target.filter(|target| (self.written..=end).contains(target));
        let target = target.ok_or_else(|| Error::other("what is in the file is not changed any more"))?;
        self.position = (target - self.written) as usize;
        Ok(target)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_grows_by_what_was_flushed() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("file");
        let mut records = WholeRecords::new(File::create(&path).expect("a file"));
        let content = || std::fs::read(&path).expect("a file");
        records.write_all(b"length?chunk").expect("memory");
        assert_eq!(content(), b"");
        records.seek(SeekFrom::Start(0)).expect("in memory");
        records.write_all(b"length5").expect("memory");
        records.seek(SeekFrom::End(0)).expect("in memory");
        records.write_all(b"!").expect("memory");
        records.flush().expect("written");
        assert_eq!(content(), b"length5chunk!");
        assert!(records.seek(SeekFrom::Start(3)).is_err());
        assert_eq!(records.stream_position().expect("the end"), 13);
    }
}
