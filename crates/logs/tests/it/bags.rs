//! Recordings in the forms in which recorders and networks leave them. The truth is known: every command is the time at which it
//! was sent, and every position is the time at which it was measured, so that a log with the right times and pairs has
//! `q = t` and `q_cmd` = `t` of the row.

use std::fs;
use std::path::Path;

use twinstep_logs::{ColumnMap, Log};
use twinstep_unitree::{LowCmd, LowState, MotorCmd, SERVO, encode};

use crate::mcap::Recorder;

const MS: u64 = 1_000_000;
/// Start of the recorder's clock [ns], and of the robot's [ms].
const START: u64 = 1_700_000_000 * 1_000_000_000;
const TICK: u64 = 40_000;

/// A message: topic, time of arrival, content.
type Message = (&'static str, u64, Vec<u8>);

fn state(topic: &'static str, step: u64, arrival: u64, tick: u64) -> Message {
    let mut state = LowState { tick: tick as u32, ..LowState::default() };
    state.motor_state.iter_mut().for_each(|motor| motor.q = step as f32 * 0.002);
    (topic, arrival, encode(&state))
}

fn command(topic: &'static str, step: u64, arrival: u64) -> Message {
    let mut command = LowCmd::default();
    let motor = MotorCmd { mode: SERVO, q: step as f32 * 0.002, kp: 20.0, kd: 0.5, ..MotorCmd::default() };
    command.motor_cmd.iter_mut().for_each(|one| *one = motor);
    (topic, arrival, encode(&command))
}

/// Returns the messages of a robot at 500 Hz. Each command is sent 0.3 ms after the state that it answers.
fn messages(
    state_arrival: impl Fn(u64) -> u64,
    command_arrival: impl Fn(u64) -> u64,
    tick: impl Fn(u64) -> u64,
) -> Vec<Message> {
    (0..2500)
        .flat_map(|step| {
            let sent = START + 2 * MS * step;
            [
                state("/lowstate", step, state_arrival(step).max(sent), tick(step)),
                command("/lowcmd", step, command_arrival(step).max(sent + 300_000)),
            ]
        })
        .collect()
}

fn in_time(step: u64) -> u64 {
    START + 2 * MS * step
}

/// Five at a time, with the last one.
fn in_bursts(step: u64) -> u64 {
    in_time(step / 5 * 5 + 4)
}

fn tick(step: u64) -> u64 {
    TICK + 2 * step
}

fn write(path: &Path, mut messages: Vec<Message>) {
    messages.sort_by_key(|(_, arrival, _)| *arrival);
    let mut recorder = Recorder::create(path);
    for (topic, arrival, bytes) in messages {
        if topic.ends_with("state") {
            recorder.state(topic, arrival, &bytes);
        } else {
            recorder.command(topic, arrival, &bytes);
        }
    }
    recorder.finish();
}

/// Checks times and pairs of the rows.
fn check(log: &Log, rows: usize) {
    assert!(log.rows().abs_diff(rows) <= 10, "{} rows: {:?}", log.rows(), log.read_warnings());
    let (q, q_cmd) = (log.q("FL_hip").expect("positions"), log.q_cmd("FL_hip").expect("commands"));
    let offset = q[0] - log.t()[0];
    let worst = |of: &dyn Fn(usize) -> f64| (0..log.rows()).map(|row| of(row).abs()).fold(0.0, f64::max);
    let time = worst(&|row| q[row] - log.t()[row] - offset);
    assert!(time < 1e-4, "times are {time} s off: {:?}", log.read_warnings());
    let pair = worst(&|row| q_cmd[row] - q[row]);
    assert!(pair < 1e-3, "commands are {pair} s off: {:?}", log.read_warnings());
}

fn opened(messages: Vec<Message>) -> Log {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("walk.mcap");
    write(&path, messages);
    Log::open(&path).expect("a log")
}

#[test]
fn late_messages_keep_the_times_at_which_they_were_sent() {
    let jitter = |step: u64| in_time(step) + step * 7919 % 800_000;
    let commands = |step: u64| in_time(step) + 300_000;
    let command_bursts = |step: u64| in_bursts(step) + 300_000;
    check(&opened(messages(in_time, commands, tick)), 2500);
    check(&opened(messages(jitter, commands, tick)), 2500);
    // States in bursts, commands in time; and both in bursts.
    check(&opened(messages(in_bursts, commands, tick)), 2500);
    check(&opened(messages(in_bursts, command_bursts, tick)), 2500);
}

#[test]
fn one_wrong_tick_costs_one_row() {
    let repeated = |step: u64| if step == 1200 { tick(1199) } else { tick(step) };
    let commands = |step: u64| in_time(step) + 300_000;
    for arrival in [in_time, in_bursts] {
        let log = opened(messages(arrival, commands, repeated));
        check(&log, 2499);
        let notes = log.read_warnings().join("\n");
        assert!(notes.contains("omitted one state whose `tick` repeats or jumps"), "{notes}");
    }
}

#[test]
fn restart_of_the_robot_begins_an_episode() {
    let restarted = |step: u64| if step < 1000 { tick(step) } else { 2 * (step - 1000) };
    let log = opened(messages(in_time, |step| in_time(step) + 300_000, restarted));
    check(&log, 2500);
    assert_eq!((log.episode()[999], log.episode()[1000]), (0, 1), "{:?}", log.read_warnings());
}

#[test]
fn folder_of_a_split_bag_is_one_recording() {
    let folder = tempfile::tempdir().expect("a folder");
    let all = messages(in_time, |step| in_time(step) + 300_000, tick);
    // More than nine parts, whose names do not sort as numbers.
    for (part, messages) in all.chunks(400).enumerate() {
        write(&folder.path().join(format!("walk_{part}.mcap")), messages.to_vec());
    }
    fs::write(folder.path().join("metadata.yaml"), "rosbag2_bagfile_information: {}\n").expect("written");
    check(&Log::open(folder.path()).expect("a log"), 2500);
    write(&folder.path().join("other_0.mcap"), all[..40].to_vec());
    let error = Log::open(folder.path()).expect_err("two bags").to_string();
    assert!(error.contains("other_0.mcap") && error.contains("walk_0.mcap"), "{error}");
}

#[test]
fn topics_may_be_in_a_namespace_and_another_robot_is_left_out() {
    let mut all: Vec<Message> = messages(in_time, |step| in_time(step) + 300_000, tick)
        .into_iter()
        .map(|(topic, arrival, bytes)| {
            (if topic == "/lowstate" { "/go2/lowstate" } else { "/go2/lowcmd" }, arrival, bytes)
        })
        .collect();
    // The same states at a lower rate, as the robot sends them on /lf/lowstate, come first in the file.
    all.extend((0..250).map(|step| state("/go2/lf/lowstate", 10 * step, in_time(10 * step), tick(10 * step))));
    all.rotate_right(250);
    let log = opened(all);
    check(&log, 2500);
    assert!(log.read_warnings().iter().any(|note| note.contains("/go2/lf")), "{:?}", log.read_warnings());
}

#[test]
fn bag_in_the_format_of_sqlite_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("walk_0.db3");
    let bag = rusqlite::Connection::open(&path).expect("a file");
    bag.execute_batch(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, \
         offered_qos_profiles TEXT NOT NULL);\n\
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);\n\
         INSERT INTO topics VALUES (1, '/lowstate', 'unitree_go/msg/LowState', 'cdr', ''), (2, '/lowcmd', \
         'unitree_go/msg/LowCmd', 'cdr', ''), (3, '/camera', 'sensor_msgs/msg/Image', 'cdr', '');\nBEGIN;",
    )
    .expect("tables");
    for (topic, arrival, bytes) in messages(in_time, |step| in_time(step) + 300_000, tick) {
        let id = if topic == "/lowstate" { 1 } else { 2 };
        bag.execute(
            "INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)",
            (id, arrival as i64, bytes),
        )
        .expect("a row");
    }
    bag.execute_batch("COMMIT").expect("written");
    drop(bag);
    check(&Log::open(&path).expect("a log"), 2500);
    check(&Log::open(folder.path()).expect("a folder"), 2500);
    fs::write(&path, b"SQLite format 3\0nonsense").expect("written");
    let error = Log::open(&path).expect_err("damaged").to_string();
    assert!(error.contains("is not a bag of rosbag2"), "{error}");
}

#[test]
fn states_alone_are_described_and_cannot_be_simulated() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("states.mcap");
    let states = messages(in_time, in_time, tick).into_iter().filter(|(topic, ..)| *topic == "/lowstate");
    write(&path, states.collect());
    let error = Log::open(&path).expect_err("no commands").to_string();
    assert!(error.contains("/lowcmd"), "{error}");
    let log = Log::open_states(&path, &ColumnMap::default()).expect("states");
    assert_eq!((log.rows(), log.q_cmd("FL_hip")), (2500, None));
    assert!(log.describe().to_string().contains("FL_hip"));
}
