//! Worst joint over time: measured, and simulated with both models.

use std::ops::Range;

use twinstep_identify::{Evaluation, JointEvaluation};
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::Joint;

use crate::model_evaluation::ModelEvaluation;
use crate::timeline::Timeline;

/// Maximum length of the detail plot [s].
const CLOSE_S: f64 = 3.0;

/// Time series of one joint.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeSeries {
    /// Name of the joint.
    pub joint: &'static str,
    /// Plotted quantity, with its unit.
    pub label: &'static str,
    /// Detail of the interval in which the given model has the largest error.
    pub close: Vec<Curve>,
    /// Model minus measurement over the whole log.
    pub errors: Vec<Curve>,
}

/// Line of a plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Name in the legend.
    pub name: &'static str,
    /// CSS class.
    pub class: &'static str,
    /// Pieces of the line, as points of time [s] and value.
    pub pieces: Vec<Vec<(f64, f64)>>,
}

impl TimeSeries {
    /// Returns the time series of position, and of torque if it was measured.
    pub fn of(log: &Log, trials: [&ModelEvaluation; 2]) -> Vec<TimeSeries> {
        let before = &trials[0].evaluation;
        let mut strips = Vec::new();
        if let Some(joint) = worst(before, |joint| joint.q_rmse_rad)
            && let Some(measured) = log.q(joint.name())
        {
            let of = |trial: &ModelEvaluation| {
                trial.position[joint.index()].iter().zip(measured).map(|(error, q)| error + q).collect()
            };
            strips.push(strip(log, joint, "joint position [rad]", measured, trials.map(of)));
        }
        if log.meta().tau_sensor != TorqueSensor::None
            && let Some(joint) = worst(before, |joint| joint.torque_rmse_nm)
            && let Some(measured) = log.tau_measured(joint.name())
        {
            let of = |trial: &ModelEvaluation| trial.balance.estimated_torque[joint.index()].clone();
            strips.push(strip(log, joint, "torque [N·m]", measured, trials.map(of)));
        }
        strips
    }
}

/// Returns the joint with the largest error.
fn worst(evaluation: &Evaluation, of: fn(&JointEvaluation) -> Option<f64>) -> Option<Joint> {
    let errors = evaluation.per_joint.iter().filter_map(|(name, joint)| Some((name, of(joint)?)));
    let (name, _) = errors.max_by(|one, other| one.1.total_cmp(&other.1))?;
    name.parse().ok()
}

fn strip(log: &Log, joint: Joint, label: &'static str, measured: &[f64], models: [Vec<f64>; 2]) -> TimeSeries {
    let [before, after] = &models;
    let differences = |model: &[f64]| model.iter().zip(measured).map(|(model, cell)| model - cell).collect::<Vec<_>>();
    let errors = [differences(before), differences(after)];
    let close = worst_rows(log, &errors[0]);
    TimeSeries {
        joint: joint.name(),
        label,
        close: [
            ("measured", "measured", measured),
            ("given model", "before", before),
            ("extended model", "after", after),
        ]
        .map(|(name, class, values)| Curve { name, class, pieces: pieces(log, &close, values) })
        .into(),
        errors: [("given model", "before", &errors[0]), ("extended model", "after", &errors[1])]
            .map(|(name, class, values)| Curve { name, class, pieces: pieces(log, &(0..log.rows()), values) })
            .into(),
    }
}

/// Returns the rows with the largest squared error, at most [`CLOSE_S`] long.
fn worst_rows(log: &Log, errors: &[f64]) -> Range<usize> {
    let length = (CLOSE_S * log.meta().rate_hz).round() as usize;
    let power = |rows: &Range<usize>| -> f64 {
        errors[rows.clone()].iter().filter(|error| error.is_finite()).map(|error| error * error).sum()
    };
    let cuts = log.segments().flat_map(|(_, part)| {
        let last = part.end.saturating_sub(length).max(part.start);
        (part.start..=last).step_by((length / 10).max(1)).map(move |start| start..(start + length).min(part.end))
    });
    cuts.max_by(|one, other| power(one).total_cmp(&power(other))).unwrap_or(0..log.rows())
}

/// Returns the lines through `rows`, without values that are not finite.
fn pieces(log: &Log, rows: &Range<usize>, values: &[f64]) -> Vec<Vec<(f64, f64)>> {
    let kept: Vec<usize> = rows.clone().filter(|row| values[*row].is_finite()).collect();
    let at = |cells: &[f64]| kept.iter().map(|row| cells[*row]).collect::<Vec<f64>>();
    let within = |row: usize| kept.partition_point(|kept| *kept < row);
    let parts: Vec<_> =
        log.segments().map(|(_, part)| within(part.start)..within(part.end)).filter(|part| !part.is_empty()).collect();
    Timeline::new(&at(log.t()), &parts).points(&at(values))
}
