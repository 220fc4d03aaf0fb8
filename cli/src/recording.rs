//! The built-in recording of a real Go2 in the air, so that the program needs no files.

use std::path::Path;

use twinstep_logs::Log;

use crate::exit::{Failure, input, other};

const FILES: [(&str, &[u8]); 3] = [
    ("data.csv.gz", include_bytes!("../../data/go2_air_chirp/data.csv.gz")),
    ("meta.json", include_bytes!("../../data/go2_air_chirp/meta.json")),
    ("LICENSE", include_bytes!("../../data/go2_air_chirp/LICENSE")),
];

/// Writes the recording to a folder, which is made where there is none, and reads it.
pub fn unpack(folder: &Path) -> Result<Log, Failure> {
    std::fs::create_dir_all(folder).map_err(input)?;
    for (name, bytes) in FILES {
        std::fs::write(folder.join(name), bytes).map_err(input)?;
    }
    Log::open(folder).map_err(other)
}
