//! The motors are damped however `twinstep robot` ends or stops.

use std::path::PathBuf;
use std::time::Duration;

use twinstep_tests::python::Programs;
use twinstep_tests::robot_pair::{RobotPair, next_domain};

/// Config with the default times, which a busy machine may miss: the robot is damped then, too.
const DEFAULT: &str = "[safety]\n";

fn program() -> PathBuf {
    Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep()
}

/// Returns a robot that stands, with the default times of the watchdog.
fn standing() -> RobotPair {
    let start = || {
        let domain = next_domain();
        let arguments = ["fake-robot", "--until-stdin-closes", "--domain", &domain.to_string()].map(str::to_owned);
        let fake = twinstep_tests::process::Process::start(&program(), &arguments)?;
        let mut pair = RobotPair::in_front_of(fake, domain, DEFAULT, &program(), &[])?;
        pair.stand()?;
        Ok::<_, String>(pair)
    };
    (0..5).find_map(|_| start().ok()).expect("one of five attempts: a busy machine makes the robot stop")
}

/// Checks that the motors were damped within `max_ms` of the last command that held them, and for a while.
fn check_damped(pair: &mut RobotPair, max_ms: u64) {
    std::thread::sleep(Duration::from_millis(1800));
    let statistics = pair.ask("statistics").unwrap();
    let number = |name: &str| statistics[name].as_u64().unwrap();
    assert!(number("dampings") >= 50, "{statistics}");
    assert!(number("damping_delay_ms") <= max_ms, "{statistics}");
    assert_eq!(number("refused"), 0, "{statistics}");
    let pose = pair.ask("pose").unwrap();
    assert!(pose["position"][2].as_f64().unwrap() < 0.2, "it lies: {pose}");
}

#[test]
fn robot_whose_process_is_killed_or_aborts_is_damped() {
    for signal in ["KILL", "ABRT", "XCPU"] {
        let mut pair = standing();
        pair.robot.signal(signal).unwrap();
        check_damped(&mut pair, 60);
    }
}

#[test]
fn robot_whose_process_is_suspended_is_damped_and_taken_back_by_arming() {
    let mut pair = standing();
    pair.robot.signal("STOP").unwrap();
    check_damped(&mut pair, 80);
    pair.robot.signal("CONT").unwrap();
    pair.wait_for("fault", Duration::from_secs(5)).unwrap();
    pair.insist("arm").unwrap();
    pair.wait_for("damp", Duration::from_secs(2)).unwrap();
    pair.insist("stand").unwrap();
    pair.wait_for("ready", Duration::from_secs(15)).unwrap();
}

#[test]
fn signal_of_a_lost_terminal_and_repeated_signals_damp_the_motors_before_the_end() {
    for (signals, code) in [(&["HUP"][..], 0), (&["QUIT"], 130), (&["INT", "INT", "TERM"], 130), (&["TERM", "HUP"], 0)]
    {
        let mut pair = standing();
        for signal in signals {
            pair.robot.signal(signal).unwrap();
        }
        assert_eq!(pair.robot.exit_code(Duration::from_secs(10)), Some(code), "{signals:?}");
        check_damped(&mut pair, 60);
    }
}

#[test]
fn watchdog_that_is_killed_is_a_fault_and_no_robot_stands_without_one() {
    let mut pair = standing();
    let children = std::fs::read_to_string(format!("/proc/{0}/task/{0}/children", pair.robot.id())).unwrap();
    let is_watchdog = |id: &&str| {
        std::fs::read_to_string(format!("/proc/{id}/cmdline")).is_ok_and(|line| line.contains("\0watchdog\0"))
    };
    let watchdog = children.split_whitespace().find(is_watchdog).expect("it is a child").to_owned();
    let kill = |signal: &str| std::process::Command::new("kill").args([signal, &watchdog]).status().unwrap();
    assert!(kill("-TERM").success() && kill("-HUP").success() && kill("-INT").success());
    std::thread::sleep(Duration::from_millis(300));
    assert!(pair.state().starts_with("ready"), "a signal that can be caught does not end it: {}", pair.state());
    assert!(kill("-KILL").success());
    pair.wait_for("fault", Duration::from_secs(2)).unwrap();
    assert!(pair.state().contains("watchdog"), "{}", pair.state());
    check_damped(&mut pair, 60);
    let refused = pair.operator("arm").unwrap();
    assert!(refused.contains("watchdog"), "{refused}");
}
