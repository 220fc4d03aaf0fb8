//! Stages that continue after an interruption: a file exists only when it is complete, also after a power failure.
//!
//! The results are in a folder beside the config file, with copies of the inputs: other inputs are refused.

use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use twinstep_agent::RunSummary;

use crate::failure::{Failure, other};
use crate::observer::Observer;
use crate::record::{RecordOptions, record};

/// Returns the folder of the results of a config file: its path without its extension.
pub fn folder_of(config: &Path) -> Result<PathBuf, Failure> {
    let out = config.with_extension("");
    if out == config {
        let path = out.display();
        return Err(Failure::Input(miette::miette!("`{path}`: the config file needs an extension, such as .toml")));
    }
    Ok(out)
}

/// Says that the same command continues, if it was interrupted.
pub fn ended<T>(result: Result<T, Failure>, observer: &Observer) -> Result<T, Failure> {
    if matches!(result, Err(Failure::Interrupted)) {
        observer.note("interrupted; the same command continues");
    }
    result
}

/// Records the log of a stage and a summary of it, unless both are there. An incomplete log is never kept.
pub fn recorded<T: Serialize + DeserializeOwned>(
    (log, summary): (&Path, &Path),
    seconds: f64,
    recording: impl FnOnce(&Path) -> Result<RecordOptions, Failure>,
    observer: &Observer,
    summarised: impl FnOnce(&RunSummary, &Path) -> Result<T, Failure>,
) -> Result<T, Failure> {
    if log.exists() && summary.exists() {
        return read_json(summary);
    }
    let partial = log.with_extension("partial");
    discard(&partial)?;
    discard(log)?;
    let recorded = record(&recording(&partial)?, observer)?.summary;
    // SIGTERM ends a run as its duration does.
    if observer.check()? || recorded.seconds < seconds - 1e-6 {
        return Err(Failure::Interrupted);
    }
    let found = summarised(&recorded, &partial)?;
    write_json(summary, &found)?;
    complete(&partial, log)?;
    Ok(found)
}

/// Reads a result of an earlier run of the command.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    let wrong = |cause: String| {
        Failure::Input(miette::miette!("cannot read {}: {cause}\n  remove it to repeat its stage", path.display()))
    };
    let text = std::fs::read_to_string(path).map_err(|error| wrong(error.to_string()))?;
    serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))
}

/// Writes a result as JSON.
pub fn write_json(path: &Path, result: &impl Serialize) -> Result<(), Failure> {
    write(path, serde_json::to_string_pretty(result).map_err(other)?.as_bytes())
}

/// Writes a file as a whole.
pub fn write(path: &Path, content: &[u8]) -> Result<(), Failure> {
    twinstep_files::write(path, content).map_err(|cause| unwritable(path, &cause))
}

/// Renames a file, or a folder of files, once its content is stored.
pub fn complete(partial: &Path, path: &Path) -> Result<(), Failure> {
    twinstep_files::complete(partial, path).map_err(|cause| unwritable(path, &cause))
}

/// Removes a file or folder that was not completed, if there is one.
pub fn discard(partial: &Path) -> Result<(), Failure> {
    let removed = match partial.symlink_metadata() {
        Ok(found) if found.is_dir() => std::fs::remove_dir_all(partial),
        Ok(_) => std::fs::remove_file(partial),
        Err(_) => Ok(()),
    };
    removed.map_err(|cause| unwritable(partial, &cause))
}

/// Creates a folder with its parents.
pub fn create_folder(folder: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(folder).map_err(|cause| unwritable(folder, &cause))
}

/// Stores copies of the inputs in the folder `inputs` of `out`, or fails if `out` has results of other inputs.
pub fn keep_inputs(out: &Path, inputs: Vec<(&'static str, Vec<u8>)>) -> Result<(), Failure> {
    let folder = out.join("inputs");
    create_folder(&folder)?;
    for (name, content) in inputs {
        let copy = folder.join(name);
        match std::fs::read(&copy) {
            Ok(earlier) if earlier != content => {
                return Err(Failure::Input(miette::miette!(
                    "{} has results of other inputs: {name} differs\n  restore it from {}, or rename the config file",
                    out.display(),
                    folder.display()
                )));
            }
            Ok(_) => {}
            Err(_) => write(&copy, &content)?,
        }
    }
    Ok(())
}

fn unwritable(path: &Path, cause: &std::io::Error) -> Failure {
    Failure::Input(miette::miette!("cannot write {}: {cause}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_of_a_stage_replaces_its_partial_one_and_other_inputs_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("result.json");
        write(&path, b"1").expect("written");
        assert_eq!(std::fs::read(&path).expect("read"), b"1");
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 1, "no partial file is left");
        keep_inputs(folder.path(), vec![("settings.toml", b"a".to_vec())]).expect("new");
        keep_inputs(folder.path(), vec![("settings.toml", b"a".to_vec())]).expect("the same");
        let Err(Failure::Input(report)) = keep_inputs(folder.path(), vec![("settings.toml", b"b".to_vec())]) else {
            panic!("it is refused")
        };
        assert!(report.to_string().contains("settings.toml differs"), "{report}");
    }
}
