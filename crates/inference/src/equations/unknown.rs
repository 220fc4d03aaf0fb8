//! Functions of what a joint measures, of which laws that the catalogue does not have are made.

use super::another_law::{AnotherLaw, Term};
use super::block::Column;
use super::causes::UnknownLaw;
use super::law::Place;
use super::system::{Predicted, System};

/// Standard deviations of angles, relative to those of torques [rad/(N·m)].
const ANGLE_PER_TORQUE: f64 = 0.02;

/// A function of what a joint measures.
pub struct Function {
    /// What it depends on most, as the prefix of a channel of the log.
    pub variable: &'static str,
    /// Formula in measurements that are relative to their standard deviations: `q`, `dq`, the position error `e`, the torque `tau`, the
    /// temperature `T`, and the time `t`.
    pub formula: &'static str,
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

const fn function(variable: &'static str, formula: &'static str, value: fn(&Measured) -> f64) -> Function {
    Function { variable, formula, value }
}

/// The functions. The first one is constant.
pub const FUNCTIONS: [Function; 20] = [
    function("q", "1", |_| 1.0),
    function("q", "q", |now| now.q),
    function("q", "q²", |now| now.q * now.q),
    function("q", "q³", |now| now.q.powi(3)),
    function("dq", "dq", |now| now.dq),
    function("dq", "dq |dq|", |now| now.dq * now.dq.abs()),
    function("dq", "max(dq, 0)", |now| now.dq.max(0.0)),
    function("dq", "sign(dq)", |now| (now.speed / 0.03).tanh()),
    function("dq", "max(sign(dq), 0)", |now| (now.speed / 0.03).tanh().max(0.0)),
    function("dq", "q sign(dq)", |now| now.q * (now.speed / 0.03).tanh()),
    function("q_error", "e", |now| now.error),
    function("q_error", "e |e|", |now| now.error * now.error.abs()),
    function("tau_measured", "tau", |now| now.torque),
    function("tau_measured", "tau |tau|", |now| now.torque * now.torque.abs()),
    function("tau_measured", "max(tau, 0)", |now| now.torque.max(0.0)),
    function("tau_measured", "|tau| sign(dq)", |now| now.torque.abs() * (now.speed / 0.03).tanh()),
    function("temp", "T dq", |now| now.temperature * now.dq),
    function("temp", "T tau", |now| now.temperature * now.torque),
    function("t", "t tau", |now| now.time * now.torque),
    function("t", "t", |now| now.time),
];

/// Describes a law at one of its joints. A constant does not tell what the law depends on.
pub fn unknown_law(law: &AnotherLaw, index: usize, joint: &str, of_drive: bool) -> UnknownLaw {
    let mut terms: Vec<&Term> = law.terms.iter().collect();
    terms.sort_by(|one, other| other.mean[index].abs().total_cmp(&one.mean[index].abs()));
    let of_state = terms.iter().find(|term| term.function > 0).or(terms.first());
    UnknownLaw {
        joint: joint.to_owned(),
        of_drive,
        variable: of_state.map_or("t", |term| FUNCTIONS[term.function].variable),
        terms: terms.iter().map(|term| (FUNCTIONS[term.function].formula, term.mean[index], term.std[index])).collect(),
        gain: law.gain,
    }
}

/// Returns the columns of the functions at a joint: of the torque of the drive or of the link, or of the angle between encoder and link.
pub fn columns(system: &System, predicted: &Predicted, joint: usize, place: Place) -> Vec<Column> {
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
    let parts = system.drive_rows(joint);
    let is_of_rows = matches!(place, Place::Drive | Place::Sensor) && system.measured.has_torque;
    let raw: Vec<[f64; 6]> = if is_of_rows {
        parts.iter().flat_map(|(_, rows)| rows).map(|row| of_row(*row)).collect()
    } else if place == Place::Link {
        (0..system.measured.t.len())
            .map(of_row)
            .map(|row| row.map(|cell| if cell.is_finite() { cell } else { 0.0 }))
            .collect()
    } else {
        (0..samples.len()).map(of_sample).collect()
    };
    let measured = standardised(&raw);
    let column = |function: &Function| {
        let values: Vec<f64> = measured.iter().map(function.value).collect();
        let scale = (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt();
        let values: Vec<f64> = values.iter().map(|value| value / scale.max(1e-9)).collect();
        if is_of_rows {
            let mut next = values.into_iter();
            let parts = parts.iter().map(|(block, rows)| (*block, next.by_ref().take(rows.len()).collect())).collect();
            return Column { parts };
        }
        if place == Place::Link {
            let shift: Vec<f64> = values.iter().map(|value| ANGLE_PER_TORQUE * value).collect();
            let motions: Vec<_> = samples.iter().map(|sample| sample.motion(&system.measured, &shift)).collect();
            return system.balance.motion_column(joint, &motions);
        }
        system.balance.joint_column(joint, &values)
    };
    // A constant angle is the offset of an encoder, which the catalogue has.
    let is_new = |index: &usize| place != Place::Link || *index > 0;
    (0..FUNCTIONS.len())
        .map(|index| if is_new(&index) { column(&FUNCTIONS[index]) } else { Column::default() })
        .collect()
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
