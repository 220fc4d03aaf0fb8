//! Progress where stderr is no terminal: lines that stay, more rarely the longer the work lasts.

use std::io::{IsTerminal, Write, stderr};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressDrawTarget, TermLike};

/// Columns of a line.
const WIDTH: u16 = 120;
/// Least time between two lines.
const LEAST_INTERVAL: Duration = Duration::from_secs(1);
/// Time between two lines, relative to the time since the first: a day makes 230 lines.
const SHARE: f64 = 0.05;

/// Returns where progress is shown on stderr.
pub fn target() -> ProgressDrawTarget {
    if stderr().is_terminal() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::term_like(Box::new(Lines::default()))
    }
}

/// Times of lines.
#[derive(Debug, Default)]
pub struct Pace {
    first: Option<Instant>,
    last: Option<Instant>,
}

impl Pace {
    /// Returns true if a line is due at this time, which is then that of the last line.
    pub fn is_due(&mut self, now: Instant) -> bool {
        let first = *self.first.get_or_insert(now);
        let interval = LEAST_INTERVAL.max(now.duration_since(first).mul_f64(SHARE));
        let is_due = self.last.is_none_or(|last| now.duration_since(last) >= interval);
        if is_due {
            self.last = Some(now);
        }
        is_due
    }
}

/// Writes each text as a line, if one is due.
#[derive(Debug, Default)]
struct Lines(Mutex<(String, Pace)>);

impl TermLike for Lines {
    fn width(&self) -> u16 {
        WIDTH
    }

    fn move_cursor_up(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }

    fn move_cursor_down(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }

    fn move_cursor_right(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }

    fn move_cursor_left(&self, _: usize) -> std::io::Result<()> {
        Ok(())
    }

    fn write_line(&self, text: &str) -> std::io::Result<()> {
        self.write_str(text)
    }

    fn write_str(&self, text: &str) -> std::io::Result<()> {
        self.0.lock().expect("no panic").0.push_str(text);
        Ok(())
    }

    fn clear_line(&self) -> std::io::Result<()> {
        Ok(())
    }

    fn flush(&self) -> std::io::Result<()> {
        let (text, pace) = &mut *self.0.lock().expect("no panic");
        let text = std::mem::take(text);
        if !text.trim().is_empty() && pace.is_due(Instant::now()) {
            // Not being able to write progress is no reason to end the work.
            let _ = writeln!(stderr(), "{}", text.trim_end());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_a_second_apart_and_rarer_later() {
        let start = Instant::now();
        let mut pace = Pace::default();
        let mut is_due = |millis: u64| pace.is_due(start + Duration::from_millis(millis));
        assert!(is_due(0) && !is_due(900) && is_due(1000) && is_due(2500));
        // After 100 s a line every 5 s.
        assert!(is_due(100_000) && !is_due(104_000) && is_due(106_000));
    }
}
