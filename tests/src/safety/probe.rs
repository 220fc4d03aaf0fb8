//! Reads the robot's commands as they arrive, on a thread of its own.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use twinstep_robot::dds::{Dds, LOW_CMD};
use twinstep_robot::real_time_thread;
use twinstep_unitree::{LowCmd, decode};

/// Period of the sleeping thread, and of the commands.
const PERIOD: Duration = Duration::from_millis(2);

/// Commands since the start, and the lateness of a sleeping thread with the same scheduling.
#[derive(Clone, Default)]
pub struct Probe {
    /// Arrival of each command, and true if it moves or holds a joint.
    commands: Arc<Mutex<Vec<(Instant, bool)>>>,
    /// Times at which the sleeping thread woke up, and how much too late.
    sleeps: Arc<Mutex<Vec<(Instant, Duration)>>>,
    has_ended: Arc<AtomicBool>,
}

impl Probe {
    /// Starts to read the commands on a domain of this machine.
    pub fn start(domain: u16) -> Result<Self, String> {
        let probe = Self::default();
        let dds = Dds::join(domain, IpAddr::V4(Ipv4Addr::LOCALHOST)).map_err(|error| error.to_string())?;
        let reading = probe.clone();
        let read = move || {
            let Ok(reader) = dds.reader(LOW_CMD, std::thread::current()) else { return };
            while !reading.has_ended.load(Ordering::Acquire) {
                while let Some(payload) = reader.take() {
                    let Ok(command) = decode::<LowCmd>(&payload) else { continue };
                    let holds = command.motor_cmd.iter().any(|motor| motor.kp != 0.0 || motor.tau != 0.0);
                    lock(&reading.commands).push((Instant::now(), holds));
                }
                std::thread::park_timeout(PERIOD);
            }
        };
        let sleeping = probe.clone();
        let sleep = move || {
            while !sleeping.has_ended.load(Ordering::Acquire) {
                let start = Instant::now();
                std::thread::sleep(PERIOD);
                lock(&sleeping.sleeps).push((Instant::now(), start.elapsed().saturating_sub(PERIOD)));
            }
        };
        real_time_thread::spawn("probe", read).map_err(|error| error.to_string())?;
        real_time_thread::spawn("sleeper", sleep).map_err(|error| error.to_string())?;
        Ok(probe)
    }

    /// Returns the first damping command after `since`, and the number of them without another command between.
    pub fn damping_after(&self, since: Instant) -> Option<(Instant, usize)> {
        let commands = lock(&self.commands);
        let after = commands.iter().skip_while(|(at, _)| *at < since).skip_while(|(_, holds)| *holds);
        let dampings: Vec<Instant> = after.take_while(|(_, holds)| !holds).map(|(at, _)| *at).collect();
        dampings.first().map(|first| (*first, dampings.len()))
    }

    /// Returns the time of the last command that moves or holds a joint.
    pub fn last_holding(&self) -> Option<Instant> {
        lock(&self.commands).iter().rev().find(|(_, holds)| *holds).map(|(at, _)| *at)
    }

    /// Returns the number of commands since `since`.
    pub fn count_since(&self, since: Instant) -> usize {
        lock(&self.commands).iter().filter(|(at, _)| *at >= since).count()
    }

    /// Returns the longest time between two commands, and the largest lateness of the sleeping thread, from `from` to `to`.
    pub fn gaps(&self, from: Instant, to: Instant) -> (Duration, Duration) {
        let is_within = |at: &Instant| (from..=to).contains(at);
        let commands = lock(&self.commands);
        let times = commands.iter().map(|(at, _)| *at).filter(is_within);
        let times: Vec<Instant> = std::iter::once(from).chain(times).chain([to]).collect();
        let gap = times.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or_default();
        (gap, self.lateness(from, to))
    }

    /// Returns the largest lateness of the sleeping thread from `from` to `to`.
    pub fn lateness(&self, from: Instant, to: Instant) -> Duration {
        let sleeps = lock(&self.sleeps);
        let within = sleeps.iter().filter(|(at, _)| (from..=to).contains(at));
        within.map(|(_, late)| *late).max().unwrap_or_default()
    }
}

impl Probe {
    /// Ends the threads.
    pub fn end(&self) {
        self.has_ended.store(true, Ordering::Release);
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
