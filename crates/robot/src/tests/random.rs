//! Ten thousand random sequences of everything that can happen.

use rand::RngExt;
use twinstep_model::{Stream, stream};
use twinstep_unitree::Button;

use super::*;
use crate::watchdog::Watchdog;

const SEQUENCES: u64 = 10_000;
/// Steps of each sequence: 2 s.
const STEPS: usize = 1000;

/// Changes one thing at random.
fn disturb(rig: &mut Rig, random: &mut Stream) {
    let joint = random.random_range(0..NUM_JOINTS);
    match random.random_range(0..19) {
        0 => rig.sends_states = !rig.sends_states,
        1 => rig.input.foreign_writers = random.random_range(0..3),
        2 => rig.input.controller_released = !rig.input.controller_released,
        3 => rig.input.stop_requested = !rig.input.stop_requested,
        4 => rig.input.client = [Client::Absent, Client::Connected, Client::EndsEpisode][random.random_range(0..3)],
        5 => rig.reading.tilt = random.random_range(0.0..3.1),
        6 => rig.reading.q[joint] = random.random_range(-5.0..5.0),
        7 => rig.reading.dq[joint] = random.random_range(-50.0..50.0),
        8 => rig.reading.tau[joint] = random.random_range(-60.0..60.0),
        9 => rig.reading.temperature[joint] = random.random_range(0..=255),
        10 => rig.reading.voltage = random.random_range(15.0..34.0),
        11 => rig.reading.lost_messages = rig.reading.lost_messages.wrapping_add(random.random_range(0..40)),
        12 => rig.reading.charge = random.random_range(0..=100),
        13 => {
            let stop = Remote::default().with_pressed(Button::L2).with_pressed(Button::B);
            rig.reading.remote = [None, Some(Remote::default()), Some(stop)][random.random_range(0..3)];
        }
        14 => rig.input.now += Duration::from_millis(random.random_range(0..100)),
        15 => rig.input.other_robot = !rig.input.other_robot,
        16 => rig.input.can_send = !rig.input.can_send,
        17 => {
            let states = [Watchdog::Missing, Watchdog::Idle, Watchdog::Guarding, Watchdog::TookOver];
            rig.input.watchdog = states[random.random_range(0..4)];
        }
        // All is well again.
        _ => {
            let healthy = Rig::new();
            rig.sends_states = true;
            rig.reading = Reading { q: rig.reading.q, lost_messages: rig.reading.lost_messages, ..healthy.reading };
            rig.input = Input { now: rig.input.now, ..healthy.input };
        }
    }
}

fn act(rig: &mut Rig, random: &mut Stream) {
    let tick = rig.next_tick().saturating_add_signed(random.random_range(-2..2));
    let mut values = [(); NUM_JOINTS].map(|()| random.random_range(-2.0..2.0));
    if random.random_bool(0.05) {
        values[random.random_range(0..NUM_JOINTS)] = [f32::NAN, f32::INFINITY, -1e30, 1e30][random.random_range(0..4)];
    }
    rig.input.action = Some(Action { tick, values });
}

fn request(random: &mut Stream) -> OperatorRequest {
    use OperatorRequest::{Arm, Damp, Disarm, Go, Sit, Stand};
    [Arm, Arm, Stand, Stand, Sit, Damp, Disarm, Go][random.random_range(0..8)]
}

/// Checks a step from `before`: commands are checked by [`Rig::step`].
fn check(before: &Output, after: &Output, request: Option<OperatorRequest>, watchdog: Watchdog) {
    let context = || format!("{} to {} with {request:?}: {before:?}", before.state, after.state);
    let done = request.filter(|_| after.request_refused.is_none());
    if before.state.is_armed() && !after.state.is_armed() {
        assert_eq!(done, Some(OperatorRequest::Disarm), "only the operator stops the commands: {}", context());
    }
    if !before.state.is_armed() && after.state.is_armed() {
        assert_eq!((done, after.state), (Some(OperatorRequest::Arm), State::Damp), "{}", context());
    }
    if before.fault.is_some() && before.fault != after.fault {
        assert_eq!(done, Some(OperatorRequest::Arm), "only the operator clears a fault: {}", context());
        assert_eq!(after.fault, None);
    }
    if before.state == State::Fault && after.state != State::Fault {
        assert!(matches!(done, Some(OperatorRequest::Arm | OperatorRequest::Disarm)), "{}", context());
    }
    if after.state.is_moving() {
        assert_eq!(watchdog, Watchdog::Guarding, "{}", context());
    }
    if before.state == State::Damp && after.state.is_moving() {
        assert_eq!((done, after.state), (Some(OperatorRequest::Stand), State::StandUp), "{}", context());
    }
    let runs = |state| matches!(state, State::Run | State::Hold);
    if runs(after.state) && !runs(before.state) {
        assert_eq!((before.state, after.state, after.missed_ticks), (State::Ready, State::Run, 0), "{}", context());
    }
    if after.fault.is_some() {
        assert!(!matches!(after.state, State::Damp | State::StandUp | State::Ready | State::Run | State::Hold));
    }
}

#[test]
fn no_sequence_of_events_makes_the_robot_unsafe() {
    let starts = State::ALL.map(Rig::in_state);
    let mut visits = [0_u64; State::ALL.len()];
    for sequence in 0..SEQUENCES {
        let mut random = stream(1, "robot::safety", sequence);
        let mut rig = starts[random.random_range(0..starts.len())].clone();
        // Some sequences are calm, so that they come far, and some are wild.
        let rates = [0.0, 0.001, 0.01, 0.1];
        let [disturbances, requests] = [(); 2].map(|()| rates[random.random_range(0..rates.len())]);
        let actions = [0.0, 0.05, 0.3][random.random_range(0..3)];
        for _ in 0..STEPS {
            if random.random_bool(disturbances) {
                disturb(&mut rig, &mut random);
            }
            if random.random_bool(requests) {
                rig.input.request = Some(request(&mut random));
            }
            if random.random_bool(actions) {
                act(&mut rig, &mut random);
            }
            let (before, asked) = (rig.output, rig.input.request);
            rig.step();
            check(&before, &rig.output, asked, rig.input.watchdog);
            visits[State::ALL.iter().position(|state| *state == rig.output.state).expect("a state")] += 1;
        }
    }
    let steps = SEQUENCES * STEPS as u64;
    for (state, visits) in State::ALL.iter().zip(visits) {
        assert!(visits > steps / 200, "the sequences are rarely in `{state}`: {visits} of {steps} steps");
    }
}
