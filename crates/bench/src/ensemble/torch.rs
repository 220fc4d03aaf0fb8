//! Baseline of the networks in PyTorch: a child process that measures one window at a time.

use std::path::Path;

use serde::Serialize;

use crate::baselines::{Baselines, Program};
use crate::error::BenchError;

/// Program of the child process; it needs only PyTorch.
const SCRIPT: &str = include_str!("torch_baseline.py");

/// Setup of the measurement.
#[derive(Serialize)]
pub struct Setup<'a> {
    /// Number of hidden units.
    pub hidden: usize,
    /// Numbers of members of a query.
    pub members: &'a [usize],
    /// Numbers of robots of a query.
    pub robots: &'a [usize],
    /// Trainings to measure.
    pub learning: Learning<'a>,
    /// Length of a window [s].
    pub window_s: f64,
}

/// Trainings of one network, one for each number of threads.
#[derive(Default, Serialize)]
pub struct Learning<'a> {
    /// Number of sequences of a batch.
    pub batch: usize,
    /// Number of rows of a sequence.
    pub rows: usize,
    /// Numbers of threads.
    pub threads: &'a [usize],
}

/// PyTorch, if it is installed.
pub struct Torch(Baselines);

/// Returns the name of a query in the child process.
pub fn name(members: usize, robots: usize) -> String {
    format!("{members} {robots}")
}

/// Returns the name of a training in the child process.
pub fn training(threads: usize) -> String {
    format!("training {threads}")
}

impl Torch {
    /// Starts the child process in the interpreter `python`. Without PyTorch it is skipped with a message on stderr.
    pub fn start(python: &Path, setup: &Setup) -> Self {
        let program =
            Program { arguments: &["-c", SCRIPT], name: "the networks in PyTorch", install: "pip install torch" };
        Self(Baselines::start_program(python, program, setup))
    }

    /// True if it has a query or a training of this name.
    pub fn has(&self, query: &str) -> bool {
        self.0.has(query)
    }

    /// Returns the median time of a query, or of a training step, in one window [µs].
    pub fn window(&mut self, query: &str) -> Result<f64, BenchError> {
        self.0.window(query)
    }
}
