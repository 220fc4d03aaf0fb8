//! Simulated actuators with known effects, and their logs: ground truth for actuator networks.
//!
//! The robot has a fixed base in the air and runs in the batch engine at 4 kHz. Every joint follows a sum of sines.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use rand::RngExt;
use twinstep_effects::{Effect, EffectEntry, Scope, apply_effects};
use twinstep_identify::{RecordError, Sensor, apply_sensors, record};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, Joint, JointKind, RobotModel, go2, stream};
use twinstep_sim::{BatchBackend, SimConfig};

/// Rate of the logs [Hz].
pub const RATE_HZ: f64 = 200.0;
/// Standard deviation of the torque sensor [N·m].
pub const NOISE_NM: f64 = 0.2;
/// Noise and resolution of the sensors. The encoder noise is small because the PD loops use the logged encoder.
const SENSORS: [Sensor; 3] = [
    Sensor { quantity: "q", sigma: 0.0003, resolution: 0.0 },
    Sensor { quantity: "dq", sigma: 0.01, resolution: 0.0 },
    Sensor { quantity: "tau_measured", sigma: NOISE_NM, resolution: 0.0 },
];
/// Number of sines per joint.
const WAVES: usize = 6;

/// An actuator with known effects at all joints.
pub struct HiddenDrive {
    /// Name in tables.
    pub name: &'static str,
    /// Effects with their values.
    effects: &'static [(&'static str, &'static [f64])],
    /// Location of the torque measurement.
    pub sensor: TorqueSensor,
}

/// Actuators for the evaluation of actuator networks.
pub const DRIVES: [HiddenDrive; 5] = [
    current("delay of 6 ms and lag of 5 ms (linear)", &[("torque_delay", &[0.006]), ("drive_lag", &[0.005])]),
    current("saturation, κ = 8 N·m", &[("torque_saturation", &[8.0])]),
    current("torque–speed limit, no-load speed 9 rad/s", &[("torque_speed_limit", &[9.0])]),
    HiddenDrive {
        name: "Coulomb and viscous friction, output sensor",
        effects: &[("coulomb_friction", &[1.2]), ("viscous_friction", &[0.15])],
        sensor: TorqueSensor::JointOutput,
    },
    HiddenDrive {
        name: "all of the above, output sensor",
        effects: &[
            ("torque_delay", &[0.004]),
            ("drive_lag", &[0.004]),
            ("torque_saturation", &[10.0]),
            ("torque_speed_limit", &[14.0]),
            ("coulomb_friction", &[0.8]),
            ("viscous_friction", &[0.1]),
        ],
        sensor: TorqueSensor::JointOutput,
    },
];

const fn current(name: &'static str, effects: &'static [(&'static str, &'static [f64])]) -> HiddenDrive {
    HiddenDrive { name, effects, sensor: TorqueSensor::MotorCurrent }
}

/// Settings of a motion.
#[derive(Clone, Copy)]
pub struct Motion {
    /// Length [s].
    pub seconds: f64,
    /// Amplitude of the sum of sines of a joint, as √2 times its RMS value [rad].
    pub amplitude: f64,
    /// Range of the frequencies [Hz].
    pub hz: [f64; 2],
    /// Seed of the frequencies, the phases and the sensor noise.
    pub seed: u64,
}

/// A log with and without sensor noise.
pub struct Logs {
    /// Log with sensor noise.
    pub measured: Log,
    /// Log without sensor noise.
    pub exact: Log,
}

impl HiddenDrive {
    /// Simulates `motion` with this actuator.
    ///
    /// # Panics
    /// If the robot cannot be simulated.
    pub fn logs(&self, motion: Motion) -> Logs {
        let entries = self.effects.iter().map(|(name, values)| {
            let effect = Effect::named(name).expect("an effect of the catalogue");
            EffectEntry::new(effect, Scope::All, values.to_vec()).expect("plausible values")
        });
        let robot = apply_effects(&go2(), &entries.collect::<Vec<_>>()).expect("a robot");
        let backend = |_, robot: &RobotModel| {
            let config =
                SimConfig { base: BaseMount::Fixed, physics_hz: Some(4000), threads: 1, ..SimConfig::default() };
            BatchBackend::new(robot.clone(), config, 1).map_err(|error| RecordError::Backend(error.into()))
        };
        let exact = record(&waves(motion), &robot, None, backend, self.name.to_owned(), &mut |_| true).expect("a log");
        let exact = if self.sensor == TorqueSensor::JointOutput { at_output(&exact, &robot) } else { exact };
        let measured = apply_sensors(&exact, &SENSORS, motion.seed).expect("a log");
        Logs { measured, exact }
    }
}

/// Returns position commands: per joint a sum of sines around the default pose.
///
/// The sines of a joint have equal amplitudes. Frequencies and phases differ between joints.
fn waves(motion: Motion) -> Log {
    let mut random = stream(motion.seed, "hidden drive motion", 0);
    let mut columns = BTreeMap::<String, Vec<f64>>::new();
    let rows = (motion.seconds * RATE_HZ) as usize;
    columns.insert("t".to_owned(), (0..rows).map(|row| row as f64 / RATE_HZ).collect());
    columns.insert("kp".to_owned(), vec![25.0; rows]);
    columns.insert("kd".to_owned(), vec![0.6; rows]);
    for joint in Joint::ALL {
        let [low, high] = motion.hz;
        let sines: [(f64, f64); WAVES] = std::array::from_fn(|_| {
            (low * (high / low).powf(random.random_range(0.0..1.0)), random.random_range(0.0..TAU))
        });
        let amplitude = motion.amplitude * if joint.kind == JointKind::Hip { 0.6 } else { 1.0 };
        let pose = go2().control.default_pose[joint.index()];
        let at = |row: usize| {
            let t = row as f64 / RATE_HZ;
            let sum: f64 = sines.iter().map(|(hz, phase)| (TAU * hz * t + phase).sin()).sum();
            pose + t.min(1.0) * amplitude * sum / (WAVES as f64).sqrt()
        };
        columns.insert(format!("q_cmd_{}", joint.name()), (0..rows).map(at).collect());
    }
    let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
    Log::new_commands(Meta::new(RATE_HZ, TorqueSensor::MotorCurrent, segments), columns).expect("a motion")
}

/// Returns `log` with the torque at the joint output, which is the motor torque minus friction.
///
/// Friction is computed from the mean joint velocity of a row and the next.
fn at_output(log: &Log, robot: &RobotModel) -> Log {
    let meta = Meta { tau_sensor: TorqueSensor::JointOutput, ..log.meta().clone() };
    let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect();
    let mut columns = vec![
        ("t".to_owned(), log.t().to_vec()),
        ("segment".to_owned(), index(log.segment())),
        ("episode".to_owned(), index(log.episode())),
    ];
    for (name, cells) in log.channels() {
        let Some(joint) = name.strip_prefix("tau_measured_") else {
            columns.push((name.to_owned(), cells.to_vec()));
            continue;
        };
        let joint: Joint = joint.parse().expect("one of the twelve");
        let (numbers, dq) = (&robot.joints[joint.index()], log.dq(joint.name()).expect("measured"));
        let output_torque = |row: usize| {
            let speed = f64::midpoint(dq[row], dq[(row + 1).min(dq.len() - 1)]);
            cells[row] - numbers.coulomb_friction * (speed / 0.02).tanh() - numbers.viscous_friction * speed
        };
        columns.push((name.to_owned(), (0..cells.len()).map(output_torque).collect()));
    }
    Log::new(meta, columns).expect("a log")
}
