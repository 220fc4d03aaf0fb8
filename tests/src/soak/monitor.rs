//! Samples of a process: memory, threads, open files.

use std::path::PathBuf;

/// State of a process at one time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sample {
    /// Resident memory [KiB].
    pub resident_kib: u64,
    /// Resident memory that no file backs: heap and stacks [KiB].
    pub anonymous_kib: u64,
    /// Number of threads.
    pub threads: u64,
    /// Number of open files, including connections.
    pub files: u64,
}

impl Sample {
    /// Reads the state of process `id` from `/proc`. Fails if the process has ended.
    pub fn of(id: u32) -> Result<Self, String> {
        let folder = PathBuf::from(format!("/proc/{id}"));
        let text = std::fs::read_to_string(folder.join("status")).map_err(|error| format!("process {id}: {error}"))?;
        let files = std::fs::read_dir(folder.join("fd")).map_err(|error| format!("process {id}: {error}"))?;
        let number = |key: &str| {
            let line = text.lines().find_map(|line| line.strip_prefix(key)?.split_whitespace().next());
            line.and_then(|word| word.parse().ok()).ok_or_else(|| format!("process {id} has no `{key}`"))
        };
        Ok(Self {
            resident_kib: number("VmRSS:")?,
            anonymous_kib: number("RssAnon:")?,
            threads: number("Threads:")?,
            files: files.count() as u64,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_and_files_of_this_process_are_counted() {
        let before = Sample::of(std::process::id()).expect("this process runs");
        assert!(before.resident_kib >= before.anonymous_kib && before.anonymous_kib > 0 && before.threads > 0);
        let files: Vec<_> = (0..100).map(|_| std::fs::File::open("/proc/self/status").expect("a file")).collect();
        let after = Sample::of(std::process::id()).expect("this process runs");
        // Other tests of this process open and close files, too.
        assert!(after.files > before.files + 50, "{before:?} {after:?}");
        drop(files);
    }
}
