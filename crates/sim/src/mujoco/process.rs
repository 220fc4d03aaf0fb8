//! The process `python -m twinstep.mujoco`.

use std::io::BufReader;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use super::frames::{ERROR, Frame, HELLO, check_greeting, read_frame, write_frame};

/// Longest time from a request to its reply. The first one includes the start of Python.
const REPLY_TIMEOUT: Duration = Duration::from_mins(1);
/// Longest time from the end of stdin or stdout to the end of the process.
const EXIT_TIMEOUT: Duration = Duration::from_secs(2);

/// A child process that answers one request after another. It terminates when its stdin closes, also if this process
/// is killed.
pub struct Process {
    child: Child,
    /// Requests to the thread that writes them; `None` after the first failure.
    requests: Option<Sender<(u8, Vec<u8>)>>,
    /// Replies, or the reason why there are no more.
    replies: Receiver<Result<Frame, String>>,
    /// Reason of the first failure, which is also that of all later requests.
    failure: String,
    reply_timeout: Duration,
}

impl Process {
    /// Starts the process with the interpreter `python` and sends the first request. Returns the reason if it fails.
    pub fn start(python: &Path, hello: &[u8]) -> Result<Self, String> {
        Self::start_within(python, hello, REPLY_TIMEOUT)
    }

    fn start_within(python: &Path, hello: &[u8], reply_timeout: Duration) -> Result<Self, String> {
        let mut child = Command::new(python)
            .args(["-m", "twinstep.mujoco"])
            // Modules are not looked for in the current folder, which anybody may have filled.
            .env("PYTHONSAFEPATH", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C in a terminal reaches this process only, which then closes the stdin of the child.
            .process_group(0)
            .spawn()
            .map_err(|error| format!("the interpreter does not start: {error}"))?;
        let stdin = child.stdin.take().expect("stdin is a pipe");
        let stdout = child.stdout.take().expect("stdout is a pipe");
        let mut process = Self {
            child,
            requests: Some(write_requests(stdin)),
            replies: read_replies(stdout),
            failure: String::new(),
            reply_timeout,
        };
        let greeting = process.request(HELLO, hello, HELLO)?;
        check_greeting(&greeting)?;
        Ok(process)
    }

    /// Returns the process id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends a request and returns the body of its reply, which is of kind `expected`. Returns the reason if it fails.
    pub fn request(&mut self, kind: u8, body: &[u8], expected: u8) -> Result<Vec<u8>, String> {
        let result = self.exchange(kind, body, expected);
        if let Err(reason) = &result {
            self.fail(reason.clone());
        }
        result
    }

    /// Ends the process because of `reason`, which is that of all later requests.
    pub fn fail(&mut self, reason: String) {
        if self.requests.take().is_some() {
            self.failure = reason;
        }
    }

    fn exchange(&mut self, kind: u8, body: &[u8], expected: u8) -> Result<Vec<u8>, String> {
        let Some(requests) = &self.requests else { return Err(self.failure.clone()) };
        // A request that cannot be written has no reply: the process has exited, or explains itself in its last reply.
        let _ = requests.send((kind, body.to_vec()));
        match self.replies.recv_timeout(self.reply_timeout) {
            Ok(Ok((kind, body))) if kind == expected => Ok(body),
            Ok(Ok((ERROR, text))) => Err(String::from_utf8_lossy(&text).into_owned()),
            Ok(Ok((kind, body))) => {
                let kind = char::from(kind);
                Err(format!("it wrote a frame of kind {kind:?} with {} bytes as a reply", body.len()))
            }
            Ok(Err(reason)) => Err(reason),
            Err(RecvTimeoutError::Timeout) => {
                Err(format!("it did not reply within {} s", self.reply_timeout.as_secs()))
            }
            Err(RecvTimeoutError::Disconnected) => Err(self.exit_report()),
        }
    }

    /// Returns how the process ended, after its stdout has.
    fn exit_report(&mut self) -> String {
        match self.wait() {
            Some(status) => format!("it ended ({status}); its messages are on stderr"),
            None => "it closed its stdout".to_owned(),
        }
    }

    fn wait(&mut self) -> Option<std::process::ExitStatus> {
        let since = Instant::now();
        while since.elapsed() < EXIT_TIMEOUT {
            if let Ok(Some(status)) = self.child.try_wait() {
                return Some(status);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        None
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let failed = self.requests.take().is_none();
        if failed || self.wait().is_none() {
            // Both fail only if the process has ended.
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// Writes frames on a thread, so that a process that does not read can be given up.
fn write_requests(mut stdin: ChildStdin) -> Sender<(u8, Vec<u8>)> {
    let (sender, requests) = channel::<(u8, Vec<u8>)>();
    std::thread::spawn(move || {
        for (kind, body) in requests {
            if write_frame(&mut stdin, kind, &body).is_err() {
                break;
            }
        }
    });
    sender
}

/// Reads frames on a thread, so that a process that hangs can be given up.
fn read_replies(stdout: ChildStdout) -> Receiver<Result<Frame, String>> {
    let (sender, replies) = channel();
    std::thread::spawn(move || {
        let mut stdout = BufReader::new(stdout);
        while let Some(reply) = read_frame(&mut stdout).map_err(|error| error.to_string()).transpose() {
            let last = reply.is_err();
            if sender.send(reply).is_err() || last {
                break;
            }
        }
    });
    replies
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn process_that_neither_reads_nor_replies_is_given_up_and_ended() {
        let folder = tempfile::tempdir().expect("a folder");
        let (program, id) = (folder.path().join("python"), folder.path().join("id"));
        std::fs::write(&program, format!("#!/bin/sh\necho $$ > {}\nexec sleep 600\n", id.display())).expect("written");
        std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o700)).expect("permitted");
        // More than a pipe holds.
        let hello = vec![0; 1 << 20];
        let reason = Process::start_within(&program, &hello, Duration::from_secs(1)).err();
        assert_eq!(reason.as_deref(), Some("it did not reply within 1 s"));
        let id = std::fs::read_to_string(id).expect("it was started");
        assert!(!Path::new(&format!("/proc/{}", id.trim())).exists(), "it is ended and reaped");
    }
}
