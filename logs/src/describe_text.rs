//! A description as short text for a terminal.

use std::fmt::{self, Display, Formatter};

use crate::Base;
use crate::describe::{ChannelDescription, Description, Excitation, SpeedSource, Timing};

impl Display for Description {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        writeln!(out, "{} rows, {:.2} s", self.rows, self.duration_s)?;
        self.timing.fmt(out)?;
        section(out, "segments", &self.segments, |segment| {
            let base = match segment.base {
                Base::Fixed => "fixed",
                Base::Floating => "floating",
            };
            let parts = if segment.parts == 1 { String::new() } else { format!(" in {} parts", segment.parts) };
            format!("{:<14} base {base}, {} rows, {:.2} s{parts}", segment.name, segment.rows, segment.duration_s)
        })?;
        section(out, "channels", &self.channels, channel)?;
        section(out, "absent", &self.absent, |absence| format!("{:<14} {}", absence.quantity, absence.cost))?;
        section(out, "joints", &self.joints, excitation)?;
        section(out, "ignored columns", &self.ignored, String::clone)?;
        section(out, "notes", &self.notes, String::clone)
    }
}

impl Display for Timing {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        let (Some(rate), Some(std), Some(jitter)) = (self.rate_hz, self.step_std_s, self.jitter_p99_s) else {
            return writeln!(out, "stated {} Hz; no two rows to measure it", self.stated_rate_hz);
        };
        let (std, jitter) = (std * 1e3, jitter * 1e3);
        write!(out, "{rate:.1} Hz (stated {}), ", self.stated_rate_hz)?;
        write!(out, "steps: σ {std:.3} ms, 99 % within {jitter:.3} ms of the median, ")?;
        match self.largest_gap_s {
            Some(largest) if self.gaps == 1 => writeln!(out, "one gap of {:.1} ms", largest * 1e3),
            Some(largest) => writeln!(out, "{} gaps, the largest {:.1} ms", self.gaps, largest * 1e3),
            None => writeln!(out, "no gap"),
        }
    }
}

/// A title and one indented line an item; nothing without items.
fn section<T>(out: &mut Formatter<'_>, title: &str, items: &[T], line: impl Fn(&T) -> String) -> fmt::Result {
    if items.is_empty() {
        return Ok(());
    }
    writeln!(out, "{title}")?;
    items.iter().try_for_each(|item| writeln!(out, "  {}", line(item)))
}

fn channel(channel: &ChannelDescription) -> String {
    let columns = if channel.columns == 1 { "1 column" } else { &format!("{} columns", channel.columns) };
    let unit = if channel.unit.is_empty() { String::new() } else { format!(" [{}]", channel.unit) };
    let missing = match channel.missing_cells {
        0 => String::new(),
        1 => ", 1 cell empty".to_owned(),
        count => format!(", {count} cells empty"),
    };
    format!("{:<14} {columns}{unit}{missing}", channel.quantity)
}

fn excitation(joint: &Excitation) -> String {
    let speed = joint.speed_max.map_or_else(String::new, |speed| {
        let derived = if joint.speed_from == SpeedSource::Derived { ", derived" } else { "" };
        format!(", up to {speed:.2} rad/s{derived}")
    });
    format!("{:<14} {:6.3} to {:6.3} rad{speed}", joint.joint, joint.q_min, joint.q_max)
}
