//! Evaluates the choice of the next experiment: predicted against achieved discrimination of confounded effects.
//!
//! A robot with the first effect of a pair, simulated in the other engine, executes every safe excitation trajectory.
//! The log-likelihood ratio of each log is compared with the prediction.
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

/// Compare predicted and achieved discrimination of confounded effects by safe excitation trajectories.
#[derive(Parser)]
struct Args {
    /// Seed of the sensor noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn main() {
    let args = Args::parse();
    let rows: Vec<Row> = PAIRS.par_iter().map(|pair| row(pair, args.seed)).collect();
    println!("# Next experiment: predicted and achieved discrimination\n");
    println!("`cargo run --release -p twinstep-tests --bin next_experiment -- --seed {}`\n", args.seed);
    println!(
        "A robot in rapier at 4 kHz has the first effect and executes each of {} safe excitation trajectories (10 s, \
         noisy sensors). The models are simulated with the batch engine. Predicted: the expected log-likelihood ratio \
         of the true model to the alternative, with the alternative's size refitted. Achieved: the log-likelihood \
         ratio of the first to the second on the log, both fitted to it.\n",
        EXCITATION_TRAJECTORIES.len()
    );
    println!(
        "| first | second | chosen | predicted [nat] | achieved [nat] | achieved by the median trajectory | \
         best trajectory | achieved by the best | rank |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
    rows.iter().for_each(Row::print);
    let better = rows.iter().filter(|row| row.achieved > row.median).count();
    let first = rows.iter().filter(|row| row.rank == 1).count();
    println!(
        "\nThe chosen trajectory is better than the median one in {better} of {} pairs and is the best in {first}.",
        rows.len()
    );
}

/// Result of a pair.
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
    // Measured channels and noise are the same in every log.
    let like = logs.last().expect("there are trajectories");
    let ratios: Vec<[f64; 2]> = motions
        .par_iter()
        .zip(&logs)
        .map(|(motion, log)| {
            let config = SimConfig { threads: 1, ..SimConfig::default() };
            let mut simulator = BatchRollout::new(&go2(), &config).expect("a simulator");
            let predicted = hypotheses.expected_log_likelihood_ratio(motion, like, &mut simulator).unwrap_or(0.0);
            [predicted, hypotheses.log_likelihood_ratio(log.clone(), &mut simulator).expect("an experiment")]
        })
        .collect();
    let largest = |column: usize| {
        let order = |a: &usize, b: &usize| ratios[*a][column].total_cmp(&ratios[*b][column]);
        (0..ratios.len()).max_by(order).expect("there are trajectories")
    };
    let (chosen, best) = (largest(0), largest(1));
    let mut achieved: Vec<f64> = ratios.iter().map(|ratio| ratio[1]).collect();
    achieved.sort_by(f64::total_cmp);
    Row {
        names: hypotheses.names(),
        chosen: motions[chosen].name,
        predicted: ratios[chosen][0],
        achieved: ratios[chosen][1],
        median: achieved[achieved.len() / 2],
        best: motions[best].name,
        best_achieved: ratios[best][1],
        rank: 1 + achieved.iter().filter(|other| **other > ratios[chosen][1]).count(),
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
