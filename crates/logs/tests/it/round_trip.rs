//! Logs are read back exactly as they were written.

use std::fs;

use expect_test::expect;
use proptest::prelude::*;
use twinstep_logs::{Gain, Log, LogError, Meta};

use crate::{CSV, META, RECORDING, columns, folder, meta};

/// Returns any finite number, including extreme ones.
fn number() -> impl Strategy<Value = f64> {
    use proptest::num::f64::{NEGATIVE, NORMAL, POSITIVE, SUBNORMAL, ZERO};
    POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO
}

/// Returns any log with up to three joints, and optional channels with missing cells.
fn log() -> impl Strategy<Value = Log> {
    (1..20usize, 1..4usize).prop_flat_map(|(rows, joints)| {
        let cells = move || prop::collection::vec(number(), rows);
        let optional =
            move || prop::option::of(prop::collection::vec(prop_oneof![4 => number(), 1 => Just(f64::NAN)], rows));
        let joint = (cells(), cells(), optional(), optional());
        (
            prop::collection::vec((1e-9..1e3f64, 0..2u32, 0..3u32), rows),
            prop::collection::vec(joint, joints),
            [optional(), optional()],
            prop::option::of(prop::collection::vec(0.0..1e3f64, rows)),
            (1e-3..1e6f64, prop::option::of(prop::collection::vec(number().prop_map(f64::abs), joints))),
        )
            .prop_map(build)
    })
}

type Joint = (Vec<f64>, Vec<f64>, Option<Vec<f64>>, Option<Vec<f64>>);
type Parts = (Vec<(f64, u32, u32)>, Vec<Joint>, [Option<Vec<f64>>; 2], Option<Vec<f64>>, (f64, Option<Vec<f64>>));

fn build((index, joints, [gyro, volts], kp, (rate_hz, kd)): Parts) -> Log {
    let mut t = 0.0;
    let steps = index.iter().map(|(step, ..)| {
        t += step;
        t
    });
    let mut all = columns([("t", steps.collect())]);
    all.push(("segment".to_owned(), index.iter().map(|row| f64::from(row.1)).collect()));
    all.push(("episode".to_owned(), index.iter().map(|row| f64::from(row.2)).collect()));
    for ((q, q_cmd, dq, tau), name) in joints.into_iter().zip(["b, with a comma", "a", "FL_hip"]) {
        all.extend([(format!("q_{name}"), q), (format!("q_cmd_{name}"), q_cmd)]);
        all.extend(dq.map(|dq| (format!("dq_{name}"), dq)));
        all.extend(tau.map(|tau| (format!("tau_measured_{name}"), tau)));
    }
    all.extend(gyro.map(|gyro| ("gyro_x".to_owned(), gyro)));
    all.extend(volts.map(|volts| ("battery_V".to_owned(), volts)));
    all.extend(kp.map(|kp| ("kp".to_owned(), kp)));
    Log::new(Meta { rate_hz, kd: Some(kd.map_or(Gain::Uniform(0.5), Gain::PerJoint)), ..meta() }, all).expect("a log")
}

fn bits(log: &Log) -> Vec<(&str, Vec<u64>)> {
    // All NaN are equal; -0 and 0 differ.
    let bits = |cell: &f64| if cell.is_nan() { f64::NAN.to_bits() } else { cell.to_bits() };
    log.channels().map(|(name, cells)| (name, cells.iter().map(bits).collect())).collect()
}

fn check(log: &Log, name: &str) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    log.write(&path).expect("written");
    let again = Log::open(&path).expect("read");
    assert_eq!(&again, log);
    assert_eq!(bits(&again), bits(log));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn csv_round_trips(log in log()) {
        check(&log, "data.csv");
    }

    #[test]
    fn compressed_csv_round_trips(log in log()) {
        check(&log, "walk.csv.gz");
    }

    #[test]
    fn parquet_round_trips(log in log()) {
        check(&log, "data.parquet");
    }
}

#[test]
fn real_recording_round_trips_in_every_format() {
    let log = Log::open(RECORDING).expect("the recording");
    for name in ["data.csv", "walk.csv.gz", "walk.parquet", "a_new_folder"] {
        check(&log, name);
    }
}

#[test]
fn motion_file_round_trips() {
    let motion = Log::new_commands(meta(), columns([("t", vec![0.0, 0.1]), ("q_cmd_a", vec![1.0, 2.0])])).expect("one");
    let folder = tempfile::tempdir().expect("a folder");
    motion.write(folder.path()).expect("written");
    assert_eq!(Log::open_commands(folder.path()).expect("read"), motion);
}

#[test]
fn written_folder_contains_two_files_and_no_temporary_ones() {
    let parent = tempfile::tempdir().expect("a folder");
    let target = parent.path().join("new/log");
    Log::open(folder(CSV, META).path()).expect("a log").write(&target).expect("written");
    let mut names: Vec<_> =
        fs::read_dir(&target).expect("a folder").map(|entry| entry.expect("an entry").file_name()).collect();
    names.sort();
    assert_eq!(names, ["data.parquet", "meta.json"]);
}

#[test]
fn failed_write_leaves_no_temporary_files() {
    let folder = folder(CSV, META);
    let log = Log::open(folder.path()).expect("a log");
    // A folder has the name of the data file, so renaming fails.
    fs::create_dir_all(folder.path().join("walk.csv/in_the_way")).expect("a folder");
    assert!(matches!(log.write(folder.path().join("walk.csv")), Err(LogError::Write { .. })));
    let hidden = |name: &str| name.starts_with('.');
    let mut names =
        fs::read_dir(folder.path()).expect("a folder").map(|e| e.expect("an entry").file_name().into_string());
    assert!(!names.any(|name| name.is_ok_and(|name| hidden(&name))));
}

#[test]
fn second_data_file_in_a_folder_is_rejected() {
    let folder = folder(CSV, META);
    let log = Log::open(folder.path()).expect("a log");
    assert!(matches!(log.write(folder.path()), Err(LogError::SeveralDataFiles { .. })));
}

#[test]
fn columns_are_written_in_the_order_of_the_format() {
    let parent = tempfile::tempdir().expect("a folder");
    let file = parent.path().join("data.csv");
    Log::open(folder(CSV, META).path()).expect("a log").write(&file).expect("written");
    expect![[r"
        t,segment,episode,kp,kd,q_cmd_FL_hip,q_FL_hip,battery_V
        0,0,0,20,0.5,0.15,0.1,28.5
        0.005,0,0,20,0.5,0.25,0.2,
        0.01,0,0,20,0.5,0.35,0.3,28
    "]]
    .assert_eq(&fs::read_to_string(file).expect("a file"));
}
