//! What ours is measured beside, in Python: a child process that measures one window at a time.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde::Serialize;

use crate::error::{BenchError, failed};

/// The module of the Python client that is the child.
const MODULE: &str = "twinstep.baseline_simulators";

/// What the peers are given: the same robots and the same motion as ours.
#[derive(Serialize)]
pub struct Setup {
    /// MuJoCo models with a position actuator, by their rate [Hz].
    pub models: std::collections::BTreeMap<u32, String>,
    /// Threads of EnvPool, one peer each.
    pub threads: Vec<usize>,
    /// Wanted joint positions in each policy period of the motion [rad].
    pub targets: Vec<Vec<f32>>,
    /// The same in units of the action scale.
    pub actions: Vec<Vec<f32>>,
    /// One policy period [s].
    pub policy_dt: f64,
    /// Robots.
    pub num_envs: usize,
    /// Length of a window [s].
    pub window_s: f64,
}

/// A program of the interpreter. It reads a line of setup, answers with the names of its peers as JSON, and then to each
/// name with a number.
#[derive(Clone, Copy)]
pub struct Program<'a> {
    /// What the interpreter runs.
    pub arguments: &'a [&'a str],
    /// What it measures.
    pub name: &'a str,
    /// How to get what it lacks.
    pub install: &'a str,
}

/// The peers that are installed; none without Python.
pub struct Baselines {
    process: Option<Process>,
    names: Vec<String>,
    program: String,
}

struct Process {
    child: Child,
    requests: ChildStdin,
    answers: Lines<BufReader<ChildStdout>>,
}

/// The child ended, or answered nonsense.
#[derive(Debug, thiserror::Error)]
#[error("{program} failed at `{peer}`; the reason is above")]
struct PeerError {
    program: String,
    peer: String,
}

impl Baselines {
    /// Asks the interpreter `python` which simulators it has; what it lacks is said on stderr, and left out.
    pub fn start(python: &Path, setup: &Setup) -> Self {
        let install = "pip install \"./clients/python[bench]\"";
        Self::start_program(python, Program { arguments: &["-m", MODULE], name: "MuJoCo and EnvPool", install }, setup)
    }

    /// The same of another program.
    pub fn start_program(python: &Path, program: Program, setup: &impl Serialize) -> Self {
        let Program { arguments, name, install } = program;
        let (process, names) = match Process::start(python, arguments, setup) {
            Ok((process, names)) => (Some(process), names),
            Err(reason) => {
                eprintln!(
                    "left out: {name}, because its program in `{}` {reason}\n  {install}, and name its interpreter with \
                     `--python`",
                    python.display()
                );
                (None, Vec::new())
            }
        };
        Self { process, names, program: name.to_owned() }
    }

    /// True if there is a peer of that name.
    pub fn has(&self, peer: &str) -> bool {
        self.names.iter().any(|name| name == peer)
    }

    /// What a peer measures in one window: env-steps a second of a simulator.
    pub fn window(&mut self, peer: &str) -> Result<f64, BenchError> {
        let answer = self.process.as_mut().and_then(|process| process.ask(peer));
        answer.ok_or_else(|| failed(PeerError { program: self.program.clone(), peer: peer.to_owned() }))
    }
}

impl Process {
    fn start(python: &Path, arguments: &[&str], setup: &impl Serialize) -> Result<(Self, Vec<String>), String> {
        let mut child = Command::new(python)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|error| format!("does not start: {error}"))?;
        let (requests, stdout) = (child.stdin.take(), child.stdout.take());
        let (Some(requests), Some(stdout)) = (requests, stdout) else { return Err("has no stdin".to_owned()) };
        let mut process = Self { child, requests, answers: BufReader::new(stdout).lines() };
        let setup = serde_json::to_string(setup).map_err(|error| error.to_string())?;
        let names = process.answer(&setup).ok_or("ended at once")?;
        let names = serde_json::from_str(&names).map_err(|error| format!("answered `{names}`: {error}"))?;
        Ok((process, names))
    }

    fn ask(&mut self, peer: &str) -> Option<f64> {
        self.answer(peer)?.parse().ok()
    }

    fn answer(&mut self, line: &str) -> Option<String> {
        writeln!(self.requests, "{line}").and_then(|()| self.requests.flush()).ok()?;
        self.answers.next()?.ok()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may be in the middle of a window; nothing is lost.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
