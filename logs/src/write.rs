//! Writing a log: whole files or none.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::files::{Files, Format};
use crate::{Log, LogError, csv_table, mcap_file, parquet_table};

impl Log {
    /// Writes the log to a data file (`*.parquet`, `*.csv`, `*.csv.gz` or `*.mcap`) and its description, or to a folder.
    ///
    /// MCAP carries the description itself, holds time to the nanosecond and numbers in single precision, and lacks the
    /// columns that [`Log::left_out_of`] names.
    ///
    /// The description of `data.*` is `meta.json`, that of `walk.*` is `walk.json`. A path with another ending is a
    /// folder, made if need be, which gets `data.parquet` and `meta.json`. Both files are complete before either
    /// takes its name. Columns in [`Log::ignored`] are not written.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<(), LogError> {
        let files = Files::choose(path.as_ref())?;
        let data = Unfinished::create(&files.data)?;
        self.write_data(&data, files.format)?;
        let Some(meta_file) = files.meta else { return data.finish() };
        let meta = Unfinished::create(&meta_file)?;
        self.write_meta(&meta).map_err(|cause| LogError::Write { file: meta_file, cause })?;
        data.finish()?;
        meta.finish()
    }

    /// The columns that the format of the data file `path` cannot hold.
    pub fn unsupported_columns(&self, path: impl AsRef<Path>) -> Vec<String> {
        match Files::choose(path.as_ref()) {
            Ok(Files { format: Format::Mcap, .. }) => mcap_file::left_out(self),
            _ => Vec::new(),
        }
    }

    fn write_data(&self, data: &Unfinished, format: Format) -> Result<(), LogError> {
        let refused = |cause| LogError::Write { file: data.target.clone(), cause };
        let columns = self.columns();
        let mut target = BufWriter::new(&data.file);
        match format {
            Format::Csv => csv_table::write(&columns, &mut target).map_err(refused)?,
            Format::CsvGz => {
                let mut gz = flate2::write::GzEncoder::new(&mut target, flate2::Compression::default());
                csv_table::write(&columns, &mut gz).and_then(|()| gz.finish().map(drop)).map_err(refused)?;
            }
            Format::Parquet => parquet_table::write(&columns, &mut target)
                .map_err(|cause| LogError::Parquet { file: data.target.clone(), cause })?,
            Format::Mcap => mcap_file::write(self, &data.target, &mut target)?,
        }
        target.flush().map_err(refused)
    }

    fn write_meta(&self, meta: &Unfinished) -> io::Result<()> {
        let mut text = serde_json::to_string_pretty(&self.meta)?;
        text.push('\n');
        (&meta.file).write_all(text.as_bytes())
    }
}

/// A file under another name until it is complete; removed if it never is.
struct Unfinished {
    file: File,
    temporary: PathBuf,
    target: PathBuf,
}

impl Unfinished {
    fn create(target: &Path) -> Result<Unfinished, LogError> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let refused = |cause| LogError::Write { file: target.into(), cause };
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let temporary = target.with_file_name(format!(".{name}.{}-{count}.part", std::process::id()));
        if let Some(folder) = target.parent() {
            fs::create_dir_all(folder).map_err(refused)?;
        }
        let file = File::create(&temporary).map_err(refused)?;
        Ok(Unfinished { file, temporary, target: target.into() })
    }

    fn finish(self) -> Result<(), LogError> {
        // The name must not reach the disk before the content.
        let renamed = self.file.sync_all().and_then(|()| fs::rename(&self.temporary, &self.target));
        renamed.map_err(|cause| LogError::Write { file: self.target.clone(), cause })
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        // After a rename there is nothing left under this name, and a failure here has no better answer.
        let _ = fs::remove_file(&self.temporary);
    }
}
