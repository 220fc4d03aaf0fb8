//! The Python environment of the tests, made once and kept in the target folder.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// The environment, or why there is none.
static ENVIRONMENT: OnceLock<Result<PathBuf, String>> = OnceLock::new();

/// The repository's root.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().expect("the crate's folder has a parent")
}

/// The folder with the built programs, `faults` and `twinstep` among them.
pub struct Programs(pub PathBuf);

impl Programs {
    /// The folder of `faults`; builds `twinstep`, which Cargo leaves out of test builds, beside it.
    pub fn beside(faults: &str) -> Result<Self, String> {
        let mut build = Command::new(env!("CARGO"));
        run(outside_cargo(&mut build).args(["build", "--release", "--quiet"]).current_dir(root()))?;
        let folder = Path::new(faults).parent().ok_or("a program has a folder")?.to_owned();
        Ok(Self(folder))
    }
}

/// The interpreter of an environment with everything that the client's tests need; `None`, said on stderr, where there is
/// no Python or no package index. In CI nothing is skipped: there that is an error.
pub fn python(target: &Path) -> Result<Option<PathBuf>, String> {
    match ENVIRONMENT.get_or_init(|| prepare(target)) {
        Ok(python) => Ok(Some(python.clone())),
        Err(reason) if std::env::var_os("CI").is_some() => Err(reason.clone()),
        Err(reason) => {
            // Past the test harness, which hides what passing tests print.
            let _ = writeln!(std::io::stderr(), "\nSKIPPED the Python client's tests: {reason}");
            Ok(None)
        }
    }
}

fn prepare(target: &Path) -> Result<PathBuf, String> {
    let (folder, project) = (target.join("python"), root().join("clients/python/pyproject.toml"));
    let python = folder.join("bin/python");
    let wanted = std::fs::read_to_string(&project).map_err(|error| format!("{}: {error}", project.display()))?;
    let stamp = folder.join("pyproject.toml");
    if std::fs::read_to_string(&stamp).is_ok_and(|installed| installed == wanted) {
        return Ok(python);
    }
    let requirements = requirements(&wanted)?;
    let has_uv = Command::new("uv").arg("--version").output().is_ok();
    if has_uv {
        run(Command::new("uv").args(["venv", "--allow-existing", "--python", ">=3.11"]).arg(&folder))?;
        run(Command::new("uv").args(["pip", "install", "--python"]).arg(&python).args(&requirements))?;
    } else {
        run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
        run(Command::new(&python).args(["-m", "pip", "install", "--quiet"]).args(&requirements))?;
    }
    std::fs::write(&stamp, wanted).map_err(|error| error.to_string())?;
    Ok(python)
}

/// Everything that the package depends on, with all its extras.
fn requirements(pyproject: &str) -> Result<Vec<String>, String> {
    let project: toml::Table = pyproject.parse().map_err(|error| format!("pyproject.toml: {error}"))?;
    let project = &project["project"];
    let extras = project["optional-dependencies"].as_table().into_iter().flatten();
    // The peers of the bench are large, and no test needs them.
    let extras = extras.filter(|(name, _)| *name != "bench").map(|(_, list)| list);
    let lists = std::iter::once(&project["dependencies"]).chain(extras);
    let words = lists.filter_map(toml::Value::as_array).flatten().filter_map(toml::Value::as_str);
    Ok(words.map(str::to_owned).collect())
}

/// Takes away what Cargo tells a test: build scripts that look at it would build their crates, and all above, again.
pub fn outside_cargo(command: &mut Command) -> &mut Command {
    let told = std::env::vars_os().filter_map(|(name, _)| name.into_string().ok());
    for name in told.filter(|name| name.starts_with("CARGO_") && name != "CARGO_HOME") {
        command.env_remove(name);
    }
    command
}

/// Runs a command; an error has what it printed.
pub fn run(command: &mut Command) -> Result<Output, String> {
    let output = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    if output.status.success() {
        return Ok(output);
    }
    let printed = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    Err(format!("{command:?} ended with {}:\n{printed}", output.status))
}
