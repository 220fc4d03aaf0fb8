//! Simulation of sensor noise and resolution on the exact log of a simulated robot.

use glam::{DQuat, DVec3};
use rand::Rng;
use twinstep_logs::{Log, LogError};
use twinstep_model::{standard_normal, stream};

/// Sensor of one quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Name of the quantity, as in `q` or `tau_measured`; its channels are `q_FL_hip` and so on.
    pub quantity: &'static str,
    /// Standard deviation of white noise, in the channel's unit; for `quat` of the angle about each axis [rad].
    pub sigma: f64,
    /// Resolution, in the channel's unit; 0 for no rounding.
    pub resolution: f64,
}

impl Sensor {
    /// Returns a measurement of `value`.
    fn measure(&self, value: f64, random: &mut impl Rng) -> f64 {
        let noisy = value + self.sigma * standard_normal(random);
        if self.resolution > 0.0 { (noisy / self.resolution).round() * self.resolution } else { noisy }
    }
}

/// Returns `log` with the noise of `sensors`, which its metadata state. Quantities without a sensor are exact.
pub fn apply_sensors(log: &Log, sensors: &[Sensor], seed: u64) -> Result<Log, LogError> {
    let mut random = stream(seed, "sensors", 0);
    let mut meta = log.meta().clone();
    let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
    let mut columns: Vec<(String, Vec<f64>)> = vec![
        ("t".to_owned(), log.t().to_vec()),
        ("segment".to_owned(), index(log.segment())),
        ("episode".to_owned(), index(log.episode())),
    ];
    for (name, cells) in log.channels() {
        // `q_cmd_FL_hip` is a command, not a measured `q`.
        let sensor = sensors.iter().find(|sensor| {
            let rest = name.strip_prefix(sensor.quantity).and_then(|rest| rest.strip_prefix('_'));
            rest.is_some_and(|rest| !rest.starts_with("cmd_")) && sensor.quantity != "quat"
        });
        let cells = match sensor {
            Some(sensor) => cells.iter().map(|value| sensor.measure(*value, &mut random)).collect(),
            None => cells.to_vec(),
        };
        columns.push((name.to_owned(), cells));
    }
    if let Some(sensor) = sensors.iter().find(|sensor| sensor.quantity == "quat") {
        add_orientation_noise(&mut columns, sensor.sigma, &mut random);
    }
    meta.noise.extend(sensors.iter().filter(|sensor| sensor.sigma > 0.0).map(|sensor| {
        // Rounding adds the variance of a uniform distribution.
        (sensor.quantity.to_owned(), sensor.sigma.hypot(sensor.resolution / 12f64.sqrt()))
    }));
    Log::new(meta, columns)
}

/// Rotates measured orientations by a small random angle about each axis.
fn add_orientation_noise(columns: &mut [(String, Vec<f64>)], sigma: f64, random: &mut impl Rng) {
    let Some(indices) = ["quat_w", "quat_x", "quat_y", "quat_z"]
        .map(|name| columns.iter().position(|(column, _)| column == name))
        .into_iter()
        .collect::<Option<Vec<_>>>()
    else {
        return;
    };
    for row in 0..columns[indices[0]].1.len() {
        let [w, x, y, z] = [0, 1, 2, 3].map(|part: usize| columns[indices[part]].1[row]);
        let error = DVec3::from_array([(); 3].map(|()| sigma * standard_normal(random)));
        let rotated = DQuat::from_xyzw(x, y, z, w) * DQuat::from_scaled_axis(error);
        for (index, value) in indices.iter().zip([rotated.w, rotated.x, rotated.y, rotated.z]) {
            columns[*index].1[row] = value;
        }
    }
}
