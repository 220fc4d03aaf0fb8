//! Files of a log: the data file and its metadata.

use std::path::{Path, PathBuf};

use crate::LogError;

/// Format of the data file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Csv,
    CsvGz,
    Parquet,
    /// MCAP, or SQLite as rosbag2 writes it.
    Mcap,
}

/// Files of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Files {
    pub data: PathBuf,
    /// Further parts of a recording that was split.
    pub more: Vec<PathBuf>,
    pub format: Format,
    /// Metadata file; `None` if it does not exist, or if the format contains the metadata.
    pub meta: Option<PathBuf>,
}

const ENDINGS: [(&str, Format); 4] =
    [(".parquet", Format::Parquet), (".csv", Format::Csv), (".csv.gz", Format::CsvGz), (".mcap", Format::Mcap)];
/// Endings of the files of a bag of rosbag2.
const BAG_ENDINGS: [&str; 2] = ["mcap", "db3"];

/// Extensions of other file formats; a path with one of them is not a folder to create.
const FOREIGN: [&str; 14] =
    ["bag", "db3", "feather", "gz", "h5", "hdf5", "json", "mat", "npy", "npz", "pkl", "tsv", "txt", "xlsx"];

impl Files {
    /// Finds the files of a log from its folder or its data file.
    pub fn find(path: &Path) -> Result<Files, LogError> {
        if path.is_dir() && data_files_in(path).is_empty() {
            let parts = bag_files_in(path);
            let stems: std::collections::BTreeSet<String> = parts.iter().map(|part| bag_name(part)).collect();
            if stems.len() > 1 {
                let found = parts.iter().filter_map(|part| part.file_name()?.to_str().map(str::to_owned)).collect();
                return Err(LogError::SeveralDataFiles { folder: path.into(), found });
            }
            if let Some((first, rest)) = parts.split_first() {
                let meta = Some(path.join("meta.json")).filter(|meta| meta.is_file());
                return Ok(Files { data: first.clone(), more: rest.to_vec(), format: Format::Mcap, meta });
            }
        }
        let data = if path.is_dir() { data_file_in(path)? } else { path.to_owned() };
        if !data.is_file() {
            return Err(LogError::NoData { path: path.into() });
        }
        if data.extension().is_some_and(|end| end == "db3") {
            let meta = ["meta.json", "data.json"].map(|name| data.with_file_name(name));
            let meta = meta.into_iter().find(|meta| meta.is_file());
            return Ok(Files { data, more: Vec::new(), format: Format::Mcap, meta });
        }
        let (stem, format) = split(&data).ok_or_else(|| LogError::UnknownFormat { file: data.clone() })?;
        let meta = meta_names(stem).map(|name| data.with_file_name(name)).into_iter().find(|meta| meta.is_file());
        Ok(Files { data, more: Vec::new(), format, meta })
    }

    /// Returns the preferred path of the metadata.
    pub fn expected_meta(&self) -> PathBuf {
        let stem = split(&self.data).map_or("data", |(stem, _)| stem);
        let [preferred, _] = meta_names(stem);
        self.data.with_file_name(preferred)
    }

    /// Chooses the files to write from the path of a data file or a folder.
    pub fn choose(path: &Path) -> Result<Files, LogError> {
        if let Some((stem, format)) = split(path) {
            let [meta, _] = meta_names(stem);
            // MCAP files contain their metadata.
            let meta = (format != Format::Mcap).then(|| path.with_file_name(meta));
            return Ok(Files { data: path.to_owned(), more: Vec::new(), format, meta });
        }
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        if ending.is_some_and(|ending| FOREIGN.contains(&ending.as_str())) && !path.is_dir() {
            return Err(LogError::UnknownFormat { file: path.into() });
        }
        let mut found = data_files_in(path);
        found.retain(|name| name != "data.parquet");
        if !found.is_empty() {
            found.push("data.parquet".to_owned());
            return Err(LogError::SeveralDataFiles { folder: path.into(), found });
        }
        Ok(Files {
            data: path.join("data.parquet"),
            more: Vec::new(),
            format: Format::Parquet,
            meta: Some(path.join("meta.json")),
        })
    }
}

/// Returns the name of a data file without its extension, and its format.
fn split(path: &Path) -> Option<(&str, Format)> {
    let name = path.file_name()?.to_str()?;
    ENDINGS.iter().find_map(|(ending, format)| {
        let stem = name.strip_suffix(ending)?;
        (!stem.is_empty()).then_some((stem, *format))
    })
}

/// Returns the names of a data file's metadata: the one that is written, then the other one that is accepted.
///
/// `meta.json` belongs to `data.*`. Other names have their own metadata, so one folder can contain several logs.
fn meta_names(stem: &str) -> [String; 2] {
    let (shared, own) = ("meta.json".to_owned(), format!("{stem}.json"));
    if stem == "data" { [shared, own] } else { [own, shared] }
}

/// Returns the file of the log at `input` that writing a log to `output` would overwrite, if any.
pub fn overwritten_file(input: &Path, output: &Path) -> Result<Option<PathBuf>, LogError> {
    let (input, output) = (Files::find(input)?, Files::choose(output)?);
    let of = |files: Files| [Some(files.data), files.meta].into_iter().flatten();
    let written: Vec<_> = of(output).filter_map(|file| file.canonicalize().ok()).collect();
    Ok(of(input).find(|file| file.canonicalize().is_ok_and(|file| written.contains(&file))))
}

fn data_file_in(folder: &Path) -> Result<PathBuf, LogError> {
    let found = data_files_in(folder);
    match found.as_slice() {
        [] => Err(LogError::NoData { path: folder.into() }),
        [name] => Ok(folder.join(name)),
        _ => Err(LogError::SeveralDataFiles { folder: folder.into(), found }),
    }
}

/// Returns the name of a bag from that of a part: `walk` for `walk_3.mcap`.
fn bag_name(part: &Path) -> String {
    let stem = part.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    match stem.rsplit_once('_') {
        Some((name, number)) if number.chars().all(|digit| digit.is_ascii_digit()) => name.to_owned(),
        _ => stem,
    }
}

/// Returns the parts of a bag of rosbag2 (`NAME_0.mcap`, `NAME_1.mcap`, ...), in their order.
fn bag_files_in(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let all: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    for ending in BAG_ENDINGS {
        let mut parts: Vec<PathBuf> = all
            .iter()
            .filter(|path| path.is_file() && path.extension().is_some_and(|end| end == ending))
            .cloned()
            .collect();
        let number = |path: &PathBuf| {
            let stem = path.file_stem()?.to_str()?;
            stem.rsplit('_').next()?.parse::<u64>().ok()
        };
        parts.sort_by_key(|path| (number(path), path.clone()));
        if !parts.is_empty() {
            return parts;
        }
    }
    Vec::new()
}

fn data_files_in(folder: &Path) -> Vec<String> {
    let names = ENDINGS.iter().map(|(ending, _)| format!("data{ending}"));
    names.filter(|name| folder.join(name).is_file()).collect()
}
