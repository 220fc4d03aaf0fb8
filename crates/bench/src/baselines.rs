//! Baselines in Python: a child process that measures one window at a time.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde::Serialize;

use crate::error::{BenchError, failed};

/// Module of the Python client that the child process runs.
const MODULE: &str = "twinstep.baseline_simulators";

/// Setup of the baseline simulators: the same robots and the same motion as for Twinstep.
#[derive(Serialize)]
pub struct Setup {
    /// MuJoCo models with position actuators and a keyframe, by the name of the baseline.
    pub models: std::collections::BTreeMap<String, String>,
    /// Numbers of threads of EnvPool, with one baseline for each.
    pub threads: Vec<usize>,
    /// Joint position targets of each policy period of the motion [rad].
    pub targets: Vec<Vec<f32>>,
    /// The targets as actions, in units of the action scale.
    pub actions: Vec<Vec<f32>>,
    /// Policy period [s].
    pub policy_dt: f64,
    /// True if the robots are reset before each cycle of the motion.
    pub restarts: bool,
    /// Number of robots.
    pub num_envs: usize,
    /// Length of a window [s].
    pub window_s: f64,
}

/// Program of the interpreter.
///
/// It reads one line of setup and prints the names of its baselines as JSON. Then it reads names and prints a number
/// for each.
#[derive(Clone, Copy)]
pub struct Program<'a> {
    /// Arguments of the interpreter.
    pub arguments: &'a [&'a str],
    /// Name of what it measures.
    pub name: &'a str,
    /// Command that installs missing packages.
    pub install: &'a str,
}

/// Installed baselines; none without Python.
pub struct Baselines {
    process: Option<Process>,
    names: Vec<String>,
    program: String,
}

struct Process {
    child: Child,
    requests: ChildStdin,
    replies: Lines<BufReader<ChildStdout>>,
}

/// The child process stopped, or its reply is not a number.
#[derive(Debug, thiserror::Error)]
#[error("{program} failed at `{baseline}`\n  its error message is above")]
struct BaselineError {
    program: String,
    baseline: String,
}

impl Baselines {
    /// Starts the baseline simulators of the interpreter `python`. Missing ones are skipped with a message on stderr.
    pub fn start(python: &Path, setup: &Setup) -> Self {
        let install = "pip install \"./clients/python[bench]\"";
        Self::start_program(python, Program { arguments: &["-m", MODULE], name: "MuJoCo and EnvPool", install }, setup)
    }

    /// Starts the baselines of another program, in the same way.
    pub fn start_program(python: &Path, program: Program, setup: &impl Serialize) -> Self {
        let Program { arguments, name, install } = program;
        let (process, names) = match Process::start(python, arguments, setup) {
            Ok((process, names)) => (Some(process), names),
            Err(reason) => {
                eprintln!(
                    "skipped: {name}, because its program in `{}` {reason}\n  install it with `{install}` and select \
                     its interpreter with `--python`",
                    python.display()
                );
                (None, Vec::new())
            }
        };
        Self { process, names, program: name.to_owned() }
    }

    /// True if there is a baseline of this name.
    pub fn has(&self, baseline: &str) -> bool {
        self.names.iter().any(|name| name == baseline)
    }

    /// Returns what a baseline measures in one window; for a simulator the env-steps per second.
    pub fn window(&mut self, baseline: &str) -> Result<f64, BenchError> {
        let rate = self.process.as_mut().and_then(|process| process.measure(baseline));
        rate.ok_or_else(|| failed(BaselineError { program: self.program.clone(), baseline: baseline.to_owned() }))
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
        let mut process = Self { child, requests, replies: BufReader::new(stdout).lines() };
        let setup = serde_json::to_string(setup).map_err(|error| error.to_string())?;
        let names = process.reply_to(&setup).ok_or("stopped at once")?;
        let names = serde_json::from_str(&names).map_err(|error| format!("replied `{names}`: {error}"))?;
        Ok((process, names))
    }

    fn measure(&mut self, baseline: &str) -> Option<f64> {
        self.reply_to(baseline)?.parse().ok()
    }

    fn reply_to(&mut self, line: &str) -> Option<String> {
        writeln!(self.requests, "{line}").and_then(|()| self.requests.flush()).ok()?;
        self.replies.next()?.ok()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // The child may be measuring a window, whose result is not needed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
