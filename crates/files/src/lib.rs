//! Files that are whole: after an error, a kill or a power failure a path has its old content or the new one.
//!
//! A file is written under a temporary name in its folder, stored on the disk, renamed, and the folder is stored. Every result of
//! Twinstep is written by [`write()`], or by a [`PartialFile`] if it is written in pieces.

use std::ffi::OsString;
use std::fs::File;
use std::io::{Error, Result, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Writes a file.
pub fn write(path: impl AsRef<Path>, content: impl AsRef<[u8]>) -> Result<()> {
    let mut partial = PartialFile::create(path.as_ref())?;
    partial.file.write_all(content.as_ref())?;
    partial.finish()
}

/// File under a temporary name until it is complete. Dropping it removes an incomplete file.
#[derive(Debug)]
pub struct PartialFile {
    /// The file.
    pub file: File,
    temporary: PathBuf,
    target: PathBuf,
}

impl PartialFile {
    /// Creates a file in the folder of `target`, which must exist.
    pub fn create(target: &Path) -> Result<Self> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let name = target.file_name().ok_or_else(|| Error::other("the path has no file name"))?;
        let mut temporary = OsString::from(".");
        temporary.push(name);
        temporary.push(format!(".{}-{}.part", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed)));
        let temporary = target.with_file_name(temporary);
        Ok(Self { file: File::create(&temporary)?, temporary, target: target.to_owned() })
    }

    /// Gives the file its name.
    pub fn finish(self) -> Result<()> {
        self.file.sync_all()?;
        std::fs::rename(&self.temporary, &self.target)?;
        store_folder(&self.target)
    }
}

impl Drop for PartialFile {
    fn drop(&mut self) {
        // After the rename this file does not exist. Another failure cannot be handled here.
        let _ = std::fs::remove_file(&self.temporary);
    }
}

/// Renames a file, or a folder of files, once its content is stored.
pub fn complete(partial: &Path, path: &Path) -> Result<()> {
    store(partial)?;
    std::fs::rename(partial, path)?;
    store_folder(path)
}

/// Gives the file at `path`, if there is one, the second name `previous`, which keeps its content when `path` is written again.
pub fn keep_previous(path: &Path, previous: &Path) -> Result<()> {
    if !path.exists() {
        return Ok(());
    }
    let partial = PartialFile::create(previous)?;
    std::fs::remove_file(&partial.temporary)?;
    // Not every file system has links.
    std::fs::hard_link(path, &partial.temporary).or_else(|_| std::fs::copy(path, &partial.temporary).map(drop))?;
    complete(&partial.temporary, previous)
}

fn store(path: &Path) -> Result<()> {
    if path.is_dir() {
        for entry in std::fs::read_dir(path)? {
            store(&entry?.path())?;
        }
    }
    File::open(path)?.sync_all()
}

fn store_folder(path: &Path) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).expect("a folder");
        let mut names: Vec<_> =
            entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("text")).collect();
        names.sort();
        names
    }

    #[test]
    fn file_is_replaced_as_a_whole_and_leaves_no_other_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("result.json");
        write(&path, "old").expect("written");
        write(&path, b"new").expect("written");
        assert_eq!(
            (std::fs::read(&path).expect("a file"), names(folder.path())),
            (b"new".to_vec(), vec!["result.json".to_owned()])
        );
        drop(PartialFile::create(&path).expect("a file"));
        assert_eq!(names(folder.path()), ["result.json"], "an incomplete file is removed");
        assert!(write(folder.path().join("none/result.json"), "").is_err());
        assert!(write("/", "").is_err());
    }

    #[test]
    fn previous_file_keeps_its_content() {
        let folder = tempfile::tempdir().expect("a folder");
        let [path, previous] = ["now", "before"].map(|name| folder.path().join(name));
        keep_previous(&path, &previous).expect("there is none yet");
        for content in ["1", "2", "3"] {
            keep_previous(&path, &previous).expect("kept");
            write(&path, content).expect("written");
        }
        let read = |path| std::fs::read_to_string(path).expect("a file");
        assert_eq!((read(&path), read(&previous)), ("3".to_owned(), "2".to_owned()));
        assert_eq!(names(folder.path()), ["before", "now"]);
    }
}
