//! A log that is written row by row while it is recorded.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use crate::columns::Column;
use crate::csv_table::shortest;
use crate::{LogError, Meta};

/// Writes a log to a folder, as `data.csv` and `meta.json`, one row at a time.
///
/// Every row is handed to the operating system as one complete line, so the folder is a valid log after the first row even
/// if the process is killed.
#[derive(Debug)]
pub struct LogWriter {
    file: File,
    path: PathBuf,
    columns: usize,
    rows: u64,
    line: String,
}

impl LogWriter {
    /// Creates the log in `folder`, which must not exist or be empty. `columns` are in the order of the rows' values.
    ///
    /// Panics if a column is not one of a log: the names are those of the calling program.
    pub fn create(folder: &Path, meta: &Meta, columns: &[String]) -> Result<Self, LogError> {
        for name in columns {
            assert!(Column::parse(name).is_some(), "`{name}` is not a column of a log");
        }
        let failed = |file: &Path| {
            let file = file.to_owned();
            move |cause| LogError::Write { file, cause }
        };
        meta.check(&folder.join("meta.json"))?;
        std::fs::create_dir_all(folder).map_err(failed(folder))?;
        if std::fs::read_dir(folder).map_err(failed(folder))?.next().is_some() {
            return Err(LogError::FolderNotEmpty { folder: folder.to_owned() });
        }
        let (path, meta_path) = (folder.join("data.csv"), folder.join("meta.json"));
        let text = serde_json::to_string_pretty(meta).expect("metadata are plain data") + "\n";
        twinstep_files::write(&meta_path, text).map_err(failed(&meta_path))?;
        let mut file = OpenOptions::new().write(true).create_new(true).open(&path).map_err(failed(&path))?;
        let header = columns.join(",") + "\n";
        file.write_all(header.as_bytes()).map_err(failed(&path))?;
        Ok(Self { file, path, columns: columns.len(), rows: 0, line: String::new() })
    }

    /// Appends a row. A missing cell is NaN.
    ///
    /// Panics if the number of values is not that of the columns.
    pub fn write_row(&mut self, values: &[f64]) -> Result<(), LogError> {
        assert_eq!(values.len(), self.columns, "one value per column");
        self.line.clear();
        for (index, value) in values.iter().enumerate() {
            if index > 0 {
                self.line.push(',');
            }
            self.line.push_str(&shortest(*value));
        }
        self.line.push('\n');
        self.file
            .write_all(self.line.as_bytes())
            .map_err(|cause| LogError::Write { file: self.path.clone(), cause })?;
        self.rows += 1;
        Ok(())
    }

    /// Returns the number of rows so far.
    pub fn rows(&self) -> u64 {
        self.rows
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::BaseMount;

    use super::*;
    use crate::{Gain, Log, Segment, TorqueSensor};

    fn meta() -> Meta {
        let segments = vec![Segment { name: "run".to_owned(), base: BaseMount::Floating }];
        let gain = |value| Some(Gain::Uniform(value));
        Meta { kp: gain(30.0), kd: gain(0.75), ..Meta::new(50.0, TorqueSensor::None, segments) }
    }

    fn columns() -> Vec<String> {
        ["t", "episode", "q_FL_hip", "q_cmd_FL_hip", "gyro_x"].map(str::to_owned).to_vec()
    }

    #[test]
    fn log_is_valid_after_every_row() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("log");
        let mut writer = LogWriter::create(&path, &meta(), &columns()).expect("created");
        for row in 0..3 {
            writer.write_row(&[0.02 * f64::from(row), 0.0, 0.1, 0.2, f64::NAN]).expect("written");
            // The writer is still open, as after SIGKILL.
            let log = Log::open(&path).expect("a log");
            assert_eq!((log.rows() as u64, writer.rows()), (row as u64 + 1, row as u64 + 1));
            assert!(log.channel("gyro_x").expect("a column").iter().all(|cell| cell.is_nan()));
        }
    }

    #[test]
    fn folder_with_files_is_not_overwritten() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("notes.txt"), "mine").expect("written");
        let error = LogWriter::create(folder.path(), &meta(), &columns()).expect_err("not empty");
        assert!(matches!(error, LogError::FolderNotEmpty { .. }), "{error}");
        assert!(!folder.path().join("data.csv").exists());
    }
}
