//! Checks of arguments that all engines share.

use twinstep_model::{BackendError, Command};

use crate::SimConfig;

/// Checks that there are one command and one flag per robot.
pub fn check_lengths(commands: &[Command], active: &[bool], robots: usize) -> Result<(), BackendError> {
    for (field, given) in [("commands", commands.len()), ("active", active.len())] {
        if given != robots {
            return Err(BackendError::WrongLength { field, given, expected: robots });
        }
    }
    Ok(())
}

/// Checks that the base of a robot can be pushed.
pub fn check_floating(robot: usize, config: &SimConfig) -> Result<(), BackendError> {
    if config.base.is_fixed() {
        return Err(BackendError::CannotPush { robot, reason: "its base is fixed" });
    }
    Ok(())
}
