//! A log in numbers: its size, its timing, what it holds, and how much its joints moved.

use serde::Serialize;
use twinstep_model::Joint;

use crate::absence::absent;
use crate::columns::{Column, QUANTITIES, Quantity};
use crate::conclusions::{Identifiability, conclusions};
use crate::excitation::{Excitation, excitation};
use crate::falls::{Fall, falls};
use crate::{BaseMount, Log, TorqueSensor};

/// What a log holds, for a person (`Display`) or a program (`Serialize`).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LogSummary {
    /// Number of rows.
    pub rows: usize,
    /// Recorded time, without the pauses between the parts of a log [s].
    pub duration_s: f64,
    /// When the rows were taken.
    pub timing: Timing,
    /// The segments that have rows, in the order of `meta.json`.
    pub segments: Vec<SegmentDescription>,
    /// What was recorded.
    pub channels: Vec<ChannelDescription>,
    /// What was not recorded, and what that costs.
    pub absent: Vec<MissingChannel>,
    /// How much each joint moved.
    pub joints: Vec<Excitation>,
    /// Where a robot with a floating base fell over; none where the log cannot tell.
    pub falls: Option<Vec<Fall>>,
    /// What the log can tell about each effect of the catalogue; empty for a motion.
    pub conclusions: Vec<Identifiability>,
    /// Columns of the file that were left out.
    pub ignored: Vec<String>,
    /// What is odd about the log and yet no error.
    pub warnings: Vec<String>,
}

/// When the rows of a log were taken; none where no segment has two rows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Timing {
    /// The rate that `meta.json` states [Hz].
    pub stated_rate_hz: f64,
    /// The reciprocal of the median step [Hz].
    pub rate_hz: Option<f64>,
    /// Standard deviation of the step [s].
    pub step_std_s: Option<f64>,
    /// What half of the steps differ by from the median at most [s].
    pub jitter_p50_s: Option<f64>,
    /// What 99 % of the steps differ by from the median at most [s].
    pub jitter_p99_s: Option<f64>,
    /// What every step differs by from the median at most [s].
    pub jitter_max_s: Option<f64>,
    /// Number of steps longer than 1.5 medians.
    pub gaps: usize,
    /// The longest of them [s].
    pub largest_gap_s: Option<f64>,
}

/// One segment of a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SegmentDescription {
    /// Its name.
    pub name: String,
    /// What the trunk could do.
    pub base: BaseMount,
    /// How often it was recorded: its parts without a break.
    pub parts: usize,
    /// Its rows.
    pub rows: usize,
    /// Its recorded time [s].
    pub duration_s: f64,
}

/// One quantity that a log holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ChannelDescription {
    /// The quantity, such as `tau_measured`.
    pub quantity: &'static str,
    /// Its unit; empty for none.
    pub unit: &'static str,
    /// Number of its columns.
    pub columns: usize,
    /// Number of empty cells in them.
    pub missing_cells: usize,
}

/// One quantity that a log lacks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MissingChannel {
    /// The quantity, such as `tau_measured`.
    pub quantity: &'static str,
    /// The conclusion that cannot be drawn.
    pub consequence: &'static str,
}

impl Log {
    /// Describes the log.
    pub fn describe(&self) -> LogSummary {
        let timing = self.timing();
        let mut description = LogSummary {
            rows: self.rows(),
            duration_s: self.duration_s(),
            segments: self.described_segments(),
            channels: self.described_channels(),
            absent: absent(self).into_iter().map(|(quantity, cost)| MissingChannel { quantity, consequence: cost }).collect(),
            joints: self.joints().iter().filter_map(|joint| excitation(self, joint)).collect(),
            falls: falls(self),
            conclusions: Vec::new(),
            ignored: self.ignored().to_vec(),
            warnings: self.notes(&timing),
            timing,
        };
        description.conclusions = conclusions(self, &description);
        description
    }

    fn timing(&self) -> Timing {
        const GAP: f64 = 1.5;
        let mut steps: Vec<f64> = self.differences(self.t()).map(|(_, step)| step).collect();
        steps.sort_by(f64::total_cmp);
        let median = quantile(&steps, 0.5);
        let mut jitter: Vec<f64> = steps.iter().map(|step| (step - median.unwrap_or(0.0)).abs()).collect();
        jitter.sort_by(f64::total_cmp);
        let gaps = steps.iter().filter(|step| median.is_some_and(|median| **step > GAP * median)).count();
        Timing {
            stated_rate_hz: self.meta().rate_hz,
            rate_hz: median.map(f64::recip),
            step_std_s: median.map(|_| standard_deviation(&steps)),
            jitter_p50_s: quantile(&jitter, 0.5),
            jitter_p99_s: quantile(&jitter, 0.99),
            jitter_max_s: jitter.last().copied(),
            gaps,
            largest_gap_s: steps.last().copied().filter(|_| gaps > 0),
        }
    }

    fn described_segments(&self) -> Vec<SegmentDescription> {
        let mut described: Vec<_> = (self.meta().segments.iter())
            .map(|segment| {
                let (name, base) = (segment.name.clone(), segment.base);
                SegmentDescription { name, base, parts: 0, rows: 0, duration_s: 0.0 }
            })
            .collect();
        for (_, rows) in self.segments() {
            let segment = &mut described[self.segment()[rows.start] as usize];
            segment.parts += 1;
            segment.rows += rows.len();
            segment.duration_s += self.t()[rows.end - 1] - self.t()[rows.start];
        }
        described.retain(|segment| segment.rows > 0);
        described
    }

    fn described_channels(&self) -> Vec<ChannelDescription> {
        let described = |quantity: &'static Quantity| {
            let cells: Vec<_> = self
                .channels()
                .filter(|(name, _)| Column::parse(name).is_some_and(|column| column.quantity == quantity))
                .map(|(_, cells)| cells)
                .collect();
            (!cells.is_empty()).then(|| ChannelDescription {
                quantity: quantity.name,
                unit: quantity.unit,
                columns: cells.len(),
                missing_cells: cells.iter().copied().flatten().filter(|cell| cell.is_nan()).count(),
            })
        };
        QUANTITIES.iter().filter_map(described).collect()
    }

    fn notes(&self, timing: &Timing) -> Vec<String> {
        const TOLERANCE: f64 = 0.05;
        // No joint of a Go2 turns that far; degrees do.
        const MOST: f64 = 7.0;
        let mut notes = self.read_warnings().to_vec();
        if let Some(rate) = timing.rate_hz
            && (rate / timing.stated_rate_hz - 1.0).abs() > TOLERANCE
        {
            notes.push(format!("rows come at {rate:.1} Hz, but the meta file says {} Hz", timing.stated_rate_hz));
        }
        let torque = self.joints().iter().any(|joint| self.tau_measured(joint).is_some());
        if torque && self.meta().tau_sensor == TorqueSensor::None {
            notes.push(
                "there is tau_measured, but by the meta file's `tau_sensor` no torque was measured: it is not compared"
                    .to_owned(),
            );
        }
        if !torque && self.meta().tau_sensor != TorqueSensor::None {
            notes.push("the meta file names a `tau_sensor`, but there is no tau_measured".to_owned());
        }
        for quantity in ["q", "q_cmd"] {
            let far = |joint: &&Joint| {
                let cells = self.channel(&format!("{quantity}_{joint}"));
                cells.is_some_and(|cells| cells.iter().any(|cell| cell.abs() > MOST))
            };
            if let Some(joint) = Joint::ALL.iter().find(far) {
                notes.push(format!(
                    "{quantity}_{joint} goes beyond {MOST} rad: is it in degrees? Positions are in radians"
                ));
            }
        }
        notes
    }

    /// The steps of a channel from each row to the next in the same part of the log, with the earlier row.
    fn differences(&self, channel: &[f64]) -> impl Iterator<Item = (usize, f64)> {
        self.segments().flat_map(|(_, rows)| rows.start..rows.end - 1).map(|row| (row, channel[row + 1] - channel[row]))
    }
}

/// The largest number; NaN does not count.
pub(crate) fn largest(values: impl Iterator<Item = f64>) -> Option<f64> {
    values.filter(|value| !value.is_nan()).reduce(f64::max)
}

/// A quantile of sorted numbers, the nearest of them.
pub(crate) fn quantile(sorted: &[f64], fraction: f64) -> Option<f64> {
    let place = (fraction * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(place).copied()
}

fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}
