//! `twinstep robot` in front of a robot that uses the vendor's DDS library, Cyclone DDS 0.10.2.

use std::io::Write;
use std::path::Path;
use std::time::Duration;

use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, cyclone_python, root};
use twinstep_tests::robot_pair::{PATIENT, RobotPair, next_domain};

/// Trials, of which one has to succeed beside other tests.
const ATTEMPTS: u32 = 3;

fn skip(reason: &str) {
    // Written directly to stderr: the test harness hides the output of passing tests.
    let _ = writeln!(std::io::stderr(), "\nSKIPPED the test with Cyclone DDS 0.10.2: {reason}");
}

/// Starts the robot in Python and `twinstep robot` in front of it.
fn pair(python: &Path) -> RobotPair {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let (script, domain) = (root().join("clients/python/tests/cyclone_robot.py"), next_domain());
    let robot = Process::start(python, &[script.display().to_string(), domain.to_string()]).unwrap();
    // Beside other tests, Python publishes its states more slowly than a real robot.
    let config = format!("{PATIENT}min_state_hz = 100\n");
    RobotPair::in_front_of(robot, domain, &config, &program, &[]).unwrap()
}

#[test]
fn robot_with_the_vendors_dds_is_observed_released_and_stands_up() {
    let python = match cyclone_python(&crate::python::target()) {
        Ok(python) => python,
        Err(reason) => {
            return skip(&reason);
        }
    };
    let mut pair = pair(&python);
    for attempt in 1.. {
        let Err(error) = pair.stand() else { break };
        let rate = pair.ask("statistics").unwrap()["states_per_second"].as_f64().unwrap();
        // How fast the machine is does not decide about the test.
        if rate < 180.0 && attempt == ATTEMPTS {
            return skip(&format!("{error}; here Python sends {rate:.0} states per second, and 200 are needed"));
        }
        assert!(attempt < ATTEMPTS, "{error}; {rate} states per second");
        pair = self::pair(&python);
    }
    let report = pair.ask("statistics").unwrap();
    assert_eq!(report["wrong_checksum"], 0, "by its own code: {report}");
    assert_eq!((&report["not_low_level"], &report["before_release"]), (&0.into(), &0.into()), "{report}");
    // It looks 50 times per second at the newest command, for the 3 s in which it stands up.
    assert!(report["received"].as_u64().unwrap() > 20, "{report}");
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
