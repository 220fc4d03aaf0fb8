//! Time of a search for commands, and how well cheaper simulations rank command sequences.
//!
//! `cargo run --release -p twinstep-tests --bin excite_speed`

use std::time::Instant;

use clap::Parser;
use indicatif::ProgressBar;
use twinstep_effects::ModelFile;
use twinstep_envs::WalkConfig;
use twinstep_excite::{
    CommandRanges, CommandSequence, Criterion, DesignOptions, Limits, Unknowns, design, simulate, walking_env,
};
use twinstep_identify::least_squares::Differences;
use twinstep_identify::{CmaEs, EffectAtScope};
use twinstep_model::{go2, stream};
use twinstep_policy::Policy;
use twinstep_sim::{BatchBackend, BatchRollout, SimConfig};

/// Measure the time of `twinstep excite`, and the rank correlation of its values between rates of the physics.
#[derive(Parser)]
struct Args {
    /// Command sequences of each timed search.
    #[arg(long, default_value_t = 1000)]
    candidates: usize,
    /// Random command sequences that are ranked.
    #[arg(long, default_value_t = 96)]
    ranked: usize,
    /// Policy of the task `walk`.
    #[arg(long, default_value = "data/policies/walk.safetensors")]
    policy: String,
    /// Seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Effects with 12 parameters.
const UNKNOWNS: [&str; 9] = [
    "payload@base",
    "coulomb_friction@hip",
    "coulomb_friction@thigh",
    "coulomb_friction@calf",
    "armature@hip",
    "armature@thigh",
    "armature@calf",
    "torque_saturation@hip",
    "torque_saturation@thigh",
];
/// Number and duration of the commands of a sequence [s].
const SEGMENTS: usize = 5;
const SEGMENT_S: f64 = 5.0;
/// No run is rejected, so that the information of each is computed.
const NO_LIMITS: Limits = Limits { room_m: 1000.0, max_saturated: 1.0, max_rms_torque_nm: 1000.0 };
/// Rates of the physics [Hz]. The last one is that of the other commands, and the reference.
const RATES_HZ: [u32; 3] = [400, 600, 1000];

fn main() {
    let args = Args::parse();
    let (policy, _) = Policy::read(&args.policy).expect("a policy");
    println!("# Time of the design of an experiment\n");
    println!("`target/release/excite_speed --candidates {} --ranked {}`\n", args.candidates, args.ranked);
    println!(
        "Sequences of {SEGMENTS} commands of {SEGMENT_S} s, {} parameters, {} threads. No run is rejected. The load of the \
         machine before the start was {}.\n",
        unknowns().parameters().len(),
        std::thread::available_parallelism().map_or(0, usize::from),
        load(),
    );
    println!("| physics [Hz] | sequences | time [s] | processor time [s] |\n|---|---|---|---|");
    for physics_hz in RATES_HZ {
        let (seconds, processor_s) = timed(&args, &policy, physics_hz);
        println!("| {physics_hz} | {} | {seconds:.1} | {processor_s:.1} |", args.candidates);
    }
    println!(
        "\nSpearman's rank correlation of {} random sequences with central differences at 1000 Hz:\n",
        args.ranked
    );
    println!("| runs [Hz] | derivatives [Hz] | trace | d-optimal | sequences without a fall |\n|---|---|---|---|---|");
    let reference = values(&args, &policy, [1000; 2], args.seed, Differences::Central);
    let pairs = RATES_HZ.map(|rate_hz| [rate_hz; 2]).into_iter().chain([[1000, 400], [1000, 600]]);
    let mut rows: Vec<_> = pairs.map(|rates_hz| (rates_hz, args.seed, "")).collect();
    rows.push(([1000; 2], args.seed + 1, ", another start"));
    for (rates_hz, start, note) in rows {
        let found = values(&args, &policy, rates_hz, start, Differences::OneSided);
        let both: Vec<_> = reference.iter().zip(&found).filter_map(|(one, other)| (*one).zip(*other)).collect();
        let [trace, d_optimal] = [0, 1].map(|criterion| {
            rank_correlation(both.iter().map(|(one, other)| [one[criterion], other[criterion]]).collect())
        });
        let [runs_hz, derivatives_hz] = rates_hz;
        println!("| {runs_hz}{note} | {derivatives_hz} | {trace:.3} | {d_optimal:.3} | {} |", both.len());
    }
}

fn unknowns() -> Unknowns {
    let effects: Vec<_> = UNKNOWNS
        .iter()
        .map(|name| name.parse().expect("an effect of the catalogue"))
        .map(|EffectAtScope(effect, scope)| (effect, scope))
        .collect();
    Unknowns::new(&ModelFile::default(), &effects).expect("effects of the catalogue")
}

fn ranges() -> CommandRanges {
    let command = WalkConfig::default().command;
    let velocity = [command.linear_velocity_x, command.linear_velocity_y, command.angular_velocity_z];
    CommandRanges { velocity, step_frequency: None }
}

fn sim(physics_hz: u32) -> SimConfig {
    SimConfig { physics_hz: Some(physics_hz), ..SimConfig::default() }
}

/// Returns wall time and processor time of a search [s].
fn timed(args: &Args, policy: &Policy, physics_hz: u32) -> (f64, f64) {
    let options = DesignOptions {
        segment_s: SEGMENT_S,
        segments: SEGMENTS,
        ranges: ranges(),
        limits: NO_LIMITS,
        criterion: Criterion::DOptimal,
        candidates: args.candidates,
        seed: args.seed,
    };
    let population = CmaEs::new(&[0.0; 3 * SEGMENTS], 1.0).population();
    let backend = BatchBackend::new(go2(), sim(physics_hz), population).expect("a backend");
    let mut env = walking_env(backend, args.seed).expect("the default task");
    let mut rollouts = BatchRollout::new(&go2(), &sim(physics_hz)).expect("a simulator");
    let (start, processor_start) = (Instant::now(), processor_s());
    let bar = ProgressBar::new(args.candidates as u64);
    let found = design(
        &unknowns(),
        &options,
        &mut |sequences| simulate(&mut env, policy, sequences, args.seed),
        &mut rollouts,
        &mut |simulated, _| {
            bar.set_position(simulated as u64);
            true
        },
    );
    bar.finish_and_clear();
    // The last generation is simulated as a whole.
    let share = args.candidates as f64 / found.expect("no limits").simulated as f64;
    (share * start.elapsed().as_secs_f64(), share * (processor_s() - processor_start))
}

/// Returns trace and D-optimal value of each random sequence; `None` after a fall.
///
/// `rates_hz` are the physics of the runs and of the derivatives. `start` is the seed of the initial state.
fn values(
    args: &Args,
    policy: &Policy,
    [runs_hz, derivatives_hz]: [u32; 2],
    start: u64,
    differences: Differences,
) -> Vec<Option<[f64; 2]>> {
    let mut random = stream(args.seed, "excite_speed", 0);
    let draw = |_| CommandSequence::random(SEGMENT_S, SEGMENTS, &ranges(), &mut random);
    let sequences: Vec<_> = (0..args.ranked).map(draw).collect();
    let backend = BatchBackend::new(go2(), sim(runs_hz), sequences.len()).expect("a backend");
    let mut env = walking_env(backend, args.seed).expect("the default task");
    let mut rollouts = BatchRollout::new(&go2(), &sim(derivatives_hz)).expect("a simulator");
    let trials = simulate(&mut env, policy, &sequences, start).expect("runs");
    let unknowns = unknowns();
    let value = |trial: twinstep_excite::Trial| {
        let log = trial.log.filter(|_| trial.motion.fell_at_s.is_none())?;
        let information = unknowns.information(&log, differences, &mut rollouts).expect("a log")?;
        Some([Criterion::Trace, Criterion::DOptimal].map(|criterion| criterion.value(&information)))
    };
    trials.into_iter().map(value).collect()
}

/// Returns Spearman's rank correlation of the pairs.
fn rank_correlation(pairs: Vec<[f64; 2]>) -> f64 {
    let ranks = |side: usize| {
        let mut order: Vec<usize> = (0..pairs.len()).collect();
        order.sort_by(|one, other| pairs[*one][side].total_cmp(&pairs[*other][side]));
        let mut ranks = vec![0.0; pairs.len()];
        order.into_iter().enumerate().for_each(|(rank, index)| ranks[index] = rank as f64);
        ranks
    };
    let (one, other) = (ranks(0), ranks(1));
    let squares: f64 = one.iter().zip(&other).map(|(one, other)| (one - other) * (one - other)).sum();
    let count = pairs.len() as f64;
    1.0 - 6.0 * squares / (count * (count * count - 1.0))
}

/// Returns the processor time of this process, with threads that have ended [s]. Linux counts it in units of 10 ms.
fn processor_s() -> f64 {
    let text = std::fs::read_to_string("/proc/self/stat").expect("Linux");
    // The name in brackets may have spaces; user and system time are the 12th and 13th fields after it.
    let fields = text.rsplit_once(')').map_or("", |(_, fields)| fields).split_whitespace();
    fields.skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// Returns the mean number of running processes over the last minute.
fn load() -> String {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    text.split_whitespace().next().unwrap_or("unknown").to_owned()
}
