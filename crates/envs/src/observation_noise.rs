//! Noise of the observation: what sensors add to the quantities that they measure.

use rand::RngExt;
use serde::{Deserialize, Serialize};
use twinstep_model::{EnvSpec, RobotSample, Stream};

use crate::config::{ConfigError, check_value};

/// Noise of the entries of group `policy`. Each value is the largest error; errors are uniform and independent.
///
/// Isaac Lab trains the Go2 with 0.2 rad/s, 0.05, 0.01 rad and 1.5 rad/s.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObservationNoise {
    /// Error of the angular velocity of the base [rad/s].
    pub angular_velocity_rad_s: f32,
    /// Error of each component of the gravity vector.
    pub gravity: f32,
    /// Error of the joint positions [rad].
    pub joint_position_rad: f32,
    /// Error of the joint velocities [rad/s].
    pub joint_velocity_rad_s: f32,
    /// Error of the measured torques [N·m]. They are in the samples of actuator periods, not in the observation.
    pub joint_torque_nm: f32,
}

impl ObservationNoise {
    /// Checks that every value is within its range.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_value("randomise.noise.angular_velocity_rad_s", self.angular_velocity_rad_s, 0.0, 10.0)?;
        check_value("randomise.noise.gravity", self.gravity, 0.0, 1.0)?;
        check_value("randomise.noise.joint_position_rad", self.joint_position_rad, 0.0, 1.0)?;
        check_value("randomise.noise.joint_velocity_rad_s", self.joint_velocity_rad_s, 0.0, 50.0)?;
        check_value("randomise.noise.joint_torque_nm", self.joint_torque_nm, 0.0, 10.0)
    }

    /// Adds noise to the readings of a sample.
    pub fn disturb(&self, sample: &mut RobotSample, random: &mut Stream) {
        let readings = [
            (&mut sample.q[..], self.joint_position_rad),
            (&mut sample.dq[..], self.joint_velocity_rad_s),
            (&mut sample.tau[..], self.joint_torque_nm),
            (&mut sample.gyro[..], self.angular_velocity_rad_s),
        ];
        for (values, limit) in readings.into_iter().filter(|(_, limit)| *limit > 0.0) {
            for value in values.iter_mut() {
                *value += limit * (2.0 * random.random::<f32>() - 1.0);
            }
        }
    }

    /// Returns the entries of the observation that have noise, and the limits of their errors.
    pub fn entries(&self, spec: &EnvSpec) -> Vec<NoisyEntry> {
        let mut entries = Vec::new();
        let mut start = 0;
        for field in &spec.observation {
            let limit = match field.name.as_str() {
                "base_angular_velocity" => self.angular_velocity_rad_s,
                "projected_gravity" => self.gravity,
                "joint_position" => self.joint_position_rad,
                "joint_velocity" => self.joint_velocity_rad_s,
                _ => 0.0,
            };
            if limit > 0.0 {
                let bounds = [field.low, field.high];
                entries.extend((start..start + field.size).map(|index| NoisyEntry { index, limit, bounds }));
            }
            start += field.size;
        }
        entries
    }
}

/// Entry of the observation with noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoisyEntry {
    index: usize,
    limit: f32,
    /// Bounds of the observation, to which the noisy value is clipped.
    bounds: [f32; 2],
}

/// Adds noise to an observation.
pub fn add_noise(entries: &[NoisyEntry], obs: &mut [f32], random: &mut Stream) {
    for NoisyEntry { index, limit, bounds: [low, high] } in entries {
        let error = limit * (2.0 * random.random::<f32>() - 1.0);
        obs[*index] = (obs[*index] + error).clamp(*low, *high);
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{go2, stream};

    use super::*;
    use crate::observation::base_spec;

    #[test]
    fn noise_is_within_its_limits_and_only_on_what_sensors_measure() {
        let noise = ObservationNoise {
            angular_velocity_rad_s: 0.2,
            gravity: 0.05,
            joint_position_rad: 0.01,
            joint_velocity_rad_s: 1.5,
            joint_torque_nm: 0.3,
        };
        let entries = noise.entries(&base_spec("walk", &go2(), Vec::new(), 20.0));
        let mut random = stream(0, "test", 0);
        let mut largest = [0.0_f32; 45];
        for _ in 0..500 {
            let mut obs = [0.0; 45];
            add_noise(&entries, &mut obs, &mut random);
            largest.iter_mut().zip(obs).for_each(|(largest, error)| *largest = largest.max(error.abs()));
        }
        let limit = |index| match index {
            0..3 => 0.2,
            3..6 => 0.05,
            9..21 => 0.01,
            21..33 => 1.5,
            _ => 0.0,
        };
        for (index, largest) in largest.into_iter().enumerate() {
            assert!((0.95 * limit(index)..=limit(index)).contains(&largest), "{index}: {largest}");
        }
    }

    #[test]
    fn readings_of_a_sample_have_noise_and_commands_do_not() {
        let noise = ObservationNoise { joint_torque_nm: 0.3, joint_position_rad: 0.01, ..ObservationNoise::default() };
        let mut random = stream(0, "test", 0);
        let mut largest = [0.0_f32; 3];
        for _ in 0..100 {
            let mut sample = RobotSample::default();
            noise.disturb(&mut sample, &mut random);
            assert_eq!((sample.q_cmd, sample.dq, sample.gyro), Default::default());
            for (largest, values) in largest.iter_mut().zip([sample.q, sample.tau]) {
                *largest = values.iter().fold(*largest, |largest, value| largest.max(value.abs()));
            }
        }
        assert!((0.0095..=0.01).contains(&largest[0]) && (0.29..=0.3).contains(&largest[1]), "{largest:?}");
    }

    #[test]
    fn noisy_gravity_stays_within_the_bounds_of_the_observation() {
        let noise = ObservationNoise { gravity: 0.5, ..ObservationNoise::default() };
        let entries = noise.entries(&base_spec("walk", &go2(), Vec::new(), 20.0));
        let mut random = stream(0, "test", 0);
        for _ in 0..100 {
            let mut obs = [-1.0; 45];
            add_noise(&entries, &mut obs, &mut random);
            assert!(obs[3..6].iter().all(|entry| (-1.0..=-0.5).contains(entry)), "{obs:?}");
        }
    }

    #[test]
    fn negative_noise_is_rejected_with_its_key() {
        let error = ObservationNoise { gravity: -0.1, ..ObservationNoise::default() }.check().expect_err("negative");
        assert_eq!(error.to_string(), "`randomise.noise.gravity` = -0.1 is not allowed: 0 to 1");
    }
}
