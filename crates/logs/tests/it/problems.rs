//! Logs that are wrong in one way, each of which is named with its remedy.

use std::f64::consts::PI;

use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, go2};

type Columns = Vec<(String, Vec<f64>)>;

/// Twelve joints that follow their commands, each with its own frequency, at 200 Hz; and a base that turns.
fn good() -> Columns {
    let rows = 0..2000;
    let t: Vec<f64> = rows.map(|row| f64::from(row) / 200.0).collect();
    let mut columns = vec![("t".to_owned(), t.clone())];
    let pose = go2().control.default_pose;
    for (joint, name) in JOINT_NAMES.iter().enumerate() {
        let rate = 2.0 * PI * (0.4 + 0.11 * joint as f64);
        let q = |delay: f64| t.iter().map(|t| pose[joint] + 0.2 * (rate * (t - delay)).sin()).collect::<Vec<_>>();
        let dq = t.iter().map(|t| 0.2 * rate * (rate * (t - 0.02)).cos()).collect();
        columns.extend([(format!("q_{name}"), q(0.02)), (format!("q_cmd_{name}"), q(0.0)), (format!("dq_{name}"), dq)]);
    }
    let yaw: Vec<f64> = t.iter().map(|t| 0.5 * (2.0 * t).sin()).collect();
    let zero = vec![0.0; t.len()];
    columns.extend([
        ("quat_w".to_owned(), yaw.iter().map(|yaw| (yaw / 2.0).cos()).collect()),
        ("quat_x".to_owned(), zero.clone()),
        ("quat_y".to_owned(), zero.clone()),
        ("quat_z".to_owned(), yaw.iter().map(|yaw| (yaw / 2.0).sin()).collect()),
        ("gyro_x".to_owned(), zero.clone()),
        ("gyro_y".to_owned(), zero.clone()),
        ("gyro_z".to_owned(), t.iter().map(|t| (2.0 * t).cos()).collect()),
        ("acc_x".to_owned(), zero.clone()),
        ("acc_y".to_owned(), zero),
        ("acc_z".to_owned(), vec![9.81; t.len()]),
    ]);
    columns
}

fn log(columns: Columns) -> Log {
    let segment = Segment { name: "walk".to_owned(), base: BaseMount::Floating };
    Log::new(Meta::new(200.0, TorqueSensor::None, vec![segment]), columns).expect("a log")
}

/// Returns the texts of the problems of the good log after a change of each cell of the columns that begin with `start`.
fn after(start: &str, change: impl Fn(f64) -> f64) -> Vec<(String, bool)> {
    let mut columns = good();
    for (_, cells) in columns.iter_mut().filter(|(name, _)| name.starts_with(start)) {
        for cell in cells.iter_mut() {
            *cell = change(*cell);
        }
    }
    texts(columns)
}

fn texts(columns: Columns) -> Vec<(String, bool)> {
    log(columns).problems().into_iter().map(|problem| (problem.text, problem.is_fatal)).collect()
}

fn check(found: &[(String, bool)], is_fatal: bool, parts: &[&str]) {
    let fits = |(text, fatal): &(String, bool)| *fatal == is_fatal && parts.iter().all(|part| text.contains(part));
    assert!(found.iter().any(fits), "{parts:?}: {found:?}");
}

fn swap(columns: &mut Columns, one: &str, other: &str) {
    let index = |name: &str| columns.iter().position(|(own, _)| own == name).expect("a column");
    let (one, other) = (index(one), index(other));
    let cells = columns[one].1.clone();
    columns[one].1 = std::mem::replace(&mut columns[other].1, cells);
}

#[test]
fn right_log_has_no_problem() {
    assert_eq!(texts(good()), []);
    let recording = Log::open(crate::RECORDING).expect("the recording");
    assert_eq!(recording.problems(), []);
}

#[test]
fn units_are_named_with_the_line_that_mends_them() {
    check(&after("q_", f64::to_degrees), true, &["in degrees, not in rad", r#""q_*" = { unit = "deg" }"#]);
    check(&after("t", |t| 1e3 * t), true, &["it is in ms, not in s", r#"t = { unit = "ms" }"#]);
    check(&after("t", |t| 1e9 * t), true, &["it is in ns, not in s"]);
    check(&after("dq_", f64::to_degrees), false, &["they are in deg/s"]);
    check(&after("dq_", |dq| dq * 30.0 / PI), false, &["they are in rpm", r#"unit = "rpm""#]);
    check(&after("gyro_", f64::to_degrees), false, &["the gyroscope", "deg/s"]);
    check(&after("acc_", |acc| acc / 9.81), false, &["it is in g"]);
}

#[test]
fn columns_that_belong_to_another_joint_are_named() {
    let mut columns = good();
    swap(&mut columns, "q_FL_thigh", "q_FL_calf");
    swap(&mut columns, "dq_FL_thigh", "dq_FL_calf");
    check(&texts(columns), false, &["FL_thigh and FL_calf", "swapped"]);
    let mut columns = good();
    for kind in ["hip", "thigh", "calf"] {
        for (left, right) in [("FL", "FR"), ("RL", "RR")] {
            for quantity in ["q", "dq"] {
                swap(&mut columns, &format!("{quantity}_{left}_{kind}"), &format!("{quantity}_{right}_{kind}"));
            }
        }
    }
    check(&texts(columns), false, &["left and right are mirrored"]);
    check(&after("dq_RR_calf", |dq| -dq), false, &["`dq_RR_calf` has the opposite sign"]);
    check(&after("q_RL_hip", |q| -q), false, &["`q_RL_hip` moves against its command"]);
}

#[test]
fn sensors_and_commands_that_do_not_work_are_named() {
    check(&after("q_FR_calf", |_| -1.5), false, &["`q_FR_calf` never changes"]);
    check(&after("dq_FR_calf", |_| 0.0), false, &["`dq_FR_calf` is 0 in every row"]);
    check(&after("q_cmd_", |_| 0.5), false, &["the commands never change"]);
    check(&after("q_FR_calf", |q| q.max(-1.6)), false, &["`q_FR_calf` is -1.6000 in", "clips it"]);
    check(&after("q_FR_calf", |q| q - 1.4), false, &["`q_FR_calf` is beyond the range of the joint"]);
}

#[test]
fn held_sensors_are_found_with_their_rate() {
    let mut columns = good();
    for (_, cells) in columns.iter_mut().filter(|(name, _)| !name.starts_with('t') && !name.contains("cmd")) {
        let fresh = cells.clone();
        (0..cells.len()).for_each(|row| cells[row] = fresh[row / 4 * 4]);
    }
    let log = log(columns);
    let text = log.describe().to_string();
    assert!(
        text.contains("the positions repeat in 75 % of the rows in motion: they were measured at 49.9 Hz"),
        "{text}"
    );
    assert!(text.contains("command_delay        no    the sensors repeat"), "{text}");
    let thin = log.without_repeats(&log.repeats().expect("repeats"));
    assert_eq!((thin.rows(), thin.meta().rate_hz, thin.repeats()), (500, 49.9, None));
}
