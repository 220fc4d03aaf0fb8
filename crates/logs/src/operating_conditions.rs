//! Operating conditions of a log: supply voltage and motor temperatures, and the derating of motor torque.

use crate::Log;
use twinstep_model::{Derating, JOINT_NAMES, NUM_JOINTS};

/// Supply voltage and motor temperatures of a log, by row; empty if the log has neither.
#[derive(Clone, Debug)]
pub struct OperatingConditions(Vec<Condition>);

#[derive(Clone, Copy, Debug)]
struct Condition {
    /// Voltage divided by the highest voltage of the log; 1 if it is missing.
    voltage: f64,
    /// Temperature of each motor [°C]; NaN if it is missing.
    temperature: [f64; NUM_JOINTS],
}

impl OperatingConditions {
    /// Collects the conditions of `log`.
    pub fn of(log: &Log) -> Self {
        let voltages = log.channel("battery_V");
        let temperatures = JOINT_NAMES.map(|name| log.channel(&format!("temp_{name}")));
        if voltages.is_none() && temperatures.iter().all(Option::is_none) {
            return Self(Vec::new());
        }
        let finite = voltages.into_iter().flatten().copied().filter(|cell| cell.is_finite());
        let highest = finite.fold(f64::MIN_POSITIVE, f64::max);
        let row = |row: usize| Condition {
            voltage: voltages.map(|cells| cells[row] / highest).filter(|ratio| ratio.is_finite()).unwrap_or(1.0),
            temperature: temperatures.map(|cells| cells.map_or(f64::NAN, |cells| cells[row])),
        };
        Self((0..log.rows()).map(row).collect())
    }

    /// Returns true if the log has neither voltage nor temperature.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the derating factor of each joint's torque in `row`.
    pub fn derating_factors(&self, derating: &Derating, row: usize) -> [f32; NUM_JOINTS] {
        let Some(condition) = self.0.get(row) else { return [1.0; NUM_JOINTS] };
        std::array::from_fn(|joint| {
            derating.derating_factor(joint, condition.voltage, condition.temperature[joint]) as f32
        })
    }
}

#[cfg(test)]
mod tests {
    use crate::{Meta, TorqueSensor};

    use super::*;

    #[test]
    fn derating_depends_on_voltage_and_temperature() {
        let segments = vec![crate::Segment { name: "air".to_owned(), base: twinstep_model::BaseMount::Fixed }];
        let column = |name: &str, cells: [f64; 3]| (name.to_owned(), cells.to_vec());
        let columns = [
            column("t", [0.0, 0.005, 0.01]),
            column("q_FL_hip", [0.0; 3]),
            column("q_cmd_FL_hip", [0.0; 3]),
            column("kp", [20.0; 3]),
            column("kd", [0.5; 3]),
            column("battery_V", [25.0, 20.0, f64::NAN]),
            column("temp_FL_hip", [30.0, f64::NAN, 55.0]),
        ];
        let log = Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log");
        let conditions = OperatingConditions::of(&log);
        let mut derating = Derating { voltage_exponent: 2.0, ..Derating::NONE };
        derating.per_kelvin[0] = 0.01;
        let factors = [0, 1, 2].map(|row| conditions.derating_factors(&derating, row)[..2].to_vec());
        assert_eq!(factors, [[1.0, 1.0], [0.64, 0.64], [0.8, 1.0]]);
    }
}
