//! Servers as processes of their own.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

/// A program that prints `listening ENDPOINT`, serves, and ends when its stdin closes: also when this process dies.
pub struct ServerProcess {
    child: Child,
    /// Where it listens.
    pub endpoint: String,
}

impl ServerProcess {
    /// Starts `program` and waits until it answers. Its stderr is this process's.
    pub fn start(program: &Path, arguments: impl IntoIterator<Item = impl AsRef<OsStr>>) -> std::io::Result<Self> {
        let mut child = Command::new(program).args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let mut line = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut line)?;
        }
        match line.trim().strip_prefix("listening ") {
            Some(endpoint) => Ok(Self { endpoint: endpoint.to_owned(), child }),
            None => Err(std::io::Error::other(format!("{} did not start", program.display()))),
        }
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        drop(self.child.stdin.take());
        let _ = self.child.wait();
    }
}
