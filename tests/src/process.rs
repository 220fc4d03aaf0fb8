//! A child process that can be killed, suspended and resumed, and whose output is read line by line.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};

/// Maximum time for the start of a server.
const STARTUP: Duration = Duration::from_mins(1);

/// A child process. It is killed when dropped.
pub struct Process {
    child: Child,
    lines: Receiver<String>,
}

impl Process {
    /// Starts `program` with `arguments` and reads its stdout line by line.
    pub fn start(program: &Path, arguments: &[String]) -> Result<Self, String> {
        Self::spawn(Command::new(program).args(arguments))
    }

    /// As [`Process::start`], in a process group of its own.
    pub fn start_in_group(program: &Path, arguments: &[String]) -> Result<Self, String> {
        Self::spawn(Command::new(program).args(arguments).process_group(0))
    }

    fn spawn(command: &mut Command) -> Result<Self, String> {
        let mut child = command
            // The pipe closes when this process exits; the child then exits too.
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|error| format!("{command:?}: {error}"))?;
        let (sender, lines) = channel();
        let stdout = child.stdout.take().ok_or("the child has no stdout")?;
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    break;
                }
            }
        });
        Ok(Self { child, lines })
    }

    /// Starts a program and waits for its line `listening ENDPOINT`. Returns the process and the endpoint.
    pub fn listening(program: &Path, arguments: &[String]) -> Result<(Self, String), String> {
        let process = Self::start(program, arguments)?;
        let line = process.line(STARTUP).unwrap_or_default();
        match line.strip_prefix("listening ") {
            Some(endpoint) => Ok((process, endpoint.to_owned())),
            None => Err(format!("`{} {}` did not start", program.display(), arguments.join(" "))),
        }
    }

    /// Returns the process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns the next line, or `None` after `timeout` or if the process has exited.
    pub fn line(&self, timeout: Duration) -> Option<String> {
        self.lines.recv_timeout(timeout).ok()
    }

    /// Writes a line to the stdin of the process.
    pub fn write_line(&mut self, text: &str) -> Result<(), String> {
        self.write(format!("{text}\n").as_bytes()).map_err(|error| format!("`{text}`: {error}"))
    }

    /// Writes bytes to the stdin of the process.
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), String> {
        let stdin = self.child.stdin.as_mut().ok_or("the child has no stdin")?;
        stdin.write_all(bytes).and_then(|()| stdin.flush()).map_err(|error| error.to_string())
    }

    /// Sends SIGINT.
    pub fn interrupt(&self) -> Result<(), String> {
        self.signal("INT")
    }

    /// Returns all lines received so far.
    pub fn lines_so_far(&self) -> Vec<String> {
        self.lines.try_iter().collect()
    }

    /// Sends SIGKILL and returns the remaining lines.
    pub fn kill(&mut self) -> Vec<String> {
        // Both fail only if the process has already exited.
        let _ = self.child.kill();
        let _ = self.child.wait();
        self.lines.iter().collect()
    }

    /// Suspends the process with SIGSTOP.
    pub fn freeze(&self) -> Result<(), String> {
        self.signal("STOP")
    }

    /// Resumes the process with SIGCONT.
    pub fn thaw(&self) -> Result<(), String> {
        self.signal("CONT")
    }

    /// Sends a signal by its name, such as `HUP`.
    pub fn signal(&self, name: &str) -> Result<(), String> {
        let status = Command::new("kill").args([&format!("-{name}"), &self.child.id().to_string()]).status();
        match status {
            Ok(status) if status.success() => Ok(()),
            other => Err(format!("kill -{name}: {other:?}")),
        }
    }

    /// Waits for the process to exit and returns its exit code, or `None` after `timeout`.
    pub fn exit_code(&mut self, timeout: Duration) -> Option<i32> {
        let since = Instant::now();
        while since.elapsed() < timeout {
            match self.lines.recv_timeout(Duration::from_millis(10)) {
                Err(RecvTimeoutError::Disconnected) => return self.child.wait().ok()?.code(),
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
            }
        }
        None
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Returns a command of `program` whose SIGINT has its default effect, also if this process ignores the signal, as one that a
/// shell has started in the background does.
pub fn interruptible(program: &Path) -> Command {
    let mut command = Command::new("env");
    command.arg("--default-signal=INT").arg(program);
    command
}
