//! More than one robot on a domain: a second one, a simulator, a replayed log.

use std::time::{Duration, Instant};

use serde_json::Value;
use twinstep_tests::process::Process;
use twinstep_tests::python::Programs;
use twinstep_tests::robot_pair::RobotPair;

/// Time within which a second robot is discovered, on a loaded computer.
const DISCOVERY: Duration = Duration::from_secs(5);

#[test]
fn robot_beside_another_is_not_armed_whatever_the_phase_of_their_states() {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let mut pair = RobotPair::start(&program, &[], &[]).unwrap();
    pair.wait_for("observe", Duration::from_mins(1)).unwrap();
    pair.operator("release").unwrap();
    let domain = pair.domain.to_string();
    for _ in 0..4 {
        let arguments = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain];
        let mut second = Process::start(&program, &arguments.map(str::to_owned)).unwrap();
        second.line(Duration::from_secs(20)).expect("it is ready");
        // Once it is known it stays known: its states come between those of the robot, or together with them.
        let since = Instant::now();
        while !pair.operator("arm").unwrap().contains("rt/lowstate") {
            assert!(since.elapsed() < DISCOVERY, "the second robot is not noticed");
            pair.operator("disarm").unwrap();
            std::thread::sleep(Duration::from_millis(100));
        }
        for _ in 0..10 {
            std::thread::sleep(Duration::from_millis(100));
            let answer = pair.operator("arm").unwrap();
            assert!(answer.starts_with("error") && answer.contains("rt/lowstate"), "{answer}");
        }
        second.write_line("statistics").unwrap();
        let statistics: Value = serde_json::from_str(&second.line(Duration::from_secs(5)).unwrap()).unwrap();
        assert_eq!(statistics["accepted"], 0, "it gets no commands");
    }
}
