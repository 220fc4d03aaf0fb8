//! Writing logs. Files are written completely or not at all.

use std::fs;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use twinstep_files::PartialFile;

use crate::files::{Files, Format};
use crate::{Log, LogError, csv_table, mcap_file, parquet_table};

impl Log {
    /// Writes the log to a data file (`*.parquet`, `*.csv`, `*.csv.gz` or `*.mcap`) and its metadata, or to a folder.
    ///
    /// An MCAP file contains the metadata. Its resolution is 1 ns in time and single precision in all numbers. It lacks
    /// the columns in [`Log::unsupported_columns`].
    ///
    /// The metadata of `data.*` is `meta.json`, that of `walk.*` is `walk.json`. A path with another extension is a
    /// folder, created if it does not exist, for `data.parquet` and `meta.json`. Both files are written under temporary
    /// names and then renamed. Columns in [`Log::ignored`] are not written.
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

    /// Returns the columns that the format of the data file `path` does not support.
    pub fn unsupported_columns(&self, path: impl AsRef<Path>) -> Vec<String> {
        match Files::choose(path.as_ref()) {
            Ok(Files { format: Format::Mcap, .. }) => mcap_file::unsupported_columns(self),
            _ => Vec::new(),
        }
    }

    fn write_data(&self, data: &Unfinished, format: Format) -> Result<(), LogError> {
        let refused = |cause| LogError::Write { file: data.target.clone(), cause };
        let columns = self.columns();
        let mut target = BufWriter::new(&data.file.file);
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
        (&meta.file.file).write_all(text.as_bytes())
    }
}

/// File of a log until it is complete.
struct Unfinished {
    file: PartialFile,
    target: PathBuf,
}

impl Unfinished {
    fn create(target: &Path) -> Result<Unfinished, LogError> {
        let refused = |cause| LogError::Write { file: target.into(), cause };
        if let Some(folder) = target.parent() {
            fs::create_dir_all(folder).map_err(refused)?;
        }
        Ok(Unfinished { file: PartialFile::create(target).map_err(refused)?, target: target.into() })
    }

    fn finish(self) -> Result<(), LogError> {
        self.file.finish().map_err(|cause| LogError::Write { file: self.target, cause })
    }
}
