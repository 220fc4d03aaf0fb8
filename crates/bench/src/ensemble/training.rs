//! Speed of training compared with PyTorch.

use std::f64::consts::TAU;
use std::path::Path;
use std::time::{Duration, Instant};

use twinstep_ensemble::{DataSet, Training, TrainingEvent, TrainingOptions};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES};

use super::torch::{Learning, Setup, Torch, training};
use super::{HIDDEN, MEMBERS};
use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::throughput::{WINDOWS, median_of};

/// Number of rows of the log at 200 Hz: ten minutes, so that batches are full and a window ends within an epoch.
const ROWS: usize = 120_000;
/// Sequences per batch and rows per sequence, as in [`Training`].
const LEARNING: (usize, usize) = (256, 64);

/// Measures member-sequences/s on one thread and on all, of Twinstep and PyTorch alternately.
pub fn measure(python: &Path, window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let data = DataSet::new(&[("swinging joints".to_owned(), log()?)]).map_err(failed)?;
    let options = TrainingOptions { members: MEMBERS, hidden: HIDDEN, ..TrainingOptions::default() };
    let ours = Training::new(&data, options).map_err(failed)?;
    let mut threads = vec![1, std::thread::available_parallelism().map_or(1, usize::from)];
    threads.dedup();
    let (batch, rows) = LEARNING;
    let learning = Learning { batch, rows, threads: &threads };
    let mut torch = Torch::start(python, &Setup { hidden: HIDDEN, members: &[], robots: &[], learning, window_s });
    let mut rates = vec![[Vec::new(), Vec::new()]; threads.len()];
    for _ in 0..WINDOWS {
        for (threads, [own, torches]) in threads.iter().zip(&mut rates) {
            check(interrupted)?;
            own.push(window(&ours, *threads, window_s)?);
            if torch.has(&training(*threads)) {
                torches.push(batch as f64 / (1e-6 * torch.window(&training(*threads))?));
            }
        }
    }
    Ok(threads.iter().zip(rates).flat_map(|(threads, rates)| rows_of(*threads, rates)).collect())
}

/// Returns the member-sequences per second of a training, counted from its first batch.
fn window(training: &Training, threads: usize, window_s: f64) -> Result<f64, BenchError> {
    let window = Duration::from_secs_f64(window_s);
    let (mut since, mut sequences, mut rate) = (None::<Instant>, 0, 0.0);
    let ended = training.run(threads, None, &mut |progress| {
        let TrainingEvent::Sequences(count) = progress else { return true };
        let Some(since) = since else {
            // The time until here was spent on creating the networks.
            since = Some(Instant::now());
            return true;
        };
        sequences += count;
        let passed = since.elapsed();
        rate = sequences as f64 / passed.as_secs_f64();
        passed < window
    });
    ended.map_err(failed)?;
    Ok(rate)
}

fn rows_of(threads: usize, [own, torches]: [Vec<f64>; 2]) -> Vec<Measurement> {
    let case = format!("training, {MEMBERS} members, threads: {threads}");
    let own = median_of(own);
    let row = |case: String, value: f64, theirs: Option<f64>| Measurement {
        case,
        value,
        unit: "member-sequences/s",
        reference: theirs.map(|_| "PyTorch".to_owned()),
        ratio: theirs.map(|theirs| value / theirs),
    };
    if torches.is_empty() {
        return vec![row(case, own, None)];
    }
    let theirs = median_of(torches);
    vec![row(case.clone(), own, Some(theirs)), row(format!("{case}, PyTorch"), theirs, None)]
}

/// Returns a log of twelve swinging joints, with torques that are delayed by one row.
fn log() -> Result<Log, BenchError> {
    let time = |row: usize| row as f64 / 200.0;
    let mut columns = vec![("t".to_owned(), (0..ROWS).map(time).collect::<Vec<_>>())];
    for (joint, name) in JOINT_NAMES.iter().enumerate() {
        let angle = |row: usize| TAU * (0.5 + 0.1 * joint as f64) * time(row) + (7.3 * time(row)).sin();
        let torque = |row: usize| 2.0 * angle(row.saturating_sub(1)).sin() + 0.5 * angle(row.saturating_sub(1)).cos();
        columns.push((format!("q_{name}"), (0..ROWS).map(|row| -0.1 * angle(row).sin()).collect()));
        columns.push((format!("dq_{name}"), (0..ROWS).map(|row| -angle(row).cos()).collect()));
        columns.push((format!("q_cmd_{name}"), vec![0.0; ROWS]));
        columns.push((format!("tau_measured_{name}"), (0..ROWS).map(torque).collect()));
    }
    let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
    let mut meta = Meta::new(200.0, TorqueSensor::MotorCurrent, segments);
    (meta.kp, meta.kd) = (Some(Gain::Uniform(20.0)), Some(Gain::Uniform(0.5)));
    Log::new(meta, columns).map_err(failed)
}
