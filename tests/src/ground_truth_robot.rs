//! Simulated robots with known parameters, and their logs: ground truth for system identification.
//!
//! The robot runs in rapier at 4 kHz, the model in the batch engine at 1 kHz. The robot's sensors have noise and a
//! finite resolution.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use glam::DVec3;
use rand::RngExt;
use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, EffectEntry, Scope};
use twinstep_identify::{RecordError, Sensor, apply_sensors, record};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, Joint, JointKind, Leg, RobotModel, go2, stream};
use twinstep_sim::{Engine, RapierBackend, SimConfig};

/// Rate of the log [Hz].
const RATE_HZ: f64 = 200.0;
/// Number of rows with a fixed base.
const AIR_ROWS: usize = 1300;
/// Number of rows with a floating base, standing.
const STANCE_ROWS: usize = 2400;

/// Noise and resolution of the sensors.
pub const SENSORS: [Sensor; 7] = [
    Sensor { quantity: "q", sigma: 0.002, resolution: 0.0002 },
    Sensor { quantity: "dq", sigma: 0.05, resolution: 0.01 },
    Sensor { quantity: "tau_measured", sigma: 0.2, resolution: 0.05 },
    Sensor { quantity: "pos", sigma: 0.002, resolution: 0.0 },
    Sensor { quantity: "quat", sigma: 0.004, resolution: 0.0 },
    Sensor { quantity: "vel", sigma: 0.03, resolution: 0.0 },
    Sensor { quantity: "gyro", sigma: 0.02, resolution: 0.001 },
];

/// Returns an effect of the catalogue with its scope, as in `coulomb_friction@calf`.
///
/// # Panics
/// If the effect or the scope does not exist.
pub fn effect(name: &str, scope: &str) -> (&'static Effect, Scope) {
    (Effect::named(name).expect("an effect of the catalogue"), scope.parse().expect("a scope"))
}

/// Returns the robot with number `case`.
///
/// Trunk mass varies by ±20 %, the centre of mass by ±4 cm along each axis, the inertia by a further ±20 %. Each joint
/// type has its own κ (18 to 30 N·m), Coulomb friction and rotor inertia. The command delay is 1 to 10 ms.
pub fn ground_truth_robot(case: u64) -> ModelFile {
    let mut random = stream(case, "hidden robot", 0);
    let mut draw = |low: f64, high: f64| random.random_range(low..high);
    let mut trunk = go2().trunk;
    let heavier = draw(0.8, 1.2);
    trunk.mass *= heavier;
    trunk.com += DVec3::new(draw(-0.04, 0.04), draw(-0.04, 0.04), draw(-0.04, 0.04));
    trunk.inertia *= heavier * draw(0.8, 1.2);
    let mut entries = vec![("inertia", "base", trunk.log_cholesky().to_vec())];
    for kind in ["hip", "thigh", "calf"] {
        let [low, high] = if kind == "calf" { [0.3, 1.2] } else { [0.1, 0.5] };
        entries.push(("torque_saturation", kind, vec![draw(18.0, 30.0)]));
        entries.push(("coulomb_friction", kind, vec![draw(low, high)]));
        entries.push(("armature", kind, vec![draw(-0.005, 0.02)]));
    }
    entries.push(("command_delay", "all", vec![draw(0.001, 0.01)]));
    let entry = |(name, scope, values): (&str, &str, Vec<f64>)| {
        let (effect, scope) = effect(name, scope);
        EffectEntry::new(effect, scope, values).expect("drawn within the bounds")
    };
    ModelFile { effects: entries.into_iter().map(entry).collect(), ..ModelFile::default() }
}

/// Returns the effects to estimate: those of the ground truth, and the ground, whose contact models differ between the
/// engines.
pub fn estimated_effects() -> Vec<(&'static Effect, Scope)> {
    let true_effects = ground_truth_robot(0).effects;
    let ground = [effect("ground_stiffness", "ground"), effect("ground_friction", "ground")];
    true_effects.iter().map(|entry| (entry.effect, entry.scope)).chain(ground).collect()
}

/// Returns commands for 6.5 s with a fixed base (a chirp, then square waves with higher gains) and 12 s of standing.
///
/// While standing, the base moves slowly. Each `variant` is another motion of the same kind.
pub fn motion(variant: u64) -> Log {
    let mut random = stream(variant, "motion", 0);
    let pace = if variant == 0 { 1.0 } else { random.random_range(0.8..1.25) };
    let shift = if variant == 0 { 0.0 } else { random.random_range(0.0..TAU) };
    let mut columns = BTreeMap::<String, Vec<f64>>::new();
    for row in 0..AIR_ROWS + STANCE_ROWS {
        let air = row < AIR_ROWS;
        let time = (if air { row } else { row - AIR_ROWS }) as f64 / RATE_HZ;
        let square = air && time > 4.0;
        let mut cell = |name: String, value: f64| columns.entry(name).or_default().push(value);
        cell("t".to_owned(), row as f64 / RATE_HZ);
        cell("segment".to_owned(), f64::from(u8::from(!air)));
        cell("kp".to_owned(), if square { 60.0 } else { 25.0 + 15.0 * f64::from(u8::from(!air)) });
        cell("kd".to_owned(), if air { 0.8 } else { 1.0 });
        for joint in Joint::ALL {
            let offset = match (air, square) {
                (true, false) => 0.3 * (TAU * pace * (0.5 + 0.4 * time) * time + joint.index() as f64 + shift).sin(),
                (true, true) => {
                    let rate = pace * (1.5 + joint.index() as f64 / 60.0);
                    0.25 * (TAU * rate * time + joint.index() as f64 + shift).sin().signum()
                }
                _ => sway(joint, pace * time, shift),
            };
            cell(format!("q_cmd_{}", joint.name()), go2().control.default_pose[joint.index()] + offset);
        }
    }
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let segments = vec![segment("air", BaseMount::Fixed), segment("stance", BaseMount::Floating)];
    let mut meta = Meta::new(RATE_HZ, TorqueSensor::MotorCurrent, segments);
    meta.joints = JOINT_NAMES.map(str::to_owned).to_vec();
    Log::new_commands(meta, columns).expect("a motion")
}

/// Returns the joint offset [rad] that lifts, pitches, rolls and shifts the trunk slowly while the feet stay in place.
fn sway(joint: Joint, time: f64, shift: f64) -> f64 {
    let wave = |way: f64| {
        let waves = [(0.31, 0.5), (0.57, 0.3), (0.97, 0.2)].into_iter().enumerate();
        let sum: f64 = waves
            .map(|(index, (rate, part))| {
                part * (TAU * (rate + 0.05 * way) * time + 1.7 * way + index as f64 + shift).sin()
            })
            .sum();
        time.min(1.0) * sum
    };
    let front = if matches!(joint.leg, Leg::FL | Leg::FR) { 1.0 } else { -1.0 };
    let left = if matches!(joint.leg, Leg::FL | Leg::RL) { 1.0 } else { -1.0 };
    let length = 0.12 * wave(0.0) + 0.07 * front * wave(1.0) + 0.03 * left * wave(2.0);
    match joint.kind {
        JointKind::Hip => 0.04 * wave(3.0),
        JointKind::Thigh => length + 0.06 * wave(4.0),
        JointKind::Calf => -2.0 * length,
    }
}

/// Simulates `robot` with the commands of `motion` and returns the log with sensor noise.
pub fn log_of(robot: &ModelFile, motion: &Log, seed: u64) -> Log {
    let robot = robot.robot_model().expect("a robot");
    let backend = |base: BaseMount, robot: &RobotModel| {
        let config =
            SimConfig { engine: Engine::Rapier, base, physics_hz: Some(4000), threads: 1, ..SimConfig::default() };
        RapierBackend::new(robot.clone(), config, 1).map_err(|error| RecordError::Backend(Box::new(error)))
    };
    let exact = record(motion, &robot, None, backend, "a robot of `ground_truth_robot`".to_owned(), &mut |_| true);
    apply_sensors(&exact.expect("the simulation completes"), &SENSORS, seed).expect("a log")
}
