//! Opening of a measured log, with its warnings.

use std::path::Path;

use twinstep_logs::Log;

use crate::failure::{Failure, input};
use crate::observer::Observer;

/// Opens the log at `path` for a simulation or a fit, and notes what was ignored in it and what is wrong with it.
///
/// Fails if no result can be right. Rows in which the sensors repeat are left out.
pub fn open_log(path: &Path, observer: &Observer) -> Result<Log, Failure> {
    let log = Log::open(path).map_err(input)?;
    for note in log.read_warnings() {
        observer.note(format_args!("note: {}: {note}", path.display()));
    }
    for problem in log.problems() {
        if problem.is_fatal {
            return Err(Failure::Input(miette::miette!("{}: {}", path.display(), problem.text)));
        }
        observer.note(format_args!("warning: {}: {}", path.display(), problem.text));
    }
    Ok(log.repeats().map_or_else(|| log.clone(), |repeats| log.without_repeats(&repeats)))
}
