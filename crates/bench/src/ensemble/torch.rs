//! The same networks in PyTorch: a child process that measures one window at a time.

use std::path::Path;

use serde::Serialize;

use crate::baselines::{Baselines, Program};
use crate::error::BenchError;

/// What the child runs; it needs nothing but PyTorch.
const SCRIPT: &str = include_str!("torch_baseline.py");

/// What is measured.
#[derive(Serialize)]
pub struct Setup<'a> {
    /// Units of an encoder.
    pub hidden: usize,
    /// Networks of a query.
    pub members: &'a [usize],
    /// Robots of a query.
    pub robots: &'a [usize],
    /// Trainings.
    pub learning: Learning<'a>,
    /// Length of a window [s].
    pub window_s: f64,
}

/// Trainings of one network, one for each number of threads.
#[derive(Default, Serialize)]
pub struct Learning<'a> {
    /// Sequences of a batch.
    pub batch: usize,
    /// Rows of a sequence.
    pub rows: usize,
    /// Threads.
    pub threads: &'a [usize],
}

/// PyTorch, if the interpreter has it.
pub struct Torch(Baselines);

/// What the child calls a query.
pub fn name(members: usize, robots: usize) -> String {
    format!("{members} {robots}")
}

/// What the child calls a training.
pub fn training(threads: usize) -> String {
    format!("training {threads}")
}

impl Torch {
    /// Asks the interpreter `python`; what it lacks is said on stderr, and left out.
    pub fn start(python: &Path, setup: &Setup) -> Self {
        let program =
            Program { arguments: &["-c", SCRIPT], name: "the networks in PyTorch", install: "pip install torch" };
        Self(Baselines::start_program(python, program, setup))
    }

    /// True if it has a query or a training of that name.
    pub fn has(&self, query: &str) -> bool {
        self.0.has(query)
    }

    /// Median time of a query, or of a training's step, in one window [µs].
    pub fn window(&mut self, query: &str) -> Result<f64, BenchError> {
        self.0.window(query)
    }
}
