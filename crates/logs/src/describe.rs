//! Summary of a log: size, timing, contents and motion of the joints.

use serde::Serialize;
use twinstep_model::{BaseMount, Joint};

use crate::columns::{Column, QUANTITIES, Quantity};
use crate::excitation::{Excitation, excitation};
use crate::falls::{Fall, falls};
use crate::identifiability::{Identifiability, conclusions};
use crate::missing_channels::absent;
use crate::{Log, TorqueSensor};

/// Summary of a log, as text (`Display`) or data (`Serialize`).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LogSummary {
    /// Number of rows.
    pub rows: usize,
    /// Recorded time, without the pauses between contiguous ranges of rows [s].
    pub duration_s: f64,
    /// Timing of the rows.
    pub timing: Timing,
    /// Segments with rows, in the order of `meta.json`.
    pub segments: Vec<SegmentDescription>,
    /// Recorded quantities.
    pub channels: Vec<ChannelDescription>,
    /// Quantities that were not recorded, and the consequences.
    pub absent: Vec<MissingChannel>,
    /// Excitation of each joint.
    pub joints: Vec<Excitation>,
    /// Falls of a robot with a floating base; `None` if the log has neither orientation nor height.
    pub falls: Option<Vec<Fall>>,
    /// Identifiability of each effect of the catalogue; empty for a motion file.
    pub conclusions: Vec<Identifiability>,
    /// Ignored columns of the file.
    pub ignored: Vec<String>,
    /// Warnings about the log.
    #[serde(rename = "notes")]
    pub warnings: Vec<String>,
}

/// Timing of the rows of a log. Values are `None` if no two rows are consecutive.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Timing {
    /// Nominal rate in `meta.json` [Hz].
    pub stated_rate_hz: f64,
    /// Reciprocal of the median time step [Hz].
    pub rate_hz: Option<f64>,
    /// Standard deviation of the time step [s].
    pub step_std_s: Option<f64>,
    /// Median of the absolute difference of a time step from the median step [s].
    pub jitter_p50_s: Option<f64>,
    /// 99 % quantile of the absolute difference of a time step from the median step [s].
    pub jitter_p99_s: Option<f64>,
    /// Maximum of the absolute difference of a time step from the median step [s].
    pub jitter_max_s: Option<f64>,
    /// Number of gaps: time steps longer than 1.5 times the median.
    pub gaps: usize,
    /// Longest gap [s].
    pub largest_gap_s: Option<f64>,
}

/// Summary of a segment.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SegmentDescription {
    /// Name of the segment.
    pub name: String,
    /// Mount of the base.
    pub base: BaseMount,
    /// Number of contiguous ranges of rows.
    pub parts: usize,
    /// Number of rows.
    pub rows: usize,
    /// Recorded time [s].
    pub duration_s: f64,
}

/// Summary of a recorded quantity.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ChannelDescription {
    /// Name of the quantity, such as `tau_measured`.
    pub quantity: &'static str,
    /// Unit; empty if dimensionless.
    pub unit: &'static str,
    /// Number of columns.
    pub columns: usize,
    /// Number of empty cells in the columns.
    pub missing_cells: usize,
}

/// Quantity that was not recorded.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MissingChannel {
    /// Name of the quantity, such as `tau_measured`.
    pub quantity: &'static str,
    /// Consequence for simulation, evaluation and identification.
    #[serde(rename = "cost")]
    pub consequence: &'static str,
}

impl Log {
    /// Returns the summary of the log.
    pub fn describe(&self) -> LogSummary {
        let timing = self.timing();
        let mut description = LogSummary {
            rows: self.rows(),
            duration_s: self.duration_s(),
            segments: self.described_segments(),
            channels: self.described_channels(),
            absent: absent(self)
                .into_iter()
                .map(|(quantity, cost)| MissingChannel { quantity, consequence: cost })
                .collect(),
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
        // Beyond the joint ranges of the Go2 [rad]; positions in degrees exceed it.
        const MAX_POSITION: f64 = 7.0;
        let mut notes = self.read_warnings().to_vec();
        if let Some(rate) = timing.rate_hz
            && (rate / timing.stated_rate_hz - 1.0).abs() > TOLERANCE
        {
            notes.push(format!(
                "the measured rate is {rate:.1} Hz, but `rate_hz` of the meta file is {} Hz",
                timing.stated_rate_hz
            ));
        }
        let torque = self.joints().iter().any(|joint| self.tau_measured(joint).is_some());
        if torque && self.meta().tau_sensor == TorqueSensor::None {
            notes.push("tau_measured is not compared, because `tau_sensor` of the meta file is \"none\"".to_owned());
        }
        if !torque && self.meta().tau_sensor != TorqueSensor::None {
            notes.push("the meta file has a `tau_sensor`, but the log has no tau_measured".to_owned());
        }
        for quantity in ["q", "q_cmd"] {
            let far = |joint: &&Joint| {
                let cells = self.channel(&format!("{quantity}_{joint}"));
                cells.is_some_and(|cells| cells.iter().any(|cell| cell.abs() > MAX_POSITION))
            };
            if let Some(joint) = Joint::ALL.iter().find(far) {
                notes.push(format!(
                    "{quantity}_{joint} exceeds {MAX_POSITION} rad in magnitude: positions must be in radians, not \
                     degrees"
                ));
            }
        }
        notes
    }

    /// Returns each row with the difference of a channel to the next row, within contiguous ranges of rows.
    fn differences(&self, channel: &[f64]) -> impl Iterator<Item = (usize, f64)> {
        self.segments().flat_map(|(_, rows)| rows.start..rows.end - 1).map(|row| (row, channel[row + 1] - channel[row]))
    }
}

/// Returns the largest number; ignores NaN.
pub(crate) fn largest(values: impl Iterator<Item = f64>) -> Option<f64> {
    values.filter(|value| !value.is_nan()).reduce(f64::max)
}

/// Returns a quantile of sorted numbers, without interpolation.
pub(crate) fn quantile(sorted: &[f64], fraction: f64) -> Option<f64> {
    let index = (fraction * sorted.len().saturating_sub(1) as f64).round() as usize;
    sorted.get(index).copied()
}

fn standard_deviation(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}
