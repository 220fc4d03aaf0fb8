//! The watchdog's process.

use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, Timespec, poll};
use rustix::io::Errno;
use rustix::mm::MlockAllFlags;
use rustix::net::{RecvFlags, SendFlags, recv, send};

use super::message::{MAX_MESSAGE, decode_readers};
use super::{FIRST_NUMBER, MAX_READERS, Message, Mode, Status, WatchdogMachine};
use crate::command_datagram::CommandDatagram;
use crate::real_time_thread::{WATCHDOG_PRIORITY, raise_priority};

/// Period of the watchdog's steps.
const PERIOD: Timespec = Timespec { tv_sec: 0, tv_nsec: 2_000_000 };

/// Guards the motors until the control loop ends. `interface` is the address of the network interface to the robot, and
/// stdin the socket of the control loop, to which the first byte is sent when everything is ready.
///
/// The caller has to ignore the signals that end a process; those of a terminal do not reach its session.
pub fn run(interface: IpAddr, timeout: Duration) -> std::io::Result<()> {
    rustix::process::setsid()?;
    let network = UdpSocket::bind((interface, 0))?;
    network.set_nonblocking(true)?;
    let mut watchdog = Process {
        machine: WatchdogMachine::new(timeout),
        network,
        datagram: None,
        readers: [None; MAX_READERS],
        number: FIRST_NUMBER,
    };
    // Without the permission it runs as every other process, which the control loop reports for both.
    let _ = rustix::mm::mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE);
    raise_priority(WATCHDOG_PRIORITY);
    let stdin = std::io::stdin();
    watchdog.guard_until_the_end(stdin.as_fd());
    Ok(())
}

struct Process {
    machine: WatchdogMachine,
    network: UdpSocket,
    datagram: Option<CommandDatagram>,
    readers: [Option<SocketAddr>; MAX_READERS],
    number: u64,
}

impl Process {
    fn guard_until_the_end(&mut self, control: BorrowedFd) {
        let start = Instant::now();
        loop {
            self.take_in(control);
            let mode = self.machine.step(start.elapsed());
            match mode {
                Mode::End => return,
                Mode::TakeOver => self.damp(),
                Mode::Idle | Mode::Guard => {}
            }
            // A control loop that does not read has a full socket; it gets the next status.
            let status = Status::new(mode, self.machine.generation()).encode();
            let _ = send(control, &status, SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
            // Not on the socket: beats arrive as often as the timer, and a closed one would wake it without end.
            let _ = poll(&mut [] as &mut [PollFd; 0], Some(&PERIOD));
        }
    }

    fn take_in(&mut self, control: BorrowedFd) {
        let mut buffer = [0; MAX_MESSAGE];
        loop {
            match recv(control, &mut buffer[..], RecvFlags::DONTWAIT) {
                Ok((_, 0)) => return self.machine.close(),
                Ok((_, len)) => self.execute(Message::decode(&buffer[..len])),
                Err(Errno::AGAIN) => return,
                Err(Errno::INTR) => {}
                Err(_) => return self.machine.close(),
            }
        }
    }

    fn execute(&mut self, message: Option<Message>) {
        match message {
            Some(Message::Guard { generation, writer, readers, damping }) => {
                let Some(datagram) = CommandDatagram::new(writer, damping) else { return };
                if self.machine.guard(generation) {
                    let mut decoded = decode_readers(readers);
                    self.readers = std::array::from_fn(|_| decoded.next());
                    self.datagram = Some(datagram);
                }
            }
            Some(Message::Beat { generation }) => self.machine.beat(generation),
            Some(Message::Release) => self.machine.release(),
            None => {}
        }
    }

    fn damp(&mut self) {
        let Some(datagram) = &mut self.datagram else { return };
        let bytes = datagram.with_number(self.number);
        self.number += 1;
        for reader in self.readers.iter().flatten() {
            // The next datagram follows in 2 ms.
            let _ = self.network.send_to(bytes, reader);
        }
    }
}
