//! A fake robot and the process that fronts it, as two processes on one DDS domain.

use std::path::Path;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::process::Process;

/// Time in which a robot starts.
const START: Duration = Duration::from_mins(1);
/// Time in which a process answers a line.
const ANSWER: Duration = Duration::from_secs(20);
/// Domains of the pairs of one test process.
static NEXT_DOMAIN: AtomicU16 = AtomicU16::new(210);
/// Config of the robot. Virtual machines stand still for tens of milliseconds.
pub const PATIENT: &str = "[safety]\nstate_timeout_ms = 150\nmax_pause_ms = 200\nwatchdog_timeout_ms = 100\n";
/// Domains above are not valid.
const LAST_DOMAIN: u16 = 232;

/// Returns a DDS domain that no other pair of this process has.
pub fn next_domain() -> u16 {
    let next = |domain: u16| Some(if domain >= LAST_DOMAIN { 210 } else { domain + 1 });
    NEXT_DOMAIN.fetch_update(Ordering::AcqRel, Ordering::Acquire, next).unwrap_or(210)
}

fn arguments(own: &[&str], more: &[&str]) -> Vec<String> {
    own.iter().chain(more).map(ToString::to_string).collect()
}

/// A fake robot and `twinstep robot`.
pub struct RobotPair {
    /// `twinstep fake-robot`.
    pub fake: Process,
    /// `twinstep robot`.
    pub robot: Process,
    /// Endpoint at which clients find the robot.
    pub endpoint: String,
    /// DDS domain of both.
    pub domain: u16,
    /// State of the robot in its last line.
    state: String,
}

impl RobotPair {
    /// Starts both, with more arguments for each.
    pub fn start(program: &Path, fake: &[&str], robot: &[&str]) -> Result<Self, String> {
        let domain = next_domain();
        let fake = arguments(&["fake-robot", "--until-stdin-closes", "--domain", &domain.to_string()], fake);
        Self::in_front_of(Process::start(program, &fake)?, domain, PATIENT, program, robot)
    }

    /// Starts `twinstep robot` with this config file for the robot on `domain` that the process `fake` simulates.
    pub fn in_front_of(
        fake: Process,
        domain: u16,
        config_text: &str,
        program: &Path,
        robot: &[&str],
    ) -> Result<Self, String> {
        if fake.line(START).is_none_or(|line| !line.starts_with("ready")) {
            return Err("the fake robot did not start".to_owned());
        }
        let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
        let config = folder.path().join("robot.toml");
        std::fs::write(&config, config_text).map_err(|error| error.to_string())?;
        let config = config.to_str().unwrap_or_default();
        let own = ["robot", "--interface", "127.0.0.1", "--listen", "tcp/127.0.0.1:0", "--config", config];
        let domain_text = domain.to_string();
        let robot = [&["--domain", &domain_text], robot].concat();
        // In a process group of its own, to which a test may send signals.
        let robot = Process::start_in_group(program, &arguments(&own, &robot))?;
        let line = robot.line(START).ok_or("the robot did not start")?;
        // With a policy of its own it serves no clients.
        let endpoint = line.strip_prefix("listening ").unwrap_or_default().to_owned();
        Ok(Self { fake, robot, endpoint, domain, state: String::new() })
    }

    /// Types a line at the robot and returns the answer, which begins with `ok` or `error`.
    pub fn operator(&mut self, request: &str) -> Result<String, String> {
        self.robot.write_line(request)?;
        let end = Instant::now() + ANSWER;
        while let Some(line) = self.robot.line(end.saturating_duration_since(Instant::now())) {
            if line.starts_with("ok") || line.starts_with("error") {
                return Ok(line);
            }
            self.note(&line);
        }
        Err(format!("no answer to `{request}`; last state `{}`", self.state))
    }

    /// Waits until the robot's state line begins with `state`.
    pub fn wait_for(&mut self, state: &str, timeout: Duration) -> Result<(), String> {
        let end = Instant::now() + timeout;
        while !self.state.starts_with(state) {
            let left = end.saturating_duration_since(Instant::now());
            let Some(line) = self.robot.line(left) else {
                return Err(format!("`{state}` was not reached; last state `{}`", self.state));
            };
            self.note(&line);
        }
        Ok(())
    }

    /// Returns the states that the robot has printed since the last call, with their faults.
    pub fn new_states(&mut self) -> Vec<String> {
        let lines = self.robot.lines_so_far();
        for line in &lines {
            self.note(line);
        }
        lines.iter().filter_map(|line| line.strip_prefix("state ")).map(str::to_owned).collect()
    }

    /// Returns the robot's last state with its fault.
    pub fn state(&mut self) -> &str {
        self.new_states();
        &self.state
    }

    /// Releases the built-in controller, arms, and begins to stand up.
    pub fn rise(&mut self) -> Result<(), String> {
        self.wait_for("observe", START)?;
        self.operator("release")?;
        self.insist("arm")?;
        self.insist("stand")
    }

    /// As [`RobotPair::rise`], and waits until the robot stands.
    pub fn stand(&mut self) -> Result<(), String> {
        self.rise()?;
        self.wait_for("ready", Duration::from_secs(15))
    }

    /// Types a line at the robot until it is executed.
    pub fn insist(&mut self, request: &str) -> Result<(), String> {
        let end = Instant::now() + ANSWER;
        loop {
            let answer = self.operator(request)?;
            if answer.starts_with("ok") {
                return Ok(());
            }
            if Instant::now() > end {
                return Err(answer);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// Types a line at the fake and returns its answer.
    pub fn inject(&mut self, line: &str) -> Result<String, String> {
        self.fake.write_line(line)?;
        self.fake.line(ANSWER).ok_or_else(|| format!("the fake does not answer `{line}`"))
    }

    /// Returns the JSON that the fake prints for `pose` or `statistics`.
    pub fn ask(&mut self, question: &str) -> Result<Value, String> {
        let answer = self.inject(question)?;
        serde_json::from_str(&answer).map_err(|error| format!("`{answer}`: {error}"))
    }

    fn note(&mut self, line: &str) {
        if let Some(state) = line.strip_prefix("state ") {
            state.clone_into(&mut self.state);
        }
    }
}
