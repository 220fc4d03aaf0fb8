//! Every fault in every state.

use twinstep_model::Joint;
use twinstep_unitree::Button;

use super::*;
use crate::watchdog::Watchdog;
use crate::{ActionRefused, Fault, Reaction, RequestRefused};

/// What causes a fault, its name, and the longest time to the reaction [ms].
type Case = (&'static str, fn(&mut Rig), fn(&Fault) -> bool, u64);

const CASES: [Case; 22] = [
    ("stale state", |rig| rig.sends_states = false, |fault| matches!(fault, Fault::StateStale { .. }), 40),
    ("stopped clock", |rig| rig.clock_runs = false, |fault| matches!(fault, Fault::StateStale { .. }), 40),
    ("foreign writer", |rig| rig.input.foreign_writers = 1, |fault| *fault == Fault::ForeignWriter { writers: 1 }, 2),
    ("other robot", |rig| rig.input.other_robot = true, |fault| *fault == Fault::OtherRobot, 2),
    ("clock jump", |rig| rig.reading.tick -= 500, |fault| matches!(fault, Fault::ClockJump { .. }), 2),
    ("takeover", |rig| rig.input.watchdog = Watchdog::TookOver, |fault| *fault == Fault::WatchdogTookOver, 2),
    ("no watchdog", |rig| rig.input.watchdog = Watchdog::Missing, |fault| *fault == Fault::WatchdogGone, 2),
    ("no guard", |rig| rig.input.watchdog = Watchdog::Idle, |fault| *fault == Fault::WatchdogGone, 2),
    ("network", |rig| rig.input.can_send = false, |fault| *fault == Fault::CannotSend, 2),
    ("controller", |rig| rig.input.controller_released = false, |fault| *fault == Fault::ControllerActive, 2),
    ("remote stop", press_stop, |fault| *fault == Fault::RemoteStop, 2),
    ("stop request", |rig| rig.input.stop_requested = true, |fault| *fault == Fault::StopRequested, 2),
    ("lost messages", |rig| rig.reading.lost_messages += 21, |fault| *fault == Fault::MessagesLost { count: 21 }, 2),
    ("tilt", |rig| rig.reading.tilt = 1.1, |fault| matches!(fault, Fault::Tilt { .. }), 2),
    (
        "accelerometer",
        |rig| rig.reading.acc = [9.81, 0.0, 0.0],
        |fault| matches!(fault, Fault::ImuDisagrees { .. }),
        330,
    ),
    (
        "joint limit",
        stray_joint,
        |fault| matches!(fault, Fault::JointLimit { joint, .. } if joint.name() == "RL_hip"),
        2,
    ),
    (
        "torque",
        |rig| rig.reading.tau[8] = -41.0,
        |fault| matches!(fault, Fault::Torque { joint, .. } if joint.name() == "RL_calf"),
        304,
    ),
    (
        "temperature",
        |rig| rig.reading.temperature[1] = 86,
        |fault| matches!(fault, Fault::Temperature { joint, celsius: 86 } if joint.name() == "FL_thigh"),
        2,
    ),
    ("voltage", |rig| rig.reading.voltage = 23.9, |fault| matches!(fault, Fault::Voltage { .. }), 2),
    ("remote lost", |rig| rig.reading.remote = None, |fault| *fault == Fault::RemoteLost, 1004),
    ("client lost", |rig| rig.input.client = Client::Absent, |fault| *fault == Fault::ClientLost, 2),
    ("late actions", |_| {}, |fault| matches!(fault, Fault::ActionLate { missed: 10 }), 221),
];

fn press_stop(rig: &mut Rig) {
    rig.reading.remote = Some(Remote::default().with_pressed(Button::L2).with_pressed(Button::B));
}

fn stray_joint(rig: &mut Rig) {
    rig.reading.q[Joint::ALL.into_iter().position(|joint| joint.name() == "RL_hip").expect("a joint")] = 1.2;
}

/// Returns whether a fault counts in `state`; from the table in the documentation.
fn counts(name: &str, state: State) -> bool {
    match state {
        State::Disconnected | State::Observe | State::Fault => false,
        State::Damp => {
            let surroundings =
                ["foreign writer", "other robot", "controller", "remote stop", "stop request", "network"];
            let process = ["takeover", "no watchdog", "stale state", "stopped clock", "clock jump", "lost messages"];
            process.iter().chain(&surroundings).any(|counts| *counts == name)
        }
        State::StandUp | State::Ready | State::Sit => !["client lost", "late actions"].contains(&name),
        State::Run | State::Hold => true,
    }
}

#[test]
fn every_fault_in_every_state_has_its_reaction_in_time() {
    for state in State::ALL {
        for (name, cause, is_fault, max_ms) in CASES {
            let mut rig = Rig::in_state(state);
            let fault_before = rig.output.fault;
            cause(&mut rig);
            let cause_is_kept = rig.reading.clone();
            let start = rig.input.now;
            let limit = Duration::from_millis(if counts(name, state) { max_ms } else { 400 });
            let acts = matches!(state, State::Run | State::Hold) && name != "late actions";
            while rig.input.now < start + limit && rig.output.fault == fault_before {
                if acts && rig.next_tick() > rig.output.tick {
                    rig.act([0.0; NUM_JOINTS]);
                } else {
                    rig.step();
                }
                // A robot that follows its commands must not undo the cause.
                if name == "joint limit" {
                    rig.reading.q = cause_is_kept.q;
                }
            }
            let context = format!("{name} in {state}");
            if !counts(name, state) {
                assert_eq!(rig.output.fault, fault_before, "{context}");
                continue;
            }
            let fault = rig.output.fault.unwrap_or_else(|| panic!("{context}: no fault within {max_ms} ms"));
            assert!(is_fault(&fault), "{context}: {fault}");
            let expected = if fault.reaction() == Reaction::Sit { State::Sit } else { State::Fault };
            assert_eq!(rig.output.state, expected, "{context}");
            rig.time_to(State::Fault);
            assert_eq!((rig.command().kp, rig.command().kd), ([0.0; NUM_JOINTS], [3.0; NUM_JOINTS]), "{context}");
        }
    }
}

#[test]
fn fault_is_kept_until_the_operator_arms_again() {
    for (name, cause, is_fault, _) in CASES {
        let mut rig = Rig::in_state(State::Run);
        let healthy = rig.clone();
        cause(&mut rig);
        if name == "late actions" {
            rig.run(0.5);
        } else {
            rig.walk(1.5);
        }
        rig.time_to(State::Fault);
        let fault = rig.output.fault;
        assert!(fault.is_some_and(|fault| is_fault(&fault)), "{name}: {fault:?}");
        (rig.sends_states, rig.clock_runs) = (true, true);
        rig.reading = Reading { q: rig.reading.q, lost_messages: rig.reading.lost_messages, ..healthy.reading };
        if name == "joint limit" {
            rig.reading.q = lying();
        }
        rig.input = Input { now: rig.input.now, ..healthy.input };
        rig.run(3.0);
        for request in [OperatorRequest::Stand, OperatorRequest::Sit, OperatorRequest::Damp] {
            rig.request(request);
        }
        rig.act([0.0; NUM_JOINTS]);
        assert_eq!((rig.output.state, rig.output.fault), (State::Fault, fault), "{name}");
        rig.request(OperatorRequest::Arm);
        assert_eq!((rig.output.state, rig.output.fault), (State::Damp, None), "{name}");
    }
}

#[test]
fn damping_begins_within_40_ms_of_the_last_state() {
    let mut rig = Rig::in_state(State::Ready);
    rig.walk(0.5);
    let last_state = rig.input.now;
    rig.sends_states = false;
    while rig.output.state != State::Fault {
        rig.step();
    }
    let age = rig.input.now.saturating_sub(last_state);
    assert!(age > Duration::from_millis(20) && age <= Duration::from_millis(40), "{age:?}");
}

#[test]
fn clock_that_never_ran_is_no_stale_state() {
    // The vendor's simulator sends states whose clock is always 0.
    let mut rig = Rig::new();
    rig.clock_runs = false;
    rig.run(1.2);
    rig.request(OperatorRequest::Arm);
    rig.run(1.0);
    assert_eq!((rig.output.state, rig.output.fault), (State::Damp, None));
}

#[test]
fn single_late_step_is_no_stale_state() {
    let mut rig = Rig::in_state(State::Ready);
    rig.sends_states = false;
    rig.input.now += Duration::from_millis(25);
    rig.step();
    rig.sends_states = true;
    rig.run(0.1);
    assert_eq!((rig.output.state, rig.output.fault), (State::Ready, None));
}

#[test]
fn short_torque_and_few_lost_messages_are_no_fault() {
    let mut rig = Rig::in_state(State::Ready);
    for _ in 0..10 {
        rig.reading.tau[8] = 45.0;
        rig.run(0.25);
        rig.reading.tau[8] = 0.0;
        rig.reading.lost_messages += 4;
        rig.run(0.01);
    }
    assert_eq!(rig.output.fault, None);
}

#[test]
fn graver_fault_interrupts_sitting_down_and_the_first_one_is_kept() {
    let mut rig = Rig::in_state(State::Run);
    rig.input.client = Client::Absent;
    rig.step();
    assert_eq!((rig.output.state, rig.output.fault), (State::Sit, Some(Fault::ClientLost)));
    rig.reading.tilt = 2.0;
    rig.step();
    assert_eq!((rig.output.state, rig.output.fault), (State::Fault, Some(Fault::ClientLost)));
}

#[test]
fn pause_of_the_process_while_the_robot_moves_is_a_fault() {
    for state in State::ALL {
        let mut rig = Rig::in_state(state);
        rig.input.now += Duration::from_millis(49);
        let fault_before = rig.output.fault;
        rig.step();
        let is_fault = matches!(rig.output.fault, Some(Fault::Pause { ms: 51 }));
        assert_eq!(is_fault, state.is_moving(), "{state}: {:?}", rig.output.fault);
        assert!(is_fault || rig.output.fault == fault_before, "{state}");
    }
}

#[test]
fn button_that_was_released_again_in_the_newest_state_stops_the_robot() {
    let mut rig = Rig::in_state(State::Ready);
    let pressed = Remote::default().with_pressed(Button::L2).with_pressed(Button::B);
    let state = |rig: &Rig, remote, tick| Reading { remote: Some(remote), tick, ..rig.reading.clone() };
    let tick = rig.reading.tick;
    rig.input.readings = vec![state(&rig, pressed, tick + 2), state(&rig, Remote::default(), tick + 4)];
    rig.input.now += DT;
    let output = rig.machine.step(&rig.input);
    assert_eq!((output.state, output.fault), (State::Fault, Some(Fault::RemoteStop)));
}

#[test]
fn number_that_is_none_is_no_healthy_one() {
    let cases: [fn(&mut Rig); 3] = [
        |rig| rig.reading.tilt = f32::NAN,
        |rig| rig.reading.voltage = f32::NAN,
        |rig| rig.reading.acc = [f32::NAN, 0.0, 9.81],
    ];
    for cause in cases {
        let mut rig = Rig::in_state(State::Ready);
        cause(&mut rig);
        rig.run(0.1);
        assert!(rig.output.fault.is_some());
    }
}

#[test]
fn watchdog_has_to_guard_the_motors_before_the_robot_stands_up() {
    let mut rig = Rig::in_state(State::Damp);
    rig.input.watchdog = Watchdog::Idle;
    rig.request(OperatorRequest::Stand);
    assert_eq!(rig.output.request_refused, Some(RequestRefused::Fault(Fault::WatchdogGone)));
    assert_eq!(rig.output.state, State::Damp);
    rig.input.watchdog = Watchdog::Guarding;
    rig.request(OperatorRequest::Stand);
    assert_eq!(rig.output.state, State::StandUp);
}

#[test]
fn motors_that_the_watchdog_took_over_are_taken_back_by_arming_again() {
    let mut rig = Rig::in_state(State::Ready);
    rig.input.watchdog = Watchdog::TookOver;
    rig.run(0.2);
    assert_eq!((rig.output.state, rig.output.fault), (State::Fault, Some(Fault::WatchdogTookOver)));
    rig.request(OperatorRequest::Arm);
    assert_eq!((rig.output.state, rig.output.request_refused), (State::Damp, None));
    // The new writer has another generation, which the watchdog does not know yet.
    rig.input.watchdog = Watchdog::Idle;
    rig.run(0.1);
    assert_eq!((rig.output.state, rig.output.fault), (State::Damp, None));
}

#[test]
fn client_acts_again_after_a_fault_when_the_operator_says_go() {
    let mut rig = Rig::in_state(State::Run);
    rig.input.stop_requested = true;
    rig.step();
    rig.input.stop_requested = false;
    for (request, seconds) in [(OperatorRequest::Arm, 0.1), (OperatorRequest::Stand, 4.0)] {
        rig.request(request);
        rig.run(seconds);
    }
    assert_eq!((rig.output.state, rig.output.is_permitted), (State::Ready, false));
    rig.act([0.1; NUM_JOINTS]);
    assert_eq!((rig.output.state, rig.output.action_refused), (State::Ready, Some(ActionRefused::NotPermitted)));
    rig.request(OperatorRequest::Go);
    assert_eq!(rig.output.request_refused, None);
    rig.walk(0.1);
    assert_eq!(rig.output.state, State::Run);
}
