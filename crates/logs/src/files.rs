//! Files of a log: the data file and its metadata.

use std::path::{Path, PathBuf};

use crate::LogError;

/// Format of the data file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    Csv,
    CsvGz,
    Parquet,
    Mcap,
}

/// Files of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Files {
    pub data: PathBuf,
    pub format: Format,
    /// Metadata file; `None` if it does not exist, or if the format contains the metadata.
    pub meta: Option<PathBuf>,
}

const ENDINGS: [(&str, Format); 4] =
    [(".parquet", Format::Parquet), (".csv", Format::Csv), (".csv.gz", Format::CsvGz), (".mcap", Format::Mcap)];

/// Extensions of other file formats; a path with one of them is not a folder to create.
const FOREIGN: [&str; 14] =
    ["bag", "db3", "feather", "gz", "h5", "hdf5", "json", "mat", "npy", "npz", "pkl", "tsv", "txt", "xlsx"];

impl Files {
    /// Finds the files of a log from its folder or its data file.
    pub fn find(path: &Path) -> Result<Files, LogError> {
        let data = if path.is_dir() { data_file_in(path)? } else { path.to_owned() };
        if !data.is_file() {
            return Err(LogError::NoData { path: path.into() });
        }
        let (stem, format) = split(&data).ok_or_else(|| LogError::UnknownFormat { file: data.clone() })?;
        let meta = meta_names(stem).map(|name| data.with_file_name(name)).into_iter().find(|meta| meta.is_file());
        Ok(Files { data, format, meta })
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
            return Ok(Files { data: path.to_owned(), format, meta });
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
        Ok(Files { data: path.join("data.parquet"), format: Format::Parquet, meta: Some(path.join("meta.json")) })
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

fn data_files_in(folder: &Path) -> Vec<String> {
    let names = ENDINGS.iter().map(|(ending, _)| format!("data{ending}"));
    names.filter(|name| folder.join(name).is_file()).collect()
}
