//! Where log messages go: to stderr, or to the operator's screen while it is shown.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::line_printer;

/// Number of messages that are kept for the screen.
const KEPT: usize = 100;

/// Messages of the screen, newest last; `None` while there is no screen.
static SCREEN: Mutex<Option<VecDeque<String>>> = Mutex::new(None);

/// Writer of log messages.
pub struct LogWriter;

/// Sends log messages to the screen until [`ScreenLog::end`].
pub struct ScreenLog(());

fn screen() -> MutexGuard<'static, Option<VecDeque<String>>> {
    SCREEN.lock().unwrap_or_else(PoisonError::into_inner)
}

#[expect(clippy::unused_self, reason = "messages are kept only between the beginning and the end of the value")]
impl ScreenLog {
    /// Begins to keep the messages.
    pub fn begin() -> Self {
        *screen() = Some(VecDeque::new());
        Self(())
    }

    /// Adds a message.
    pub fn add(&self, message: &str) {
        for line in message.lines() {
            keep(&mut screen(), line);
        }
    }

    /// Returns the messages, newest last.
    pub fn lines(&self) -> Vec<String> {
        screen().iter().flatten().cloned().collect()
    }
}

impl ScreenLog {
    /// Writes the messages to stderr, and later ones too.
    #[expect(clippy::unused_self, reason = "the messages were kept by this value")]
    pub fn end(&self) {
        let lines = screen().take();
        for line in lines.into_iter().flatten() {
            line_printer::print_log(format!("{line}\n").as_bytes());
        }
    }
}

fn keep(lines: &mut Option<VecDeque<String>>, line: &str) {
    if let Some(lines) = lines {
        lines.push_back(line.to_owned());
        while lines.len() > KEPT {
            lines.pop_front();
        }
    }
}

impl Write for LogWriter {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let mut lines = screen();
        if lines.is_none() {
            drop(lines);
            return if line_printer::print_log(bytes) { Ok(bytes.len()) } else { std::io::stderr().write(bytes) };
        }
        for line in without_colours(&String::from_utf8_lossy(bytes)).lines() {
            keep(&mut lines, line);
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        std::io::stderr().flush()
    }
}

/// Returns a text without the sequences `ESC [ … m` that colour it.
fn without_colours(text: &str) -> String {
    let mut parts = text.split("\x1b[");
    let first = parts.next().unwrap_or_default().to_owned();
    parts.fold(first, |text, part| text + part.split_once('m').map_or("", |(_, rest)| rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_go_to_the_screen_without_colours_while_it_is_shown() {
        let log = ScreenLog::begin();
        LogWriter.write_all(b"\x1b[2m2026-11-23\x1b[0m \x1b[33m WARN\x1b[0m late\n").expect("a message");
        log.add("ok arm");
        assert_eq!(log.lines(), ["2026-11-23  WARN late", "ok arm"]);
        (0..2 * KEPT).for_each(|number| log.add(&number.to_string()));
        assert_eq!((log.lines().len(), log.lines().last().map(String::as_str)), (KEPT, Some("199")));
    }
}
