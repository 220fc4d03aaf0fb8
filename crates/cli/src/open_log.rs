//! Opening of a measured log, with its warnings on stderr.

use std::path::Path;

use twinstep_logs::Log;

use crate::exit::{Failure, input};

/// Opens the log at `path` and prints what was ignored in it.
pub fn open_log(path: &Path) -> Result<Log, Failure> {
    let log = Log::open(path).map_err(input)?;
    for note in log.read_warnings() {
        eprintln!("note: {}: {note}", path.display());
    }
    Ok(log)
}
