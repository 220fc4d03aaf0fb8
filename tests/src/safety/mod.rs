//! Attacks on `twinstep robot` and on servers, with what was measured: the rows of `results/safety.md`.
//!
//! - [`probe`]: a reader of the robot's commands, and a sleeping thread of the same priority beside it.
//! - [`signals`]: the control process is ended or suspended in each state.
//! - [`stops`]: stops by key, client, signal and remote control, while something else keeps the process busy.
//! - [`packets`]: forged packets at the DDS sockets.
//! - [`robots`]: another robot, a robot that restarts, a state from another interface.
//! - [`recordings`]: recordings of processes that are killed.
//! - [`servers`]: clients that do not read, long rollouts, oversized requests.

mod other_interface;
pub mod packets;
pub mod probe;
pub mod recordings;
pub mod robots;
pub mod servers;
pub mod signals;
pub mod stops;

use std::path::Path;
use std::time::Duration;

use crate::process::Process;
use crate::robot_pair::{RobotPair, next_domain};

/// Config with the default times.
const DEFAULT: &str = "[safety]\n";
/// Attempts to make a robot stand. A computer that stands still makes it stop, as it should.
const ATTEMPTS: usize = 5;

/// A row of the results.
pub struct Row {
    /// What was done.
    pub what: String,
    /// What was measured.
    pub found: String,
    /// True if the bound is met.
    pub is_met: bool,
}

impl Row {
    /// Returns the row as a line of a table.
    pub fn line(&self) -> String {
        format!("| {} | {} | {} |", self.what, self.found, if self.is_met { "met" } else { "**missed**" })
    }
}

/// Starts a fake robot and `twinstep robot` with the default times and more arguments.
pub fn pair(program: &Path, robot: &[&str]) -> Result<RobotPair, String> {
    let domain = next_domain();
    let arguments = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain.to_string()];
    let fake = Process::start(program, &arguments.map(str::to_owned))?;
    RobotPair::in_front_of(fake, domain, DEFAULT, program, robot)
}

/// Starts `twinstep robot` for a fake robot on `domain`, with the default times and more arguments.
pub fn pair_on(program: &Path, domain: u16, more: &[&str]) -> Result<Process, String> {
    let own = ["robot", "--interface", "127.0.0.1", "--listen", "tcp/127.0.0.1:0", "--domain"];
    let domain = domain.to_string();
    let arguments: Vec<String> = own.iter().chain([&domain.as_str()]).chain(more).map(ToString::to_string).collect();
    Process::start(program, &arguments)
}

/// Types `arm` at a robot until it is in `state`.
pub fn in_state_of(robot: &mut Process, state: &str) -> Result<(), String> {
    for _ in 0..100 {
        robot.write_line("arm")?;
        std::thread::sleep(Duration::from_millis(100));
        if robot.lines_so_far().iter().any(|line| line.starts_with(&format!("state {state}"))) {
            return Ok(());
        }
    }
    Err(format!("`{state}` was not reached"))
}

/// Returns a robot in `state`.
pub fn in_state(program: &Path, state: &str) -> Result<RobotPair, String> {
    let attempt = || {
        let policy = crate::python::root().join("data/policies/walk.safetensors");
        let policy = ["--policy", policy.to_str().unwrap_or_default()];
        let mut pair = pair(program, if state == "run" { &policy } else { &[] })?;
        pair.wait_for("observe", Duration::from_secs(20))?;
        pair.insist("arm")?;
        if state != "damp" {
            pair.insist("stand")?;
            pair.wait_for(if state == "sit" { "ready" } else { state }, Duration::from_secs(15))?;
        }
        match state {
            "sit" => {
                pair.insist("sit")?;
                pair.wait_for("sit", Duration::from_secs(1))?;
            }
            "stand_up" => std::thread::sleep(Duration::from_millis(1500)),
            _ => std::thread::sleep(Duration::from_millis(300)),
        }
        if pair.state().starts_with(state) { Ok(pair) } else { Err(pair.state().to_owned()) }
    };
    let mut failure = String::new();
    for _ in 0..ATTEMPTS {
        match attempt() {
            Ok(pair) => return Ok(pair),
            Err(error) => failure = error,
        }
    }
    Err(format!("`{state}` was not reached: {failure}"))
}

/// Returns the value that `share` of the sorted values do not exceed [ms].
pub fn quantile(values: &mut [f64], share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let index = (share * values.len() as f64).ceil() as usize;
    values.get(index.saturating_sub(1)).copied().unwrap_or(f64::NAN)
}

/// Returns the resident memory of a process [MiB].
pub fn memory_mib(id: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap_or("0");
    line.split_whitespace().next().and_then(|kib| kib.parse::<f64>().ok()).unwrap_or(0.0) / 1024.0
}
