//! How a command ends: 0 done, 2 bad input, 130 interrupted, 1 anything else.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};

/// Why a command did not end well.
#[derive(Debug)]
pub enum Failure {
    /// The user's input is at fault.
    Input(miette::Report),
    /// Something else is.
    Other(miette::Report),
    /// Ctrl-C.
    Interrupted,
}

/// What a command returns.
pub type CommandResult = Result<(), Failure>;

/// An error of the user's input.
pub fn input(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Input(miette::Report::msg(error.to_string()))
}

/// Any other error.
pub fn other(error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Other(miette::Report::msg(error.to_string()))
}

/// Tells the user, and the shell.
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

/// The signals that ask to end. The first is left to the program; a second one ends it at once.
pub struct Signals(Arc<AtomicUsize>);

impl Signals {
    /// Starts to listen for SIGINT and SIGTERM.
    pub fn listen() -> Result<Self, Failure> {
        let last = Arc::new(AtomicUsize::new(0));
        for signal in [SIGINT, SIGTERM] {
            let armed = Arc::new(AtomicBool::new(false));
            signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&armed)).map_err(other)?;
            signal_hook::flag::register(signal, armed).map_err(other)?;
            signal_hook::flag::register_usize(signal, Arc::clone(&last), signal as usize).map_err(other)?;
        }
        Ok(Self(last))
    }

    /// `Err(Interrupted)` after a SIGINT, `Ok(true)` after a SIGTERM, `Ok(false)` before any.
    pub fn check(&self) -> Result<bool, Failure> {
        match self.0.load(Ordering::Acquire) as i32 {
            SIGINT => Err(Failure::Interrupted),
            SIGTERM => Ok(true),
            _ => Ok(false),
        }
    }
}
