//! Python environment of the tests, created once in the target folder.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// Interpreter of the environment, or the reason why it could not be created.
static ENVIRONMENT: OnceLock<Result<PathBuf, String>> = OnceLock::new();

/// Returns the root folder of the repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize().expect("the crate's folder has a parent")
}

/// Arguments of Cargo that build `twinstep`.
const BUILD: [&str; 3] = ["build", "--release", "--quiet"];

/// Folder with the built programs, including `faults` and `twinstep`.
pub struct Programs(pub PathBuf);

impl Programs {
    /// Returns the folder of `faults` after building `twinstep` there, which Cargo does not build for tests.
    pub fn beside(faults: &str) -> Result<Self, String> {
        static BUILT: OnceLock<Result<(), String>> = OnceLock::new();
        let build = || run(outside_cargo(&mut Command::new(env!("CARGO"))).args(BUILD).current_dir(root())).map(drop);
        BUILT.get_or_init(build).clone()?;
        let folder = Path::new(faults).parent().ok_or("a program has a folder")?.to_owned();
        Ok(Self(folder))
    }

    /// Returns the program `twinstep`.
    pub fn twinstep(&self) -> PathBuf {
        self.0.join("twinstep")
    }
}

/// Returns the interpreter of an environment with all requirements of the client's tests.
///
/// Returns `None` with a message on stderr if there is no Python or no package index. In CI this is an error.
pub fn python(target: &Path) -> Result<Option<PathBuf>, String> {
    match ENVIRONMENT.get_or_init(|| prepare(target)) {
        Ok(python) => Ok(Some(python.clone())),
        Err(reason) if std::env::var_os("CI").is_some() => Err(reason.clone()),
        Err(reason) => {
            // Written directly to stderr: the test harness hides the output of passing tests.
            let _ = writeln!(std::io::stderr(), "\nSKIPPED the Python client's tests: {reason}");
            Ok(None)
        }
    }
}

fn prepare(target: &Path) -> Result<PathBuf, String> {
    let (folder, project) = (target.join("python"), root().join("clients/python/pyproject.toml"));
    let python = folder.join("bin/python");
    let expected = std::fs::read_to_string(&project).map_err(|error| format!("{}: {error}", project.display()))?;
    let stamp = folder.join("pyproject.toml");
    if std::fs::read_to_string(&stamp).is_ok_and(|installed| installed == expected) {
        return Ok(python);
    }
    let requirements = requirements(&expected)?;
    let has_uv = Command::new("uv").arg("--version").output().is_ok();
    if has_uv {
        run(Command::new("uv").args(["venv", "--allow-existing", "--python", ">=3.11"]).arg(&folder))?;
        run(Command::new("uv").args(["pip", "install", "--python"]).arg(&python).args(&requirements))?;
    } else {
        run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
        run(Command::new(&python).args(["-m", "pip", "install", "--quiet"]).args(&requirements))?;
    }
    std::fs::write(&stamp, expected).map_err(|error| error.to_string())?;
    Ok(python)
}

/// Returns the interpreter of an environment with Cyclone DDS 0.10.2, the version on the robot, or why there is none.
///
/// It has wheels up to Python 3.10.
pub fn cyclone_python(target: &Path) -> Result<PathBuf, String> {
    static ENVIRONMENT: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    let prepare = || {
        let python = target.join("python3.10/bin/python");
        let has_cyclone = |python: &Path| run(Command::new(python).args(["-c", "import cyclonedds"])).is_ok();
        if !has_cyclone(&python) {
            let base = python_3_10().ok_or("there is no Python 3.10 on the PATH or among the versions of pyenv")?;
            run(Command::new(base).args(["-m", "venv"]).arg(target.join("python3.10")))?;
            run(Command::new(&python).args(["-m", "pip", "install", "--quiet", "cyclonedds==0.10.2"]))?;
        }
        Ok(python)
    };
    ENVIRONMENT.get_or_init(prepare).clone()
}

fn python_3_10() -> Option<PathBuf> {
    let on_path =
        std::env::var_os("PATH").into_iter().flat_map(|path| std::env::split_paths(&path).collect::<Vec<_>>());
    let pyenv = std::env::var_os("HOME").map(|home| Path::new(&home).join(".pyenv/versions"));
    let versions = pyenv.and_then(|versions| std::fs::read_dir(versions).ok()).into_iter().flatten().flatten();
    let versions = versions.map(|version| version.path().join("bin"));
    // The scripts of pyenv on the PATH fail if the version is not selected.
    let is_usable = |python: &PathBuf| run(Command::new(python).arg("--version")).is_ok();
    on_path.chain(versions).map(|folder| folder.join("python3.10")).filter(|python| python.exists()).find(is_usable)
}

/// Returns the dependencies of the package and of its extras, except `bench`.
fn requirements(pyproject: &str) -> Result<Vec<String>, String> {
    let project: toml::Table = pyproject.parse().map_err(|error| format!("pyproject.toml: {error}"))?;
    let project = &project["project"];
    let extras = project["optional-dependencies"].as_table().into_iter().flatten();
    // The baselines of the benchmark are large, and no test needs them.
    let extras = extras.filter(|(name, _)| *name != "bench").map(|(_, list)| list);
    let lists = std::iter::once(&project["dependencies"]).chain(extras);
    let words = lists.filter_map(toml::Value::as_array).flatten().filter_map(toml::Value::as_str);
    Ok(words.map(str::to_owned).collect())
}

/// Removes Cargo's environment variables from `command`.
///
/// Build scripts that depend on them would otherwise rebuild their crates and all dependents.
pub fn outside_cargo(command: &mut Command) -> &mut Command {
    let names = std::env::vars_os().filter_map(|(name, _)| name.into_string().ok());
    for name in names.filter(|name| name.starts_with("CARGO_") && name != "CARGO_HOME") {
        command.env_remove(name);
    }
    command
}

/// Runs a command. The error contains its output.
pub fn run(command: &mut Command) -> Result<Output, String> {
    let output = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    if output.status.success() {
        return Ok(output);
    }
    let printed = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    Err(format!("{command:?} failed with {}:\n{printed}", output.status))
}
