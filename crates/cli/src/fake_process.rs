//! A fake robot in a process of its own.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::exit::{Failure, other};

/// Time in which a fake robot begins to send states.
const FAKE_START: Duration = Duration::from_secs(10);
/// Lowest domain of a fake robot, far from the robot's 0 and the vendor's simulator's 1; and the number of domains.
const FAKE_DOMAINS: [u32; 2] = [10, 200];

/// A fake robot in a process of its own, which ends with this one.
pub struct FakeProcess {
    child: Child,
    /// Its DDS domain.
    pub domain: u16,
}

impl FakeProcess {
    /// Starts it with a model file and more arguments, and waits until it sends states.
    pub fn start(model: Option<&Path>, more: &[&str]) -> Result<Self, Failure> {
        let [first, number] = FAKE_DOMAINS;
        let domain = (first + std::process::id() % number) as u16;
        let mut command = Command::new(std::env::current_exe().map_err(other)?);
        command.args(["fake-robot", "--until-stdin-closes", "--motion-capture", "--domain", &domain.to_string()]);
        command.args(more);
        if let Some(model) = model {
            command.arg("--model").arg(model);
        }
        // Ctrl-C in a terminal goes to the whole group: the fake must outlive the final damping.
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().map_err(other)?;
        let mut line = String::new();
        let since = Instant::now();
        if let Some(output) = child.stdout.take() {
            std::io::BufRead::read_line(&mut std::io::BufReader::new(output), &mut line).map_err(other)?;
        }
        if !line.starts_with("ready") || since.elapsed() > FAKE_START {
            let _ = child.kill();
            return Err(Failure::Other(miette::miette!("the fake robot did not start; its errors are above")));
        }
        Ok(Self { child, domain })
    }
}

impl Drop for FakeProcess {
    fn drop(&mut self) {
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}
