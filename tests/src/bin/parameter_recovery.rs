//! Parameter recovery: estimates the parameters of sampled robots from noisy logs and compares them with the true
//! values.
//!
//! The robots are simulated in another engine than the model and at a smaller step. Whether a parameter is identifiable
//! is decided before the fit.
//!
//! `cargo run --release -p twinstep-tests --bin parameter_recovery > results/parameter_recovery.md`

use clap::Parser;
use indicatif::ProgressBar;
use rayon::prelude::*;
use twinstep_effects::ModelFile;
use twinstep_identify::{Experiment, IdentifyOptions, ParameterEstimate, WindowConfig, identify};
use twinstep_model::go2;
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::ground_truth_robot::{estimated_effects, ground_truth_robot, log_of, motion};

/// Estimate the parameters of ground-truth robots and print a table of the errors.
#[derive(Parser)]
struct Args {
    /// Number of robots.
    #[arg(long, default_value_t = 30)]
    cases: u64,
    /// Seed of the first robot. Seeds from 1000 on were not used during development.
    #[arg(long, default_value_t = 1000)]
    first: u64,
}

/// One estimated parameter of one robot.
struct RecoveredValue {
    quantity: &'static str,
    /// Largest allowed error, in the unit of [`ROWS`].
    goal: f64,
    error: f64,
    /// Predicted half-width of the 95 % interval, in the same unit.
    predicted: f64,
    /// True if the 95 % interval covers the true value.
    covered: bool,
}

/// Rows of the table: name, effect, parameter, unit of errors, and goal.
const ROWS: [(&str, &str, &str, &str, f64); 8] = [
    ("base mass", "inertia", "theta.0", "%", 2.0),
    ("centre of mass, x", "inertia", "theta.7", "mm", 5.0),
    ("centre of mass, y", "inertia", "theta.8", "mm", 5.0),
    ("centre of mass, z", "inertia", "theta.9", "mm", 5.0),
    ("saturation κ", "torque_saturation", "kappa_nm", "%", 5.0),
    ("Coulomb friction", "coulomb_friction", "torque_nm", "%", 10.0),
    ("rotor inertia", "armature", "inertia_kgm2", "%", 10.0),
    ("delay", "command_delay", "delay_s", "ms", 0.5),
];

fn main() {
    let args = Args::parse();
    let bar = ProgressBar::new(args.cases);
    let motion = motion(0);
    let values: Vec<RecoveredValue> = (args.first..args.first + args.cases)
        .into_par_iter()
        .flat_map_iter(|case| {
            let values = recover(case, &motion);
            bar.inc(1);
            values
        })
        .collect();
    bar.finish_and_clear();
    println!("# Parameter recovery\n");
    println!(
        "`cargo run --release -p twinstep-tests --bin parameter_recovery -- --first {} --cases {}`\n",
        args.first, args.cases
    );
    println!(
        "| parameter | goal | identifiable | within the goal | median error | 95 % interval covers the true value |"
    );
    println!("|---|---|---|---|---|---|");
    for (name, _, _, unit, goal) in ROWS {
        let all: Vec<_> = values.iter().filter(|value| value.quantity == name).collect();
        let identifiable: Vec<_> = all.iter().filter(|value| value.predicted < value.goal).collect();
        let within = identifiable.iter().filter(|value| value.error.abs() < value.goal).count();
        let share = match identifiable.len() {
            0 => "-".to_owned(),
            count => format!("{} %", 100 * within / count),
        };
        println!(
            "| {name} | {goal} {unit} | {} of {} | {share} | {:.2} {unit} | {} |",
            identifiable.len(),
            all.len(),
            median(all.iter().map(|value| value.error.abs())),
            coverage(&all)
        );
    }
    println!("| all | | | | | {} |", coverage(&values.iter().collect::<Vec<_>>()));
}

fn coverage(values: &[&RecoveredValue]) -> String {
    let covered = values.iter().filter(|value| value.covered).count();
    format!("{covered} of {} ({} %)", values.len(), 100 * covered / values.len())
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<_> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Identifies robot `case` from its log of `motion`.
fn recover(case: u64, motion: &twinstep_logs::Log) -> Vec<RecoveredValue> {
    let robot = ground_truth_robot(case);
    let log = log_of(&robot, motion, case);
    let experiment = Experiment::new(&log, &go2(), WindowConfig::IDENTIFICATION).expect("an experiment");
    let mut simulator =
        BatchRollout::new(&go2(), &SimConfig { threads: 1, ..SimConfig::default() }).expect("a simulator");
    let found = identify(
        &ModelFile::default(),
        &estimated_effects(),
        &[experiment],
        &mut simulator,
        &IdentifyOptions::default(),
        &mut |_, _, _| true,
    )
    .expect("the ideal robot can be simulated");
    let truths = robot.effects.iter().flat_map(|entry| entry.values.iter().copied());
    found.findings.iter().zip(truths).filter_map(|(finding, truth)| recovered_value(finding, truth)).collect()
}

/// Compares an estimate with its true value. Returns `None` if the table has no row for the parameter.
fn recovered_value(finding: &ParameterEstimate, truth: f64) -> Option<RecoveredValue> {
    let is_its_row = |row: &&(_, &str, &str, _, _)| {
        row.1 == finding.parameter.effect.name && row.2 == finding.parameter.parameter_name
    };
    let (quantity, _, _, unit, goal) = *ROWS.iter().find(is_its_row)?;
    let half = 0.5 * (finding.predicted_interval[1] - finding.predicted_interval[0]);
    let middle = 0.5 * (finding.predicted_interval[0] + finding.predicted_interval[1]);
    // Factor from the parameter's unit to that of the table, linearised at `value`.
    let scale = |value: f64| match (quantity, unit) {
        // mass = exp(2 α)
        ("base mass", _) => 200.0,
        ("rotor inertia", _) => 100.0 / (value + go2().joints[0].armature),
        (_, "%") => 100.0 / value,
        _ => 1000.0,
    };
    let interval = finding.interval.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
    Some(RecoveredValue {
        quantity,
        goal,
        error: (finding.value - truth) * scale(truth),
        predicted: half * scale(middle),
        covered: interval[0] <= truth && truth <= interval[1],
    })
}
