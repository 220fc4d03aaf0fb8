//! Summary of a log as text.

use std::fmt::{self, Display, Formatter};

use crate::excitation::{Excitation, SpeedSource, TorqueSource};
use crate::falls::Fall;
use crate::summary::{ChannelDescription, Identifiability, IdentifiabilityLevel, LogSummary, Timing};
use twinstep_model::BaseMount;

impl Display for LogSummary {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        writeln!(out, "{} rows, {:.2} s", self.rows, self.duration_s)?;
        self.timing.fmt(out)?;
        section(out, "segments", &self.segments, |segment| {
            let base = match segment.base {
                BaseMount::Fixed => "fixed",
                BaseMount::Floating => "floating",
            };
            let ranges =
                if segment.parts == 1 { String::new() } else { format!(" in {} contiguous ranges", segment.parts) };
            format!("{:<14} base {base}, {} rows, {:.2} s{ranges}", segment.name, segment.rows, segment.duration_s)
        })?;
        section(out, "channels", &self.channels, channel)?;
        section(out, "absent", &self.absent, |absence| format!("{:<14} {}", absence.quantity, absence.consequence))?;
        joints(out, &self.joints)?;
        if let Some(falls) = &self.falls {
            match falls.as_slice() {
                [] => writeln!(out, "falls\n  none")?,
                falls => section(out, "falls", falls, fall)?,
            }
        }
        section(out, "identifiability", &self.conclusions, conclusion)?;
        section(out, "problems", &self.problems, |problem| problem.text.clone())?;
        section(out, "ignored columns", &self.ignored, String::clone)?;
        section(out, "warnings", &self.warnings, String::clone)
    }
}

impl Display for Timing {
    fn fmt(&self, out: &mut Formatter<'_>) -> fmt::Result {
        let (Some(rate), Some(std), Some(half), Some(jitter), Some(most)) =
            (self.rate_hz, self.step_std_s, self.jitter_p50_s, self.jitter_p99_s, self.jitter_max_s)
        else {
            return writeln!(out, "stated {} Hz; not measured: no two rows are consecutive", self.stated_rate_hz);
        };
        let [std, half, jitter, most] = [std, half, jitter, most].map(|seconds| seconds * 1e3);
        write!(out, "{rate:.1} Hz (stated {}), ", self.stated_rate_hz)?;
        write!(out, "steps: σ {std:.3} ms; 50 % within {half:.3} ms of the median, 99 % within {jitter:.3} ms, ")?;
        write!(out, "all within {most:.3} ms; ")?;
        match self.largest_gap_s {
            Some(largest) if self.gaps == 1 => writeln!(out, "one gap of {:.1} ms", largest * 1e3),
            Some(largest) => writeln!(out, "{} gaps, the largest {:.1} ms", self.gaps, largest * 1e3),
            None => writeln!(out, "no gap"),
        }
    }
}

/// Writes a title and one indented line per item; nothing if there are no items.
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
    let quantum = channel.quantum.map_or(String::new(), |step| format!(", in steps of {}", significant(step)));
    format!("{:<14} {columns}{unit}{quantum}{missing}", channel.quantity)
}

/// Returns a number with three significant digits.
fn significant(value: f64) -> String {
    let decimals = (2 - value.abs().log10().floor() as i32).clamp(0, 12) as usize;
    format!("{value:.decimals$}")
}

/// Writes one line per joint, below two header lines.
fn joints(out: &mut Formatter<'_>, joints: &[Excitation]) -> fmt::Result {
    let derived = joints.iter().any(|joint| joint.speed_from == SpeedSource::Derived);
    let commanded =
        joints.iter().any(|joint| joint.torque_from == TorqueSource::Commanded && joint.torque_max.is_some());
    writeln!(
        out,
        "joints             position [rad]          speed [rad/s]        torque [N·m]     reversals   frequency"
    )?;
    writeln!(
        out,
        "                 low    high  to limit    RMS   peak  limit    RMS   peak  limit              [Hz]"
    )?;
    for joint in joints {
        let name = &joint.joint;
        write!(out, "  {name:<12} {:6.3}  {:6.3}  {}  ", joint.q_min, joint.q_max, number(joint.limit_distance, 8, 3))?;
        write!(
            out,
            "{} {}  {}",
            number(joint.speed_rms, 6, 2),
            number(joint.speed_max, 6, 2),
            percent(joint.speed_max, joint.speed_limit)
        )?;
        write!(
            out,
            " {} {}  {}",
            number(joint.torque_rms, 6, 2),
            number(joint.torque_max, 6, 2),
            percent(joint.torque_max, joint.torque_limit)
        )?;
        let band = joint.band_hz.map_or_else(|| "–".to_owned(), |[low, high]| format!("{low:.2}–{high:.2}"));
        writeln!(out, "  {:6}  {band:>10}", joint.reversals)?;
    }
    if derived {
        writeln!(out, "  speed is computed from position by finite differences")?;
    }
    if commanded {
        writeln!(out, "  torque is computed by the PD law from commands and measured positions; it was not measured")?;
    }
    Ok(())
}

fn number(value: Option<f64>, width: usize, decimals: usize) -> String {
    value.map_or_else(|| format!("{:>width$}", "–"), |value| format!("{value:width$.decimals$}"))
}

/// Returns the ratio of a value to its limit as text [%].
fn percent(reached: Option<f64>, limit: Option<f64>) -> String {
    reached
        .zip(limit)
        .map_or_else(|| "   – ".to_owned(), |(reached, limit)| format!("{:3.0} %", 100.0 * reached / limit))
}

fn fall(fall: &Fall) -> String {
    let tilt = fall.tilt_deg.map_or_else(String::new, |tilt| format!(", tilted by {tilt:.0}°"));
    let height = fall.height_m.map_or_else(String::new, |height| format!(", base at {height:.2} m"));
    format!("{:<14} at {:.2} s (row {}){tilt}{height}", fall.segment, fall.t, fall.row)
}

fn conclusion(conclusion: &Identifiability) -> String {
    let verdict = match conclusion.verdict {
        IdentifiabilityLevel::Identifiable => "yes",
        IdentifiabilityLevel::Weak => "weak",
        IdentifiabilityLevel::NotIdentifiable => "no",
    };
    format!("{:<20} {verdict:<5} {}", conclusion.effect, conclusion.reason)
}
