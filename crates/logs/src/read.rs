//! Reading logs from files, and creating logs from columns in memory.

use std::path::Path;

use crate::check::{self, LogKind};
use crate::column_map::ColumnMap;
use crate::files::{Files, Format};
use crate::limited::Limited;
use crate::meta::KEYS;
use crate::table::Table;
use crate::{Log, LogError, Meta, csv_table, mcap_file, parquet_table};

impl Log {
    /// Reads a log from its folder or its data file.
    ///
    /// A folder is a bag of rosbag2 (`*.mcap`, `*.db3`), or contains `meta.json` and one of `data.parquet`, `data.csv`, `data.csv.gz` and `data.mcap`. The metadata
    /// of a data file `walk.csv` is `walk.json` or `meta.json` in the same folder. MCAP needs no metadata file: a file
    /// that [`Log::write`] wrote contains its metadata, and for other recordings default metadata are used.
    pub fn open(path: impl AsRef<Path>) -> Result<Log, LogError> {
        read(path.as_ref(), LogKind::Measurement, &ColumnMap::default())
    }

    /// Reads a log whose columns have other names or units, as the map says.
    pub fn open_mapped(path: impl AsRef<Path>, map: &ColumnMap) -> Result<Log, LogError> {
        read(path.as_ref(), LogKind::Measurement, map)
    }

    /// Reads a recording that may lack commands, to describe it. Nothing can be simulated from it.
    pub fn open_states(path: impl AsRef<Path>, map: &ColumnMap) -> Result<Log, LogError> {
        read(path.as_ref(), LogKind::States, map)
    }

    /// Reads a motion file: a log that needs only command columns, and no gains.
    ///
    /// A measured log is also a valid motion file.
    pub fn open_commands(path: impl AsRef<Path>) -> Result<Log, LogError> {
        read(path.as_ref(), LogKind::Commands, &ColumnMap::default())
    }

    /// Creates a log from columns in memory, validated like a file. A missing cell is NaN.
    pub fn new(meta: Meta, columns: impl IntoIterator<Item = (String, Vec<f64>)>) -> Result<Log, LogError> {
        from_columns(meta, columns, LogKind::Measurement)
    }

    /// Creates a log from command columns in memory, as [`Log::open_commands`] reads them.
    pub fn new_commands(meta: Meta, columns: impl IntoIterator<Item = (String, Vec<f64>)>) -> Result<Log, LogError> {
        from_columns(meta, columns, LogKind::Commands)
    }
}

fn read(path: &Path, need: LogKind, map: &ColumnMap) -> Result<Log, LogError> {
    let files = Files::find(path)?;
    let (meta, unknown) = match files.meta.as_deref().map(Meta::read).transpose()? {
        Some((meta, unknown)) => (Some(meta), unknown),
        None => (map.meta(), Vec::new()),
    };
    let meta_file = files.meta.as_ref().unwrap_or(&files.data);
    let needed = |meta: Option<Meta>| {
        meta.ok_or_else(|| LogError::NoMeta { expected: files.expected_meta(), data: files.data.clone() })
    };
    let open = || std::fs::File::open(&files.data).map_err(|cause| LogError::Read { file: files.data.clone(), cause });
    let mut is_recording = false;
    let (mut table, meta) = match files.format {
        Format::Csv => (csv_table::read(&files.data, open()?, map)?, needed(meta)?),
        Format::CsvGz => {
            let file = open()?;
            let length = file.metadata().map_err(|cause| LogError::Read { file: files.data.clone(), cause })?.len();
            let limit = mcap_file::length_limit(length) as u64;
            let content = Limited::new(flate2::read::MultiGzDecoder::new(file), limit);
            (csv_table::read(&files.data, content, map)?, needed(meta)?)
        }
        Format::Parquet => (parquet_table::read(&files.data, map)?, needed(meta)?),
        Format::Mcap => {
            let parts = [std::slice::from_ref(&files.data), &files.more].concat();
            let (table, meta, is_written) = mcap_file::read(&parts, meta, need != LogKind::States)?;
            is_recording = !is_written;
            (table, meta)
        }
    };
    table.notes.extend(
        unknown.iter().map(|key| {
            format!("unknown key `{key}` of the meta file is ignored; the known keys are {}", KEYS.join(", "))
        }),
    );
    let log = check::assemble(table, meta, meta_file, need)?;
    // A torque that repeats is taken as known at the times of its messages.
    Ok(if is_recording && log.repeats().is_none() { log.with_torques_before_messages() } else { log })
}

fn from_columns(
    meta: Meta,
    columns: impl IntoIterator<Item = (String, Vec<f64>)>,
    need: LogKind,
) -> Result<Log, LogError> {
    // Errors show this instead of a path.
    let here = Path::new("columns in memory");
    meta.check(here)?;
    let (names, cells): (Vec<_>, Vec<_>) = columns.into_iter().unzip();
    let (mut table, indices) = Table::from_header(here, &names)?;
    for (cells, index) in cells.into_iter().zip(indices) {
        if let Some(index) = index {
            table.columns[index].1 = cells;
        }
    }
    check::assemble(table, meta, here, need)
}
