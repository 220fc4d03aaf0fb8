//! Opening of a measured log, with its warnings on stderr.

use std::path::Path;

use twinstep_logs::Log;

use crate::exit::{Failure, input};

/// Opens the log at `path` for a simulation or a fit, and prints what was ignored in it and what is wrong with it.
///
/// Fails if no result can be right. Rows in which the sensors repeat are left out.
pub fn open_log(path: &Path) -> Result<Log, Failure> {
    let log = Log::open(path).map_err(input)?;
    for note in log.read_warnings() {
        eprintln!("note: {}: {note}", path.display());
    }
    for problem in log.problems() {
        if problem.is_fatal {
            return Err(Failure::Input(miette::miette!("{}: {}", path.display(), problem.text)));
        }
        eprintln!("warning: {}: {}", path.display(), problem.text);
    }
    Ok(log.repeats().map_or_else(|| log.clone(), |repeats| log.without_repeats(&repeats)))
}
