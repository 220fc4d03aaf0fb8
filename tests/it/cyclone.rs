//! `twinstep robot` in front of a robot that uses the vendor's DDS library, Cyclone DDS 0.10.2.

use std::io::Write;
use std::time::Duration;

use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, cyclone_python, root};
use twinstep_tests::robot_pair::{PATIENT, RobotPair, next_domain};

/// Starts a robot with the vendor's DDS library, whose reader of commands is `reliable` or `best-effort`, and makes it stand.
/// `None` without Python 3.10.
fn standing(reader: &str) -> Option<RobotPair> {
    let python = match cyclone_python(&crate::python::target()) {
        Ok(python) => python,
        Err(reason) => {
            // Written directly to stderr: the test harness hides the output of passing tests.
            let _ = writeln!(std::io::stderr(), "\nSKIPPED the test with Cyclone DDS 0.10.2: {reason}");
            return None;
        }
    };
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let (script, domain) = (root().join("clients/python/tests/cyclone_robot.py"), next_domain());
    let robot =
        Process::start(&python, &[script.display().to_string(), domain.to_string(), reader.to_owned()]).unwrap();
    // Beside other tests, Python publishes its states more slowly than a real robot.
    let config = format!("{PATIENT}min_state_hz = 100\n");
    let mut pair = RobotPair::in_front_of(robot, domain, &config, &program, &[]).unwrap();
    pair.stand().unwrap();
    Some(pair)
}

#[test]
fn watchdog_damps_a_robot_with_the_vendors_dds() {
    for (signal, reader) in
        [("KILL", "best-effort"), ("STOP", "best-effort"), ("KILL", "reliable"), ("STOP", "reliable")]
    {
        let Some(mut pair) = standing(reader) else { return };
        pair.robot.signal(signal).unwrap();
        std::thread::sleep(Duration::from_millis(500));
        let [before, after] = [0, 1].map(|_| {
            std::thread::sleep(Duration::from_millis(500));
            pair.ask("statistics").unwrap()
        });
        let is_damped = |gains: &serde_json::Value| gains[0] == 0.0 && gains[1] == 3.0;
        assert!(after["last_gains"].as_array().unwrap().iter().all(is_damped), "{signal}, {reader}: {after}");
        let received = |report: &serde_json::Value| report["received"].as_u64().unwrap();
        assert!(received(&after) > received(&before) + 20, "{signal}, {reader}: {before}, then {after}");
        assert_eq!(after["wrong_checksum"], 0, "{after}");
    }
}

#[test]
fn robot_with_the_vendors_dds_is_observed_released_and_stands_up() {
    let Some(mut pair) = standing("best-effort") else { return };
    let report = pair.ask("statistics").unwrap();
    assert_eq!(report["wrong_checksum"], 0, "by its own code: {report}");
    assert_eq!((&report["not_low_level"], &report["before_release"]), (&0.into(), &0.into()), "{report}");
    // It looks 200 times per second at the newest command, for the 3 s in which it stands up.
    assert!(report["received"].as_u64().unwrap() > 100, "{report}");
    // Motors in the robot's order, which begins with the right front leg: the hips of the two sides differ by sign.
    let q: Vec<f64> = report["q"].as_array().unwrap().iter().map(|q| q.as_f64().unwrap()).collect();
    let default_pose = twinstep_model::go2().control.default_pose_f32();
    for (motor, joint) in [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8].into_iter().enumerate() {
        assert!((q[motor] - f64::from(default_pose[joint])).abs() < 0.05, "motor {motor}: {report}");
    }
    pair.robot.interrupt().unwrap();
    assert_eq!(pair.robot.exit_code(Duration::from_secs(10)), Some(130));
    let report = pair.ask("statistics").unwrap();
    assert!(
        report["last_gains"].as_array().unwrap().iter().all(|gains| gains[0] == 0.0 && gains[1] == 3.0),
        "{report}"
    );
}
