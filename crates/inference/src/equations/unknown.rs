//! Functions of what a joint measures, of which laws that the catalogue does not have are made.

use super::another_law::{AnotherLaw, Term};
use super::block::Column;
use super::causes::{LawTerm, UnknownLaw};
use super::law::Place;
use super::residuals::Formula;
use super::system::{Predicted, System};

/// Standard deviations of angles, relative to those of torques [rad/(N·m)].
const ANGLE_PER_TORQUE: f64 = 0.02;

/// A function of what a joint measures.
pub struct Function {
    /// What it depends on most, as the prefix of a channel of the log.
    pub variable: &'static str,
    /// Formula of position `q`, velocity `dq`, position error `e`, torque `tau`, temperature `T` and time `t`. In braces: minus its mean.
    formula: &'static str,
    /// Exponents of the six quantities, of which a standard deviation is a factor of the function.
    exponents: [i32; 6],
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

/// Means and standard deviations of what a joint measures, in the order of [`Function::exponents`].
struct Scales {
    means: [f64; 6],
    stds: [f64; 6],
}

const fn function(
    variable: &'static str,
    formula: &'static str,
    exponents: [i32; 6],
    value: fn(&Measured) -> f64,
) -> Function {
    Function { variable, formula, exponents, value }
}

/// The functions. The first one is constant.
pub const FUNCTIONS: [Function; 20] = [
    function("q", "1", [0; 6], |_| 1.0),
    function("q", "{q}", [1, 0, 0, 0, 0, 0], |now| now.q),
    function("q", "{q}²", [2, 0, 0, 0, 0, 0], |now| now.q * now.q),
    function("q", "{q}³", [3, 0, 0, 0, 0, 0], |now| now.q.powi(3)),
    function("dq", "dq", [0, 1, 0, 0, 0, 0], |now| now.dq),
    function("dq", "dq |dq|", [0, 2, 0, 0, 0, 0], |now| now.dq * now.dq.abs()),
    function("dq", "max(dq, 0)", [0, 1, 0, 0, 0, 0], |now| now.dq.max(0.0)),
    function("dq", "sign(dq)", [0; 6], |now| (now.speed / 0.03).tanh()),
    function("dq", "max(sign(dq), 0)", [0; 6], |now| (now.speed / 0.03).tanh().max(0.0)),
    function("dq", "{q} sign(dq)", [1, 0, 0, 0, 0, 0], |now| now.q * (now.speed / 0.03).tanh()),
    function("q_error", "e", [0, 0, 1, 0, 0, 0], |now| now.error),
    function("q_error", "e |e|", [0, 0, 2, 0, 0, 0], |now| now.error * now.error.abs()),
    function("tau_measured", "tau", [0, 0, 0, 1, 0, 0], |now| now.torque),
    function("tau_measured", "tau |tau|", [0, 0, 0, 2, 0, 0], |now| now.torque * now.torque.abs()),
    function("tau_measured", "max(tau, 0)", [0, 0, 0, 1, 0, 0], |now| now.torque.max(0.0)),
    function("tau_measured", "|tau| sign(dq)", [0, 0, 0, 1, 0, 0], |now| now.torque.abs() * (now.speed / 0.03).tanh()),
    function("temp", "{T} dq", [0, 1, 0, 0, 1, 0], |now| now.temperature * now.dq),
    function("temp", "{T} tau", [0, 0, 0, 1, 1, 0], |now| now.temperature * now.torque),
    function("t", "{t} tau", [0, 0, 0, 1, 0, 1], |now| now.time * now.torque),
    function("t", "{t}", [0, 0, 0, 0, 0, 1], |now| now.time),
];

impl Function {
    /// Returns the formula with the means of a joint.
    fn text(&self, scales: &Scales) -> String {
        ["q", "dq", "e", "tau", "T", "t"].iter().zip(scales.means).fold(
            self.formula.to_owned(),
            |text, (name, mean)| {
                let sign = if mean < 0.0 { '+' } else { '-' };
                text.replace(&format!("{{{name}}}"), &format!("({name} {sign} {:.3})", mean.abs()))
            },
        )
    }

    /// Returns by how much it is larger in physical units.
    fn unit(&self, scales: &Scales) -> f64 {
        self.exponents.iter().zip(scales.stds).map(|(exponent, std)| std.powi(*exponent)).product()
    }
}

/// Describes a law at one of its joints. A constant does not tell what the law depends on.
pub fn unknown_law(law: &AnotherLaw, index: usize, joint: &str, place: Place, formulas: &[Formula]) -> UnknownLaw {
    let described = |term: &&Term| LawTerm {
        formula: formulas[term.function].text.clone(),
        coefficient: formulas[term.function].per_torque * term.mean[index],
        torque: term.mean[index],
        std: term.std[index],
    };
    let mut terms: Vec<&Term> = law.terms.iter().collect();
    terms.sort_by(|one, other| other.mean[index].abs().total_cmp(&one.mean[index].abs()));
    let of_state = terms.iter().find(|term| term.function > 0).or(terms.first());
    UnknownLaw {
        joint: joint.to_owned(),
        quantity: quantity(place),
        variable: of_state.map_or("t", |term| FUNCTIONS[term.function].variable),
        terms: terms.iter().map(described).collect(),
        gain: law.gain,
    }
}

/// Returns what a law at a place is a law of.
pub fn quantity(place: Place) -> &'static str {
    match place {
        Place::Drive | Place::Sensor | Place::Supply => "torque of the drive",
        Place::Link => "angle between encoder and link",
        _ => "torque on the link",
    }
}

/// Returns position, velocity, error, torque, temperature and time of a joint in the rows or samples of a law's equations.
fn measurements(system: &System, predicted: &Predicted, joint: usize, place: Place) -> Vec<[f64; 6]> {
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
    if is_of_rows(system, place) {
        system.drive_rows(joint).iter().flat_map(|(_, rows)| rows).map(|row| of_row(*row)).collect()
    } else if place == Place::Link {
        (0..system.measured.t.len())
            .map(of_row)
            .map(|row| row.map(|cell| if cell.is_finite() { cell } else { 0.0 }))
            .collect()
    } else {
        (0..samples.len()).map(of_sample).collect()
    }
}

/// Returns true if the equations of a place are rows of the log.
fn is_of_rows(system: &System, place: Place) -> bool {
    matches!(place, Place::Drive | Place::Sensor) && system.measured.has_torque
}

/// Returns the root mean square of values, or almost zero.
fn root_mean_square(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64).sqrt().max(1e-9)
}

/// Returns the functions at a joint in physical units.
pub fn formulas(system: &System, predicted: &Predicted, joint: usize, place: Place) -> Vec<Formula> {
    let (measured, scales) = standardised(&measurements(system, predicted, joint, place));
    let formula = |function: &Function| {
        let values: Vec<f64> = measured.iter().map(function.value).collect();
        let of_angle = if place == Place::Link { ANGLE_PER_TORQUE } else { 1.0 };
        let per_torque = of_angle / (root_mean_square(&values) * function.unit(&scales));
        Formula { text: function.text(&scales), per_torque }
    };
    FUNCTIONS.iter().map(formula).collect()
}

/// Returns the columns of the functions at a joint: of the torque of the drive or of the link, or of the angle between encoder and link.
pub fn columns(system: &System, predicted: &Predicted, joint: usize, place: Place) -> Vec<Column> {
    let (measured, _) = standardised(&measurements(system, predicted, joint, place));
    let (samples, parts) = (&system.balance.samples, system.drive_rows(joint));
    let column = |function: &Function| {
        let values: Vec<f64> = measured.iter().map(function.value).collect();
        let scale = root_mean_square(&values);
        let values: Vec<f64> = values.iter().map(|value| value / scale).collect();
        if is_of_rows(system, place) {
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

/// Returns the measurements relative to their means (those of velocity, error and torque are zero) and standard deviations.
fn standardised(raw: &[[f64; 6]]) -> (Vec<Measured>, Scales) {
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
    (raw.iter().map(of).collect(), Scales { means, stds })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formula_in_physical_units_has_the_value_of_the_function_of_relative_measurements() {
        let row = |index: usize| {
            let time = 0.01 * index as f64;
            [
                0.7 + 0.2 * time.sin(),
                1.5 * time.cos(),
                0.03 * (2.0 * time).sin(),
                4.0 * (3.0 * time).cos(),
                45.0 + time,
                time,
            ]
        };
        let raw: Vec<[f64; 6]> = (0..500).map(row).collect();
        let (measured, scales) = standardised(&raw);
        let of = |formula: &str| FUNCTIONS.iter().find(|function| function.formula == formula).expect("a function");
        let relative = |formula: &str| (of(formula).value)(&measured[123]) * of(formula).unit(&scales);
        let [q, dq, error, torque, temperature, _] = raw[123];
        let [of_q, of_temperature] = [q - scales.means[0], temperature - scales.means[4]];
        for (formula, physical) in [
            ("{q}²", of_q * of_q),
            ("dq |dq|", dq * dq.abs()),
            ("e", error),
            ("max(tau, 0)", torque.max(0.0)),
            ("{T} tau", of_temperature * torque),
        ] {
            assert!((relative(formula) - physical).abs() < 1e-9, "{formula}: {} {physical}", relative(formula));
        }
        assert_eq!(of("{q}²").text(&scales), format!("(q - {:.3})²", scales.means[0]));
        assert_eq!(of("max(tau, 0)").text(&scales), "max(tau, 0)");
    }
}
