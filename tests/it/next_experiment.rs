//! The next experiment: all excitation trajectories are safe, and the chosen one discriminates better than the median.

use std::f64::consts::TAU;

use twinstep_diagnose::{Diagnosis, EXCITATION_TRAJECTORIES};
use twinstep_effects::EffectEntry;
use twinstep_effects::ModelFile;
use twinstep_identify::{Sensor, apply_sensors, record};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, Joint, RobotModel, go2};
use twinstep_sim::{BatchBackend, BatchRollout, SimConfig};
use twinstep_tests::confounded_pairs::PAIRS;
use twinstep_tests::ground_truth_robot::effect;

use crate::identify::twinstep;

/// Minimum distance of a joint from the limits of its range [rad].
const MARGIN: f64 = 0.1;
/// Maximum speed of a joint [rad/s]. The speed limit of the calf actuator is 15.7 rad/s.
const MAX_SPEED: f64 = 10.0;

/// Returns the log of `robot` for the commands of `motion`, simulated with a smaller step than the models.
fn simulated(motion: &Log, robot: &RobotModel) -> Log {
    let backend = |base: BaseMount, robot: &RobotModel| {
        let config = SimConfig { base, physics_hz: Some(4000), threads: 1, ..SimConfig::default() };
        Ok(BatchBackend::new(robot.clone(), config, 1).unwrap())
    };
    record(motion, robot, None, backend, String::new(), &mut |_| true).unwrap()
}

/// Returns only the noisy encoder readings and the commands of `log`.
fn with_encoders_only(log: &Log) -> Log {
    let is_kept = |name: &str| name.starts_with("q_") || name.starts_with('k');
    let kept = log.channels().filter(|(name, _)| is_kept(name));
    let columns = kept.map(|(name, cells)| (name.to_owned(), cells.to_vec()));
    let columns = columns.chain([("t".to_owned(), log.t().to_vec())]);
    let log = Log::new(Meta { tau_sensor: TorqueSensor::None, ..log.meta().clone() }, columns).unwrap();
    apply_sensors(&log, &[Sensor { quantity: "q", sigma: 0.002, resolution: 0.0 }], 1).unwrap()
}

#[test]
fn nominal_robot_executes_every_trajectory_within_its_limits() {
    for motion in EXCITATION_TRAJECTORIES {
        let (name, log) = (motion.name, simulated(&motion.motion(&go2()), &go2()));
        let largest = |cells: &[f64]| {
            cells.iter().filter(|cell| cell.is_finite()).fold(0.0, |largest: f64, cell| largest.max(cell.abs()))
        };
        for joint in Joint::ALL {
            let limits = go2().joints[joint.index()];
            let [low, high] = limits.range;
            for cells in [log.q(joint.name()).unwrap(), log.q_cmd(joint.name()).unwrap()] {
                assert!(
                    cells.iter().all(|q| (low + MARGIN..high - MARGIN).contains(q)),
                    "{name}: {joint} is close to its limit"
                );
            }
            let speed = largest(log.dq(joint.name()).unwrap());
            let torque = largest(log.tau_measured(joint.name()).unwrap());
            assert!(speed < MAX_SPEED, "{name}: {joint} at {speed} rad/s");
            assert!(torque < 0.9 * limits.torque_limit, "{name}: {joint} with {torque} N·m");
        }
        if motion.base == BaseMount::Floating {
            let cells = |name: &str| log.channel(name).unwrap().iter();
            assert!(cells("pos_z").all(|height| (0.2..0.4).contains(height)), "{name}: falls or jumps");
            // 1 − 2 (x² + y²) is the cosine of the tilt.
            let upright = cells("quat_x").zip(cells("quat_y")).all(|(x, y)| 1.0 - 2.0 * (x * x + y * y) > 0.95);
            assert!(upright, "{name}: tips over");
        }
    }
}

#[test]
fn trajectories_have_unique_names_and_begin_and_end_in_the_default_pose() {
    for (index, motion) in EXCITATION_TRAJECTORIES.iter().enumerate() {
        assert!(EXCITATION_TRAJECTORIES[..index].iter().all(|other| other.name != motion.name));
        let log = motion.motion(&go2());
        for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
            let (commands, pose) = (log.q_cmd(name).unwrap(), go2().control.default_pose[joint]);
            assert!([0, log.rows() - 1].iter().all(|row| (commands[*row] - pose).abs() < 0.01), "{}", motion.name);
        }
    }
}

#[test]
fn chosen_trajectory_discriminates_better_than_the_median_one() {
    // Actuator lag or torque delay; `results/next_experiment.md` has more pairs.
    let pair = &PAIRS[2];
    let (pair, robot) = (pair.hypothesis_pair(), pair.robot().robot_model().unwrap());
    let mut simulator = BatchRollout::new(&go2(), &SimConfig::default()).unwrap();
    let mut ratios: Vec<[f64; 2]> = Vec::new();
    for motion in EXCITATION_TRAJECTORIES.iter().filter(|motion| motion.base == BaseMount::Fixed) {
        let log = with_encoders_only(&simulated(&motion.motion(&go2()), &robot));
        let predicted = pair.expected_log_likelihood_ratio(motion, &log, &mut simulator).unwrap();
        ratios.push([predicted, pair.log_likelihood_ratio(log, &mut simulator).unwrap()]);
    }
    let chosen = ratios.iter().max_by(|one, other| one[0].total_cmp(&other[0])).unwrap()[1];
    ratios.sort_by(|one, other| one[1].total_cmp(&other[1]));
    assert!(chosen > ratios[ratios.len() / 2][1] + 10.0, "chosen {chosen:.1}: {ratios:.1?}");
}

/// Returns commands of one slow sine per joint for 6 s, at which all laws of dry friction have the same effect.
fn slow_sines() -> Log {
    let segments = vec![Segment { name: "sines".to_owned(), base: BaseMount::Fixed }];
    let meta = Meta {
        kp: Some(Gain::Uniform(30.0)),
        kd: Some(Gain::Uniform(0.8)),
        ..Meta::new(200.0, TorqueSensor::None, segments)
    };
    let t: Vec<f64> = (0..1200).map(|row| f64::from(row) * 0.005).collect();
    let commands = Joint::ALL.map(|joint| {
        let (index, pose) = (joint.index(), go2().control.default_pose[joint.index()]);
        let command = t.iter().map(|t| pose + 0.15 * t.min(1.0) * (TAU * t + index as f64).sin()).collect();
        (format!("q_cmd_{}", joint.name()), command)
    });
    Log::new_commands(meta, commands.into_iter().chain([("t".to_owned(), t.clone())])).unwrap()
}

#[test]
fn diagnosis_with_an_alternative_writes_commands_that_play_accepts() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (friction, thighs) = effect("coulomb_friction", "thigh");
    let entry = EffectEntry::new(friction, thighs, vec![0.2]).unwrap();
    let robot = ModelFile { effects: vec![entry], ..ModelFile::default() };
    std::fs::write(path("robot.toml"), robot.to_toml()).unwrap();
    let run = |arguments: &[&str]| {
        let output = twinstep(arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    };
    let log = with_encoders_only(&simulated(&slow_sines(), &robot.robot_model().unwrap()));
    log.write(path("first.parquet")).unwrap();
    let printed = run(&["diagnose", &path("first.parquet"), "--out", &path("one"), "--json"]);
    let diagnosis: Diagnosis = serde_json::from_slice(&printed).unwrap();
    let next = diagnosis.next_experiment.expect("friction that falls at higher speeds has the same effect");
    assert!(next.parts[0].effects.iter().any(|name| name.starts_with("stribeck_friction@")), "{next:?}");
    assert!(next.parts[0].predicted_nats > next.parts[0].median_nats, "{next:?}");
    let page = std::fs::read_to_string(path("one/report.html")).unwrap();
    assert!(page.contains("Next experiment: <code>next_experiment</code>"));

    let motion = path(&format!("one/{}", next.motion));
    run(&["play", &motion, "--model", &path("robot.toml"), "--out", &path("second")]);
    assert_eq!(Log::open(path("second")).unwrap().rows(), 2000);
}
