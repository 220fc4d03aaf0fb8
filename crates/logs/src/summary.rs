//! Types of the summary of a log.

use serde::Serialize;
use twinstep_model::BaseMount;

use crate::excitation::Excitation;
use crate::falls::Fall;
use crate::problems::Problem;

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
    /// What is wrong with the measurements.
    pub problems: Vec<Problem>,
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
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelDescription {
    /// Name of the quantity, such as `tau_measured`.
    pub quantity: &'static str,
    /// Unit; empty if dimensionless.
    pub unit: &'static str,
    /// Number of columns.
    pub columns: usize,
    /// Number of empty cells in the columns.
    pub missing_cells: usize,
    /// Step of a quantised sensor: all cells are multiples of it, the largest of all columns. `None` if the cells are not quantised.
    pub quantum: Option<f64>,
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

/// Identifiability of one effect from a log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Identifiability {
    /// Name of the effect in the catalogue.
    pub effect: &'static str,
    /// Level of identifiability.
    pub verdict: IdentifiabilityLevel,
    /// Reason, as text.
    #[serde(rename = "because")]
    pub reason: String,
}

/// Level of identifiability of an effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum IdentifiabilityLevel {
    /// The log meets all necessary and recommended requirements.
    #[serde(rename = "can")]
    Identifiable,
    /// The log meets the necessary requirements, but not all recommended ones.
    #[serde(rename = "weakly")]
    Weak,
    /// The log does not meet a necessary requirement.
    #[serde(rename = "cannot")]
    NotIdentifiable,
}
