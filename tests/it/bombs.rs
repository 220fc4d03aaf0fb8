//! Small files that would cost much memory or time: each is refused with a reason, at once.

use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use twinstep_robot_files::read_robot;

/// Time in which a file is refused, on a busy machine.
const AT_ONCE: Duration = Duration::from_secs(5);

fn import(text: &str) -> String {
    let since = Instant::now();
    let error = read_robot(text, None).expect_err("a bomb");
    assert!(since.elapsed() < AT_ONCE, "{:?}", since.elapsed());
    error.to_string()
}

fn numbered(count: usize, part: impl Fn(usize) -> String) -> String {
    (0..count).map(part).collect::<Vec<_>>().concat()
}

#[test]
fn urdf_whose_links_have_two_parents_is_refused() {
    let joint = |index: usize, copy: char| {
        format!(
            "<joint name=\"j{index}{copy}\" type=\"fixed\"><parent link=\"l{index}\"/><child link=\"l{}\"/></joint>",
            index + 1
        )
    };
    let links = numbered(61, |index| format!("<link name=\"l{index}\"/>"));
    let joints: String = (0..60).map(|index| joint(index, 'a') + &joint(index, 'b')).collect();
    let text = import(&format!("<robot name=\"bomb\">{links}{joints}</robot>"));
    assert!(text.contains("`l1` is the child of two joints"), "{text}");
    let many = numbered(1001, |index| format!("<link name=\"l{index}\"/>"));
    assert!(import(&format!("<robot name=\"bomb\">{many}</robot>")).contains("at most 1000"));
}

#[test]
fn mjcf_with_deep_bodies_or_classes_is_refused() {
    let bodies = "<body>".repeat(20_000) + &"</body>".repeat(20_000);
    let text = import(&format!("<mujoco><worldbody>{bodies}</worldbody></mujoco>"));
    assert!(text.contains("deeper than 256"), "{text}");
    let attributes = numbered(1001, |index| format!(" a{index}=\"1\""));
    let text = import(&format!("<mujoco><default><geom{attributes}/></default><worldbody/></mujoco>"));
    assert!(text.contains("at most 1000"), "{text}");
    let attributes = numbered(900, |index| format!(" a{index}=\"1\""));
    let classes = numbered(2000, |index| format!("<default class=\"c{index}\"/>"));
    let text = import(&format!("<mujoco><default><geom{attributes}/>{classes}</default><worldbody/></mujoco>"));
    assert!(text.contains("more than 1000 default classes"), "{text}");
    let geoms = "<geom size=\"1\"/>".repeat(100_000);
    let text = import(&format!("<mujoco><worldbody><body><freejoint/>{geoms}</body></worldbody></mujoco>"));
    assert!(text.contains("more than 20000 elements"), "{text}");
}

#[test]
fn csv_that_is_compressed_too_well_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (data, meta) = (folder.path().join("data.csv.gz"), folder.path().join("meta.json"));
    let mut file = flate2::write::GzEncoder::new(std::fs::File::create(&data).unwrap(), flate2::Compression::best());
    file.write_all(b"t,q_FL_hip\n").unwrap();
    (0..64).for_each(|_| file.write_all(&vec![b'0'; 1 << 20]).unwrap());
    file.finish().unwrap();
    std::fs::write(meta, r#"{"rate_hz": 200, "joints": ["FL_hip"], "tau_sensor": "none", "segments": [{"name": "held", "base": "fixed"}]}"#).unwrap();
    let since = Instant::now();
    let error = twinstep_logs::Log::open(folder.path()).expect_err("a bomb").to_string();
    assert!(error.contains("1024 times") && since.elapsed() < AT_ONCE, "{error}");
}

/// Field of a Protocol Buffers message with bytes.
fn bytes(number: u8, content: &[u8]) -> Vec<u8> {
    let mut field = vec![number << 3 | 2];
    let mut len = content.len();
    while len > 127 {
        field.push(len as u8 | 128);
        len >>= 7;
    }
    field.push(len as u8);
    field.extend(content);
    field
}

/// Returns an ONNX model that concatenates an array with itself, `doublings` times.
fn doubling_model(doublings: usize) -> Vec<u8> {
    let dimension = |len: u8| bytes(1, &[1 << 3, len]);
    let shape = bytes(2, &[dimension(1), dimension(4)].concat());
    let value = |name: &[u8]| [bytes(1, name), bytes(2, &bytes(1, &[&[1 << 3, 1][..], &shape].concat()))].concat();
    let axis = bytes(5, &[bytes(1, b"axis"), vec![3 << 3, 1], vec![0xa0, 1, 2]].concat());
    let name = |index: usize| format!("v{index}").into_bytes();
    let node = |index: usize| {
        let (from, to) = (name(index), name(index + 1));
        [bytes(1, &from), bytes(1, &from), bytes(2, &to), bytes(4, b"Concat"), axis.clone()].concat()
    };
    let mut graph: Vec<u8> = (0..doublings).flat_map(|index| bytes(1, &node(index))).collect();
    graph.extend(bytes(11, &value(&name(0))));
    graph.extend(bytes(12, &value(&name(doublings))));
    bytes(7, &graph)
}

fn read_onnx(folder: &Path, doublings: usize) -> Result<usize, String> {
    let path = folder.join("model.onnx");
    std::fs::write(&path, doubling_model(doublings)).unwrap();
    twinstep_agent::OnnxNetwork::read(&path)
        .map(|network| network.outputs()[0].len())
        .map_err(|error| error.to_string())
}

#[test]
fn onnx_whose_arrays_grow_is_refused_before_they_fill_the_memory() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(read_onnx(folder.path(), 3), Ok(32), "a small one is read");
    let since = Instant::now();
    let error = read_onnx(folder.path(), 60).expect_err("a bomb");
    assert!(error.contains("longer than"), "{error}");
    assert!(since.elapsed() < 4 * AT_ONCE, "{:?}", since.elapsed());
}
