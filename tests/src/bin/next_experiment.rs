//! Is the motion that diagnosis would choose next a good one? For pairs of effects that are taken for each other, a robot in
//! the other engine that has the first plays every safe motion, and what each log says is compared with what was predicted.
//!
//! `cargo run --release -p twinstep-tests --bin next_experiment > results/next_experiment.md`

use clap::Parser;
use rayon::prelude::*;
use twinstep_diagnose::{EXCITATION_TRAJECTORIES, ExcitationTrajectory};
use twinstep_logs::Log;
use twinstep_model::{BaseMount, go2};
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::confounded_pairs::{PAIRS, Pair};
use twinstep_tests::ground_truth_robot::log_of;

/// Predict what safe motions tell of pairs of effects, and measure it.
#[derive(Parser)]
struct Args {
    /// Seed of the sensors' noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn main() {
    let args = Args::parse();
    let rows: Vec<Row> = PAIRS.par_iter().map(|pair| row(pair, args.seed)).collect();
    println!("# The next experiment: predicted and achieved\n");
    println!("`cargo run --release -p twinstep-tests --bin next_experiment -- --seed {}`\n", args.seed);
    println!(
        "A robot in rapier at 4 kHz has the first effect and plays each of {} safe motions (10 s, noisy sensors); the \
         models are simulated by the batch engine. Predicted: the evidence expected for the true one of the two, the \
         other's size refitted. Achieved: the evidence of the log for the first, both fitted to it.\n",
        EXCITATION_TRAJECTORIES.len()
    );
    println!(
        "| first | second | chosen | predicted [nats] | achieved [nats] | median motion achieved | best motion | best achieved | rank |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    rows.iter().for_each(Row::print);
    let better = rows.iter().filter(|row| row.achieved > row.median).count();
    let first = rows.iter().filter(|row| row.rank == 1).count();
    println!(
        "\nThe chosen motion beats the median one in {better} of {} pairs and is the best in {first}.",
        rows.len()
    );
}

/// What became of a pair.
struct Row {
    names: [String; 2],
    chosen: &'static str,
    predicted: f64,
    achieved: f64,
    median: f64,
    best: &'static str,
    best_achieved: f64,
    rank: usize,
}

fn row(pair: &Pair, seed: u64) -> Row {
    let hypotheses = pair.hypothesis_pair();
    let motions: Vec<&ExcitationTrajectory> =
        EXCITATION_TRAJECTORIES.iter().filter(|motion| pair.on_ground || motion.base == BaseMount::Fixed).collect();
    let robot = pair.robot();
    let logs: Vec<Log> = motions.par_iter().map(|motion| log_of(&robot, &motion.motion(&go2()), seed)).collect();
    // What is measured, and how well: the same in every log.
    let like = logs.last().expect("there are motions");
    let told: Vec<[f64; 2]> = motions
        .par_iter()
        .zip(&logs)
        .map(|(motion, log)| {
            let config = SimConfig { threads: 1, ..SimConfig::default() };
            let mut simulator = BatchRollout::new(&go2(), &config).expect("a simulator");
            let predicted = hypotheses.expected_log_likelihood_ratio(motion, like, &mut simulator).unwrap_or(0.0);
            [predicted, hypotheses.log_likelihood_ratio(log.clone(), &mut simulator).expect("an experiment")]
        })
        .collect();
    let most =
        |of: usize| (0..told.len()).max_by(|a, b| told[*a][of].total_cmp(&told[*b][of])).expect("there are motions");
    let (chosen, best) = (most(0), most(1));
    let mut achieved: Vec<f64> = told.iter().map(|told| told[1]).collect();
    achieved.sort_by(f64::total_cmp);
    Row {
        names: hypotheses.names(),
        chosen: motions[chosen].name,
        predicted: told[chosen][0],
        achieved: told[chosen][1],
        median: achieved[achieved.len() / 2],
        best: motions[best].name,
        best_achieved: told[best][1],
        rank: 1 + achieved.iter().filter(|other| **other > told[chosen][1]).count(),
    }
}

impl Row {
    fn print(&self) {
        let Self { names: [one, other], chosen, predicted, achieved, median, best, best_achieved, rank } = self;
        println!(
            "| {one} | {other} | {chosen} | {predicted:.0} | {achieved:.0} | {median:.0} | {best} | {best_achieved:.0} | {rank} |"
        );
    }
}
