//! Logs in MCAP: files that `Log::write` wrote, and recordings of other programs.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use expect_test::{Expect, expect};
use proptest::prelude::*;
use twinstep_logs::{Gain, Log, LogError, Meta, Segment, TorqueSensor};
use twinstep_model::BaseMount;

use crate::{RECORDING, columns, meta};

/// Returns a number that is exact in single precision.
fn single() -> impl Strategy<Value = f64> {
    (-1e6..1e6f32).prop_map(f64::from)
}

/// Returns any log of the Go2 with channels that MCAP supports.
fn log() -> impl Strategy<Value = Log> {
    let joints = prop::sample::subsequence(twinstep_model::JOINT_NAMES.to_vec(), 1..=12);
    (1..12usize, joints).prop_flat_map(|(rows, joints)| {
        let cells = move || prop::collection::vec(single(), rows);
        let holes = move |cell: BoxedStrategy<f64>| {
            prop::option::of(prop::collection::vec(prop_oneof![4 => cell, 1 => Just(f64::NAN)], rows))
        };
        let joint = (
            [cells(), cells()],
            [holes(single().boxed()), holes(single().boxed()), holes(single().boxed()), holes(single().boxed())],
            holes((0..=254u8).prop_map(f64::from).boxed()),
        );
        let kp = prop::option::of(prop::collection::vec((0..100u8).prop_map(f64::from), rows));
        (
            prop::collection::vec((1_000..1_000_000_000u64, 0..2u32, 0..3u32), rows),
            prop::collection::vec(joint, joints.len()),
            [holes(single().boxed()), holes(single().boxed())],
            holes((-32767..=32767i16).prop_map(f64::from).boxed()),
            kp,
        )
            .prop_map(move |parts| build(&joints, parts))
    })
}

type Holes = Option<Vec<f64>>;
type Joint = ([Vec<f64>; 2], [Holes; 4], Holes);
type Parts = (Vec<(u64, u32, u32)>, Vec<Joint>, [Holes; 2], Holes, Holes);

fn build(names: &[&str], (index, joints, [gyro, volts], force, kp): Parts) -> Log {
    let mut nanoseconds = 0;
    let t = index.iter().map(|(step, ..)| {
        nanoseconds += step;
        nanoseconds as f64 * 1e-9
    });
    let mut all = columns([
        ("t", t.collect()),
        ("segment", index.iter().map(|row| f64::from(row.1)).collect()),
        ("episode", index.iter().map(|row| f64::from(row.2)).collect()),
    ]);
    for (([q, q_cmd], optional, temp), name) in joints.into_iter().zip(names) {
        all.extend([(format!("q_{name}"), q), (format!("q_cmd_{name}"), q_cmd)]);
        for (cells, quantity) in optional.into_iter().zip(["dq", "tau_measured", "dq_cmd", "tau_ff"]) {
            all.extend(cells.map(|cells| (format!("{quantity}_{name}"), cells)));
        }
        all.extend(temp.map(|temp| (format!("temp_{name}"), temp)));
    }
    let rest = [("gyro_x", gyro), ("battery_V", volts), ("foot_force_RL", force), ("kp", kp)];
    all.extend(rest.into_iter().filter_map(|(name, cells)| Some((name.to_owned(), cells?))));
    Log::new(meta(), all).expect("a log")
}

/// Checks that the logs are equal, in time to 1 ns.
fn check_equal(read: &Log, written: &Log) {
    assert_eq!(read.rows(), written.rows());
    for (read, written) in read.t().iter().zip(written.t()) {
        // Rounding to nanoseconds, and of the time in double precision.
        assert!((read - written).abs() < 0.6e-9 + 1e-12 * written.abs(), "{read} {written}");
    }
    let with_time = |log: &Log| {
        let index = |cells: &[u32]| cells.iter().map(|cell| f64::from(*cell)).collect::<Vec<_>>();
        let mut all: Vec<_> = log.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
        all.push(("t".to_owned(), written.t().to_vec()));
        all.extend([("segment".to_owned(), index(log.segment())), ("episode".to_owned(), index(log.episode()))]);
        Log::new(log.meta().clone(), all).expect("a log")
    };
    let names = |log: &Log| log.channels().map(|(name, _)| name.to_owned()).collect::<Vec<_>>();
    assert_eq!(names(read), names(written));
    for (name, cells) in written.channels() {
        let again = read.channel(name).expect("the channel");
        let same = cells.iter().zip(again).all(|(a, b)| a == b || (a.is_nan() && b.is_nan()));
        assert!(same, "{name}: {cells:?} became {again:?}");
    }
    assert_eq!(with_time(read).meta(), with_time(written).meta());
    assert_eq!((read.segment(), read.episode()), (written.segment(), written.episode()));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn mcap_round_trips_in_supported_channels(log in log()) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("walk.mcap");
        log.write(&path).expect("written");
        check_equal(&Log::open(&path).expect("read"), &log);
        let files = fs::read_dir(folder.path()).expect("a folder").count();
        prop_assert_eq!(files, 1, "MCAP files contain their metadata");
    }

    #[test]
    fn damaged_mcap_gives_an_error_or_fewer_rows_but_no_panic(at in 8..20_000usize, to in any::<u8>(), cut in any::<bool>()) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("walk.mcap");
        small().write(&path).expect("written");
        let mut bytes = fs::read(&path).expect("a file");
        let at = at % bytes.len();
        if cut { bytes.truncate(at) } else { bytes[at] = to }
        fs::write(&path, bytes).expect("a file");
        if let Ok(log) = Log::open(&path) {
            prop_assert!(log.rows() <= small().rows());
        }
    }
}

/// Returns a log with four rows of one joint.
fn small() -> Log {
    let rows = columns([
        ("t", vec![0.0, 0.005, 0.01, 0.015]),
        ("q_FR_hip", vec![0.125, 0.25, 0.5, 1.0]),
        ("q_cmd_FR_hip", vec![0.25, 0.5, 1.0, 2.0]),
        ("pos_z", vec![0.3; 4]),
    ]);
    Log::new(meta(), rows).expect("a log")
}

#[test]
fn unsupported_columns_are_listed() {
    assert_eq!(small().unsupported_columns("walk.mcap"), ["pos_z"]);
    assert!(small().unsupported_columns("walk.csv").is_empty());
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("walk.mcap");
    small().write(&path).expect("written");
    let names: Vec<_> = Log::open(path).expect("read").channels().map(|(name, _)| name.to_owned()).collect();
    assert_eq!(names, ["q_FR_hip", "q_cmd_FR_hip"]);
}

#[test]
fn real_recording_round_trips_in_single_precision() {
    let log = Log::open(RECORDING).expect("the recording");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("air.mcap");
    log.write(&path).expect("written");
    let read = Log::open(&path).expect("read");
    assert_eq!((read.rows(), read.meta(), read.joints()), (log.rows(), log.meta(), log.joints()));
    for (name, cells) in log.channels() {
        let again = read.channel(name).expect("the channel");
        assert!(cells.iter().zip(again).all(|(a, b)| f64::from(*a as f32) == *b), "{name}");
    }
}

/// Writer of a recording as of another program, with explicit topics, schemas and bytes.
pub struct Recorder {
    writer: mcap::Writer<fs::File>,
}

impl Recorder {
    pub fn create(path: &Path) -> Recorder {
        Recorder::compressed(path, Some(mcap::Compression::Zstd))
    }

    fn compressed(path: &Path, compression: Option<mcap::Compression>) -> Recorder {
        let options = mcap::WriteOptions::new().compression(compression);
        Recorder { writer: options.create(fs::File::create(path).expect("a file")).expect("a writer") }
    }

    fn send(&mut self, topic: &str, schema: &str, encoding: &str, nanoseconds: u64, data: &[u8]) {
        let schema = if schema.is_empty() { 0 } else { self.writer.add_schema(schema, "ros2msg", b"").expect("one") };
        let channel_id = self.writer.add_channel(schema, topic, encoding, &BTreeMap::new()).expect("a channel");
        let (log_time, publish_time) = (nanoseconds, nanoseconds);
        let header = mcap::records::MessageHeader { channel_id, sequence: 0, log_time, publish_time };
        self.writer.write_to_known_channel(&header, data).expect("written");
    }

    pub fn state(&mut self, topic: &str, nanoseconds: u64, data: &[u8]) {
        self.send(topic, "unitree_go/msg/LowState", "cdr", nanoseconds, data);
    }

    pub fn command(&mut self, topic: &str, nanoseconds: u64, data: &[u8]) {
        self.send(topic, "unitree_go/msg/LowCmd", "cdr", nanoseconds, data);
    }

    pub fn finish(mut self) {
        self.writer.finish().expect("finished");
    }
}

/// Writes bytes at an offset of a message's body.
fn put(message: &mut [u8], offset: usize, bytes: &[u8]) {
    message[4 + offset..4 + offset + bytes.len()].copy_from_slice(bytes);
}

// The offsets below follow from the IDL: each field is aligned to its size.

/// Returns a state with q = 1 + index for every motor, and feet 10, 20, 30, 40, in the robot's order.
fn state_bytes() -> Vec<u8> {
    let mut bytes = vec![0; 4 + 1176];
    bytes[1] = 1;
    put(&mut bytes, 24, &1.0f32.to_le_bytes()); // quaternion w
    put(&mut bytes, 44, &0.5f32.to_le_bytes()); // gyroscope y
    put(&mut bytes, 60, &9.81f32.to_le_bytes()); // accelerometer z
    for motor in 0..20 {
        // The mode of the first motor is at 77; the other motors start at multiples of four.
        let start = 76 + 48 * motor;
        put(&mut bytes, start + 4, &(1.0 + motor as f32).to_le_bytes());
        put(&mut bytes, start + 16, &(-1.0 - motor as f32).to_le_bytes()); // tau_est
        put(&mut bytes, start + 32, &[30 + motor as u8]); // temperature
    }
    for (foot, force) in [10i16, 20, 30, 40].into_iter().enumerate() {
        put(&mut bytes, 1080 + 2 * foot, &force.to_le_bytes());
    }
    put(&mut bytes, 1152, &28.5f32.to_le_bytes());
    bytes
}

/// Returns a command with q = 100 + index, kp 20 and kd 0.5; the values of the first motor are `first`.
fn command_bytes(first: [f32; 5]) -> Vec<u8> {
    let mut bytes = vec![0; 4 + 808];
    bytes[1] = 1;
    for motor in 0..20 {
        put(&mut bytes, 20 + 36 * motor + if motor == 0 { 2 } else { 0 }, &[1]);
        let values = if motor == 0 { first } else { [100.0 + motor as f32, 0.0, 0.0, 20.0, 0.5] };
        for (index, value) in values.into_iter().enumerate() {
            put(&mut bytes, 24 + 36 * motor + 4 * index, &value.to_le_bytes());
        }
    }
    bytes
}

const FIRST: [f32; 5] = [100.0, 0.0, 0.0, 20.0, 0.5];

#[test]
fn recording_of_the_robot_is_reordered_to_the_joint_order() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.mcap");
    let mut recorder = Recorder::create(&path);
    for row in 0..4u64 {
        let now = 1_700_000_000_000_000_000 + row * 2_000_000;
        recorder.state("rt/lowstate", now, &state_bytes());
        // 0.4 ms after the state that the command responds to, 1.6 ms before the next state.
        let first = [100.0 + row as f32 / 4.0, 0.0, 0.0, 20.0, 0.5];
        if row > 0 {
            recorder.command("rt/lowcmd", now + 400_000, &command_bytes(first));
        }
        recorder.send("/camera/image", "", "cbor", now, &[1, 2, 3]);
    }
    recorder.finish();

    let log = Log::open(&path).expect("a log");
    assert_eq!(log.t(), [0.0, 0.002, 0.004]);
    let first = |quantity: &str, joint: &str| log.channel(&format!("{quantity}_{joint}")).expect("a channel")[0];
    // Robot order: FR 0-2, FL 3-5, RR 6-8, RL 9-11.
    let q: Vec<f64> = log.joints().iter().map(|joint| first("q", joint)).collect();
    assert_eq!(q, [4.0, 5.0, 6.0, 1.0, 2.0, 3.0, 10.0, 11.0, 12.0, 7.0, 8.0, 9.0]);
    assert_eq!((first("tau_measured", "FR_hip"), first("temp", "RL_calf")), (-1.0, 41.0));
    assert_eq!(["FL", "FR", "RL", "RR"].map(|leg| first("foot_force", leg)), [20.0, 10.0, 40.0, 30.0]);
    assert_eq!((first("quat", "w"), first("gyro", "y"), first("acc", "z")), (1.0, 0.5, f64::from(9.81f32)));
    assert_eq!(log.channel("battery_V").expect("volts")[0], 28.5);
    assert_eq!(
        log.q_cmd("FR_hip"),
        Some(&[100.25, 100.5, 100.75][..]),
        "each state has the command that responds to it"
    );
    assert_eq!(
        (log.channel("kp").map(<[f64]>::len), log.kp("RR_calf", 0), log.kd("RR_calf", 0)),
        (Some(3), Some(20.0), Some(0.5))
    );
    assert!(log.dq("FL_hip").is_none(), "sensors that are zero throughout are absent");
    assert_eq!((log.meta().tau_sensor, log.meta().rate_hz), (TorqueSensor::MotorCurrent, 500.0));
    assert_eq!(log.ignored(), ["topic /camera/image (4 messages)"]);
    expect![[r#"
        [
            "the robot's clock (`tick`) does not run: rows have the times of arrival",
            "omitted one state before the first command",
            "foot_force is the robot's raw count, not newtons: it only distinguishes loaded from unloaded feet",
        ]
    "#]]
    .assert_debug_eq(&log.read_warnings());
}

/// Records states of which each is sent `times`, with a motion in the positions and torques that grow. Returns the torques of the log.
fn torques_of_states(count: u16, times: u64) -> Vec<f64> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.mcap");
    let mut recorder = Recorder::create(&path);
    for row in 0..u64::from(count) * times {
        let (mut state, reading) = (state_bytes(), (row / times) as f32);
        for motor in 0..12 {
            put(&mut state, 76 + 48 * motor + 4, &(0.3 * (0.2 * reading).sin()).to_le_bytes());
            put(&mut state, 76 + 48 * motor + 16, &reading.to_le_bytes());
        }
        recorder.state("rt/lowstate", row * 2_000_000, &state);
        recorder.command("rt/lowcmd", row * 2_000_000, &command_bytes(FIRST));
    }
    recorder.finish();
    Log::open(&path).expect("a log").tau_measured("FR_hip").expect("torques").to_vec()
}

#[test]
fn the_torque_of_a_message_is_that_of_the_row_before() {
    let torques = torques_of_states(4, 1);
    assert_eq!(torques[..3], [1.0, 2.0, 3.0]);
    assert!(torques[3].is_nan(), "no message follows the last one: {torques:?}");
}

/// The torque between two readings is the mean of both, if the readings repeat.
#[test]
fn torques_that_repeat_are_those_of_their_messages() {
    let torques = torques_of_states(40, 5);
    assert_eq!(torques[95..105], [19.0, 19.0, 19.0, 19.0, 19.0, 20.0, 20.0, 20.0, 20.0, 20.0]);
}

#[test]
fn chunks_of_every_compression_are_read() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, compression) in
        [("plain", None), ("lz4", Some(mcap::Compression::Lz4)), ("zstd", Some(mcap::Compression::Zstd))]
    {
        let path = folder.path().join(format!("{name}.mcap"));
        let mut recorder = Recorder::compressed(&path, compression);
        recorder.state("/rt/lowstate", 0, &state_bytes());
        recorder.command("/rt/lowcmd", 0, &command_bytes(FIRST));
        recorder.finish();
        assert_eq!(Log::open(&path).expect("a log").q("FR_hip"), Some(&[1.0][..]), "{name}");
    }
}

#[test]
fn metadata_file_of_a_recording_is_used() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.mcap");
    let mut recorder = Recorder::create(&path);
    recorder.state("/lowstate", 0, &state_bytes());
    recorder.command("/lowcmd", 0, &command_bytes(FIRST));
    recorder.finish();
    let segments = vec![Segment { name: "held".to_owned(), base: BaseMount::Fixed }];
    let expected = Meta { joints: vec!["RR_hip".to_owned()], ..Meta::new(500.0, TorqueSensor::MotorCurrent, segments) };
    fs::write(folder.path().join("robot.json"), serde_json::to_string(&expected).expect("JSON")).expect("a file");
    let log = Log::open(&path).expect("a log");
    assert_eq!((log.meta(), log.joints()), (&expected, &["RR_hip".to_owned()][..]));
}

#[test]
fn commands_without_position_or_velocity_have_gains_of_zero() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.mcap");
    let mut recorder = Recorder::create(&path);
    recorder.state("/lowstate", 0, &state_bytes());
    recorder.command("/lowcmd", 0, &command_bytes([2.146e9, 16_000.0, 0.0, 20.0, 0.5]));
    recorder.finish();
    let log = Log::open(&path).expect("a log");
    assert_eq!((log.kp("FR_hip", 0), log.kd("FR_hip", 0), log.kp("FR_thigh", 0)), (Some(0.0), Some(0.0), Some(20.0)));
    assert_eq!((log.q_cmd("FR_hip"), log.dq_cmd("FR_hip")), (Some(&[1.0][..]), Some(&[0.0][..])));
}

#[test]
fn truncated_file_gives_its_complete_chunks_and_a_warning() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("air.mcap");
    Log::open(RECORDING).expect("the recording").write(&path).expect("written");
    let whole = fs::read(&path).expect("a file");
    fs::write(&path, &whole[..whole.len() * 3 / 4]).expect("a file");
    let log = Log::open(&path).expect("a log");
    assert!(log.rows() > 1000 && log.rows() < 3200, "{}", log.rows());
    assert!(log.read_warnings()[0].starts_with("the MCAP file is truncated: read the"), "{:?}", log.read_warnings());
}

fn check(record: impl FnOnce(&mut Recorder), expected: &Expect) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("robot.mcap");
    let mut recorder = Recorder::create(&path);
    record(&mut recorder);
    recorder.finish();
    let error = Log::open(&path).expect_err("no log").to_string();
    expected.assert_eq(&error.replace(&folder.path().display().to_string(), "log"));
}

#[test]
fn errors_for_incomplete_recordings_say_what_is_missing() {
    check(
        |_| {},
        &expect![[r#"
        `log/robot.mcap` has no message on /lowstate; its topics are none
          record both /lowstate and /lowcmd (or rt/lowstate and rt/lowcmd): a log needs measurements and commands"#]],
    );
    check(
        |recorder| recorder.state("/lowstate", 0, &state_bytes()),
        &expect![[r#"
        `log/robot.mcap` has no message on /lowcmd; its topics are `/lowstate` (1 messages)
          record both /lowstate and /lowcmd (or rt/lowstate and rt/lowcmd): a log needs measurements and commands"#]],
    );
    check(
        |recorder| {
            recorder.state("/lowstate", 0, &state_bytes());
            recorder.command("/lowcmd", 9, &command_bytes(FIRST));
            recorder.command("/lowcmd", 2_000_000_000, &command_bytes(FIRST));
        },
        &expect![[r#"
            `log/robot.mcap` has no message on /lowcmd before the last /lowstate; its topics are `/lowstate` (1 messages), `/lowcmd` (2 messages)
              record both /lowstate and /lowcmd (or rt/lowstate and rt/lowcmd): a log needs measurements and commands"#]],
    );
    check(
        |recorder| recorder.send("/lowstate", "unitree_hg/msg/LowState", "cdr", 0, &[0, 1, 0, 0]),
        &expect![
            "`log/robot.mcap`, topic `/lowstate` has messages unitree_hg/msg/LowState as cdr, but they must be unitree_go/msg/LowState as cdr"
        ],
    );
    check(
        |recorder| recorder.send("/lowcmd", "", "json", 0, b"{}"),
        &expect![
            "`log/robot.mcap`, topic `/lowcmd` has messages as json, but they must be unitree_go/msg/LowCmd as cdr"
        ],
    );
    check(
        |recorder| {
            recorder.state("/lowstate", 0, &state_bytes());
            recorder.state("/lowstate", 5, &state_bytes()[..600]);
        },
        &expect![[r#"
            `log/robot.mcap`, topic `/lowstate`, message 2: it ends after 600 bytes, but a message of this type has 1180
              the robot's firmware or the recorder may use another version of the message"#]],
    );
    check(
        |recorder| recorder.command("/lowcmd", 0, &[&[0, 7], &command_bytes(FIRST)[2..]].concat()),
        &expect![[r#"
        `log/robot.mcap`, topic `/lowcmd`, message 1: its header is [00, 07], but plain CDR starts with 00 00 or 00 01
          the robot's firmware or the recorder may use another version of the message"#]],
    );
}

#[test]
fn error_for_nan_contains_its_row() {
    check(
        |recorder| {
            recorder.state("/lowstate", 0, &state_bytes());
            let mut broken = state_bytes();
            put(&mut broken, 80, &f32::NAN.to_le_bytes());
            recorder.state("/lowstate", 2_000_000, &broken);
            recorder.command("/lowcmd", 0, &command_bytes(FIRST));
        },
        &expect![[r#"
            `log/robot.mcap`, column `q_FR_hip`, row 2 is empty or NaN, but it must be a finite number
              remove the row, or fill the cell with the value that was in force"#]],
    );
}

#[test]
fn values_out_of_range_of_the_messages_are_rejected() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("walk.mcap");
    let error = |rows| {
        let meta = Meta { kp: Some(Gain::Uniform(1.0)), ..meta() };
        let error = Log::new(meta, rows).expect("a log").write(&path).expect_err("refused").to_string();
        error.replace(&folder.path().display().to_string(), "log")
    };
    let hot =
        columns([("t", vec![0.0]), ("q_FL_hip", vec![0.0]), ("q_cmd_FL_hip", vec![0.0]), ("temp_FL_hip", vec![300.0])]);
    expect![[r#"
        `log/walk.mcap`, column `temp_FL_hip`, row 1: 300 is out of the range of the robot's message, 0 to 254 °C
          write Parquet or CSV instead"#]]
    .assert_eq(&error(hot));
    expect![[r#"
        `log/walk.mcap`: the messages of the Go2 have no joint `a`
          write Parquet or CSV instead"#]]
    .assert_eq(&error(columns([("t", vec![0.0]), ("q_a", vec![0.0]), ("q_cmd_a", vec![0.0])])));
    assert!(!path.exists());
}

#[test]
fn invalid_mcap_file_is_rejected() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("walk.mcap");
    fs::write(&path, "t,q_FL_hip\n").expect("a file");
    assert!(matches!(Log::open(&path), Err(LogError::Mcap { .. })));
    fs::write(&path, "").expect("a file");
    assert!(matches!(Log::open(&path), Err(LogError::Mcap { .. })));
}

#[test]
fn record_that_claims_to_be_longer_than_the_file_is_an_error() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("data.mcap");
    // A channel of 2^29 bytes, in a file of 17.
    let record = [&[4][..], &(1u64 << 29).to_le_bytes()].concat();
    fs::write(&file, [b"\x89MCAP0\r\n", &record[..]].concat()).expect("written");
    let error = Log::open(&file).expect_err("damaged");
    assert!(matches!(error, LogError::Mcap { .. }), "{error}");
}
