//! `twinstep play` and `twinstep mjcf` as processes.

use std::path::Path;
use std::process::{Command, Output};

use expect_test::{Expect, expect};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{
    Backend, BaseMount, Command as RobotCommand, Ground, InitialState, JOINT_NAMES, NUM_JOINTS, PerJoint, Simulator,
    go2,
};
use twinstep_sim::{BatchBackend, Engine, SimConfig};
use twinstep_tests::python::Programs;

/// Number of rows of the commands, at 50 Hz with four actuator periods each.
const ROWS: usize = 40;
/// Row at which the second episode begins with a reset.
const RESET_ROW: usize = 25;
const KP: f64 = 40.0;

fn twinstep(arguments: &[&str]) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Command::new(programs.twinstep()).args(arguments).output().unwrap()
}

fn play(motion: &Path, out: &Path, more: &[&str]) -> Output {
    let files = ["play", motion.to_str().unwrap(), "--out", out.to_str().unwrap()];
    twinstep(&[&files, more].concat())
}

fn target(row: usize) -> PerJoint {
    let pose = go2().control.default_pose_f32();
    std::array::from_fn(|joint| pose[joint] + 0.1 * (0.3 * row as f32 + joint as f32).sin())
}

/// Returns commands for all joints but one, in two episodes.
pub fn motion(base: BaseMount, row_period: f64) -> Log {
    let segments = vec![Segment { name: "sway".to_owned(), base }];
    let meta = Meta { kp: Some(Gain::Uniform(KP)), ..Meta::new(50.0, TorqueSensor::None, segments) };
    let episode = |row| f64::from(u8::from(row >= RESET_ROW));
    let mut columns = vec![
        ("t".to_owned(), (0..ROWS).map(|row| row as f64 * row_period).collect()),
        ("episode".to_owned(), (0..ROWS).map(episode).collect()),
    ];
    // The last joint has no column and holds its default pose.
    for (joint, name) in JOINT_NAMES.iter().enumerate().take(NUM_JOINTS - 1) {
        columns.push((format!("q_cmd_{name}"), (0..ROWS).map(|row| f64::from(target(row)[joint])).collect()));
    }
    Log::new_commands(meta, columns).unwrap()
}

#[test]
fn play_writes_the_log_of_the_simulated_robot() {
    let folder = tempfile::tempdir().unwrap();
    let (source, out) = (folder.path().join("sway.csv"), folder.path().join("played"));
    motion(BaseMount::Floating, 0.02).write(&source).unwrap();
    let settings = ["--engine", "batch", "--physics-hz", "400"];
    let output = play(&source, &out, &settings);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.stdout.is_empty());
    let log = Log::open(&out).unwrap();

    let robot = go2();
    let config = SimConfig { engine: Engine::Batch, physics_hz: Some(400), threads: 1, ..SimConfig::default() };
    let mut backend = BatchBackend::new(robot.clone(), config, 1).unwrap();
    let pose = robot.control.default_pose_f32();
    let start = InitialState::standing_on(&Ground::FLAT, &robot, pose, 0.0);
    assert_eq!(log.rows(), ROWS);
    for row in 0..ROWS {
        if row == 0 || row == RESET_ROW {
            backend.reset(&[(0, start)]).unwrap();
        }
        let states = backend.states();
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            assert_eq!(log.q(name).unwrap()[row], f64::from(states.measured.q[0][joint]), "row {row}");
            assert_eq!(log.dq(name).unwrap()[row], f64::from(states.measured.dq[0][joint]), "row {row}");
        }
        assert_eq!(log.channel("pos_z").unwrap()[row], f64::from(states.truth.base_position[0][2]));
        assert_eq!(log.channel("gyro_y").unwrap()[row], f64::from(states.measured.gyro[0][1]));
        let mut command = RobotCommand::hold(target(row), KP as f32, robot.control.kd[0] as f32);
        (command.q[NUM_JOINTS - 1], command.kp[NUM_JOINTS - 1]) =
            (pose[NUM_JOINTS - 1], robot.control.kp[NUM_JOINTS - 1] as f32);
        let mut torque = 0.0;
        for _ in 0..4 {
            backend.step(&[command], &[true], 1).unwrap();
            torque += f64::from(backend.measured().tau[0][1]) / 4.0;
        }
        let logged = log.tau_measured("FL_thigh").unwrap()[row];
        if row + 1 == RESET_ROW || row + 1 == ROWS {
            assert!(logged.is_nan(), "no interval follows the last row of an episode");
        } else {
            assert!((logged - torque).abs() < 1e-9, "row {row}: {logged} N·m, not {torque}");
        }
    }
    assert_eq!((log.kp("FL_hip", 0), log.kp("RR_calf", 0)), (Some(KP), Some(robot.control.kp[NUM_JOINTS - 1])));
    assert_eq!(log.kd("FL_hip", 0), Some(robot.control.kd[0]));
    let forces = log.channel("foot_force_FL").unwrap();
    assert!(forces[0].is_nan() && forces[1].is_finite());
}

#[test]
fn base_flag_overrides_the_base_of_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let (source, out) = (folder.path().join("sway.parquet"), folder.path().join("fixed.parquet"));
    motion(BaseMount::Floating, 0.02).write(&source).unwrap();
    assert!(play(&source, &out, &["--base", "fixed"]).status.success());
    let log = Log::open(&out).unwrap();
    assert_eq!(log.meta().segments[0].base, BaseMount::Fixed);
    assert!(log.channel("pos_z").is_none() && log.tau_measured("RR_calf").is_some());
}

fn check_error(output: &Output, message: &Expect) {
    assert_eq!(output.status.code(), Some(2));
    assert!(output.stdout.is_empty());
    message.assert_eq(&String::from_utf8_lossy(&output.stderr));
}

#[test]
fn motion_at_500_hz_and_at_77_hz_is_played_at_its_own_rate() {
    let folder = tempfile::tempdir().unwrap();
    for (period, actuator_hz) in [(0.002, 500), (0.013, 231)] {
        let (source, out) = (folder.path().join("sway.csv"), folder.path().join("played.parquet"));
        motion(BaseMount::Fixed, period).write(&source).unwrap();
        let output = play(&source, &out, &[]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let log = Log::open(&out).unwrap();
        assert!(log.meta().pd.as_ref().unwrap().starts_with(&format!("PD at {actuator_hz} Hz")), "{:?}", log.meta().pd);
        // The same model on its own log: any other clock, rate or delay leaves an error.
        let evaluation = twinstep(&["evaluate", out.to_str().unwrap(), "--json"]);
        let errors: serde_json::Value = serde_json::from_slice(&evaluation.stdout).unwrap();
        assert!(errors["q_rmse_rad"].as_f64().unwrap() < 2e-3, "{errors}");
    }
}

#[test]
fn motion_below_20_hz_is_rejected_with_the_possible_rates() {
    let folder = tempfile::tempdir().unwrap();
    let (source, out) = (folder.path().join("sway.csv"), folder.path().join("played.csv"));
    motion(BaseMount::Fixed, 0.1).write(&source).unwrap();
    check_error(
        &play(&source, &out, &[]),
        &expect![[r"
            error: the log's median sample period is 100.000 ms; 0.5 to 50 ms are possible (20 to 2000 Hz)
              resample the log
        "]],
    );
    assert!(!out.exists());
}

#[test]
fn play_does_not_overwrite_its_input() {
    let folder = tempfile::tempdir().unwrap();
    let source = folder.path().join("sway.csv");
    motion(BaseMount::Fixed, 0.02).write(&source).unwrap();
    let output = play(&source, &source, &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("is the motion file itself"));
    assert!(Log::open_commands(&source).unwrap().q("FL_hip").is_none());
}

#[test]
fn physics_rate_that_is_not_a_multiple_of_the_actuator_rate_is_rejected_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let (source, out) = (folder.path().join("sway.csv"), folder.path().join("played.csv"));
    motion(BaseMount::Fixed, 0.005).write(&source).unwrap();
    check_error(
        &play(&source, &out, &["--physics-hz", "500"]),
        &expect![[r"
            error: `sim.physics_hz` = 500 is not allowed: a multiple of the actuator rate, 200 Hz, up to 20000
        "]],
    );
}

#[test]
fn time_step_of_a_mujoco_model_is_validated() {
    check_error(
        &twinstep(&["mjcf", "--timestep", "5"]),
        &expect![[r"
            error: `--timestep` = 5 is not allowed: 0.00001 to 0.02 s
        "]],
    );
    let output = twinstep(&["mjcf", "--base", "fixed"]);
    assert!(output.status.success() && output.stdout.starts_with(b"<mujoco model=\"go2\">"));
}
