//! Are hidden bodies and motors found again? One robot after the other is drawn, simulated in another engine than the
//! model's at a finer step, and identified from its noisy log; whether the log can tell a number is decided before the fit.
//!
//! `cargo run --release -p twinstep-tests --bin recovery > results/recovery.md`

use clap::Parser;
use indicatif::ProgressBar;
use rayon::prelude::*;
use twinstep_effects::ModelFile;
use twinstep_identify::{Experiment, IdentifyOptions, ParameterEstimate, WindowConfig, identify};
use twinstep_model::go2;
use twinstep_sim::{BatchRollout, SimConfig};
use twinstep_tests::ground_truth_robot::{estimated_effects, ground_truth_robot, log_of, motion};

/// Find hidden bodies and motors again, and print the table.
#[derive(Parser)]
struct Args {
    /// Robots.
    #[arg(long, default_value_t = 30)]
    cases: u64,
    /// Number of the first; 1000 and up were never looked at in development.
    #[arg(long, default_value_t = 1000)]
    first: u64,
}

/// A number of one case.
struct Answer {
    quantity: &'static str,
    /// How far off it may be.
    goal: f64,
    error: f64,
    /// Predicted half-width of its interval, in the same unit.
    predicted: f64,
    covered: bool,
}

/// A row of the table: what it is called, of which unknowns, in which unit errors are, and the goal.
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
    let answers: Vec<Answer> = (args.first..args.first + args.cases)
        .into_par_iter()
        .flat_map_iter(|case| {
            let answers = recovered(case, &motion);
            bar.inc(1);
            answers
        })
        .collect();
    bar.finish_and_clear();
    println!("# Hidden bodies and motors, found again\n");
    println!(
        "`cargo run --release -p twinstep-tests --bin recovery -- --first {} --cases {}`\n",
        args.first, args.cases
    );
    println!("| | goal | the log can tell | within the goal | median error | 95 % interval holds the truth |");
    println!("|---|---|---|---|---|---|");
    for (name, _, _, unit, goal) in ROWS {
        let of: Vec<_> = answers.iter().filter(|answer| answer.quantity == name).collect();
        let told: Vec<_> = of.iter().filter(|answer| answer.predicted < answer.goal).collect();
        let within = told.iter().filter(|answer| answer.error.abs() < answer.goal).count();
        let share = if told.is_empty() { "-".to_owned() } else { format!("{} %", 100 * within / told.len()) };
        println!(
            "| {name} | {goal} {unit} | {} of {} | {share} | {:.2} {unit} | {} |",
            told.len(),
            of.len(),
            median(of.iter().map(|answer| answer.error.abs())),
            coverage(&of)
        );
    }
    println!("| all | | | | | {} |", coverage(&answers.iter().collect::<Vec<_>>()));
}

fn coverage(answers: &[&Answer]) -> String {
    let covered = answers.iter().filter(|answer| answer.covered).count();
    format!("{covered} of {} ({} %)", answers.len(), 100 * covered / answers.len())
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<_> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn recovered(case: u64, motion: &twinstep_logs::Log) -> Vec<Answer> {
    let hidden = ground_truth_robot(case);
    let log = log_of(&hidden, motion, case);
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
    let truths = hidden.effects.iter().flat_map(|entry| entry.values.iter().copied());
    found.findings.iter().zip(truths).filter_map(|(finding, truth)| answer(finding, truth)).collect()
}

fn answer(finding: &ParameterEstimate, truth: f64) -> Option<Answer> {
    let of = |row: &&(_, &str, &str, _, _)| {
        row.1 == finding.parameter.effect.name && row.2 == finding.parameter.parameter_name
    };
    let (quantity, _, _, unit, goal) = *ROWS.iter().find(of)?;
    let half = 0.5 * (finding.predicted_interval[1] - finding.predicted_interval[0]);
    let middle = 0.5 * (finding.predicted_interval[0] + finding.predicted_interval[1]);
    // Per unit of the unknown, at `value`.
    let scale = |value: f64| match (quantity, unit) {
        // mass = exp(2 α)
        ("base mass", _) => 200.0,
        ("rotor inertia", _) => 100.0 / (value + go2().joints[0].armature),
        (_, "%") => 100.0 / value,
        _ => 1000.0,
    };
    let interval = finding.interval.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
    Some(Answer {
        quantity,
        goal,
        error: (finding.value - truth) * scale(truth),
        predicted: half * scale(middle),
        covered: interval[0] <= truth && truth <= interval[1],
    })
}
