//! A server as another process, which ends with this one however that ends.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use crate::exit::{Failure, other};

/// `twinstep serve` on a free port of this machine.
pub struct ServerProcess {
    child: Child,
    /// Where it listens.
    pub endpoint: String,
}

impl ServerProcess {
    /// Starts this very program as a server with `flags` and waits until it answers.
    pub fn start(flags: &[&str]) -> Result<Self, Failure> {
        let program = std::env::current_exe().map_err(other)?;
        let mut child = Command::new(program)
            .args(["serve", "--until-stdin-closes", "--listen", "tcp/127.0.0.1:0"])
            .args(flags)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(other)?;
        let mut line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut line).map_err(other)?;
        }
        match line.trim().strip_prefix("listening ") {
            Some(endpoint) => Ok(Self { endpoint: endpoint.to_owned(), child }),
            None => Err(Failure::Other(miette::miette!("the server did not start; `twinstep serve` says why"))),
        }
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // The server ends when its stdin closes.
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}
