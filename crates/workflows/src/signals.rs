//! SIGINT and SIGTERM.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};

use crate::failure::{Failure, other};

/// Time from a signal to the end of a command that is still busy.
const PATIENCE: Duration = Duration::from_millis(900);
/// Interval at which a signal is looked for.
const TICK: Duration = Duration::from_millis(50);

/// SIGINT and SIGTERM. The program handles the first one; a second one terminates it at once.
///
/// A command that has not ended by itself within a second is ended: its files are whole at any time.
pub struct Signals {
    last: Arc<AtomicUsize>,
    flag: Arc<AtomicBool>,
}

impl Signals {
    /// Registers the handlers of SIGINT and SIGTERM.
    pub fn listen() -> Result<Self, Failure> {
        let signals = Self::listen_unhurried()?;
        let last = Arc::clone(&signals.last);
        let wait = move || {
            while last.load(Ordering::Acquire) == 0 {
                std::thread::sleep(TICK);
            }
            std::thread::sleep(PATIENCE);
            eprintln!("interrupted; files that were complete are kept");
            std::process::exit(130);
        };
        std::thread::Builder::new().name("interrupt".to_owned()).spawn(wait).map_err(other)?;
        Ok(signals)
    }

    /// Registers the handlers for a command that others use, and that ends by itself however long it takes.
    pub fn listen_unhurried() -> Result<Self, Failure> {
        let (last, flag) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        for signal in [SIGINT, SIGTERM] {
            let armed = Arc::new(AtomicBool::new(false));
            signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&armed)).map_err(other)?;
            signal_hook::flag::register(signal, armed).map_err(other)?;
            signal_hook::flag::register_usize(signal, Arc::clone(&last), signal as usize).map_err(other)?;
            signal_hook::flag::register(signal, Arc::clone(&flag)).map_err(other)?;
        }
        Ok(Self { last, flag })
    }

    /// Returns signals that never come, for programs that handle them themselves.
    pub fn none() -> Self {
        Self { last: Arc::default(), flag: Arc::default() }
    }

    /// Returns a flag that is true after either signal.
    pub fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.flag)
    }

    /// Returns `Err(Interrupted)` after a SIGINT, `Ok(true)` after a SIGTERM, and `Ok(false)` before either.
    pub fn check(&self) -> Result<bool, Failure> {
        match self.last.load(Ordering::Acquire) as i32 {
            SIGINT => Err(Failure::Interrupted),
            SIGTERM => Ok(true),
            _ => Ok(false),
        }
    }
}
