//! A worker process: reads inputs one after another, each within its limit of memory.

use std::alloc::System;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Barrier, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use cap::Cap;
use serde::{Deserialize, Serialize};

use super::format::{Format, Outcome};
use super::input::Corpus;

/// Time after which the process ends because one input is still being read.
const HANG: Duration = Duration::from_secs(30);

/// Inputs that a worker reads.
#[derive(Clone, Copy, Debug)]
pub struct Batch {
    /// Their format.
    pub format: Format,
    /// Seed of the inputs.
    pub seed: u64,
    /// Index of the first.
    pub first: u64,
    /// Number of inputs.
    pub count: u64,
}

/// Result of a batch.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct BatchResult {
    /// Number of inputs read.
    pub inputs: u64,
    /// Number of inputs that are of the format.
    pub decoded: u64,
    /// Number of inputs that were accepted.
    pub accepted: u64,
    /// Largest memory for one input [bytes].
    pub memory: usize,
    /// Index and reason of each input that caused a panic.
    pub panics: Vec<(u64, String)>,
}

/// Reads a batch with `folder` for temporary files. Calls `before` with the index of each input before it is read.
///
/// Runs on a thread with a stack of 2 MiB, as the threads of the server.
pub fn run(allocator: &'static Cap<System>, batch: Batch, folder: &Path, before: impl Fn(u64) + Sync) -> BatchResult {
    let current = AtomicU64::new(batch.first);
    let (is_done, done) = channel();
    // The allocator's maximum is wrong if another thread allocates while the limit changes.
    let all_started = Barrier::new(2);
    std::thread::scope(|scope| {
        scope.spawn(|| exit_if_stuck(&current, done));
        let reader = scope.spawn(|| {
            all_started.wait();
            read_all(allocator, batch, folder, &current, &before)
        });
        all_started.wait();
        let result = reader.join().expect("panics of decoders are caught");
        drop(is_done);
        result
    })
}

fn read_all(
    allocator: &'static Cap<System>,
    batch: Batch,
    folder: &Path,
    current: &AtomicU64,
    before: &impl Fn(u64),
) -> BatchResult {
    let corpus = Corpus::new(batch.format);
    // Tables that are built at the first use do not count.
    for example in batch.format.examples() {
        batch.format.read(&example, folder);
    }
    let mut result = BatchResult::default();
    for index in batch.first..batch.first + batch.count {
        current.store(index, Ordering::Relaxed);
        before(index);
        let input = corpus.input(batch.seed, index);
        let (outcome, memory) = read_within_limit(allocator, batch.format, &input, folder);
        result.inputs += 1;
        result.memory = result.memory.max(memory);
        match outcome {
            Ok(Outcome::Refused) => {}
            Ok(Outcome::Decoded) => result.decoded += 1,
            Ok(Outcome::Accepted) => {
                result.decoded += 1;
                result.accepted += 1;
            }
            Err(reason) => result.panics.push((index, reason)),
        }
    }
    result
}

/// Reads an input. Returns its outcome or the text of a panic, and the memory that it needed [bytes].
///
/// An allocation beyond the limit fails, which ends the process.
pub fn read_within_limit(
    allocator: &'static Cap<System>,
    format: Format,
    input: &[u8],
    folder: &Path,
) -> (Result<Outcome, String>, usize) {
    let before = allocator.allocated();
    let limit = before + format.memory_limit().of(input.len());
    allocator.set_limit(limit).expect("the limit is above what is allocated");
    let outcome = catch_unwind(AssertUnwindSafe(|| format.read(input, folder)));
    allocator.set_limit(usize::MAX).expect("the limit is raised");
    // The maximum is that since the start of the process: exact for the input that needed most.
    let memory = allocator.max_allocated().saturating_sub(before);
    (outcome.map_err(|_| std::mem::take(&mut *lock_last_panic())), memory)
}

/// Message and place of the last panic of this process.
static LAST_PANIC: Mutex<String> = Mutex::new(String::new());

fn lock_last_panic() -> MutexGuard<'static, String> {
    LAST_PANIC.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Stores the messages of panics instead of printing them.
pub fn store_panics() {
    std::panic::set_hook(Box::new(|panic| *lock_last_panic() = panic.to_string().replace('\n', " ")));
}

/// Ends the process if an input is read for longer than [`HANG`].
fn exit_if_stuck(current: &AtomicU64, done: Receiver<()>) {
    let mut last = u64::MAX;
    while let Err(RecvTimeoutError::Timeout) = done.recv_timeout(HANG) {
        let index = current.load(Ordering::Relaxed);
        if index == last {
            eprintln!("input {index} is still being read after {} s", HANG.as_secs());
            std::process::exit(3);
        }
        last = index;
    }
}
