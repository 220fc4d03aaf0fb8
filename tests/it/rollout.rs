//! Rollouts in the batch engine: a request is independent of the others and can continue from a history.

use twinstep_effects::{EffectEntry, apply_effects};
use twinstep_model::{
    BaseMount, Command, HistoryStep, InitialState, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, go2,
};
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::ground_truth_robot::effect;

/// Number of requests: more than one SIMD register of either precision, and not a multiple of a register.
const JOBS: usize = 21;
/// Index of the request with NaN commands from the third actuator period on.
const BROKEN: usize = 5;

/// Returns robot `index`. Every second one has a command delay, and thus a state.
fn robot(index: usize) -> RobotModel {
    let (effect, scope) = effect("command_delay", "all");
    let delay = 0.002 * (index % 2) as f64;
    apply_effects(&go2(), &[EffectEntry::new(effect, scope, vec![delay]).unwrap()]).unwrap()
}

/// Returns the commands of request `index`, 3 to 60 actuator periods. Consecutive requests differ in length.
fn commands(index: usize) -> Vec<Command> {
    let pose = go2().control.default_pose_f32();
    let command = |period: usize| {
        let mut command = Command::hold(pose.map(|q| q + 0.2 * (0.1 * (period + index) as f32).sin()), 30.0, 0.75);
        if index == BROKEN && period >= 2 {
            command.tau_ff[4] = f32::NAN;
        }
        command
    };
    (0..3 + index * 34 % 58).map(command).collect()
}

#[test]
fn request_is_independent_of_other_requests_and_their_lengths() {
    let robots: Vec<_> = (0..JOBS).map(robot).collect();
    let commands: Vec<_> = (0..JOBS).map(commands).collect();
    let start = |index: usize| InitialState::at_rest(0.3 + 0.005 * index as f32, go2().control.default_pose_f32());
    let jobs: Vec<_> = (0..JOBS)
        .map(|index| RolloutRequest {
            robot: &robots[index],
            base: if index % 3 == 0 { BaseMount::Fixed } else { BaseMount::Floating },
            start: start(index),
            history: &[],
            commands: &commands[index],
            derating: &[],
        })
        .collect();
    let mut simulator = BatchRollout::new(&go2(), &SimConfig { threads: 2, ..SimConfig::default() }).unwrap();
    for precision in [Precision::Single, Precision::Double] {
        let together = simulator.run(&jobs, precision);
        for (index, states) in together.iter().enumerate() {
            let periods = commands[index].len();
            assert_eq!(states.measured.q.len(), periods + 1);
            let diverged: Vec<_> = (0..=periods).map(|entry| states.first_not_finite(entry).is_some()).collect();
            if index == BROKEN {
                assert!(!diverged[2] && diverged[3..].iter().all(|diverged| *diverged), "{diverged:?}");
                continue;
            }
            let alone: RobotStates = simulator.run(&jobs[index..=index], precision).remove(0);
            assert_eq!(*states, alone, "request {index}, {precision:?}");
            assert!(diverged.iter().all(|diverged| !diverged));
        }
    }
}

#[test]
fn request_with_a_history_continues_an_earlier_rollout() {
    let entries = [("torque_delay", 0.008), ("command_delay", 0.006), ("drive_lag", 0.005), ("encoder_offset", 0.02)]
        .map(|(name, value)| {
            let (effect, scope) = effect(name, "all");
            EffectEntry::new(effect, scope, vec![value]).unwrap()
        });
    let robot = apply_effects(&go2(), &entries).unwrap();
    let pose = go2().control.default_pose_f32();
    let command = |period: usize| Command::hold(pose.map(|q| q + 0.2 * (0.2 * period as f32).sin()), 30.0, 0.75);
    let commands: Vec<_> = (0..90).map(command).collect();
    let mut simulator = BatchRollout::new(&go2(), &SimConfig { threads: 1, ..SimConfig::default() }).unwrap();
    let mut simulate = |start: InitialState, history: &[HistoryStep], commands: &[Command]| {
        let job = RolloutRequest { robot: &robot, base: BaseMount::Fixed, start, history, commands, derating: &[] };
        simulator.run(&[job], Precision::Double).remove(0)
    };
    let whole = simulate(InitialState::at_rest(1.0, pose), &[], &commands);
    let now = 50;
    let start =
        InitialState { q: whole.measured.q[now], dq: whole.measured.dq[now], ..InitialState::at_rest(1.0, pose) };
    let history: Vec<_> = (now - 8..now)
        .map(|period| HistoryStep {
            command: commands[period],
            q: whole.measured.q[period],
            dq: whole.measured.dq[period],
        })
        .collect();
    let mut error = |history: &[HistoryStep]| {
        let states = simulate(start, history, &commands[now..]);
        let pairs = states.measured.q.iter().flatten().zip(whole.measured.q[now..].iter().flatten());
        pairs.map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
    };
    let [with, without] = [error(&history), error(&[])];
    assert!(with < 0.02 * without, "{with} rad with its history, {without} rad without");
}
