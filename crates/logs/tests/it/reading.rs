//! Files of a log, and its contents.

use std::fs;

use twinstep_logs::{Gain, Log, Meta};
use twinstep_model::{BaseMount, Joint};

use crate::{CSV, META, RECORDING, columns, folder, meta, write};

#[test]
fn recording_of_the_real_robot_is_read() {
    let log = Log::open(RECORDING).expect("the recording");
    assert!((log.duration_s() - 16.0).abs() < 0.1, "{}", log.duration_s());
    assert_eq!((log.meta().rate_hz, log.rows()), (200.0, 3_200));
    assert_eq!(log.go2_joints(), Some(Joint::ALL.to_vec()));
    assert_eq!((log.kp("RR_calf", 0), log.kd("RR_calf", 0)), (Some(20.0), Some(1.5)));
    assert_eq!(log.q("FL_hip").map(|q| q[0]), Some(-0.047_134_7));
    let ranges: Vec<_> = log.segments().map(|(segment, rows)| (segment.name.as_str(), segment.base, rows)).collect();
    assert_eq!(ranges, [("air_chirp", BaseMount::Fixed, 0..log.rows())]);
}

#[test]
fn log_is_opened_by_its_folder_or_its_data_file() {
    let folder = folder(CSV, META);
    let log = Log::open(folder.path()).expect("a log");
    assert_eq!(log, Log::open(folder.path().join("data.csv")).expect("a log"));
    assert_eq!(log.t(), [0.0, 0.005, 0.01]);
    assert_eq!(log.q_cmd("FL_hip"), Some(&[0.15, 0.25, 0.35][..]));
}

#[test]
fn one_folder_can_contain_several_logs() {
    let folder = folder(CSV, META);
    let walk = write(folder.path(), "walk.csv", CSV);
    assert_eq!(Log::open(&walk).expect("a log").meta().segments[0].name, "stand");
    write(folder.path(), "walk.json", &META.replace("stand", "walk"));
    assert_eq!(Log::open(&walk).expect("a log").meta().segments[0].name, "walk");
}

#[test]
fn empty_cells_of_optional_channels_are_nan() {
    let log = Log::open(folder(CSV, META).path()).expect("a log");
    assert_eq!(format!("{:?}", log.channel("battery_V").expect("a channel")), "[28.5, NaN, 28.0]");
}

#[test]
fn unknown_columns_are_ignored_and_listed() {
    let csv = "t,note,q_a,q_cmd_a,tau_measured_b\n0,left,1,1,7\n";
    let meta = META.replacen('{', r#"{"kp": 20, "kd": 0.5,"#, 1);
    let log = Log::open(folder(csv, &meta).path()).expect("a log");
    assert_eq!(log.ignored(), ["note", "tau_measured_b"]);
    assert_eq!(log.joints(), ["a"]);
    assert_eq!(log.go2_joints(), None);
}

#[test]
fn metadata_select_and_order_the_joints() {
    let cells = || vec![0.0];
    let all = columns([("t", cells()), ("q_a", cells()), ("q_cmd_a", cells()), ("q_b", cells()), ("q_cmd_b", cells())]);
    let with = |joints: &[&str]| Meta { joints: joints.iter().map(|&joint| joint.to_owned()).collect(), ..meta() };
    let both = Log::new(with(&["b", "a"]), all.clone()).expect("a log");
    assert_eq!(both.joints(), ["b", "a"]);
    let one = Log::new(with(&["b"]), all).expect("a log");
    assert_eq!(one.ignored(), ["q_a", "q_cmd_a"]);
}

#[test]
fn gain_of_a_joint_overrides_the_common_one_which_overrides_the_metadata() {
    let cells = |value: f64| vec![value; 2];
    let rows = columns([
        ("t", vec![0.0, 0.1]),
        ("q_a", cells(0.0)),
        ("q_cmd_a", cells(0.0)),
        ("q_b", cells(0.0)),
        ("q_cmd_b", cells(0.0)),
        ("kp", cells(2.0)),
        ("kp_b", vec![3.0, 4.0]),
    ]);
    let gains = Gain::PerJoint(vec![0.25, 0.75]);
    let log = Log::new(Meta { kd: Some(gains), ..meta() }, rows).expect("a log");
    assert_eq!((log.kp("a", 1), log.kp("b", 1)), (Some(2.0), Some(4.0)));
    assert_eq!((log.kd("a", 1), log.kd("b", 1)), (Some(0.25), Some(0.75)));
    assert_eq!((log.kp("a", 2), log.kd("a", 2), log.kp("c", 0)), (None, None, None));
    assert_eq!(log.gains("a"), [Some(cells(2.0)), Some(cells(0.25))]);
    assert_eq!((log.gains("b"), log.gains("c")), ([Some(vec![3.0, 4.0]), Some(cells(0.75))], [None, None]));
}

#[test]
fn ranges_end_at_changes_of_segment_or_episode() {
    let rows = columns([
        ("t", vec![0.0, 0.1, 0.0, 0.1, 0.2]),
        ("segment", vec![0.0, 0.0, 1.0, 1.0, 1.0]),
        ("episode", vec![0.0, 0.0, 0.0, 0.0, 1.0]),
        ("q_a", vec![0.0; 5]),
        ("q_cmd_a", vec![0.0; 5]),
    ]);
    let log = Log::new(meta(), rows).expect("time may restart in a new range");
    let ranges: Vec<_> = log.segments().map(|(segment, rows)| (segment.name.as_str(), rows)).collect();
    assert_eq!(ranges, [("stand", 0..2), ("walk", 2..4), ("walk", 4..5)]);
    assert!((log.duration_s() - 0.2).abs() < 1e-12);
}

#[test]
fn motion_file_needs_only_commands() {
    let csv = "t,q_cmd_a\n0,0.1\n0.02,0.2\n";
    let folder = folder(csv, META);
    let motion = Log::open_commands(folder.path()).expect("a motion file");
    assert_eq!((motion.joints(), motion.q("a"), motion.kp("a", 0)), (&["a".to_owned()][..], None, None));
    assert!(Log::open(folder.path()).is_err());
    assert!(Log::open_commands(RECORDING).is_ok(), "a measured log is also a motion file");
}

#[test]
fn noise_of_a_channel_overrides_that_of_its_quantity() {
    let noise = [("q".to_owned(), 1e-4), ("q_a".to_owned(), 2e-4)].into_iter().collect();
    let rows = columns([("t", vec![0.0]), ("q_a", vec![0.0]), ("q_cmd_a", vec![0.0])]);
    let log = Log::new(Meta { noise, ..meta() }, rows).expect("a log");
    assert_eq!([log.noise("q_a"), log.noise("q_b"), log.noise("gyro_x")], [Some(2e-4), Some(1e-4), None]);
}

#[test]
fn compressed_csv_equals_plain_csv() {
    let folder = folder(CSV, META);
    let log = Log::open(folder.path()).expect("a log");
    log.write(folder.path().join("small.csv.gz")).expect("written");
    let bytes = fs::read(folder.path().join("small.csv.gz")).expect("a file");
    assert_eq!(bytes[..2], [0x1f, 0x8b], "magic number of gzip");
    assert_eq!(Log::open(folder.path().join("small.csv.gz")).expect("a log"), log);
}

#[test]
fn log_of_an_arm_needs_no_gains_and_describes_what_it_has() {
    let rows = (0..400).map(|row| {
        let t = f64::from(row) * 0.02;
        let counts = (400.0 * (3.0 * t).sin()).round();
        format!("{t},{},{},{}\n", 0.6 * (3.0 * t).sin(), counts * 0.0015, (counts / 40.0).abs().round() * 0.02)
    });
    let csv = format!("t,q_cmd_elbow,q_elbow,current_abs_elbow\n{}", rows.collect::<String>());
    let meta = r#"{"rate_hz": 50, "tau_sensor": "none", "segments": [{"name": "sine", "base": "fixed"}],
        "base_quat": [0.8, 0.6, 0, 0]}"#;
    let log = Log::open(folder(&csv, meta).path()).expect("a log");
    assert_eq!((log.kp("elbow", 0), log.gains("elbow")), (None, [None, None]));
    assert_eq!(log.meta().base_quat, Some([0.8, 0.6, 0.0, 0.0]));
    let text = log.describe().to_string();
    assert!(text.contains("current_abs    1 column, in steps of 0.0200"), "{text}");
    assert!(text.contains("kp             unknown: `identify` estimates it"), "{text}");
    let folder = tempfile::tempdir().expect("a folder");
    let error = log.write(folder.path().join("arm.mcap")).expect_err("no gains").to_string();
    assert!(
        error.contains("the gains of the joint `elbow` are unknown") || error.contains("no joint `elbow`"),
        "{error}"
    );
}

#[test]
fn joint_names_of_the_robot_file_of_a_go2_are_read_as_its_joints() {
    for name in ["FL_hip_joint", "fl_hip"] {
        let log = Log::open(folder(&CSV.replace("FL_hip", name), META).path()).expect("a log");
        assert_eq!(log.q("FL_hip"), Log::open(folder(CSV, META).path()).expect("a log").q("FL_hip"));
        assert!(log.read_warnings()[0].contains("is read as"), "{:?}", log.read_warnings());
    }
}
