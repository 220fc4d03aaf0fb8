//! What is each part of the identification worth? SPI-Active's three motor models, gradient descent in place of the search,
//! and all that is sought here, on motion that none of them has seen.
//!
//! `cargo run --release -p twinstep-tests --bin ablation > results/ablation.md`

use clap::Parser;
use indicatif::ProgressBar;
use rayon::prelude::*;
use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, Scope};
use twinstep_identify::{
    Experiment, IdentifyOptions, WindowConfig, candidate, evaluate, free_parameters, identify, initial_coordinate,
    with_values,
};
use twinstep_logs::Log;
use twinstep_model::{JOINT_NAMES, Precision, RobotStates, Rollout, RolloutRequest, go2};
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::ground_truth_robot::{effect, estimated_effects, ground_truth_robot, log_of, motion};

/// Identify hidden robots with different models and searches, and judge them on other motion.
#[derive(Parser)]
struct Args {
    /// Robots.
    #[arg(long, default_value_t = 10)]
    cases: u64,
    /// Number of the first; 2000 and up were never looked at in development.
    #[arg(long, default_value_t = 2000)]
    first: u64,
}

/// Step of each unknown in a step of Adam, in prior deviations. Of 0.05 to 1.6, 0.2 and 0.4 did best with two robots that
/// are not in the table.
const DESCENT_RATE: f64 = 0.3;

const NAMES: [&str; 8] = [
    "ideal robot",
    "body and linear motor (one gain for all)",
    "body and one tanh for all",
    "body and tanh by joint type (SPI-Active)",
    "body and tanh by joint",
    "all that is sought, by CMA-ES and Levenberg-Marquardt",
    "all that is sought, by gradient descent (Adam) with as many rollouts",
    "all that is sought, by gradient descent with four times as many",
];

/// What became of a fit.
#[derive(Clone, Copy)]
struct Outcome {
    /// On the motion that was not fitted [rad].
    error: f64,
    /// Candidates that were played through the whole log.
    rollouts: f64,
}

fn main() {
    let args = Args::parse();
    let (seen, unseen) = (motion(0), motion(1));
    let bar = ProgressBar::new(args.cases * (NAMES.len() as u64 - 1));
    let cases: Vec<Vec<Outcome>> = (args.first..args.first + args.cases)
        .into_par_iter()
        .map(|case| {
            let hidden = ground_truth_robot(case);
            outcomes(&log_of(&hidden, &seen, case), &log_of(&hidden, &unseen, case + 1), &bar)
        })
        .collect();
    bar.finish_and_clear();
    println!("# What each part of the identification is worth\n");
    println!(
        "`cargo run --release -p twinstep-tests --bin ablation -- --first {} --cases {}`\n",
        args.first, args.cases
    );
    println!("Medians over {} hidden robots, lowest to highest in brackets.\n", args.cases);
    println!("| | closed-loop joint RMSE on other motion [rad] | of the ideal robot's | rollouts of the log |");
    println!("|---|---|---|---|");
    for (row, name) in NAMES.into_iter().enumerate() {
        let of = |pick: &dyn Fn(&[Outcome]) -> f64| sorted(cases.iter().map(|case| pick(case)));
        let errors = of(&|case| case[row].error);
        let shares = of(&|case| 100.0 * case[row].error / case[0].error);
        let rollouts = of(&|case| case[row].rollouts);
        println!(
            "| {name} | {:.4} [{:.4} to {:.4}] | {:.0} % | {:.0} |",
            median(&errors),
            errors[0],
            errors[errors.len() - 1],
            median(&shares),
            median(&rollouts)
        );
    }
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<_> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

fn median(sorted: &[f64]) -> f64 {
    f64::midpoint(sorted[sorted.len() / 2], sorted[(sorted.len() - 1) / 2])
}

/// A simulator that counts what it plays.
struct Counting {
    simulator: BatchRollout,
    /// Actuator periods.
    played: usize,
}

impl Rollout for Counting {
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        self.played += jobs.iter().map(|job| job.commands.len()).sum::<usize>();
        self.simulator.run(jobs, precision)
    }
}

/// What becomes of fits to `seen` on `unseen`, in the order of [`NAMES`].
fn outcomes(seen: &Log, unseen: &Log, bar: &ProgressBar) -> Vec<Outcome> {
    let experiment = Experiment::new(seen, &go2(), WindowConfig::IDENTIFICATION).expect("an experiment");
    let simulator = BatchRollout::new(&go2(), &SimConfig { threads: 1, ..SimConfig::default() }).expect("a simulator");
    let mut simulator = Counting { simulator, played: 0 };
    experiment.residuals(&mut simulator, &[go2()], Precision::Single);
    let once = simulator.played;
    let mut outcomes = Vec::new();
    let mut judge = |fit: &dyn Fn(&mut Counting) -> ModelFile| {
        simulator.played = 0;
        let robot = fit(&mut simulator).robot_model().expect("a robot");
        let played = simulator.played;
        let judged = evaluate(unseen, &robot, &mut simulator, |_| true).expect("an experiment");
        let error = judged.q_rmse_rad.expect("positions");
        outcomes.push(Outcome { error, rollouts: played as f64 / once as f64 });
        bar.inc(1);
        played
    };
    judge(&|_| ModelFile::default());
    let motors: [(&str, &[&str]); 4] = [
        ("torque_gain", &["all"]),
        ("torque_saturation", &["all"]),
        ("torque_saturation", &["hip", "thigh", "calf"]),
        ("torque_saturation", &JOINT_NAMES),
    ];
    for (name, scopes) in motors {
        let motor = scopes.iter().map(|scope| effect(name, scope));
        let effects: Vec<_> = std::iter::once(effect("inertia", "base")).chain(motor).collect();
        judge(&|simulator| fitted(&effects, &experiment, simulator));
    }
    let budget = judge(&|simulator| fitted(&estimated_effects(), &experiment, simulator));
    for times in [1, 4] {
        judge(&|simulator| descended(&estimated_effects(), &experiment, simulator, times * budget));
    }
    outcomes
}

fn fitted(effects: &[(&'static Effect, Scope)], experiment: &Experiment, simulator: &mut dyn Rollout) -> ModelFile {
    let options = IdentifyOptions { force: true, ..IdentifyOptions::default() };
    let experiments = std::slice::from_ref(experiment);
    let found = identify(&ModelFile::default(), effects, experiments, simulator, &options, &mut |_, _, _| true);
    found.expect("the ideal robot can be simulated").model
}

/// Adam on central differences of the sum of squares, from the ideal robot, until it has played as much as `budget`.
fn descended(
    effects: &[(&'static Effect, Scope)],
    experiment: &Experiment,
    simulator: &mut Counting,
    budget: usize,
) -> ModelFile {
    let (file, unknowns) = free_parameters(&ModelFile::default(), effects).expect("known effects");
    let mut point: Vec<f64> = unknowns.iter().map(|unknown| initial_coordinate(&file, unknown)).collect();
    let (mut mean, mut square) = (vec![0.0; point.len()], vec![0.0; point.len()]);
    let mut best = (f64::INFINITY, point.clone());
    let mut step = 0;
    while simulator.played < budget {
        step += 1;
        let mut points = vec![point.clone()];
        for (index, unknown) in unknowns.iter().enumerate() {
            for side in [-0.05, 0.05] {
                let mut moved = point.clone();
                moved[index] += side * unknown.prior[1];
                points.push(moved);
            }
        }
        let robots: Vec<_> = points.iter().filter_map(|point| candidate(&file, &unknowns, point)).collect();
        assert_eq!(robots.len(), points.len(), "every neighbour is a robot");
        let costs: Vec<f64> = experiment
            .residuals(simulator, &robots, Precision::Double)
            .iter()
            .map(|residuals| residuals.iter().map(|residual| residual * residual).sum())
            .collect();
        if costs[0] < best.0 {
            best = (costs[0], point.clone());
        }
        for (index, unknown) in unknowns.iter().enumerate() {
            let slope = (costs[2 * index + 2] - costs[2 * index + 1]) / 0.1;
            mean[index] = 0.9 * mean[index] + 0.1 * slope;
            square[index] = 0.999 * square[index] + 0.001 * slope * slope;
            let (mean, square): (f64, f64) =
                (mean[index] / (1.0 - 0.9f64.powi(step)), square[index] / (1.0 - 0.999f64.powi(step)));
            let [low, high] = unknown.coordinate_bounds();
            point[index] =
                (point[index] - DESCENT_RATE * unknown.prior[1] * mean / square.sqrt().max(1e-12)).clamp(low, high);
        }
    }
    with_values(&file, &unknowns, &best.1)
}
