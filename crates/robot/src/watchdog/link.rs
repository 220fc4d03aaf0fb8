//! The control loop's side of the watchdog.

use std::net::IpAddr;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::io::Errno;
use rustix::net::{AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, recv, send, socketpair};

use super::message::{MAX_MESSAGE, RELEASE, encode_beat};
use super::{Guard, Status, Watchdog};

/// Longest time between two steps of the control loop that counts as silence of the watchdog.
const MAX_SILENT_STEP: Duration = Duration::from_millis(5);
/// Silence after which the watchdog does not run. It sends its status every 2 ms.
const MAX_SILENCE: Duration = Duration::from_millis(50);

/// A running watchdog. It ends when the value is dropped, and damps the motors then if they are still guarded.
pub struct WatchdogLink {
    socket: OwnedFd,
    child: Child,
    status: Option<Status>,
    generation: u32,
    is_guarding: bool,
    is_closed: bool,
    now: Duration,
    silence: Duration,
    /// Last message that must not be lost and did not fit into the socket.
    undelivered: [u8; MAX_MESSAGE],
    undelivered_len: usize,
}

impl WatchdogLink {
    /// Starts the process `program watchdog INTERFACE TIMEOUT_MS`, which calls [`run`](super::run).
    pub fn start(program: &Path, interface: IpAddr, timeout: Duration) -> std::io::Result<Self> {
        let (own, other) = socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)?;
        let child = Command::new(program)
            .arg("watchdog")
            .arg(interface.to_string())
            .arg(timeout.as_millis().to_string())
            .current_dir("/")
            .stdin(Stdio::from(other))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        Ok(Self {
            socket: own,
            child,
            status: None,
            generation: 0,
            is_guarding: false,
            is_closed: false,
            undelivered: [0; MAX_MESSAGE],
            undelivered_len: 0,
            now: Duration::ZERO,
            silence: Duration::ZERO,
        })
    }

    /// Returns the process id of the watchdog.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Begins to guard a writer, or replaces the addresses of its readers.
    pub fn guard(&mut self, guard: &Guard) {
        let mut buffer = [0; MAX_MESSAGE];
        if let Some(len) = guard.encode(&mut buffer) {
            (self.generation, self.is_guarding) = (guard.generation, true);
            self.deliver(&buffer[..len]);
        }
    }

    /// Reports that a command was sent.
    pub fn beat(&mut self) {
        if self.is_guarding {
            self.send(&encode_beat(self.generation));
        }
    }

    /// Reports that the robot is not armed any more.
    pub fn release(&mut self) {
        if std::mem::take(&mut self.is_guarding) {
            self.deliver(RELEASE);
        }
    }

    /// Sends a message that must not be lost: now, or when the socket is not full any more. A later one replaces it.
    fn deliver(&mut self, message: &[u8]) {
        self.undelivered[..message.len()].copy_from_slice(message);
        self.undelivered_len = message.len();
        self.deliver_again();
    }

    fn deliver_again(&mut self) {
        let message = self.undelivered;
        if self.undelivered_len > 0 && self.send(&message[..self.undelivered_len]) {
            self.undelivered_len = 0;
        }
    }

    /// Returns what the watchdog does at `now`. Never waits.
    pub fn state(&mut self, now: Duration) -> Watchdog {
        self.silence += now.saturating_sub(self.now).min(MAX_SILENT_STEP);
        self.now = now;
        self.deliver_again();
        self.take_in();
        match self.status {
            _ if self.is_closed || self.silence > MAX_SILENCE => Watchdog::Missing,
            Some(status) if self.is_guarding && status.generation == self.generation => {
                if status.has_taken_over {
                    Watchdog::TookOver
                } else {
                    Watchdog::Guarding
                }
            }
            _ => Watchdog::Idle,
        }
    }

    fn take_in(&mut self) {
        let mut buffer = [0; 16];
        loop {
            match recv(self.socket.as_fd(), &mut buffer[..], RecvFlags::DONTWAIT) {
                Ok((_, 0)) => return self.is_closed = true,
                Ok((_, len)) => {
                    self.silence = Duration::ZERO;
                    self.status = Status::decode(&buffer[..len]).or(self.status);
                }
                Err(Errno::AGAIN) => return,
                Err(Errno::INTR) => {}
                Err(_) => return self.is_closed = true,
            }
        }
    }

    /// Returns false if the socket is full, as that of a watchdog that does not read, which becomes [`Watchdog::Missing`] by its
    /// silence.
    fn send(&mut self, message: &[u8]) -> bool {
        let sent = send(self.socket.as_fd(), message, SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
        self.is_closed |= matches!(sent, Err(Errno::PIPE | Errno::CONNRESET));
        !matches!(sent, Err(Errno::AGAIN | Errno::INTR))
    }
}

impl Drop for WatchdogLink {
    fn drop(&mut self) {
        // It notices the end of the socket; a process that is suspended must not keep this one.
        let _ = rustix::net::shutdown(&self.socket, rustix::net::Shutdown::Both);
        let _ = self.child.try_wait();
    }
}
