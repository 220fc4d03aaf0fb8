//! Tests of the public interface of measured logs: files, errors, summaries.

// `UPDATE_EXPECT` always writes snapshots with hashes.
#![allow(clippy::needless_raw_string_hashes)]

mod bags;
mod description;
mod errors;
mod mcap;
mod parquet;
mod problems;
mod reading;
mod round_trip;

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use twinstep_logs::{Gain, Meta, Segment, TorqueSensor};
use twinstep_model::BaseMount;

/// Recording of a real robot with its feet in the air, 16 s at 200 Hz.
const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/go2_air_chirp");

/// Minimal metadata.
const META: &str = r#"{"rate_hz": 200, "tau_sensor": "none", "segments": [{"name": "stand", "base": "fixed"}]}"#;

/// One joint, three rows.
const CSV: &str = "\
t,kp,kd,q_FL_hip,q_cmd_FL_hip,battery_V
0,20,0.5,0.1,0.15,28.5
0.005,20,0.5,0.2,0.25,
0.01,20,0.5,0.3,0.35,28
";

/// Creates a folder with `data.csv` and `meta.json`.
fn folder(csv: &str, meta: &str) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    write(folder.path(), "data.csv", csv);
    write(folder.path(), "meta.json", meta);
    folder
}

fn write(folder: &Path, name: &str, content: &str) -> PathBuf {
    let file = folder.join(name);
    fs::write(&file, content).expect("a file");
    file
}

/// Returns metadata with gains and the segments `stand` (fixed base) and `walk` (floating base).
fn meta() -> Meta {
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let segments = vec![segment("stand", BaseMount::Fixed), segment("walk", BaseMount::Floating)];
    Meta {
        kp: Some(Gain::Uniform(20.0)),
        kd: Some(Gain::Uniform(0.5)),
        ..Meta::new(200.0, TorqueSensor::MotorCurrent, segments)
    }
}

/// Returns columns by name, as arguments of `Log::new`.
fn columns<const N: usize>(columns: [(&str, Vec<f64>); N]) -> Vec<(String, Vec<f64>)> {
    columns.into_iter().map(|(name, cells)| (name.to_owned(), cells)).collect()
}
