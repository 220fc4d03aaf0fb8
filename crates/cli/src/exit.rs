//! Exit codes: 0 success, 2 invalid input, 130 interrupted, 1 any other error.

use std::process::ExitCode;

pub use twinstep_workflows::failure::{Failure, input, other};
pub use twinstep_workflows::signals::Signals;

/// Result of a command.
pub type CommandResult = Result<(), Failure>;

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
