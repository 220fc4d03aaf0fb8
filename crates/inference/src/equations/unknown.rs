//! Laws that the catalogue does not have: functions of what a joint measures, that explain what the causes leave.

use super::block::Column;
use super::law::Place;
use super::system::{Predicted, System};

/// Standard deviation of the torque of each function [N·m], root mean square over its rows.
pub const STD: f64 = 0.2;

/// A function of what a joint measures.
struct Function {
    /// What it depends on most, as the prefix of a channel of the log.
    variable: &'static str,
    value: fn(&Measured) -> f64,
}

/// What a joint measures, relative to its standard deviation.
struct Measured {
    q: f64,
    dq: f64,
    /// Speed [rad/s].
    speed: f64,
    error: f64,
    torque: f64,
    temperature: f64,
    time: f64,
}

const fn function(variable: &'static str, value: fn(&Measured) -> f64) -> Function {
    Function { variable, value }
}

const FUNCTIONS: [Function; 19] = [
    function("q", |now| now.q),
    function("q", |now| now.q * now.q),
    function("q", |now| now.q.powi(3)),
    function("dq", |now| now.dq),
    function("dq", |now| now.dq * now.dq.abs()),
    function("dq", |now| now.dq.max(0.0)),
    function("dq", |now| (now.speed / 0.03).tanh()),
    function("dq", |now| (now.speed / 0.03).tanh().max(0.0)),
    function("dq", |now| now.q * (now.speed / 0.03).tanh()),
    function("q_error", |now| now.error),
    function("q_error", |now| now.error * now.error.abs()),
    function("tau_measured", |now| now.torque),
    function("tau_measured", |now| now.torque * now.torque.abs()),
    function("tau_measured", |now| now.torque.max(0.0)),
    function("tau_measured", |now| now.torque.abs() * (now.speed / 0.03).tanh()),
    function("temp", |now| now.temperature * now.dq),
    function("temp", |now| now.temperature * now.torque),
    function("t", |now| now.time * now.torque),
    function("t", |now| now.time),
];

/// Returns the columns of the functions at a joint, with what each depends on: on the torque of the drive, or of the link.
pub fn columns(system: &System, predicted: &Predicted, joint: usize, place: Place) -> Vec<(&'static str, Column)> {
    let rows = &system.measured.joints[joint];
    let temperature = |row: usize| rows.temperature.get(row).copied().unwrap_or(0.0);
    let of_row = |row: usize| {
        let [q, dq] = [0, 1].map(|quantity| rows.smooth[quantity][row]);
        let error = rows.command[0][row] - q;
        let torque = predicted.sensed(joint)[row];
        [q, dq, error, torque, temperature(row), system.measured.t[row]]
    };
    let samples = &system.balance.samples;
    let of_sample = |index: usize| {
        let sample = &samples[index];
        let middle = usize::midpoint(sample.rows.start, sample.rows.end);
        let [q, dq, _] = sample.instrument.of(joint);
        let error = rows.command[0][middle] - q;
        [q, dq, error, predicted.balanced(index)[joint], temperature(middle), system.measured.t[middle]]
    };
    let drive = matches!(place, Place::Drive | Place::Sensor);
    let parts = system.drive_rows(joint);
    let raw: Vec<[f64; 6]> = if drive {
        parts.iter().flat_map(|(_, rows)| rows).map(|row| of_row(*row)).collect()
    } else {
        (0..samples.len()).map(of_sample).collect()
    };
    let measured = standardised(&raw);
    let column = |function: &Function| {
        let values: Vec<f64> = measured.iter().map(function.value).collect();
        let scale = (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt();
        let values: Vec<f64> = values.iter().map(|value| value / scale.max(1e-9)).collect();
        if !drive {
            return (function.variable, system.balance.joint_column(joint, &values));
        }
        let mut next = values.into_iter();
        let parts = parts.iter().map(|(block, rows)| (*block, next.by_ref().take(rows.len()).collect())).collect();
        (function.variable, Column { parts })
    };
    FUNCTIONS.iter().map(column).filter(|(_, column)| !column.is_zero()).collect()
}

/// Returns the measurements relative to their means (that of the velocity is zero) and standard deviations.
fn standardised(raw: &[[f64; 6]]) -> Vec<Measured> {
    let count = raw.len().max(1) as f64;
    let means: [f64; 6] = std::array::from_fn(|quantity| {
        let has_sign = matches!(quantity, 1..=3);
        if has_sign { 0.0 } else { raw.iter().map(|row| row[quantity]).sum::<f64>() / count }
    });
    let stds: [f64; 6] = std::array::from_fn(|quantity| {
        let squares = raw.iter().map(|row| (row[quantity] - means[quantity]).powi(2)).sum::<f64>();
        (squares / count).sqrt().max(1e-9)
    });
    let of = |row: &[f64; 6]| {
        let [q, dq, error, torque, temperature, time] =
            std::array::from_fn(|quantity| (row[quantity] - means[quantity]) / stds[quantity]);
        Measured { q, dq, speed: row[1], error, torque, temperature, time }
    };
    raw.iter().map(of).collect()
}
