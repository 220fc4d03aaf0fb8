//! Short logs of every format, and recordings as MCAP without compression or checksums.

use std::sync::LazyLock;

use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::BaseMount;
use twinstep_unitree::{LowCmd, LowState, encode};

/// Number of rows.
const ROWS: usize = 8;
const JOINTS: [&str; 3] = ["FL_hip", "FL_thigh", "FL_calf"];

/// Returns the metadata of the examples.
pub fn meta() -> String {
    static META: LazyLock<String> = LazyLock::new(|| serde_json::to_string(&metadata()).expect("plain data"));
    META.clone()
}

/// Returns the metadata of data files, which may have other joints than the examples.
pub fn meta_without_joints() -> String {
    static META: LazyLock<String> = LazyLock::new(|| {
        let meta = Meta { joints: Vec::new(), ..metadata() };
        serde_json::to_string(&meta).expect("plain data")
    });
    META.clone()
}

/// Returns the example as CSV.
pub fn csv() -> Vec<u8> {
    static CSV: LazyLock<Vec<u8>> = LazyLock::new(|| written("data.csv"));
    CSV.clone()
}

/// Returns a motion file as CSV: commands without measurements.
pub fn commands_csv() -> Vec<u8> {
    let rows = (0..ROWS).map(|row| format!("{:.3},{:.2},{:.2}\n", row as f64 * 0.005, 0.1 * row as f64, -0.5));
    ["t,q_cmd_FL_hip,q_cmd_FL_thigh\n".to_owned(), rows.collect()].concat().into_bytes()
}

fn metadata() -> Meta {
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let segments = vec![segment("air", BaseMount::Fixed), segment("stand", BaseMount::Floating)];
    let mut meta = Meta::new(200.0, TorqueSensor::MotorCurrent, segments);
    meta.policy_hz = Some(50.0);
    meta.joints = JOINTS.map(str::to_owned).to_vec();
    meta.noise.insert("q".to_owned(), 1e-4);
    meta.noise.insert("tau_measured_FL_hip".to_owned(), 0.1);
    meta.source = Some("an example".to_owned());
    meta
}

fn example() -> Log {
    let column = |of: &dyn Fn(f64) -> f64| (0..ROWS).map(|row| of(row as f64)).collect::<Vec<_>>();
    let half = ROWS as f64 / 2.0;
    let mut columns = vec![
        ("t".to_owned(), column(&|row| 0.005 * row)),
        ("segment".to_owned(), column(&|row| f64::from(row >= half))),
        ("episode".to_owned(), column(&|row| f64::from(row >= half))),
        ("kp".to_owned(), column(&|_| 25.0)),
        ("kd".to_owned(), column(&|_| 0.5)),
    ];
    for (index, joint) in JOINTS.iter().enumerate() {
        let phase = move |row: f64| (0.3 * row + index as f64).sin();
        columns.push((format!("q_cmd_{joint}"), column(&phase)));
        columns.push((format!("q_{joint}"), column(&|row| 0.9 * phase(row - 1.0))));
        columns.push((format!("dq_{joint}"), column(&|row| if row == 3.0 { f64::NAN } else { phase(row + 2.0) })));
        columns.push((format!("tau_measured_{joint}"), column(&|row| 5.0 * phase(row))));
    }
    for (name, value) in [("quat_w", 1.0), ("quat_x", 0.0), ("quat_y", 0.0), ("quat_z", 0.0), ("battery_V", 28.5)] {
        columns.push((name.to_owned(), column(&|_| value)));
    }
    columns.push(("foot_force_FL".to_owned(), column(&|row| 10.0 * row)));
    Log::new(metadata(), columns).expect("a valid log")
}

/// Returns the content of the data file `name` of the example.
pub fn written(name: &str) -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join(name);
    example().write(&path).expect("a log can be written");
    std::fs::read(path).expect("the log was written")
}

/// Returns the example as MCAP, and recordings without chunks and in one chunk without checksum.
///
/// A change to a compressed chunk or to one with a checksum makes all of it invalid.
pub fn mcap() -> Vec<Vec<u8>> {
    vec![written("data.mcap"), recording(false), recording(true)]
}

const MAGIC: &[u8] = b"\x89MCAP0\r\n";

/// Opcodes of MCAP records.
const HEADER: u8 = 1;
const FOOTER: u8 = 2;
const SCHEMA: u8 = 3;
const CHANNEL: u8 = 4;
const MESSAGE: u8 = 5;
const CHUNK: u8 = 6;
const DATA_END: u8 = 15;

fn record(opcode: u8, content: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(content.len() as u64).to_le_bytes(), content].concat()
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn recording(is_chunked: bool) -> Vec<u8> {
    let mut records = Vec::new();
    for (id, topic, name) in [(1u16, "/lowstate", "unitree_go/msg/LowState"), (2, "rt/lowcmd", "unitree_go::LowCmd_")] {
        let schema = [id.to_le_bytes().to_vec(), text(name), text("ros2msg"), text("")].concat();
        records.extend(record(SCHEMA, &schema));
        let ids = [id.to_le_bytes(), id.to_le_bytes()].concat();
        records.extend(record(CHANNEL, &[ids, text(topic), text("cdr"), 0u32.to_le_bytes().to_vec()].concat()));
    }
    for row in 0..4u64 {
        for (channel, size) in [(1u16, 1176), (2, 808)] {
            let time = (1_000_000_000 + row * 2_000_000).to_le_bytes();
            let head = [&channel.to_le_bytes()[..], &(row as u32).to_le_bytes(), &time, &time].concat();
            records.extend(record(MESSAGE, &[head, cdr_body(size, row)].concat()));
        }
    }
    let records = if is_chunked { record(CHUNK, &chunk(&records)) } else { records };
    let header = record(HEADER, &[text("ros2"), text("fuzz")].concat());
    let end = [record(DATA_END, &[0; 4]), record(FOOTER, &[0; 20])].concat();
    [MAGIC, &header, &records, &end, MAGIC].concat()
}

/// Returns a chunk without compression and checksum.
fn chunk(records: &[u8]) -> Vec<u8> {
    let length = (records.len() as u64).to_le_bytes();
    [&[0; 16][..], &length, &[0; 4], &text(""), &length, records].concat()
}

/// Returns a message in which every 32-bit float is 0.1 or slightly more, with a unit quaternion.
fn cdr_body(size: usize, row: u64) -> Vec<u8> {
    let mut body = (0.1 + 0.01 * row as f32).to_le_bytes().repeat(size.div_ceil(4));
    body.truncate(size);
    if size > 1000 {
        // The quaternion begins at byte 24 of a state.
        body[24..40].copy_from_slice(&[1.0f32, 0.0, 0.0, 0.0].map(f32::to_le_bytes).concat());
    }
    [vec![0, 1, 0, 0], body].concat()
}

/// Returns a bag of rosbag2 in the format of SQLite, with a state and a command.
pub fn bag() -> Vec<u8> {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("bag.db3");
    let bag = rusqlite::Connection::open(&path).expect("a file");
    bag.execute_batch(
        "PRAGMA page_size = 512;
         CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
         INSERT INTO topics VALUES (1, '/lowstate', 'unitree_go/msg/LowState', 'cdr', ''), (2, '/lowcmd', 'unitree_go/msg/LowCmd',
             'cdr', '');",
    )
    .expect("tables");
    let messages = [(2, 1_000_000, encode(&LowCmd::default())), (1, 2_000_000, encode(&LowState::default()))];
    for message in messages {
        bag.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)", message).expect("a row");
    }
    drop(bag);
    std::fs::read(&path).expect("the file")
}
