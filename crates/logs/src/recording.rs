//! Built-in recording of a real Go2 with its feet in the air.

use std::path::Path;

use crate::{Log, LogError};

const FILES: [(&str, &[u8]); 3] = [
    ("data.csv.gz", include_bytes!("../../../data/go2_air_chirp/data.csv.gz")),
    ("meta.json", include_bytes!("../../../data/go2_air_chirp/meta.json")),
    ("LICENSE", include_bytes!("../../../data/go2_air_chirp/LICENSE")),
];

/// Writes the recording to a folder, which is created if it does not exist, and reads it.
pub fn unpack(folder: &Path) -> Result<Log, LogError> {
    std::fs::create_dir_all(folder).map_err(|cause| LogError::Write { file: folder.to_owned(), cause })?;
    for (name, bytes) in FILES {
        let file = folder.join(name);
        twinstep_files::write(&file, bytes).map_err(|cause| LogError::Write { file, cause })?;
    }
    Log::open(folder)
}
