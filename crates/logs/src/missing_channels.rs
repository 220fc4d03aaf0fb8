//! Consequences of quantities that a log does not contain.

use crate::columns::Column;
use crate::{Log, TorqueSensor};
use twinstep_model::BaseMount;

/// When the absence of a quantity has consequences.
#[derive(PartialEq, Eq)]
enum Missed {
    Always,
    /// Only with a floating base.
    Floating,
}

/// Quantities whose absence has consequences, and the consequences.
const COSTS: [(&str, Missed, &str); 16] = [
    ("q", Missed::Always, "nothing was measured: this is a motion file, with which a model cannot be compared"),
    ("tau_measured", Missed::Always, "torque is not compared: a model is evaluated on its motion only"),
    ("dq", Missed::Always, "velocity is computed from q: friction and damping are estimated less accurately"),
    (
        "kp",
        Missed::Always,
        "unknown: `identify` estimates it for each joint, with a wide prior; `diagnose` and `fit` need it",
    ),
    ("kd", Missed::Always, "unknown: estimated in the same way; at one gain it is confounded with viscous friction"),
    ("dq_cmd", Missed::Always, "assumed zero: a commanded velocity is attributed to a wrong damping"),
    ("tau_ff", Missed::Always, "assumed zero: a commanded torque is attributed to an effect"),
    ("temp", Missed::Always, "a drift of friction is confounded with motor temperature"),
    ("battery_V", Missed::Always, "supply sag is confounded with weak motors"),
    (
        "quat",
        Missed::Always,
        "a fixed base is assumed level without `base_quat` in meta.json: a tilt is attributed to a load",
    ),
    ("gyro", Missed::Floating, "base rotation is not compared, and a gyro bias is not identifiable"),
    ("acc", Missed::Floating, "base acceleration is not compared"),
    ("pos", Missed::Floating, "base height is estimated from the feet, and not compared"),
    ("vel", Missed::Floating, "base velocity is estimated from the legs, and not compared"),
    ("contact", Missed::Floating, "contact times are inferred from a model"),
    ("foot_force", Missed::Floating, "contact forces are inferred from a model"),
];

/// Returns the quantities that a log does not contain, and the consequences.
pub(crate) fn absent(log: &Log) -> Vec<(&'static str, &'static str)> {
    let floating = log.segments().any(|(segment, _)| segment.base == BaseMount::Floating);
    let held = |quantity: &str| match quantity {
        "tau_measured" if log.meta().tau_sensor == TorqueSensor::None => false,
        "kp" => log.joints().iter().all(|joint| log.kp(joint, 0).is_some()),
        "kd" => log.joints().iter().all(|joint| log.kd(joint, 0).is_some()),
        _ => log.channels().any(|(name, _)| Column::parse(name).is_some_and(|column| column.quantity.name == quantity)),
    };
    COSTS
        .iter()
        .filter(|(quantity, missed, _)| (floating || *missed == Missed::Always) && !held(quantity))
        .map(|&(quantity, _, cost)| (quantity, cost))
        .collect()
}
