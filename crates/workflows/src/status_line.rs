//! One line on stderr that is overwritten, or, where stderr is no terminal, lines that stay.

use std::io::{IsTerminal, Write, stderr};
use std::time::{Duration, Instant};

use crate::progress_lines::Pace;

/// Interval between two texts of the line.
const INTERVAL: Duration = Duration::from_millis(100);

/// Line on stderr.
pub struct StatusLine {
    is_silent: bool,
    is_terminal: bool,
    written: Option<Instant>,
    pace: Pace,
}

impl StatusLine {
    /// Creates an empty line. A silent one has no messages either.
    pub fn new(is_silent: bool) -> Self {
        Self { is_silent, is_terminal: !is_silent && stderr().is_terminal(), written: None, pace: Pace::default() }
    }

    /// Replaces the text, at most ten times per second.
    pub fn show(&mut self, text: impl FnOnce() -> String) {
        if self.is_silent {
            return;
        }
        if !self.is_terminal {
            if self.pace.is_due(Instant::now()) {
                eprintln!("{}", text());
            }
            return;
        }
        if self.written.is_none_or(|written| written.elapsed() >= INTERVAL) {
            // Not being able to write a status is no reason to end a run.
            let _ = write!(stderr(), "\r\x1b[2K{}", text());
            let _ = stderr().flush();
            self.written = Some(Instant::now());
        }
    }

    /// Writes a line that stays.
    pub fn message(&mut self, text: &str) {
        self.clear();
        if !self.is_silent {
            eprintln!("{text}");
        }
    }

    /// Removes the text.
    pub fn clear(&mut self) {
        if self.written.take().is_some() {
            let _ = write!(stderr(), "\r\x1b[2K");
            let _ = stderr().flush();
        }
    }
}
