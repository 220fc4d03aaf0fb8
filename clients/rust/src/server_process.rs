//! A server as a child process, which terminates with this one even after a crash.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use crate::ClientError;

/// A `twinstep serve` process on a free port of this machine.
pub struct ServerProcess {
    child: Child,
    /// Endpoint at which it listens.
    pub endpoint: String,
}

impl ServerProcess {
    /// Starts this program as a server with `flags` and waits until it listens.
    pub fn start(flags: &[&str]) -> Result<Self, ClientError> {
        let program = std::env::current_exe().map_err(start_failed)?;
        let mut child = Command::new(program)
            .args(["serve", "--until-stdin-closes", "--listen", "tcp/127.0.0.1:0"])
            .args(flags)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(start_failed)?;
        let mut line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut line).map_err(start_failed)?;
        }
        match line.trim().strip_prefix("listening ") {
            Some(endpoint) => Ok(Self { endpoint: endpoint.to_owned(), child }),
            None => Err(ClientError::ServerStart(
                "it did not print its endpoint; `twinstep serve` prints the reason".to_owned(),
            )),
        }
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        // The server terminates when its stdin closes.
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}

fn start_failed(error: std::io::Error) -> ClientError {
    ClientError::ServerStart(error.to_string())
}
