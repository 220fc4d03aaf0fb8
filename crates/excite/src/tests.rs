//! Tests of the whole design, with the shipped policy in the batch engine.

use twinstep_effects::ModelFile;
use twinstep_envs::{TaskEnv, Walk};
use twinstep_identify::EffectAtScope;
use twinstep_identify::least_squares::Differences;
use twinstep_model::go2;
use twinstep_policy::Policy;
use twinstep_sim::{BatchBackend, BatchRollout, SimConfig};

use crate::{
    CommandRanges, CommandSequence, Criterion, Design, DesignError, DesignOptions, Limits, Motion, Trial, Unknowns,
    Violation, design, gait_env, simulate, walking_env,
};

const NO_LIMITS: Limits = Limits { room_m: 100.0, max_saturated: 1.0, max_rms_torque_nm: 100.0 };

fn policy() -> Policy {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/policies/walk.safetensors");
    Policy::read(path).expect("the shipped policy").0
}

fn env(robots: usize) -> TaskEnv<BatchBackend, Walk> {
    let backend = BatchBackend::new(go2(), SimConfig::default(), robots).expect("a backend");
    walking_env(backend, 1).expect("the default task")
}

fn trials(sequences: &[CommandSequence], seed: u64) -> Vec<Trial> {
    let mut env = env(sequences.len());
    simulate(&mut env, &policy(), sequences, seed).expect("runs")
}

fn unknowns(names: &[&str]) -> Unknowns {
    let effects: Vec<_> = names
        .iter()
        .map(|name| name.parse().expect("an effect of the catalogue"))
        .map(|EffectAtScope(effect, scope)| (effect, scope))
        .collect();
    Unknowns::new(&ModelFile::default(), &effects).expect("effects with a scope that they can have")
}

fn designed(limits: Limits, candidates: usize) -> Result<Design, DesignError> {
    let options = DesignOptions {
        segment_s: 1.0,
        segments: 2,
        ranges: CommandRanges { velocity: [[-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]], step_frequency: None },
        limits,
        criterion: Criterion::DOptimal,
        candidates,
        seed: 1,
    };
    let mut rollouts = BatchRollout::new(&go2(), &SimConfig::default()).expect("a simulator");
    let unknowns = unknowns(&["payload@base", "coulomb_friction@calf"]);
    let mut run = |sequences: &[CommandSequence]| Ok(trials(sequences, 1));
    design(&unknowns, &options, &mut run, &mut rollouts, &mut |_, _| true)
}

#[test]
fn design_tells_more_than_the_median_random_sequence_and_equal_seeds_give_equal_designs() {
    let (first, second) = (designed(NO_LIMITS, 96).expect("a design"), designed(NO_LIMITS, 96).expect("a design"));
    assert!(first.best.value > first.random.value + 0.5, "{} and {}", first.best.value, first.random.value);
    assert_eq!((first.simulated, first.rejected.len()), (96, 0));
    assert_eq!(first.best.sequence, second.best.sequence);
    assert!(first.best.std.iter().all(|std| *std > 0.0 && *std < 1.0), "{:?}", first.best.std);
}

#[test]
fn room_that_every_run_leaves_is_an_error_with_the_last_motion() {
    let error = designed(Limits { room_m: 0.001, ..NO_LIMITS }, 32).expect_err("no room").to_string();
    assert!(error.contains("none of 32 random sequences") && error.contains("m from the start"), "{error}");
}

#[test]
fn log_has_the_commands_in_force_and_rows_do_not_depend_on_other_robots() {
    let walking = CommandSequence::new(0.5, [[0.5, 0.0, 0.0], [0.0, 0.0, 0.8]]);
    let standing = CommandSequence::new(0.5, [[0.0; 3], [0.0; 3]]);
    let both = trials(&[walking.clone(), standing], 3);
    let alone = trials(std::slice::from_ref(&walking), 3);
    let logs: Vec<_> = both.iter().chain(&alone).map(|trial| trial.log.as_ref().expect("no fall")).collect();
    assert_eq!((logs[0].rows(), logs[0].meta().rate_hz), (50, 50.0));
    assert_eq!(logs[0], logs[2]);
    assert!(both[0].motion.farthest_m > 2.0 * both[1].motion.farthest_m, "{:?}", both[0].motion);
    assert!(both[0].motion.rms_torque_nm > 1.0 && both[0].motion.fell_at_s.is_none());
    // The robots have a common start, and the policy observes the first command at once.
    let cell = |log: usize, column: &str, row: usize| logs[log].channel(column).expect("a column")[row];
    assert!((cell(0, "q_FL_hip", 0) - cell(1, "q_FL_hip", 0)).abs() < 1e-9);
    assert!((cell(0, "q_cmd_FL_hip", 0) - cell(1, "q_cmd_FL_hip", 0)).abs() > 1e-3);
    // What the environments did before has no effect.
    let turning = CommandSequence::new(0.5, [[0.0, 0.3, -1.0]]);
    let mut used = env(1);
    let mut again =
        |sequence| simulate(&mut used, &policy(), std::slice::from_ref(sequence), 3).expect("a run").remove(0);
    again(&turning);
    assert_eq!(again(&walking).log.as_ref(), Some(logs[0]));
}

#[test]
fn gaits_of_a_sequence_are_walked() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/policies/gait.safetensors");
    let policy = Policy::read(path).expect("the shipped policy").0;
    let ranges = CommandRanges { velocity: [[-1.0, 1.0], [0.0, 0.0], [-1.0, 1.0]], step_frequency: Some([2.0, 4.0]) };
    // A trot and a pronk at 3 Hz, forward at 0.3 m/s.
    let sequences: Vec<_> =
        [-1.0, 1.0].map(|gait| CommandSequence::from_coordinates(3.0, &[0.3, 0.0, 0.0, 0.0, gait], &ranges)).to_vec();
    let backend = BatchBackend::new(go2(), SimConfig::default(), 2).expect("a backend");
    let mut env = gait_env(backend, 1).expect("the default task");
    let trials = simulate(&mut env, &policy, &sequences, 1).expect("runs");
    // Correlation of the calves of FL and FR after the first second: opposite in a trot, equal in a pronk.
    let correlations = trials.iter().map(|trial| {
        let log = trial.log.as_ref().expect("no fall");
        let [left, right] = ["q_FL_calf", "q_FR_calf"].map(|name| {
            let cells = &log.channel(name).expect("a column")[50..];
            let mean = cells.iter().sum::<f64>() / cells.len() as f64;
            cells.iter().map(|cell| cell - mean).collect::<Vec<_>>()
        });
        let product = |one: &[f64], other: &[f64]| one.iter().zip(other).map(|(one, other)| one * other).sum::<f64>();
        product(&left, &right) / (product(&left, &left) * product(&right, &right)).sqrt()
    });
    let [trot, pronk] = correlations.collect::<Vec<_>>().try_into().expect("two runs");
    assert!(trot < -0.3 && pronk > 0.7, "{trot} and {pronk}");
}

#[test]
fn walking_tells_more_of_viscous_friction_than_standing() {
    // Dry friction also shows at rest: it holds a joint away from its target.
    let commands = [[[0.8, 0.0, 0.0]; 2], [[0.0; 3]; 2]].map(|velocities| CommandSequence::new(1.0, velocities));
    let mut rollouts = BatchRollout::new(&go2(), &SimConfig::default()).expect("a simulator");
    let unknowns = unknowns(&["viscous_friction@calf"]);
    let information = trials(&commands, 1).into_iter().map(|trial| {
        let log = trial.log.expect("no fall");
        let information = unknowns
            .information(&log, Differences::Central, &mut rollouts)
            .expect("a log")
            .expect("a finite simulation");
        information[(0, 0)]
    });
    let [walking, standing] = information.collect::<Vec<_>>().try_into().expect("two logs");
    assert!(walking > 4.0 * standing && standing >= 1.0, "{walking} and {standing}");
}

#[test]
fn worst_violation_is_returned_and_a_fall_counts_before_all() {
    let limits = Limits { room_m: 2.0, max_saturated: 0.1, max_rms_torque_nm: 10.0 };
    let calm = Motion { fell_at_s: None, farthest_m: 1.0, saturated: 0.0, rms_torque_nm: 5.0 };
    assert_eq!(limits.violation(&calm, 10.0), None);
    let far = Motion { farthest_m: 3.0, rms_torque_nm: 11.0, ..calm };
    assert_eq!(limits.violation(&far, 10.0), Some(Violation::Room(0.5)));
    let fallen = Motion { fell_at_s: Some(4.0), ..far };
    assert_eq!(limits.violation(&fallen, 10.0), Some(Violation::Fall(0.6)));
}
