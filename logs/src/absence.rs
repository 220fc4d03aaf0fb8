//! What a log that lacks a quantity cannot tell.

use crate::columns::Column;
use crate::{BaseMount, Log, TorqueSensor};

/// Where a quantity is missed.
#[derive(PartialEq, Eq)]
enum Missed {
    Always,
    /// Only where the trunk moves.
    Floating,
}

/// Each quantity whose absence costs a conclusion, and which.
const COSTS: [(&str, Missed, &str); 14] = [
    (
        "q",
        Missed::Always,
        "nothing was measured: this is a motion to play, and a model has nothing to be compared with",
    ),
    ("tau_measured", Missed::Always, "no comparison of torques: a model is judged by its motion alone"),
    ("dq", Missed::Always, "velocity is derived from q: friction and damping are seen less sharply"),
    ("dq_cmd", Missed::Always, "taken as zero: a velocity that was commanded looks like a wrong damping"),
    ("tau_ff", Missed::Always, "taken as zero: a torque that was commanded looks like an effect"),
    ("temp", Missed::Always, "a drift of friction cannot be told from warming"),
    ("battery_V", Missed::Always, "a sagging supply cannot be told from weak motors"),
    ("quat", Missed::Always, "the trunk is taken as level: a tilt looks like a load"),
    ("gyro", Missed::Floating, "the trunk's rotation is not compared, and no gyro bias is found"),
    ("acc", Missed::Floating, "the trunk's acceleration is not compared"),
    ("pos", Missed::Floating, "the trunk's path is not compared"),
    ("vel", Missed::Floating, "the trunk's velocity is not compared, and starting states lack it"),
    ("contact", Missed::Floating, "the times of contact are inferred from a model"),
    ("foot_force", Missed::Floating, "the ground's forces are inferred from a model"),
];

/// The quantities that a log lacks and what each costs.
pub(crate) fn absent(log: &Log) -> Vec<(&'static str, &'static str)> {
    let floating = log.segments().any(|(segment, _)| segment.base == BaseMount::Floating);
    let held = |quantity: &str| match quantity {
        "tau_measured" if log.meta().tau_sensor == TorqueSensor::None => false,
        _ => log.channels().any(|(name, _)| Column::parse(name).is_some_and(|column| column.quantity.name == quantity)),
    };
    COSTS
        .iter()
        .filter(|(quantity, missed, _)| (floating || *missed == Missed::Always) && !held(quantity))
        .map(|&(quantity, _, cost)| (quantity, cost))
        .collect()
}
