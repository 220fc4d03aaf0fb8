//! Every transition of the state machine without a fault.

use super::*;
use crate::{ActionRefused, Fault, RequestRefused};

#[test]
fn unarmed_robot_is_observed_after_half_a_second_of_states() {
    let mut rig = Rig::new();
    rig.run(0.4);
    assert_eq!(rig.output.state, State::Disconnected);
    rig.run(0.7);
    assert_eq!((rig.output.state, rig.output.command), (State::Observe, None));
    rig.sends_states = false;
    assert!(rig.time_to(State::Disconnected) < 0.04);
}

#[test]
fn states_at_a_low_rate_are_no_connection() {
    let mut rig = Rig::new();
    for _ in 0..500 {
        rig.step();
        rig.sends_states = !rig.sends_states;
    }
    assert_eq!(rig.output.state, State::Disconnected, "250 states per second");
}

#[test]
fn armed_robot_is_damped() {
    let rig = Rig::in_state(State::Damp);
    assert_eq!((rig.command().kp, rig.command().kd), ([0.0; NUM_JOINTS], [3.0; NUM_JOINTS]));
}

#[test]
fn robot_is_not_armed_if_anything_is_wrong() {
    type Change = fn(&mut Rig);
    let cases: [(Change, &str); 8] = [
        (|rig| rig.input.foreign_writers = 2, "2 other writers"),
        (|rig| rig.input.controller_released = false, "built-in controller"),
        (|rig| rig.input.stop_requested = true, "stopped on request"),
        (|rig| rig.reading.remote = Some(stop_buttons()), "L2 + B"),
        (|rig| rig.reading.charge = 19, "19 %"),
        (|rig| rig.reading.temperature[4] = 71, "FR_thigh has 71 °C"),
        (|rig| rig.reading.lost_messages = 50, "50 messages"),
        (
            |rig| {
                rig.input.foreign_writers = 1;
                rig.step();
                rig.input.foreign_writers = 0;
            },
            "within the last second",
        ),
    ];
    for (change, expected) in cases {
        let mut rig = Rig::in_state(State::Observe);
        change(&mut rig);
        rig.request(OperatorRequest::Arm);
        let text = rig.output.request_refused.map(|refused| refused.to_string()).unwrap_or_default();
        assert!(text.contains(expected), "{expected}: {text}");
        assert_eq!(rig.output.state, State::Observe, "{expected}");
    }
}

#[test]
fn robot_without_states_is_not_armed() {
    let mut rig = Rig::in_state(State::Fault);
    rig.sends_states = false;
    rig.step();
    rig.run(0.1);
    rig.request(OperatorRequest::Arm);
    assert_eq!((rig.output.state, rig.output.request_refused), (State::Fault, Some(RequestRefused::StateRate)));
}

fn stop_buttons() -> Remote {
    use twinstep_unitree::Button;
    Remote::default().with_pressed(Button::L2).with_pressed(Button::B)
}

#[test]
fn robot_stands_up_from_the_measured_pose() {
    let mut rig = Rig::in_state(State::Damp);
    rig.request(OperatorRequest::Stand);
    assert_eq!(rig.output.state, State::StandUp);
    let start = rig.limits.clamp(lying());
    let distance = rig.command().q.iter().zip(start).map(|(q, start)| (q - start).abs()).fold(0.0, f32::max);
    assert!(distance < 0.01, "{distance}");
    let seconds = rig.time_to(State::Ready);
    assert!((2.99..3.01).contains(&seconds), "{seconds}");
    let q = rig.command().q;
    assert_eq!(q, go2().control.default_pose_f32());
    assert_eq!(rig.command().kp[..3], [60.0, 80.0, 80.0]);
}

#[test]
fn tilted_or_moving_robot_does_not_stand_up() {
    type Change = fn(&mut Reading);
    let cases: [(Change, &str); 5] = [
        (|reading| reading.tilt = 0.6, "tilted by 34°"),
        (|reading| reading.dq[7] = -0.6, "RL_thigh moves"),
        (|reading| reading.tilt = 1.2, "tilted by 69°"),
        (|reading| reading.temperature[0] = 86, "FL_hip has 86 °C"),
        (|reading| reading.voltage = 23.0, "23.0 V"),
    ];
    for (change, expected) in cases {
        let mut rig = Rig::in_state(State::Damp);
        change(&mut rig.reading);
        rig.request(OperatorRequest::Stand);
        let text = rig.output.request_refused.expect("refused").to_string();
        assert!(text.contains(expected), "{text}");
        assert_eq!((rig.output.state, rig.output.fault), (State::Damp, None));
    }
}

#[test]
fn robot_that_does_not_reach_the_standing_pose_sits_down() {
    let mut rig = Rig::in_state(State::Damp);
    rig.request(OperatorRequest::Stand);
    let mut seconds = 0.0;
    while rig.output.state == State::StandUp {
        rig.step();
        rig.reading.q[2] = -2.5;
        seconds += 0.002;
    }
    assert!((3.9..4.1).contains(&seconds), "{seconds}");
    assert!(matches!(rig.output.fault, Some(Fault::StandFailed { error, .. }) if (0.9..1.1).contains(&error)));
    rig.time_to(State::Fault);
}

#[test]
fn first_action_for_the_present_tick_starts_the_run() {
    let mut rig = Rig::in_state(State::Ready);
    rig.act([0.2; NUM_JOINTS]);
    assert_eq!(rig.output.state, State::Run);
    for (q, pose) in rig.command().q.iter().zip(go2().control.default_pose_f32()) {
        assert!((q - pose - 0.1).abs() < 1e-6);
    }
    assert_eq!((rig.command().kp, rig.command().kd), ([30.0; NUM_JOINTS], [0.75; NUM_JOINTS]));
    rig.walk(2.0);
    assert_eq!((rig.output.state, rig.output.missed_ticks), (State::Run, 0));
}

#[test]
fn action_is_clipped_and_what_was_applied_is_returned() {
    let mut rig = Rig::in_state(State::Ready);
    rig.act([9.0; NUM_JOINTS]);
    let applied = rig.output.applied.expect("an action");
    assert!(applied.iter().all(|action| (action - 1.0).abs() < 1e-5), "{applied:?}");
    rig.run(0.02);
    rig.act([-1.0; NUM_JOINTS]);
    let applied = rig.output.applied.expect("an action");
    assert!(applied.iter().all(|action| action.abs() < 1e-5), "a joint moves by 0.5 rad at most: {applied:?}");
}

#[test]
fn old_future_repeated_and_impossible_actions_are_refused() {
    let mut rig = Rig::in_state(State::Run);
    let before = rig.command();
    rig.run(0.04);
    let current = rig.next_tick();
    let nan = std::array::from_fn(|joint| if joint == 3 { f32::NAN } else { 0.0 });
    let mut send = |tick: u64, values: PerJoint| {
        rig.input.action = Some(Action { tick, values });
        rig.step();
        assert_eq!(rig.output.state, State::Run);
        rig.output.action_refused
    };
    assert_eq!(send(current - 2, [1.0; 12]), Some(ActionRefused::OldTick { tick: current - 2, current }));
    assert_eq!(send(current + 1, [1.0; 12]), Some(ActionRefused::FutureTick { tick: current + 1, current }));
    assert!(matches!(send(current, nan), Some(ActionRefused::NotFinite { joint, .. }) if joint.name() == "FR_hip"));
    assert_eq!(send(current, [0.1; 12]), None);
    assert_eq!(send(current, [1.0; 12]), Some(ActionRefused::Repeated { tick: current }));
    assert_eq!(rig.command(), before, "none of them was executed");
}

#[test]
fn action_is_refused_unless_the_robot_stands_and_a_client_has_it() {
    for state in [State::Disconnected, State::Observe, State::Damp, State::StandUp, State::Sit, State::Fault] {
        let mut rig = Rig::in_state(state);
        rig.act([1.0; NUM_JOINTS]);
        assert_eq!(rig.output.action_refused, Some(ActionRefused::NotReady { state }));
        assert_eq!((rig.output.state, rig.output.applied), (state, None));
    }
    let mut rig = Rig::in_state(State::Ready);
    rig.input.client = Client::Absent;
    rig.act([1.0; NUM_JOINTS]);
    assert_eq!((rig.output.action_refused, rig.output.state), (Some(ActionRefused::NoClient), State::Ready));
}

#[test]
fn missing_actions_hold_the_last_target_then_the_pose_then_sit() {
    let mut rig = Rig::in_state(State::Ready);
    rig.walk(0.5);
    while rig.next_tick() == rig.output.tick {
        rig.step();
    }
    rig.act([0.1; NUM_JOINTS]);
    let (target, tick) = (rig.command(), rig.output.tick);
    let mut seen = Vec::new();
    while rig.output.state != State::Sit {
        rig.step();
        seen.push((rig.output.tick - tick, rig.output.state));
        if rig.output.state == State::Run {
            assert_eq!(rig.command(), target);
        } else if rig.output.state == State::Hold {
            assert_eq!(rig.command().q, target.q);
        }
        assert!(rig.output.tick < tick + 20);
    }
    seen.dedup();
    // The first tick has its action, so n missed ones are over when tick n + 1 begins.
    let expected = (0..=3).map(|tick| (tick, State::Run)).chain((4..=10).map(|tick| (tick, State::Hold)));
    let expected: Vec<_> = expected.chain([(11, State::Sit)]).collect();
    assert_eq!(seen, expected);
    assert_eq!(rig.output.fault, Some(Fault::ActionLate { missed: 10 }));
    let seconds = rig.time_to(State::Fault);
    assert!((1.9..2.1).contains(&seconds), "{seconds}");
}

#[test]
fn held_robot_stiffens_and_runs_again_with_the_next_action() {
    let mut rig = Rig::in_state(State::Hold);
    assert_eq!(rig.output.missed_ticks, 4);
    let kp = rig.command().kp[1];
    rig.step();
    assert!(rig.command().kp[1] > kp && kp > 30.0 && kp < 80.0);
    rig.act([0.0; NUM_JOINTS]);
    assert_eq!((rig.output.state, rig.output.missed_ticks), (State::Run, 0));
}

#[test]
fn robot_goes_back_to_the_standing_pose_when_the_client_ends_its_episode() {
    for state in [State::Run, State::Hold] {
        let mut rig = Rig::in_state(state);
        rig.input.client = Client::EndsEpisode;
        rig.step();
        assert_eq!((rig.output.state, rig.output.applied), (State::StandUp, None));
        rig.input.client = Client::Connected;
        assert!((1.9..2.1).contains(&rig.time_to(State::Ready)));
        assert_eq!(rig.output.fault, None);
    }
    for state in State::ALL.into_iter().filter(|state| !matches!(state, State::Run | State::Hold)) {
        let mut rig = Rig::in_state(state);
        rig.input.client = Client::EndsEpisode;
        rig.step();
        assert_eq!(rig.output.state, state, "a reset moves no robot");
    }
}

#[test]
fn requests_are_executed_only_in_their_states() {
    use OperatorRequest::{Arm, Damp, Disarm, Sit, Stand};
    for state in State::ALL {
        for request in [Arm, Stand, Sit, Damp, Disarm] {
            let mut rig = Rig::in_state(state);
            rig.request(request);
            let expected = match (request, state) {
                (Arm, State::Observe | State::Fault)
                | (Damp, State::StandUp | State::Ready | State::Run | State::Hold | State::Sit) => State::Damp,
                (Stand, State::Damp) => State::StandUp,
                (Sit, State::StandUp | State::Ready | State::Run | State::Hold) => State::Sit,
                (Disarm, State::Damp | State::Fault) => State::Observe,
                _ => state,
            };
            assert_eq!(rig.output.state, expected, "{request:?} in {state}");
            assert_eq!(rig.output.request_refused.is_some(), expected == state, "{request:?} in {state}");
        }
    }
}

#[test]
fn damping_is_sent_before_a_robot_with_a_fault_is_disarmed_or_armed() {
    for request in [OperatorRequest::Disarm, OperatorRequest::Arm] {
        let mut rig = Rig::in_state(State::Run);
        rig.reading.tilt = 1.1;
        rig.request(request);
        assert_eq!(rig.output.state, State::Fault, "{request:?}");
        assert!(matches!(rig.output.request_refused, Some(RequestRefused::Fault(Fault::Tilt { .. }))), "{request:?}");
        assert_eq!(rig.command().kp, [0.0; 12]);
        rig.run(0.1);
        rig.request(request);
        assert_eq!(rig.output.request_refused, None);
    }
}

#[test]
fn robot_that_sat_down_is_damped_before_it_is_disarmed() {
    let mut rig = Rig::in_state(State::Sit);
    rig.time_to(State::Damp);
    assert_eq!(rig.output.fault, None);
    rig.request(OperatorRequest::Disarm);
    // The message with the damping may be lost.
    assert_eq!(rig.output.request_refused, Some(RequestRefused::BarelyDamped));
    rig.run(0.1);
    rig.request(OperatorRequest::Disarm);
    assert_eq!(rig.output.command, None);
}

#[test]
fn pause_of_the_loop_is_not_a_jump() {
    let mut rig = Rig::in_state(State::StandUp);
    let before = rig.command().q;
    rig.input.now += Duration::from_millis(45);
    rig.step();
    assert_eq!(rig.output.state, State::StandUp);
    let moved = rig.command().q.iter().zip(before).map(|(q, before)| (q - before).abs()).fold(0.0, f32::max);
    assert!(moved < 0.03, "{moved}");
}

#[test]
fn robot_whose_gains_are_outside_the_limits_is_rejected() {
    let mut robot = go2();
    robot.control.kp[4] = 200.0;
    let error = SafetyMachine::new(&robot, SafetyConfig::default()).expect_err("too stiff").to_string();
    assert!(error.contains("`kp` of FR_thigh is 200"), "{error}");
}
