//! Signals that stop the robot.

use std::sync::Arc;
use std::sync::atomic::{AtomicI32, Ordering};

use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM};
use signal_hook::iterator::Signals;
use twinstep_robot::RobotHandle;

use crate::exit::{CommandResult, Failure, other};

/// SIGHUP, SIGINT, SIGTERM and SIGQUIT, in any number: each damps the motors and ends the process once they are damped.
///
/// A lost ssh link sends SIGHUP. The signals are taken by a thread of their own, which does nothing else.
pub struct StopSignals(Arc<AtomicI32>);

impl StopSignals {
    /// Takes the signals from now on.
    pub fn listen(handle: &RobotHandle) -> Result<Self, Failure> {
        let mut signals = Signals::new([SIGHUP, SIGINT, SIGTERM, SIGQUIT]).map_err(other)?;
        let (first, handle) = (Arc::new(AtomicI32::new(0)), handle.clone());
        let taken = Arc::clone(&first);
        let thread = std::thread::Builder::new().name("signals".to_owned());
        let spawned = thread.spawn(move || {
            for signal in &mut signals {
                handle.stop();
                handle.end();
                let is_first = taken.compare_exchange(0, signal, Ordering::AcqRel, Ordering::Acquire).is_ok();
                // The damping was sent; what the process still waits for is not worth a second Ctrl-C.
                if !is_first && handle.has_ended() {
                    std::process::exit(130);
                }
            }
        });
        spawned.map_err(other)?;
        Ok(Self(first))
    }

    /// Returns how the process ends: interrupted after SIGINT and SIGQUIT.
    pub fn outcome(&self) -> CommandResult {
        match self.0.load(Ordering::Acquire) {
            SIGINT | SIGQUIT => Err(Failure::Interrupted),
            _ => Ok(()),
        }
    }
}
