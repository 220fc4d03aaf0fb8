//! Preflight on the fake Go2: every injected mistake is named, and nothing is found on healthy robots.

use std::time::Duration;

use rand::RngExt;
use rayon::prelude::*;
use twinstep_model::{BaseMount, Joint, RobotModel, stream};
use twinstep_robot::fake::{FakeConfig, FakeFault, FakeRobot};
use twinstep_robot::preflight::{Preflight, PreflightInput, PreflightReport};
use twinstep_robot::{CommandLimits, Fault, SafetyConfig};
use twinstep_tests::robot_rig::{backend, released, robot_at_500_hz};
use twinstep_unitree::encode;

/// Runs preflight on a robot. `change` is called before each step with the time [s].
fn run_with(robot: FakeRobot, change: impl FnMut(&mut FakeRobot, f64, &mut PreflightInput)) -> PreflightReport {
    run_with_gaps(robot, 2, change)
}

/// The same, on a computer that makes gaps of up to `max_gap_ms` between commands.
fn run_with_gaps(
    mut robot: FakeRobot,
    max_gap_ms: u64,
    mut change: impl FnMut(&mut FakeRobot, f64, &mut PreflightInput),
) -> PreflightReport {
    let model = robot_at_500_hz();
    let limits = CommandLimits::new(&model, &SafetyConfig::default());
    let mut preflight = Preflight::new(&model, SafetyConfig::default()).unwrap();
    let mut input = PreflightInput::default();
    for step in 1..50_000_u64 {
        input.now = Duration::from_millis(2 * step);
        input.states = robot.step().unwrap();
        input.foreign_writers = usize::from(robot.wants_foreign_writer());
        input.controller = robot.sport_state().map(|_| "mcf".to_owned());
        change(&mut robot, 0.002 * step as f64, &mut input);
        let output = preflight.step(&input);
        if let Some(command) = output.command {
            assert!(limits.check(command.command()).is_ok());
            robot.receive(&encode(&command.to_low_cmd())).unwrap();
        }
        if let Some(report) = output.report {
            assert!(robot.statistics().largest_gap_ms <= max_gap_ms && robot.statistics().refused == 0);
            return report;
        }
    }
    panic!("preflight does not end");
}

fn run(robot: FakeRobot) -> PreflightReport {
    run_with(robot, |_, _, _| {})
}

/// Returns a robot with these faults, one line each.
fn robot_with(lines: &[&str]) -> FakeRobot {
    let mut robot = FakeRobot::new(backend(robot_at_500_hz(), BaseMount::Floating), released()).unwrap();
    for line in lines {
        robot.inject(line.parse::<FakeFault>().unwrap()).unwrap();
    }
    robot
}

/// Runs preflight on a healthy robot, on a computer that stands still for `pause_ms` every `every_ms`. `robot_too`: the robot is
/// simulated on the same computer.
fn run_with_pauses(every_ms: u64, pause_ms: u64, robot_too: bool) -> PreflightReport {
    let (mut stood_still_ms, mut count) = (0, 0);
    run_with_gaps(robot_with(&[]), pause_ms + 2, move |robot, time, input| {
        if (1000.0 * time) as u64 / every_ms > count {
            count += 1;
            stood_still_ms += pause_ms;
            for _ in 0..if robot_too { 0 } else { pause_ms / 2 } {
                input.states.extend(robot.step().unwrap());
            }
        }
        input.now += Duration::from_millis(stood_still_ms);
    })
}

#[test]
fn pauses_of_the_computer_are_no_finding() {
    for (every_ms, pause_ms, robot_too) in
        [(300, 15, false), (300, 15, true), (150, 10, true), (97, 8, false), (400, 18, false), (400, 18, true)]
    {
        let report = run_with_pauses(every_ms, pause_ms, robot_too);
        let what = format!("{pause_ms} ms every {every_ms} ms, robot too: {robot_too}");
        assert!(report.findings.is_empty() && report.stopped_by.is_none(), "{what}: {report:#?}");
    }
    // So often that nothing can be measured: each test is repeated, left out, and noted.
    let report = run_with_pauses(20, 10, true);
    assert!(report.findings.is_empty() && report.stopped_by.is_none(), "{report:#?}");
    let left_out: Vec<_> = report.left_out.iter().map(|left_out| left_out.check).collect();
    assert!(left_out.contains(&"rate of the states") && left_out.contains(&"legs against the trunk"), "{left_out:?}");
}

/// Mistakes as lines of the fake robot, each with the finding that names it and the part that it must name.
const MISTAKES: [(&str, &str, &str); 44] = [
    ("loss 1", "no_states", "interface"),
    ("mistake states slow", "state_rate", "50 states per second"),
    ("mistake checksum wrong", "checksum", "wrong checksum"),
    ("mistake clock stopped", "clock_stopped", "stands still"),
    ("foreign writer on", "foreign_writer", "1 other writers"),
    ("controller on", "controller_active", "`mcf`"),
    ("battery 10", "battery_low", "10 %"),
    ("voltage 20", "voltage_low", "20.0 V"),
    ("heat RL_calf 80", "motor_hot", "RL_calf"),
    ("remote lost", "remote_lost", "remote control"),
    ("messages lost", "messages_lost", "lost messages"),
    ("fall", "tilted", "tilted by"),
    ("joint out FL_hip", "joint_out_of_range", "FL_hip"),
    ("mistake encoder degrees", "encoder_degrees", "degrees"),
    ("mistake encoder scale FR_calf 1.917", "joint_out_of_range", "FR_calf"),
    ("mistake encoder scale RL_hip 2", "encoder_scale", "RL_hip"),
    ("mistake encoder scale FL_hip 0.5", "encoder_scale", "FL_hip"),
    ("mistake encoder sign FR_hip", "encoder_sign", "FR_hip"),
    ("mistake encoder offset FL_hip 0.2", "encoder_offset", "FL_hip"),
    ("mistake encoder offset RR_calf 0.25", "encoder_offset", "RR_calf"),
    ("mistake encoder dead RR_thigh", "encoder_dead", "RR_thigh"),
    ("mistake motor frozen FL_calf", "motor_unresponsive", "FL_calf"),
    ("mistake motor dead FR_thigh", "motor_unresponsive", "FR_thigh"),
    ("mistake motor weak RL_calf 0.5", "motor_gain", "RL_calf"),
    ("mistake gains stale FR_hip", "gains_stale", "FR_hip"),
    ("mistake velocity sign RL_thigh", "velocity_sign", "RL_thigh"),
    ("mistake velocity scale RR_hip 0.5", "velocity_scale", "RR_hip"),
    ("mistake torque sign FL_thigh", "torque_sign", "FL_thigh"),
    ("mistake commands swapped FL FR", "joint_order", "FL_hip reaches FR_hip"),
    ("mistake joint mirrored FR_thigh", "joint_implausible", "FR"),
    ("mistake joint mirrored RL_calf", "joint_out_of_range", "RL_calf"),
    ("mistake joint mirrored FL_hip", "joint_mirrored", "FL_hip"),
    ("mistake joint mirrored RR_hip", "joint_mirrored", "RR_hip"),
    ("mistake legs swapped FL FR", "legs_swapped", "FL and FR"),
    ("mistake legs swapped FR RL", "legs_swapped", "FR and RL"),
    ("mistake joint offset RL_calf 0.3", "joint_offset", "RL_calf"),
    ("mistake quaternion xyzw", "quaternion_xyzw", "w, x, y, z"),
    ("mistake quaternion inverted", "quaternion_inverted", "invert"),
    ("mistake gyro swapped", "gyro_axes", "x and y"),
    ("mistake gyro degrees", "gyro_degrees", "degrees"),
    ("mistake gyro sign x", "gyro_sign", "x axis"),
    ("mistake accelerometer g", "accelerometer_g", "9.81"),
    ("mistake imu turned 90", "imu_turned", "90°"),
    ("mistake imu upside down", "imu_upside_down", "upside down"),
];

/// Further mistakes: the same with another sign, axis or angle.
const MORE: [(&str, &str, &str); 4] = [
    ("mistake accelerometer sign", "accelerometer_sign", "sign"),
    ("mistake gyro sign y", "gyro_sign", "y axis"),
    ("mistake imu turned 180", "imu_turned", "180°"),
    ("mistake imu turned 270", "imu_turned", "270°"),
];

#[test]
fn every_injected_mistake_is_named() {
    let mistakes: Vec<_> = MISTAKES.into_iter().chain(MORE).collect();
    let rows: Vec<_> = mistakes
        .par_iter()
        .map(|(line, id, part)| {
            let report = run(robot_with(&[line]));
            let named = report.findings.iter().any(|finding| finding.id == *id && finding.to_string().contains(part));
            let others: Vec<_> =
                report.findings.iter().filter(|finding| finding.id != *id).map(|finding| finding.id).collect();
            (*line, *id, named, others, report)
        })
        .collect();
    let mut wrong = 0;
    for (line, id, named, others, report) in &rows {
        println!("| {line} | {id} | {} | {} |", if *named { "named" } else { "NOT NAMED" }, others.join(", "));
        if !named || !others.is_empty() {
            wrong += 1;
            for finding in &report.findings {
                println!("{finding}");
            }
            for left_out in &report.left_out {
                println!("{left_out}");
            }
            println!("stopped by {:?}", report.stopped_by);
        }
    }
    assert_eq!(wrong, 0);
}

/// Returns a healthy robot: another seed, pose, weight, ground and friction each.
fn healthy(seed: u64) -> (RobotModel, FakeConfig) {
    let mut random = stream(seed, "healthy", 0);
    let mut between = |low: f64, high: f64| random.random_range(low..high);
    let mut model = robot_at_500_hz();
    if seed.is_multiple_of(2) {
        model.trunk.mass *= 1.2;
        model.trunk.inertia *= 1.2;
    }
    model.contact.friction = between(0.5, 1.0);
    let friction = if seed.is_multiple_of(3) { 0.1 } else { 0.0 };
    let coulomb = between(0.2, 0.5);
    for joint in &mut model.joints {
        (joint.coulomb_friction, joint.viscous_friction) = (coulomb, friction);
    }
    let mut start = Joint::map_kinds(0.0, 1.36, -2.65);
    for q in &mut start {
        *q += between(-0.1, 0.1) as f32;
        *q = q.max(-2.7);
    }
    (model, FakeConfig { seed, start, ..released() })
}

#[test]
fn nothing_is_found_on_100_healthy_robots() {
    let reports: Vec<_> = (0..100_u64)
        .into_par_iter()
        .map(|seed| {
            let (model, config) = healthy(seed);
            (seed, run(FakeRobot::new(backend(model, BaseMount::Floating), config).unwrap()))
        })
        .collect();
    let mut wrong = 0;
    for (seed, report) in reports {
        if report != PreflightReport::default() {
            wrong += 1;
            println!("seed {seed}: {:?}", report.stopped_by);
            report.findings.iter().for_each(|finding| println!("{finding}"));
            report.left_out.iter().for_each(|left_out| println!("{left_out}"));
        }
    }
    assert_eq!(wrong, 0);
}

#[test]
fn robot_that_hangs_has_no_finding_and_a_list_of_what_was_not_checked() {
    let report = run(FakeRobot::new(backend(robot_at_500_hz(), BaseMount::Fixed), released()).unwrap());
    assert_eq!((report.findings, report.stopped_by), (Vec::new(), None));
    let checks: Vec<_> = report.left_out.iter().map(|left_out| left_out.check).collect();
    assert!(checks.ends_with(&["gyroscope against quaternion", "frame of the IMU", "legs against the trunk"]));
}

#[test]
fn several_mistakes_are_all_named() {
    let lines = ["battery 10", "mistake encoder dead RR_thigh", "mistake accelerometer g", "mistake clock stopped"];
    let ids = |report: PreflightReport| report.findings.into_iter().map(|finding| finding.id).collect::<Vec<_>>();
    assert_eq!(ids(run(robot_with(&lines))), ["clock_stopped", "battery_low", "accelerometer_g"]);
    let lines = [lines[1], lines[2], "mistake torque sign FL_hip", "mistake motor weak FR_calf 0.5"];
    let expected = ["accelerometer_g", "torque_sign", "motor_gain", "encoder_dead"];
    assert_eq!(ids(run(robot_with(&lines))), expected);
}

#[test]
fn faults_end_the_motions_in_damping() {
    let stopped = |line: &str, at: f64| {
        let fault: FakeFault = line.parse().unwrap();
        let mut injected = false;
        let report = run_with(robot_with(&[]), |robot, time, _| {
            if time > at && !injected {
                injected = true;
                robot.inject(fault).unwrap();
            }
        });
        assert!(report.left_out.iter().any(|left_out| left_out.check == "everything after the stop"), "{line}");
        report.stopped_by.unwrap()
    };
    assert_eq!(stopped("remote L2+B", 3.0), Fault::RemoteStop);
    assert!(matches!(stopped("foreign writer on", 5.0), Fault::ForeignWriter { .. }));
    assert!(matches!(stopped("stale 200", 6.0), Fault::StateStale { .. }));
    assert!(matches!(stopped("heat FL_calf 90", 16.0), Fault::Temperature { .. }));
    assert!(matches!(stopped("joint out RR_hip", 18.0), Fault::JointLimit { .. }));
    let report = run_with(robot_with(&[]), |_, time, input| input.stop_requested = time > 4.0);
    assert_eq!(report.stopped_by, Some(Fault::StopRequested));
}

#[test]
fn second_robot_is_named_and_nothing_is_moved() {
    let mut commands = 0;
    let report = run_with(robot_with(&[]), |robot, _, input| {
        input.other_robot = true;
        commands = robot.statistics().accepted;
    });
    assert!(report.findings.iter().any(|finding| finding.id == "other_robot"), "{report:?}");
    assert_eq!(commands, 0);
}

#[test]
fn states_that_are_a_little_late_or_sometimes_lost_are_no_finding() {
    for lines in [&["delay 2"][..], &["delay 6"], &["loss 0.05"], &["reorder"], &["delay 4", "loss 0.02"]] {
        let report = run(robot_with(lines));
        assert_eq!(report, PreflightReport::default(), "{lines:?}");
    }
}
