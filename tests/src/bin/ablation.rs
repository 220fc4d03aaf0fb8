//! What is each part of the identification worth? SPI-Active's three motor models, gradient descent in place of the search,
//! and all that is sought here, on motion that none of them has seen.
//!
//! `cargo run --release -p twinstep-tests --bin ablation > results/ablation.md`

use clap::Parser;
use indicatif::ProgressBar;
use rayon::prelude::*;
use twinstep_logs::Log;
use twinstep_model::effects::{Effect, Scope};
use twinstep_model::{JOINT_NAMES, ModelFile, Precision, Rollout, go2};
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_sysid::{Experiment, Horizon, Options, candidate, evaluate, identify, start, unknowns, with_values};
use twinstep_tests::hidden_robot::{effect, hidden_robot, log_of, motion, sought};

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

/// Steps of gradient descent: as many rollouts as the search and its refinement take together.
const DESCENT_STEPS: usize = 25;
/// Step of each unknown in a step of Adam, in prior deviations.
const DESCENT_RATE: f64 = 0.1;

fn main() {
    let args = Args::parse();
    let (seen, unseen) = (motion(0), motion(1));
    let bar = ProgressBar::new(args.cases * 6);
    let errors: Vec<Vec<f64>> = (args.first..args.first + args.cases)
        .into_par_iter()
        .map(|case| {
            let hidden = hidden_robot(case);
            errors(&log_of(&hidden, &seen, case), &log_of(&hidden, &unseen, case + 1), &bar)
        })
        .collect();
    bar.finish_and_clear();
    println!("# What each part of the identification is worth\n");
    println!(
        "`cargo run --release -p twinstep-tests --bin ablation -- --first {} --cases {}`\n",
        args.first, args.cases
    );
    println!("Median over {} hidden robots, on motion that was not fitted.\n", args.cases);
    println!("| | closed-loop joint RMSE [rad] | of the ideal robot's |");
    println!("|---|---|---|");
    let median = |column: usize| {
        let mut values: Vec<_> = errors.iter().map(|errors| errors[column]).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    for (column, name) in NAMES.into_iter().enumerate() {
        println!("| {name} | {:.4} | {:.0} % |", median(column), 100.0 * median(column) / median(0));
    }
}

const NAMES: [&str; 7] = [
    "ideal robot",
    "body and linear motor (one gain for all)",
    "body and one tanh for all",
    "body and tanh by joint type (SPI-Active)",
    "body and tanh by joint",
    "all that is sought, by gradient descent (Adam)",
    "all that is sought, by CMA-ES and Levenberg-Marquardt",
];

/// Errors on `unseen` of what is fitted to `seen`, in the order of [`NAMES`].
fn errors(seen: &Log, unseen: &Log, bar: &ProgressBar) -> Vec<f64> {
    let experiment = [Experiment::new(seen, &go2(), Horizon::IDENTIFICATION).expect("an experiment")];
    let mut simulator =
        BatchRollout::new(&go2(), &SimConfig { threads: 1, ..SimConfig::default() }).expect("a simulator");
    let ideal = ModelFile::default();
    let motor = |name: &str, scopes: &[&str]| {
        let body = vec![effect("inertia", "base")];
        body.into_iter().chain(scopes.iter().map(|scope| effect(name, scope))).collect::<Vec<_>>()
    };
    let variants = [
        motor("torque_gain", &["all"]),
        motor("torque_saturation", &["all"]),
        motor("torque_saturation", &["hip", "thigh", "calf"]),
        motor("torque_saturation", &JOINT_NAMES),
    ];
    let mut fits = vec![ideal.clone()];
    for effects in &variants {
        fits.push(fitted(effects, &experiment, &mut simulator));
        bar.inc(1);
    }
    fits.push(descended(&sought(), &experiment[0], &mut simulator));
    bar.inc(1);
    fits.push(fitted(&sought(), &experiment, &mut simulator));
    bar.inc(1);
    let error = |model: &ModelFile, simulator: &mut BatchRollout| {
        let robot = model.robot_model().expect("a robot");
        evaluate(unseen, &robot, simulator, |_| true).expect("an experiment").q_rmse_rad.expect("positions")
    };
    fits.iter().map(|fit| error(fit, &mut simulator)).collect()
}

fn fitted(effects: &[(&'static Effect, Scope)], experiments: &[Experiment], simulator: &mut dyn Rollout) -> ModelFile {
    let options = Options { force: true, ..Options::default() };
    let found = identify(&ModelFile::default(), effects, experiments, simulator, &options, &mut |_, _, _| true);
    found.expect("the ideal robot can be simulated").model
}

/// Adam on central differences of the same cost, from the ideal robot.
fn descended(effects: &[(&'static Effect, Scope)], experiment: &Experiment, simulator: &mut dyn Rollout) -> ModelFile {
    let (file, unknowns) = unknowns(&ModelFile::default(), effects).expect("known effects");
    let mut point: Vec<f64> = unknowns.iter().map(|unknown| start(&file, unknown)).collect();
    let (mut mean, mut square) = (vec![0.0; point.len()], vec![0.0; point.len()]);
    let mut best = (f64::INFINITY, point.clone());
    for step in 1..=DESCENT_STEPS {
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
                (mean[index] / (1.0 - 0.9f64.powi(step as i32)), square[index] / (1.0 - 0.999f64.powi(step as i32)));
            let [low, high] = unknown.coordinate_bounds();
            point[index] =
                (point[index] - DESCENT_RATE * unknown.prior[1] * mean / square.sqrt().max(1e-12)).clamp(low, high);
        }
    }
    with_values(&file, &unknowns, &best.1)
}
