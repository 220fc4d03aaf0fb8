//! Other simulators, in Python: a child process that measures one window at a time.

use std::io::{BufRead, BufReader, Lines, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde::Serialize;

use crate::exit::{Failure, other};

/// The module of the Python client that is the child.
const MODULE: &str = "twinstep.peer_simulators";

/// What the peers are given: the same robots and the same motion as ours.
#[derive(Serialize)]
pub struct Setup {
    /// MuJoCo models with a position drive, by their rate [Hz].
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

/// The peers that are installed; none without Python.
pub struct Peers {
    process: Option<Process>,
    names: Vec<String>,
}

struct Process {
    child: Child,
    requests: ChildStdin,
    answers: Lines<BufReader<ChildStdout>>,
}

/// The child ended, or answered nonsense.
#[derive(Debug, thiserror::Error)]
#[error("`{MODULE}` failed at `{peer}`; its reason is above")]
struct PeerError {
    peer: String,
}

impl Peers {
    /// Asks the interpreter `python` what it has; what it lacks is said on stderr, and left out.
    pub fn start(python: &Path, setup: &Setup) -> Self {
        Process::start(python, setup).unwrap_or_else(|reason| {
            eprintln!(
                "left out: MuJoCo and EnvPool, because `{} -m {MODULE}` {reason}\n  \
                 pip install \"./clients/python[bench]\", and name its interpreter with `--python`",
                python.display()
            );
            Self { process: None, names: Vec::new() }
        })
    }

    /// True if there is a peer of that name.
    pub fn has(&self, peer: &str) -> bool {
        self.names.iter().any(|name| name == peer)
    }

    /// Env-steps a second of a peer in one window.
    pub fn window(&mut self, peer: &str) -> Result<f64, Failure> {
        let answer = self.process.as_mut().and_then(|process| process.ask(peer));
        answer.ok_or_else(|| other(PeerError { peer: peer.to_owned() }))
    }
}

impl Process {
    fn start(python: &Path, setup: &Setup) -> Result<Peers, String> {
        let mut child = Command::new(python)
            .args(["-m", MODULE])
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
        Ok(Peers { process: Some(process), names })
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
