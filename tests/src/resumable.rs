//! Runs commands of `twinstep` whose results are kept, so that a campaign of many continues after an interruption.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Instant;

use serde_json::Value;

use crate::python::root;

/// Result of a step; the error says which command failed.
pub type Step<T = ()> = Result<T, String>;

/// Program `twinstep` and the folder of the results. `ledger.csv` there has the command and the time of each step.
#[derive(Clone, Debug)]
pub struct Resumable {
    /// Path of `twinstep`.
    pub twinstep: PathBuf,
    /// Folder of all results.
    pub folder: PathBuf,
}

impl Resumable {
    /// Creates the folder. `twinstep` is the program beside this one.
    pub fn new(folder: &Path) -> Step<Self> {
        // The commands run in the folder of the repository.
        let folder = std::path::absolute(folder).map_err(text)?;
        std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        let twinstep = std::env::current_exe().map_err(text)?.with_file_name("twinstep");
        Ok(Self { twinstep, folder })
    }

    /// Returns a path in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// Runs `twinstep` with `--out`, unless its result exists. A training that was interrupted continues.
    pub fn step(&self, result: &Path, arguments: &[&str], out: &Path) -> Step {
        if result.exists() {
            return Ok(());
        }
        let out = out.display().to_string();
        if Path::new(&out).join("checkpoint.safetensors").exists() {
            return self.run(&["train", "--resume", "--out", &out]).map(drop);
        }
        self.run(&[arguments, &["--out", &out]].concat()).map(drop)
    }

    /// Trains a task on the nominal Go2, by the command of `data/policies`; `turn` is that of `jump_turn`. Returns the folder of
    /// the training, whose checkpoint has the critic that fine-tuning needs.
    pub fn nominal(&self, task: &str) -> Step<PathBuf> {
        let out = self.path("nominal").join(task);
        let arguments: &[&str] = match task {
            "walk" => &["walk", "--seed", "4"],
            "jump" => &["jump", "--seed", "1", "--steps", "20000000"],
            "turn" => &["jump", "--config", "data/policies/jump_turn.toml", "--seed", "1", "--steps", "20000000"],
            "attitude" => &["attitude", "--seed", "1", "--steps", "10000000"],
            _ => &[task, "--seed", "1", "--steps", "30000000"],
        };
        self.step(&out.join("evaluation.json"), &[&["train"], arguments].concat(), &out)?;
        Ok(out)
    }

    /// Runs `twinstep` and returns its stdout. Adds its time to the ledger.
    pub fn run(&self, arguments: &[&str]) -> Step<String> {
        let (start, line) = (Instant::now(), arguments.join(" "));
        eprintln!("twinstep {line}");
        let output = Command::new(&self.twinstep).args(arguments).current_dir(root()).output().map_err(text)?;
        if !output.status.success() {
            return Err(format!("twinstep {line}: {}", String::from_utf8_lossy(&output.stderr)));
        }
        let mut ledger =
            std::fs::OpenOptions::new().append(true).create(true).open(self.path("ledger.csv")).map_err(text)?;
        writeln!(ledger, "{:.1},twinstep {line}", start.elapsed().as_secs_f64()).map_err(text)?;
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

/// Prints the table of a campaign, or its error.
pub fn print_result(result: Step<String>) -> ExitCode {
    match result {
        Ok(table) => {
            print!("{table}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Reads a JSON file.
pub fn read(path: &Path) -> Step<Value> {
    let content = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
    serde_json::from_str(&content).map_err(|error| format!("{}: {error}", path.display()))
}

/// Returns a number; NaN if it is none.
pub fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

/// Returns the text of an error.
pub fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}
