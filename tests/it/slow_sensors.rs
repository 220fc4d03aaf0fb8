//! A log whose sensors are slower than the motion, through the programs that would take held readings for physics.

use std::process::Command;

use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, Joint};

use crate::robot::program;

/// All joints swing at `hz`. The sensors are read at 50 Hz, and recorded at 500 Hz.
fn log(hz: f64) -> Log {
    let meta =
        Meta::new(500.0, TorqueSensor::MotorCurrent, vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }]);
    let phase = |row: usize| std::f64::consts::TAU * hz * row as f64 / 500.0;
    let held = |row: usize| phase(row / 10 * 10);
    let column = |of: &dyn Fn(usize) -> f64| (0..2000).map(of).collect::<Vec<f64>>();
    let mut columns = vec![("t".to_owned(), column(&|row| row as f64 / 500.0))];
    for joint in Joint::ALL {
        let middle = [0.0, 0.8, -1.5][joint.index() % 3];
        columns.push((format!("q_cmd_{joint}"), column(&|row| middle + 0.1 * phase(row).sin())));
        columns.push((format!("q_{joint}"), column(&|row| middle + 0.09 * held(row).sin())));
        columns.push((format!("dq_{joint}"), column(&|row| 0.09 * std::f64::consts::TAU * hz * held(row).cos())));
        columns.push((format!("tau_measured_{joint}"), column(&|row| 0.2 * held(row).sin())));
    }
    Log::new(
        Meta { kp: Some(twinstep_logs::Gain::Uniform(20.0)), kd: Some(twinstep_logs::Gain::Uniform(0.5)), ..meta },
        columns,
    )
    .unwrap()
}

/// Returns the exit code and what the program says.
fn twinstep(arguments: &[&str]) -> (Option<i32>, String) {
    let output = Command::new(program()).args(arguments).output().unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn nothing_is_identified_or_learned_from_sensors_slower_than_the_motion() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (fast, slow, model, out) = (path("fast"), path("slow"), path("model.toml"), path("out"));
    log(6.1).write(&fast).unwrap();
    log(1.0).write(&slow).unwrap();
    let identify = |log: &str| twinstep(&["identify", log, "--effects", "viscous_friction@all", "--out", &model]);
    for (code, error) in [identify(&fast), twinstep(&["diagnose", &fast, "--out", &out])] {
        assert_eq!(code, Some(2), "{error}");
        assert!(error.contains("times in a period of the motion") && error.contains("record the sensors"), "{error}");
    }
    // Slow motion is measured well enough, but held readings would be learned.
    assert_eq!(identify(&slow).0, Some(0), "{}", identify(&slow).1);
    let (code, error) = twinstep(&["fit", &slow, "--out", &out]);
    assert_eq!(code, Some(2), "{error}");
    assert!(error.contains("the sensors repeat"), "{error}");
}
