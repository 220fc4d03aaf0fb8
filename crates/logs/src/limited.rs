//! Reads compressed data up to a limit, so that a small file cannot fill the memory.

use std::io::{Error, ErrorKind, Read, Result};

/// Reader that fails after a number of bytes.
pub(crate) struct Limited<R> {
    source: R,
    left: u64,
}

impl<R> Limited<R> {
    /// Returns a reader of at most `limit` bytes of `source`.
    pub fn new(source: R, limit: u64) -> Self {
        Self { source, left: limit }
    }
}

impl<R: Read> Read for Limited<R> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        let read = self.source.read(buffer)?;
        self.left = self.left.checked_sub(read as u64).ok_or_else(|| {
            Error::new(ErrorKind::InvalidData, "the compressed data is more than 1024 times as long as the file")
        })?;
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_within_the_limit_is_read_and_more_is_an_error() {
        let read = |limit| Limited::new(&b"12345"[..], limit).read_to_end(&mut Vec::new());
        assert_eq!(read(5).expect("five bytes"), 5);
        assert!(read(4).expect_err("too long").to_string().contains("1024 times"));
    }
}
