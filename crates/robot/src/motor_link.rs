//! The way to the motors: a writer of `rt/lowcmd` that the robot knows, and the watchdog that guards it.

use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::time::Duration;

use crate::command_datagram::{CommandDatagram, WriterGuid};
use crate::dds::{Dds, LOW_CMD, Writer};
use crate::watchdog::{Guard, MAX_READERS, Watchdog, WatchdogLink};

/// Number of commands in a row that the network refuses, from which the motors count as out of reach.
const MAX_FAILURES: u32 = 10;

/// Sends commands to the motors, from the thread of the caller. It never waits.
pub struct MotorLink {
    dds: Dds,
    network: UdpSocket,
    watchdog: WatchdogLink,
    generation: u32,
    /// Exists while the robot is armed.
    writer: Option<ArmedWriter>,
    failures: u32,
    has_writer_failed: bool,
}

/// The writer of an armed robot.
struct ArmedWriter {
    /// Announces the writer. It writes nothing itself.
    _announced: Writer,
    guid: WriterGuid,
    damping: Vec<u8>,
    datagram: CommandDatagram,
    readers: Vec<SocketAddr>,
    /// Sequence number of the last command.
    number: u64,
}

impl MotorLink {
    /// Starts the watchdog `program watchdog`, for the robot on the interface of `dds`. It takes over
    /// after `timeout` without a command.
    pub fn start(dds: &Dds, program: &Path, timeout: Duration) -> std::io::Result<Self> {
        let address = dds.address();
        let network = UdpSocket::bind((address, 0))?;
        network.set_nonblocking(true)?;
        let watchdog = WatchdogLink::start(program, address, timeout)?;
        let dds = dds.clone();
        Ok(Self { dds, network, watchdog, generation: 0, writer: None, failures: 0, has_writer_failed: false })
    }

    /// Returns the process id of the watchdog.
    pub fn watchdog_id(&self) -> u32 {
        self.watchdog.id()
    }

    /// Returns what the watchdog does. `now` is the time on the caller's clock.
    pub fn watchdog(&mut self, now: Duration) -> Watchdog {
        self.watchdog.state(now)
    }

    /// Returns false if commands cannot be sent.
    pub fn can_send(&self) -> bool {
        !self.has_writer_failed && self.failures < MAX_FAILURES
    }

    /// Creates a new writer, which others discover from now on. `damping` is the payload of a command that damps the motors.
    pub fn arm(&mut self, damping: Vec<u8>) {
        self.writer = None;
        self.generation += 1;
        let announced = self.dds.writer(LOW_CMD, 1);
        self.has_writer_failed = announced.is_err();
        let announced = match announced {
            Ok(announced) => announced,
            Err(error) => return tracing::error!(%error, "commands cannot be sent"),
        };
        let guid = announced.guid();
        let Some(datagram) = CommandDatagram::new(guid, &damping) else {
            self.has_writer_failed = true;
            return;
        };
        self.writer =
            Some(ArmedWriter { _announced: announced, guid, damping, datagram, readers: Vec::new(), number: 0 });
    }

    /// Sets the addresses of those who read the commands. Without one, the watchdog does not guard.
    pub fn set_readers(&mut self, readers: &[SocketAddr]) {
        let Some(writer) = &mut self.writer else { return };
        let readers = &readers[..readers.len().min(MAX_READERS)];
        if readers.is_empty() || writer.readers == readers {
            return;
        }
        writer.readers = readers.to_vec();
        let ArmedWriter { guid, damping, readers, .. } = writer;
        self.watchdog.guard(&Guard { generation: self.generation, writer: *guid, readers, damping });
    }

    /// Sends a command to all readers.
    pub fn send(&mut self, payload: &[u8]) {
        let Some(writer) = &mut self.writer else { return };
        writer.number += 1;
        let bytes = writer.datagram.with_payload(writer.number, payload);
        let sent = writer.readers.iter().filter(|reader| self.network.send_to(bytes, **reader).is_ok()).count();
        self.failures = if sent == 0 && !writer.readers.is_empty() { self.failures + 1 } else { 0 };
    }

    /// Reports to the watchdog that the caller is in control of the motors.
    pub fn beat(&mut self) {
        self.watchdog.beat();
    }

    /// Ends the writer: the robot is not armed any more.
    pub fn disarm(&mut self) {
        if self.writer.take().is_some() {
            self.watchdog.release();
            self.failures = 0;
        }
    }

    /// Returns true while there is a writer.
    pub fn is_armed(&self) -> bool {
        self.writer.is_some()
    }
}
