//! Rollouts in the batch engine: a job is the same alone and among others, and goes on from a past.

use twinstep_effects::{EffectEntry, apply_effects};
use twinstep_model::{
    BaseMount, Command, HistoryStep, InitialState, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, go2,
};
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::ground_truth_robot::effect;

/// More than one register of either precision, and no whole number of them.
const JOBS: usize = 21;
/// The job whose command is no number, from the third actuator period on.
const BROKEN: usize = 5;

/// Every other robot has a delay, so that it remembers commands.
fn robot(index: usize) -> RobotModel {
    let (effect, scope) = effect("command_delay", "all");
    let delay = 0.002 * (index % 2) as f64;
    apply_effects(&go2(), &[EffectEntry::new(effect, scope, vec![delay]).unwrap()]).unwrap()
}

/// 3 to 60 actuator periods, no neighbours alike.
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
fn a_job_is_the_same_alone_and_among_others_of_other_lengths() {
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
        })
        .collect();
    let mut simulator = BatchRollout::new(&go2(), &SimConfig { threads: 2, ..SimConfig::default() }).unwrap();
    for precision in [Precision::Single, Precision::Double] {
        let together = simulator.run(&jobs, precision);
        for (index, states) in together.iter().enumerate() {
            let periods = commands[index].len();
            assert_eq!(states.q.len(), periods + 1);
            let diverged: Vec<_> = (0..=periods).map(|entry| states.first_not_finite(entry).is_some()).collect();
            if index == BROKEN {
                assert!(!diverged[2] && diverged[3..].iter().all(|diverged| *diverged), "{diverged:?}");
                continue;
            }
            let alone: RobotStates = simulator.run(&jobs[index..=index], precision).remove(0);
            assert_eq!(*states, alone, "job {index} in {precision:?}");
            assert!(diverged.iter().all(|diverged| !diverged));
        }
    }
}

#[test]
fn a_job_with_a_past_goes_on_as_if_it_had_never_ended() {
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
    let mut play = |start: InitialState, past: &[HistoryStep], commands: &[Command]| {
        let job = RolloutRequest { robot: &robot, base: BaseMount::Fixed, start, history: past, commands };
        simulator.run(&[job], Precision::Double).remove(0)
    };
    let whole = play(InitialState::at_rest(1.0, pose), &[], &commands);
    let now = 50;
    let start = InitialState { q: whole.q[now], dq: whole.dq[now], ..InitialState::at_rest(1.0, pose) };
    let past: Vec<_> = (now - 8..now)
        .map(|period| HistoryStep { command: commands[period], q: whole.q[period], dq: whole.dq[period] })
        .collect();
    let mut error = |past: &[HistoryStep]| {
        let states = play(start, past, &commands[now..]);
        let pairs = states.q.iter().flatten().zip(whole.q[now..].iter().flatten());
        pairs.map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
    };
    let [with, without] = [error(&past), error(&[])];
    assert!(with < 0.02 * without, "{with} rad with its past, {without} rad without");
}
