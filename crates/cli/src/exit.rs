//! Exit codes: 0 success, 2 invalid input, 130 interrupted, 1 any other error.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};

/// Reason why a command failed.
#[derive(Debug)]
pub enum Failure {
    /// The user's input is invalid.
    Input(miette::Report),
    /// Any other error.
    Other(miette::Report),
    /// The user pressed Ctrl-C.
    Interrupted,
}

/// Result of a command.
pub type CommandResult = Result<(), Failure>;

/// Wraps an error in the user's input.
pub fn input(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Input(miette::Report::msg(error.to_string()))
}

/// Wraps any other error.
pub fn other(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Other(miette::Report::msg(error.to_string()))
}

/// Prints the error, if any, and returns the exit code.
pub fn code(outcome: CommandResult) -> ExitCode {
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Input(report)) => print_error(&report, 2),
        Err(Failure::Other(report)) => print_error(&report, 1),
        Err(Failure::Interrupted) => ExitCode::from(130),
    }
}

fn print_error(report: &miette::Report, code: u8) -> ExitCode {
    eprintln!("error: {report}");
    ExitCode::from(code)
}

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
