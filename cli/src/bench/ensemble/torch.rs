//! The same networks in PyTorch: a child process that measures one window at a time.

use std::path::Path;

use serde::Serialize;

use crate::bench::peers::{Peers, Program};
use crate::exit::Failure;

/// What the child runs; it needs nothing but PyTorch.
const SCRIPT: &str = include_str!("torch_peer.py");

#[derive(Serialize)]
struct Setup<'a> {
    hidden: usize,
    members: &'a [usize],
    robots: &'a [usize],
    window_s: f64,
}

/// PyTorch, if the interpreter has it.
pub struct Torch(Peers);

/// What the child calls a query.
pub fn name(members: usize, robots: usize) -> String {
    format!("{members} {robots}")
}

impl Torch {
    /// Asks the interpreter `python`; what it lacks is said on stderr, and left out.
    pub fn start(python: &Path, hidden: usize, members: &[usize], robots: &[usize], window_s: f64) -> Self {
        let program =
            Program { arguments: &["-c", SCRIPT], name: "the networks in PyTorch", install: "pip install torch" };
        Self(Peers::start_program(python, program, &Setup { hidden, members, robots, window_s }))
    }

    /// True if it can answer a query of that name.
    pub fn has(&self, query: &str) -> bool {
        self.0.has(query)
    }

    /// Median time of a query in one window [µs].
    pub fn window(&mut self, query: &str) -> Result<f64, Failure> {
        self.0.window(query)
    }
}
