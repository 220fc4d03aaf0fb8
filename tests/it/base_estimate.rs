//! Logs without motion capture: the motion of the base from legs and IMU, and a diagnosis that starts from it.

use std::f64::consts::TAU;

use glam::DVec3;
use twinstep_diagnose::{Diagnosis, ParameterValue};
use twinstep_effects::{Effect, EffectEntry, Scope, apply_effects};
use twinstep_identify::orientation::orientation;
use twinstep_identify::{BaseEstimate, Sensor, apply_sensors, record};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, Joint, JointKind, Leg, RobotModel, go2, standard_normal, stream};
use twinstep_sim::{Engine, RapierBackend, SimConfig};

use crate::identify::twinstep;

const RATE_HZ: f64 = 200.0;
const ROWS: usize = 1200;

/// Returns the joint command of a trot in place of 2 Hz, with hops after 4 s [rad].
fn command(joint: Joint, t: f64) -> f64 {
    let pose = go2().control.default_pose[joint.index()];
    let phase = if matches!(joint.leg, Leg::FL | Leg::RR) { 0.0 } else { 0.5 };
    let lift = (TAU * (2.0 * t + phase)).sin().max(0.0);
    let ease = t.min(1.0);
    let crouch = 0.2 * (1.0 - (TAU * 2.5 * t).cos());
    match joint.kind {
        JointKind::Hip => pose,
        JointKind::Thigh if t > 4.0 => pose + crouch,
        JointKind::Calf if t > 4.0 => pose - 2.0 * crouch,
        JointKind::Thigh => pose + ease * (0.35 * lift + 0.1 * (TAU * (2.0 * t + phase)).cos()),
        JointKind::Calf => pose - ease * 0.6 * lift,
    }
}

/// Returns the log of `robot` for `rows` of the motion, measured by encoders, gyroscope, force sensors and motion capture.
fn log(robot: &RobotModel, rows: usize) -> Log {
    let column =
        |name: String, of: &dyn Fn(f64) -> f64| (name, (0..rows).map(|row| of(row as f64 / RATE_HZ)).collect());
    let mut columns: Vec<(String, Vec<f64>)> =
        vec![column("t".into(), &|t| t), column("kp".into(), &|_| 40.0), column("kd".into(), &|_| 1.0)];
    columns.extend(Joint::ALL.map(|joint| column(format!("q_cmd_{joint}"), &|t| command(joint, t))));
    let segments = vec![Segment { name: "trot".into(), base: BaseMount::Floating }];
    let motion = Log::new_commands(Meta::new(RATE_HZ, TorqueSensor::None, segments), columns).unwrap();
    let backend = |base, robot: &RobotModel| {
        let config = SimConfig { base, engine: Engine::Rapier, threads: 1, ..SimConfig::default() };
        Ok(RapierBackend::new(robot.clone(), config, 1).unwrap())
    };
    let exact = record(&motion, robot, None, backend, "test".into(), &mut |_| true);
    let sensor = |quantity, sigma| Sensor { quantity, sigma, resolution: 0.0 };
    let sensors = [sensor("q", 5e-4), sensor("dq", 0.05), sensor("gyro", 0.02), sensor("quat", 5e-3)];
    apply_sensors(&exact.unwrap(), &sensors, 1).unwrap()
}

/// Returns the root mean square errors of height [m] and velocity [m/s] in rows.
fn errors(log: &Log, estimate: &BaseEstimate, rows: std::ops::Range<usize>) -> [f64; 2] {
    let axes = ["x", "y", "z"];
    let velocity = axes.map(|axis| log.channel(&format!("vel_{axis}")).unwrap());
    let height = log.channel("pos_z").unwrap();
    let count = rows.len() as f64;
    let of_height = rows.clone().map(|row| (estimate.position[row].z - height[row]).powi(2)).sum::<f64>();
    let of_velocity = rows
        .flat_map(|row| (0..3).map(move |axis| (row, axis)))
        .map(|(row, axis)| (estimate.velocity[row][axis] - velocity[axis][row]).powi(2))
        .sum::<f64>();
    [(of_height / count).sqrt(), (of_velocity / count / 3.0).sqrt()]
}

#[test]
fn height_and_velocity_of_a_trotting_and_hopping_robot_are_estimated_from_its_legs() {
    let forces = log(&go2(), ROWS);
    let (accelerometer, counts) = (with_accelerometer(&forces), with_counts(&forces));
    for (sensor, log) in [("forces", forces), ("accelerometer", accelerometer), ("raw counts", counts)] {
        let estimate = BaseEstimate::of(&log, &go2());
        for (name, rows, most) in [("trot", 0..800, [0.002, 0.06]), ("hop", 800..ROWS, [0.012, 0.2])] {
            let [height, velocity] = errors(&log, &estimate, rows);
            let text = format!("{sensor}, {name}: height {height:.4} m, velocity {velocity:.3} m/s");
            println!("{text}; predicted {:.4} m, {:.3} m/s", estimate.height_sigma, estimate.velocity_sigma);
            assert!(height < most[0] && velocity < most[1], "{text}");
            assert!(height < 4.0 * estimate.height_sigma && velocity < 4.0 * estimate.velocity_sigma, "{text}");
        }
    }
}

/// Returns the log with the raw counts of force sensors that have an offset, as those of a Go2.
fn with_counts(log: &Log) -> Log {
    let counts = |(name, cells): (&str, &[f64])| {
        let is_force = name.starts_with("foot_force_");
        (name.to_owned(), cells.iter().map(|cell| if is_force { (15.0 + 0.8 * cell).floor() } else { *cell }).collect())
    };
    let time = [("t".to_owned(), log.t().to_vec())];
    Log::new(log.meta().clone(), log.channels().map(counts).chain(time)).unwrap()
}

/// Returns the log with an accelerometer of 0.2 m/s² noise in place of force sensors.
fn with_accelerometer(log: &Log) -> Log {
    let row_of =
        |kind: &str, row: usize| ["x", "y", "z"].map(|axis| log.channel(&format!("{kind}_{axis}")).unwrap()[row]);
    let mut random = stream(2, "accelerometer", 0);
    let of_row = |row: usize| {
        let [before, after] = [row.saturating_sub(1), (row + 1).min(log.rows() - 1)];
        let [v0, v1] = [before, after].map(|row| DVec3::from_array(row_of("vel", row)));
        let force = (v1 - v0) / (log.t()[after] - log.t()[before]) + DVec3::new(0.0, 0.0, 9.81);
        orientation(log, row).inverse() * force
    };
    let exact: Vec<DVec3> = (0..log.rows()).map(of_row).collect();
    let kept = log.channels().filter(|(name, _)| !name.starts_with("foot_force_"));
    let columns = kept.map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect::<Vec<_>>();
    let acc = (0..3).map(|axis| {
        let cells = exact.iter().map(|acc| acc[axis] + 0.2 * standard_normal(&mut random)).collect();
        (format!("acc_{}", ["x", "y", "z"][axis]), cells)
    });
    let acc: Vec<(String, Vec<f64>)> = acc.collect();
    Log::new(log.meta().clone(), columns.into_iter().chain(acc).chain([("t".to_owned(), log.t().to_vec())])).unwrap()
}

#[test]
fn friction_of_a_trotting_robot_is_found_without_motion_capture() {
    let folder = tempfile::tempdir().unwrap();
    let hidden =
        EffectEntry::new(Effect::named("coulomb_friction").unwrap(), Scope::Kind(JointKind::Thigh), vec![0.8]).unwrap();
    let with_capture = log(&apply_effects(&go2(), &[hidden]).unwrap(), 800);
    let channels = with_capture.channels().filter(|(name, _)| !name.starts_with("pos_") && !name.starts_with("vel_"));
    let columns = channels.map(|(name, cells)| (name.to_owned(), cells.to_vec()));
    let all = columns.chain([("t".to_owned(), with_capture.t().to_vec())]);
    let path = folder.path().join("trot.parquet");
    Log::new(with_capture.meta().clone(), all).unwrap().write(&path).unwrap();
    let out = folder.path().join("diagnosis");
    let output = twinstep(&["diagnose", path.to_str().unwrap(), "--out", out.to_str().unwrap(), "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let diagnosis: Diagnosis = serde_json::from_slice(&output.stdout).unwrap();
    let cause = &diagnosis.findings[0];
    assert_eq!((cause.effect.as_str(), cause.scope.as_str()), ("coulomb_friction", "thigh"), "{diagnosis:#?}");
    let ParameterValue::Number(value) = cause.parameters["torque_nm"].value else { panic!("{cause:?}") };
    // Four seconds without a torque sensor.
    assert!((value - 0.8).abs() < 0.16, "{value}");
}
