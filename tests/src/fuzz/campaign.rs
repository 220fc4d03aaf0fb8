//! A campaign: worker processes read the inputs of every format, and inputs that end one are found and saved.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use super::format::Format;
use super::input::Corpus;
use super::worker::{Batch, BatchResult};

/// Number of findings of one format after which its remaining inputs are not read.
const MAX_FINDINGS: usize = 20;
/// Number of batches of each format, at least.
const BATCHES: u64 = 40;
/// Number of inputs in a batch, at most.
const MAX_BATCH: u64 = 100_000;

/// Settings of a campaign.
#[derive(Clone, Debug)]
pub struct Plan {
    /// This program.
    pub program: PathBuf,
    /// Formats, with the number of inputs of each.
    pub formats: Vec<(Format, u64)>,
    /// Seed of the inputs.
    pub seed: u64,
    /// Number of worker processes at the same time.
    pub threads: usize,
    /// Folder of saved inputs.
    pub out: PathBuf,
}

/// An input that caused a panic, ended its process or needed too much memory.
#[derive(Clone, Debug)]
pub struct Finding {
    /// The saved input.
    pub file: PathBuf,
    /// Text of the panic, or the last line that the process wrote.
    pub reason: String,
}

/// Result of one format.
#[derive(Clone, Debug)]
pub struct FormatResult {
    /// The format.
    pub format: Format,
    /// Sum over all batches; `panics` are in `findings`.
    pub total: BatchResult,
    /// Time that all its workers ran, added up.
    pub time: Duration,
    /// What was found.
    pub findings: Vec<Finding>,
}

/// Runs a campaign. Calls `progress` with the format and number of inputs of each batch. Stops early once `stop` is
/// true.
pub fn run(plan: &Plan, stop: &AtomicBool, progress: impl Fn(Format, u64)) -> Result<Vec<FormatResult>, String> {
    std::fs::create_dir_all(&plan.out).map_err(|error| format!("cannot create {}: {error}", plan.out.display()))?;
    let batches = batches(plan);
    let next = AtomicUsize::new(0);
    let empty = |(format, _): &(Format, u64)| FormatResult {
        format: *format,
        total: BatchResult::default(),
        time: Duration::ZERO,
        findings: Vec::new(),
    };
    let mut results: Vec<FormatResult> = plan.formats.iter().map(empty).collect();
    std::thread::scope(|scope| {
        let (sender, receiver) = channel();
        for _ in 0..plan.threads {
            let (sender, next, batches) = (sender.clone(), &next, &batches);
            scope.spawn(move || {
                while let Some(batch) = batches.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let since = Instant::now();
                    let result = run_batch(plan, *batch, stop);
                    if stop.load(Ordering::Acquire) || sender.send((*batch, result, since.elapsed())).is_err() {
                        break;
                    }
                }
            });
        }
        drop(sender);
        for (batch, result, time) in receiver {
            let Some(sum) = results.iter_mut().find(|sum| sum.format == batch.format) else { continue };
            add(sum, plan, result?, time);
            if sum.findings.len() > MAX_FINDINGS {
                stop.store(true, Ordering::Release);
            }
            progress(batch.format, batch.count);
        }
        Ok(results)
    })
}

fn batches(plan: &Plan) -> Vec<Batch> {
    let of = |&(format, inputs): &(Format, u64)| {
        let size = (inputs / BATCHES).clamp(1, MAX_BATCH);
        let batch = move |first| Batch { format, seed: plan.seed, first, count: size.min(inputs - first) };
        (0..inputs).step_by(size as usize).map(batch)
    };
    plan.formats.iter().flat_map(of).collect()
}

fn add(sum: &mut FormatResult, plan: &Plan, result: BatchResult, time: Duration) {
    sum.time += time;
    add_counts(&mut sum.total, &result);
    for (index, reason) in result.panics {
        sum.findings.push(Finding { file: save(plan, sum.format, index), reason });
    }
}

/// Writes an input to the folder of findings.
fn save(plan: &Plan, format: Format, index: u64) -> PathBuf {
    let file = plan.out.join(format!("{}-{}-{index}.bin", format.name(), plan.seed));
    let input = Corpus::new(format).input(plan.seed, index);
    std::fs::write(&file, input).unwrap_or_else(|error| panic!("cannot write {}: {error}", file.display()));
    file
}

/// Runs a batch in a worker process. If an input ends the process, it is found by a second run and the others are read
/// without it.
fn run_batch(plan: &Plan, batch: Batch, stop: &AtomicBool) -> Result<BatchResult, String> {
    let mut sum = BatchResult::default();
    let mut rest = batch;
    while rest.count > 0 && sum.panics.len() <= MAX_FINDINGS && !stop.load(Ordering::Acquire) {
        if let Ok(result) = start_worker(plan, rest, false)? {
            add_counts(&mut sum, &result);
            sum.panics.extend(result.panics);
            break;
        }
        let (index, reason) = find_fatal_input(plan, rest)?;
        let before = Batch { count: index - rest.first, ..rest };
        if before.count > 0 {
            let result = start_worker(plan, before, false)?.map_err(|(_, reason)| reason)?;
            add_counts(&mut sum, &result);
            sum.panics.extend(result.panics);
        }
        sum.inputs += 1;
        sum.panics.push((index, reason));
        rest = Batch { first: index + 1, count: rest.first + rest.count - index - 1, ..rest };
    }
    Ok(sum)
}

fn add_counts(sum: &mut BatchResult, result: &BatchResult) {
    sum.inputs += result.inputs;
    sum.decoded += result.decoded;
    sum.accepted += result.accepted;
    sum.memory = sum.memory.max(result.memory);
}

/// Runs a batch again and returns the input that ends its process, with the reason.
fn find_fatal_input(plan: &Plan, batch: Batch) -> Result<(u64, String), String> {
    let name = batch.format.name();
    match start_worker(plan, batch, true)? {
        Err((Some(index), reason)) => Ok((index, reason)),
        Err((None, reason)) => Err(format!("{name}: {reason}")),
        Ok(_) => Err(format!("{name}: a worker ended, but not a second time: {batch:?}")),
    }
}

/// Result of a worker, or the last index that it printed and the reason of its end.
type WorkerResult = Result<BatchResult, (Option<u64>, String)>;

fn start_worker(plan: &Plan, batch: Batch, print_each: bool) -> Result<WorkerResult, String> {
    let folder = temporary_folder().map_err(|error| error.to_string())?;
    let mut command = Command::new(&plan.program);
    command.args(["worker", "--format", batch.format.name(), "--folder"]).arg(folder.path());
    for (flag, value) in [("--seed", batch.seed), ("--first", batch.first), ("--count", batch.count)] {
        command.args([flag, &value.to_string()]);
    }
    if print_each {
        command.arg("--each");
    }
    let output = command.output().map_err(|error| format!("{}: {error}", plan.program.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let last = text.lines().last().unwrap_or_default();
    if output.status.success() {
        return serde_json::from_str(last).map(Ok).map_err(|error| format!("a worker wrote `{last}`: {error}"));
    }
    let errors = String::from_utf8_lossy(&output.stderr);
    let reason = errors.lines().find(|line| !line.is_empty()).unwrap_or("no message");
    Ok(Err((last.parse().ok(), format!("{}: {reason}", output.status))))
}

/// Creates a temporary folder, in memory if the system has one there.
pub fn temporary_folder() -> std::io::Result<tempfile::TempDir> {
    let memory = Path::new("/dev/shm");
    if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }
}
