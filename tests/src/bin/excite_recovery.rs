//! Active identification on another engine: walking robots in MuJoCo with hidden parameters follow random and designed
//! velocity commands for equal times, and are identified from the logs.
//!
//! `cargo build --release --workspace && target/release/excite_recovery`. Needs Python with the
//! package's extra `mujoco`; `TWINSTEP_PYTHON` is its interpreter.

use std::time::Instant;

use clap::Parser;
use indicatif::ProgressBar;
use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_envs::{TaskEnv, Walk, WalkConfig};
use twinstep_excite::{
    CommandRanges, CommandSequence, Criterion, DesignOptions, Limits, Unknowns, design, simulate, walking_env,
};
use twinstep_identify::{CmaEs, Experiment, Identification, IdentifyOptions, WindowConfig, apply_sensors, identify};
use twinstep_logs::Log;
use twinstep_model::{RobotModel, Simulator, go2};
use twinstep_policy::Policy;
use twinstep_sim::{BatchBackend, BatchRollout, MujocoBackend, SimConfig};
use twinstep_tests::ground_truth_robot::{SENSORS, effect, ground_truth_robot};

/// Identify robots in MuJoCo from random and designed velocity commands, and print a table of the errors.
#[derive(Parser)]
struct Args {
    /// Number of robots.
    #[arg(long, default_value_t = 8)]
    cases: u64,
    /// Seed of the first robot.
    #[arg(long, default_value_t = 3000)]
    first: u64,
    /// Duration of a run [s].
    #[arg(long, default_value_t = 25.0)]
    seconds: f64,
    /// Number of candidate sequences of a design.
    #[arg(long, default_value_t = 320)]
    candidates: usize,
    /// Policy of the task `walk`.
    #[arg(long, default_value = "data/policies/walk.safetensors")]
    policy: String,
}

/// Commands that are compared.
const METHODS: [&str; 3] = ["random", "trace", "d-optimal"];
/// Duration of a command [s].
const SEGMENT_S: f64 = 5.0;

/// Errors of the estimates of one robot.
struct Errors {
    method: usize,
    /// Relative error of the trunk's mass.
    mass: f64,
    /// Distance of the trunk's centre of mass from the true one [m].
    com_m: f64,
    /// Largest error of the Coulomb friction of a joint type [N·m].
    friction_nm: f64,
}

fn main() {
    let args = Args::parse();
    let (policy, _) = Policy::read(&args.policy).expect("a policy");
    let mut rollouts = BatchRollout::new(&go2(), &SimConfig::default()).expect("a simulator");
    let since = Instant::now();
    let sequences: Vec<CommandSequence> =
        METHODS.iter().map(|method| sequence(method, &args, &policy, &mut rollouts)).collect();
    let design_s = since.elapsed().as_secs_f64();
    let bar = ProgressBar::new(args.cases * METHODS.len() as u64);
    let mut errors = Vec::new();
    let mut fell = 0;
    for case in args.first..args.first + args.cases {
        let truth = hidden_robot(case);
        for (method, sequence) in sequences.iter().enumerate() {
            match walk(&truth, &policy, sequence, case) {
                Some(log) => {
                    let found = compare(method, &identified(&log, &mut rollouts), &truth);
                    let (name, mass) = (METHODS[method], 100.0 * found.mass);
                    bar.suspend(|| {
                        eprintln!("robot {case}, {name}: mass {mass:.2} %, friction {:.3} N·m", found.friction_nm);
                    });
                    errors.push(found);
                }
                None => fell += 1,
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    print(&args, &errors, fell, design_s);
}

/// Returns the hidden robot with number `case`: its effects that MuJoCo simulates.
fn hidden_robot(case: u64) -> ModelFile {
    let mut model = ground_truth_robot(case);
    model.effects.retain(|entry| !["torque_saturation", "command_delay"].contains(&entry.effect.name));
    model
}

/// Returns the effects to estimate: those of the hidden robots, and the ground, which differs between the engines.
fn unknowns() -> Vec<(&'static Effect, Scope)> {
    let ground = [effect("ground_stiffness", "ground"), effect("ground_friction", "ground")];
    hidden_robot(0).effects.iter().map(|entry| (entry.effect, entry.scope)).chain(ground).collect()
}

/// Returns the commands of a method, designed for the nominal robot.
fn sequence(method: &str, args: &Args, policy: &Policy, rollouts: &mut BatchRollout) -> CommandSequence {
    let segments = (args.seconds / SEGMENT_S).round() as usize;
    let command = WalkConfig::default().command;
    let options = DesignOptions {
        segment_s: SEGMENT_S,
        segments,
        ranges: CommandRanges {
            velocity: [command.linear_velocity_x, command.linear_velocity_y, command.angular_velocity_z],
            step_frequency: None,
        },
        limits: Limits { room_m: 3.0, max_saturated: 0.05, max_rms_torque_nm: 15.0 },
        criterion: method.parse().unwrap_or(Criterion::DOptimal),
        candidates: if method == "random" { 0 } else { args.candidates },
        seed: 1,
    };
    let population = CmaEs::new(&vec![0.0; 3 * segments], 1.0).population();
    let backend = BatchBackend::new(go2(), SimConfig::default(), population).expect("a backend");
    let mut env = walking_env(backend, 1).expect("the default task");
    let unknowns = Unknowns::new(&ModelFile::default(), &unknowns()).expect("effects of the catalogue");
    let bar = ProgressBar::new(options.candidates as u64);
    let found = design(
        &unknowns,
        &options,
        &mut |sequences| simulate(&mut env, policy, sequences, 1),
        rollouts,
        &mut |simulated, _| {
            bar.set_position(simulated as u64);
            true
        },
    );
    bar.finish_and_clear();
    let found = found.expect("a sequence within the limits");
    if method == "random" { found.random.sequence } else { found.best.sequence }
}

/// Lets the hidden robot follow the commands in MuJoCo. Returns its log with sensor noise; `None` if it fell.
fn walk(truth: &ModelFile, policy: &Policy, sequence: &CommandSequence, case: u64) -> Option<Log> {
    let robot = truth.robot_model().expect("a valid robot");
    let backend = MujocoBackend::new(robot, SimConfig::default(), 1).expect("MuJoCo");
    let trial = run(&mut walking_env(backend, 1).expect("the default task"), policy, sequence, case);
    let log = trial.log.filter(|_| trial.motion.fell_at_s.is_none())?;
    Some(apply_sensors(&log, &SENSORS, case).expect("a valid log"))
}

fn run<B: Simulator>(
    env: &mut TaskEnv<B, Walk>,
    policy: &Policy,
    sequence: &CommandSequence,
    seed: u64,
) -> twinstep_excite::Trial {
    simulate(env, policy, std::slice::from_ref(sequence), seed).expect("a run").remove(0)
}

fn identified(log: &Log, rollouts: &mut BatchRollout) -> Identification {
    let experiment = Experiment::new(log, &go2(), WindowConfig::IDENTIFICATION).expect("an experiment");
    let options = IdentifyOptions::default();
    identify(&ModelFile::default(), &unknowns(), &[experiment], rollouts, &options, &mut |_, _, _| true)
        .expect("the ideal robot can be simulated")
}

fn compare(method: usize, found: &Identification, truth: &ModelFile) -> Errors {
    let robots = [&found.model, truth].map(|model| model.robot_model().expect("a valid robot"));
    let [found, truth] = robots.each_ref().map(|robot| robot.trunk);
    let friction = |robot: &RobotModel| [0, 1, 2].map(|joint| robot.joints[joint].coulomb_friction);
    let [found_friction, true_friction] = robots.each_ref().map(friction);
    let differences = found_friction.iter().zip(true_friction).map(|(found, truth)| (found - truth).abs());
    Errors {
        method,
        mass: (found.mass / truth.mass - 1.0).abs(),
        com_m: (found.com - truth.com).length(),
        friction_nm: differences.fold(0.0, f64::max),
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn print(args: &Args, errors: &[Errors], fell: usize, design_s: f64) {
    let Args { cases, first, seconds, candidates, .. } = args;
    println!("# Identification from random and designed velocity commands\n");
    println!(
        "{cases} robots in MuJoCo with hidden trunk (mass ±20 %, centre of mass ±4 cm, inertia), Coulomb friction and rotor \
         inertia follow the\nshipped `walk` policy for {seconds} s within 3 m of the start. The log has sensor noise and \
         motion capture. The commands are designed\nonce for the nominal robot in the batch engine, from {candidates} \
         sequences. The model is identified in the batch engine.\n"
    );
    println!("```sh\ntarget/release/excite_recovery --cases {cases} --first {first} --candidates {candidates}\n```\n");
    println!(
        "| commands | robots | mass, median error | largest | within 1 % | centre of mass | Coulomb friction, worst joint type |"
    );
    println!("|---|---|---|---|---|---|---|");
    for (method, name) in METHODS.iter().enumerate() {
        let of: Vec<&Errors> = errors.iter().filter(|errors| errors.method == method).collect();
        let largest = of.iter().map(|errors| errors.mass).fold(0.0, f64::max);
        println!(
            "| {name} | {} | {:.2} % | {:.2} % | {} | {:.1} mm | {:.3} N·m |",
            of.len(),
            100.0 * median(of.iter().map(|errors| errors.mass).collect()),
            100.0 * largest,
            of.iter().filter(|errors| errors.mass <= 0.01).count(),
            1000.0 * median(of.iter().map(|errors| errors.com_m).collect()),
            median(of.iter().map(|errors| errors.friction_nm).collect()),
        );
    }
    println!("\n{fell} runs ended with a fall and are not in the table. The designs took {design_s:.0} s.");
}
