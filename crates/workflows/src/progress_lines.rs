//! How progress is shown on stderr. Where it is no terminal: lines that stay, more rarely the longer the work lasts.

use std::io::{IsTerminal, Write, stderr};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{HumanCount, ProgressDrawTarget, ProgressState, ProgressStyle, TermLike};

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

/// Returns the style of a template of `indicatif`, whose `per_sec` is a whole number above 10.
pub fn style(template: &str) -> ProgressStyle {
    let per_sec = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
        // The text is empty if it cannot be written.
        let _ = out.write_str(&rate(state.per_sec()));
    };
    ProgressStyle::with_template(template).expect("the template is valid").with_key("per_sec", per_sec)
}

fn rate(per_second: f64) -> String {
    if per_second < 10.0 {
        format!("{per_second:.2}/s")
    } else {
        format!("{}/s", HumanCount(per_second.round() as u64))
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
    fn rates_are_whole_numbers_above_ten() {
        assert_eq!([0.0417, 9.2, 62_512.9].map(rate), ["0.04/s", "9.20/s", "62,513/s"]);
    }

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
