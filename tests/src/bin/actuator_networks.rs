//! Evaluates actuator networks on simulated actuators: torque error, and epistemic uncertainty on unseen motion.
//!
//! `cargo run --release -p twinstep-tests --bin actuator_networks > results/actuator_networks.md`

use std::path::{Path, PathBuf};

use clap::Parser;
use indicatif::ProgressBar;
use twinstep_ensemble::{
    Calibration, DataSet, Ensemble, Gaussian, Sequence, Split, Training, TrainingEvent, TrainingOptions,
    TrainingResult, epistemic_uncertainty, jensen_renyi,
};
use twinstep_logs::Log;
use twinstep_tests::ground_truth_actuator::{DRIVES, HiddenDrive, Motion, NOISE_NM};

/// Train ensembles on simulated actuators and compare them with an ideal actuator, a linear filter and one network.
#[derive(Parser)]
struct Args {
    /// Length of the training logs [s].
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    /// Maximum number of passes over the data.
    #[arg(long, default_value_t = 60)]
    epochs: usize,
    /// Seed of the motions, the sensor noise and the networks.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write only the logs of three stages of increasing amplitude, for `twinstep fit --cross`.
    #[arg(long, value_name = "DIR")]
    stages: Option<PathBuf>,
}

/// Number of input rows of the linear filter. All models are evaluated on rows with at least so many before them.
const HISTORY: usize = 32;
/// Relative ridge term of the filter's normal equations. Without it, correlated inputs make them singular.
const RIDGE: f64 = 1e-6;
/// Rows of a control step, over which a reward averages the uncertainty.
const CONTROL_STEP: usize = 4;

fn main() {
    let args = Args::parse();
    if let Some(folder) = &args.stages {
        return write_stages(&args, folder);
    }
    let bar = ProgressBar::new_spinner();
    println!("# Actuator networks on simulated actuators\n");
    println!(
        "`cargo run --release -p twinstep-tests --bin actuator_networks -- --seconds {} --epochs {} --seed {}`\n",
        args.seconds, args.epochs, args.seed
    );
    println!("## Fit: held-out torque RMSE, in units of the sensor noise of {NOISE_NM} N·m\n");
    println!(
        "| actuator | ideal PD | linear filter over {HISTORY} rows | one network | ensemble of 6 | coverage of 90 % intervals |"
    );
    println!("|---|---|---|---|---|---|");
    for actuator in &DRIVES {
        println!("{}", fit(actuator, &args, &bar));
    }
    println!("\n## Epistemic uncertainty: trained on gentle motion, evaluated on other gentle and on violent motion\n");
    println!(
        "| actuator | measure | AUROC, rows | AUROC, control steps | Spearman with the true error, rows | \
         Spearman, control steps | below zero |"
    );
    println!("|---|---|---|---|---|---|---|");
    for actuator in &DRIVES {
        print_uncertainty(actuator, &args, &bar);
    }
    bar.finish_and_clear();
}

/// Writes logs of the last actuator in three motions, each with a larger amplitude and frequency range.
fn write_stages(args: &Args, folder: &Path) {
    std::fs::create_dir_all(folder).expect("a folder");
    let actuator = &DRIVES[DRIVES.len() - 1];
    for (name, amplitude, most_hz) in [("init", 0.12, 2.0), ("exp-1", 0.25, 3.5), ("exp-2", 0.45, 6.0)] {
        let motion = Motion { seconds: args.seconds, amplitude, hz: [0.3, most_hz], seed: args.seed };
        actuator.logs(motion).measured.write(folder.join(format!("{name}.parquet"))).expect("written");
    }
}

/// Returns a motion that rarely reaches a limit.
fn gentle(args: &Args, seed: u64) -> Motion {
    Motion { seconds: args.seconds, amplitude: 0.12, hz: [0.3, 2.0], seed }
}

fn violent(args: &Args, seed: u64) -> Motion {
    Motion { seconds: args.seconds, amplitude: 0.45, hz: [1.5, 6.0], seed }
}

/// Returns a motion with a wide range of amplitudes and frequencies.
fn rich(args: &Args, seed: u64) -> Motion {
    Motion { seconds: args.seconds, amplitude: 0.3, hz: [0.5, 5.0], seed }
}

fn data(log: Log) -> DataSet {
    DataSet::new(&[("simulated".to_owned(), log)]).expect("a data set")
}

fn trained(data: &DataSet, args: &Args, bar: &ProgressBar) -> Ensemble {
    let options = TrainingOptions { epochs: args.epochs, seed: args.seed, ..TrainingOptions::default() };
    let training = Training::new(data, options).expect("settings in range");
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let ended = training.run(threads, None, &mut |progress| {
        if let TrainingEvent::Epoch { member, curve, .. } = progress {
            bar.set_message(format!("member {}, epoch {}", member + 1, curve.len()));
            bar.tick();
        }
        true
    });
    match ended.expect("trained") {
        TrainingResult::Trained(ensemble, _) => *ensemble,
        TrainingResult::Interrupted(_) => unreachable!("the callback never interrupts"),
    }
}

/// Returns one line of the table of fits.
fn fit(actuator: &HiddenDrive, args: &Args, bar: &ProgressBar) -> String {
    let data = data(actuator.logs(rich(args, args.seed)).measured);
    let ensemble = trained(&data, args, bar);
    let filter = Filter::fitted(&data);
    let predicted = ensemble.predict(data.runs(Split::Test));
    let mut squares = [0.0; 4];
    let mut rows = 0.0;
    for (run, predicted) in data.runs(Split::Test).zip(&predicted) {
        let skipped = run.torques.len() - predicted.len();
        let [kp, kd] = data.gains[run.joint];
        for row in HISTORY..run.torques.len() {
            let [dq, ddq] = run.inputs[row];
            let members = &predicted[row - skipped];
            let predictions = [kp * dq + kd * ddq, filter.torque(run, row), members[0].mean, mean(members)];
            for (sum, prediction) in squares.iter_mut().zip(predictions) {
                *sum += (run.torques[row] - prediction).powi(2);
            }
            rows += 1.0;
        }
    }
    let errors = squares.map(|sum: f64| format!("{:.2}", (sum / rows).sqrt() / NOISE_NM)).join(" | ");
    let calibration = Calibration::of(&ensemble, &data);
    format!("| {} | {errors} | {:.1} % |", actuator.name, 100.0 * calibration.mixture[1].empirical[1])
}

fn mean(members: &[Gaussian]) -> f64 {
    members.iter().map(|member| member.mean).sum::<f64>() / members.len() as f64
}

/// Linear filter of the last rows of ξ, fitted to the training blocks by least squares.
struct Filter {
    weights: Vec<f64>,
}

impl Filter {
    const INPUTS: usize = 2 * HISTORY + 1;

    fn inputs(run: &Sequence, row: usize) -> Vec<f64> {
        let past = run.inputs[row + 1 - HISTORY..=row].iter().flatten().copied();
        past.chain([1.0]).collect()
    }

    fn fitted(data: &DataSet) -> Self {
        let mut matrix = vec![vec![0.0; Self::INPUTS]; Self::INPUTS];
        let mut right = vec![0.0; Self::INPUTS];
        for run in data.runs(Split::Training) {
            for row in HISTORY..run.torques.len() {
                let inputs = Self::inputs(run, row);
                for (one, line) in inputs.iter().zip(&mut matrix) {
                    line.iter_mut().zip(&inputs).for_each(|(cell, other)| *cell += one * other);
                }
                right.iter_mut().zip(&inputs).for_each(|(cell, input)| *cell += input * run.torques[row]);
            }
        }
        for (index, line) in matrix.iter_mut().enumerate() {
            line[index] *= 1.0 + RIDGE;
        }
        Self { weights: solve(matrix, right) }
    }

    fn torque(&self, run: &Sequence, row: usize) -> f64 {
        Self::inputs(run, row).iter().zip(&self.weights).map(|(input, weight)| input * weight).sum()
    }
}

/// Solves a linear system with a positive definite matrix by Gaussian elimination.
fn solve(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> Vec<f64> {
    let count = right.len();
    for pivot in 0..count {
        for row in pivot + 1..count {
            let factor = matrix[row][pivot] / matrix[pivot][pivot];
            let (above, below) = matrix.split_at_mut(row);
            below[0].iter_mut().zip(&above[pivot]).for_each(|(cell, other)| *cell -= factor * other);
            right[row] -= factor * right[pivot];
        }
    }
    for row in (0..count).rev() {
        let known: f64 = (row + 1..count).map(|column| matrix[row][column] * right[column]).sum();
        right[row] = (right[row] - known) / matrix[row][row];
    }
    right
}

/// Epistemic uncertainty and error without sensor noise of a row or a control step; `unseen` marks violent motion.
struct Evaluated {
    euf: f64,
    error: f64,
    unseen: bool,
}

/// Prints two lines of the table of uncertainty: U2E's measure and the corrected one.
fn print_uncertainty(actuator: &HiddenDrive, args: &Args, bar: &ProgressBar) {
    let training_data = data(actuator.logs(gentle(args, args.seed)).measured);
    let ensemble = trained(&training_data, args, bar);
    let motions = [(gentle(args, args.seed + 100), false), (violent(args, args.seed + 200), true)];
    let runs: Vec<(Sequence, Vec<Vec<Gaussian>>, bool)> = motions
        .into_iter()
        .flat_map(|(motion, unseen)| {
            let logs = actuator.logs(motion);
            let (measured, exact) = (data(logs.measured), data(logs.exact));
            let all = [Split::Training, Split::Validation, Split::Test];
            let runs_of = |set: &DataSet| all.iter().flat_map(|block| set.runs(*block)).cloned().collect::<Vec<_>>();
            let (noisy, exact) = (runs_of(&measured), runs_of(&exact));
            let predicted = ensemble.predict(noisy.iter());
            exact.into_iter().zip(predicted).map(move |(run, predicted)| (run, predicted, unseen))
        })
        .collect();
    for (name, euf) in [("U2E", jensen_renyi as fn(&[f64], &[f64]) -> f64), ("corrected", epistemic_uncertainty)] {
        let rows: Vec<Evaluated> =
            runs.iter().flat_map(|(run, predicted, unseen)| evaluated(run, predicted, *unseen, euf)).collect();
        let steps = control_steps(&runs, euf);
        let negative = rows.iter().filter(|row| row.euf < 0.0).count() as f64 / rows.len() as f64;
        println!(
            "| {} | {name} | {:.3} | {:.3} | {:.2} | {:.2} | {:.1} % |",
            actuator.name,
            auroc(&rows),
            auroc(&steps),
            spearman(&rows),
            spearman(&steps),
            100.0 * negative
        );
    }
}

fn evaluated(
    run: &Sequence,
    predicted: &[Vec<Gaussian>],
    unseen: bool,
    euf: fn(&[f64], &[f64]) -> f64,
) -> Vec<Evaluated> {
    let truth = &run.torques[run.torques.len() - predicted.len()..];
    let row = |(members, truth): (&Vec<Gaussian>, &f64)| {
        let (means, variances): (Vec<f64>, Vec<f64>) =
            members.iter().map(|member| (member.mean, member.variance)).unzip();
        Evaluated { euf: euf(&means, &variances), error: (mean(members) - truth).abs(), unseen }
    };
    predicted.iter().zip(truth).map(row).collect()
}

/// Returns means over the rows of each control step and the twelve joints, as in a reward (U2E §III-C).
///
/// `runs` contains, block by block, the runs of all twelve joints.
fn control_steps(runs: &[(Sequence, Vec<Vec<Gaussian>>, bool)], euf: fn(&[f64], &[f64]) -> f64) -> Vec<Evaluated> {
    let mut steps = Vec::new();
    for joints in runs.chunks(12) {
        let all: Vec<Vec<Evaluated>> =
            joints.iter().map(|(run, predicted, unseen)| evaluated(run, predicted, *unseen, euf)).collect();
        let length = all.iter().map(Vec::len).min().unwrap_or(0);
        for first in (0..length.saturating_sub(CONTROL_STEP - 1)).step_by(CONTROL_STEP) {
            let rows = || all.iter().flat_map(|rows| &rows[first..first + CONTROL_STEP]);
            let mean = |value: fn(&Evaluated) -> f64| rows().map(value).sum::<f64>() / (12 * CONTROL_STEP) as f64;
            steps.push(Evaluated { euf: mean(|row| row.euf), error: mean(|row| row.error), unseen: all[0][0].unseen });
        }
    }
    steps
}

/// Returns the ranks of `values`, from 1. Equal values have the mean of their ranks.
fn ranks(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let values: Vec<f64> = values.collect();
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|one, other| values[*one].total_cmp(&values[*other]));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    while first < order.len() {
        let equal = order[first..].iter().take_while(|index| values[**index] == values[order[first]]).count();
        for index in &order[first..first + equal] {
            ranks[*index] = first as f64 + 0.5 * (equal + 1) as f64;
        }
        first += equal;
    }
    ranks
}

/// Returns the area under the ROC curve: the probability that an unseen row has a higher uncertainty than a seen one.
fn auroc(rows: &[Evaluated]) -> f64 {
    let ranks = ranks(rows.iter().map(|row| row.euf));
    let unseen = rows.iter().filter(|row| row.unseen).count() as f64;
    let sum: f64 = ranks.iter().zip(rows).filter(|(_, row)| row.unseen).map(|(rank, _)| rank).sum();
    (sum - 0.5 * unseen * (unseen + 1.0)) / (unseen * (rows.len() as f64 - unseen))
}

/// Returns Spearman's rank correlation of uncertainty and error.
fn spearman(rows: &[Evaluated]) -> f64 {
    let (eufs, errors) = (ranks(rows.iter().map(|row| row.euf)), ranks(rows.iter().map(|row| row.error)));
    let middle = 0.5 * (rows.len() + 1) as f64;
    let product = |one: &[f64], other: &[f64]| -> f64 {
        one.iter().zip(other).map(|(one, other)| (one - middle) * (other - middle)).sum()
    };
    product(&eufs, &errors) / (product(&eufs, &eufs) * product(&errors, &errors)).sqrt()
}
