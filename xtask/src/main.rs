//! Tasks of maintainers: `cargo xtask dist` makes the files of a release.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

/// Oldest glibc on which the wheel of `--zig` runs.
const MANYLINUX: &str = "manylinux_2_28";
const USAGE: &str = "usage: cargo xtask dist [--zig]

  dist    make the archive, the wheel, the container file and the checksums of a release in `dist/`
  --zig   make a wheel for glibc 2.28 or newer; needs `pip install \"maturin[zig]\"`";
/// Image of the program. The wheel has the program inside.
const CONTAINERFILE: &str = "FROM docker.io/library/python:3.13-slim
COPY twinstep-*.whl /tmp/
RUN pip install --no-cache-dir /tmp/twinstep-*.whl && rm /tmp/twinstep-*.whl
EXPOSE 7447
ENTRYPOINT [\"twinstep\"]
CMD [\"serve\", \"--listen\", \"tcp/0.0.0.0:7447\"]
";

/// Result of a task; the error says what failed.
type Outcome<T = ()> = Result<T, String>;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let outcome = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["dist"] => dist(false),
        ["dist", "--zig"] => dist(true),
        _ => Err(USAGE.to_owned()),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("a workspace").to_owned()
}

/// Makes the files of a release.
fn dist(zig: bool) -> Outcome {
    let dist = root().join("dist");
    if dist.exists() {
        std::fs::remove_dir_all(&dist).map_err(at(&dist))?;
    }
    std::fs::create_dir_all(&dist).map_err(at(&dist))?;
    run(cargo().args(["build", "--release", "--bin", "twinstep"]))?;
    archive(&dist)?;
    wheel(&dist, zig)?;
    write(&dist.join("Containerfile"), CONTAINERFILE)?;
    let names: Vec<String> = files(&dist)?.iter().map(|path| name(path)).collect();
    let sums = checksums(&dist, &names)?;
    write(&dist.join("SHA256SUMS"), &sums)?;
    print!("{sums}");
    Ok(())
}

/// Returns the checksums of files, with the program of Linux or of macOS.
fn checksums(folder: &Path, names: &[String]) -> Outcome<String> {
    let with = |program: &str, flags: &[&str]| run(Command::new(program).args(flags).args(names).current_dir(folder));
    with("sha256sum", &[]).or_else(|_| with("shasum", &["-a", "256"]))
}

/// Makes the archive of the program.
fn archive(dist: &Path) -> Outcome {
    let folder = format!("twinstep-{}-{}", env!("CARGO_PKG_VERSION"), target()?);
    let staged = dist.join(&folder);
    let policies = staged.join("policies");
    std::fs::create_dir_all(&policies).map_err(at(&policies))?;
    for (from, to) in [
        ("target/release/twinstep", "twinstep"),
        ("README.md", "README.md"),
        ("CHANGELOG.md", "CHANGELOG.md"),
        ("LICENSE-APACHE", "LICENSE-APACHE"),
        ("LICENSE-MIT", "LICENSE-MIT"),
    ] {
        std::fs::copy(root().join(from), staged.join(to)).map_err(at(Path::new(from)))?;
    }
    for policy in files(&root().join("data/policies"))? {
        std::fs::copy(&policy, policies.join(name(&policy))).map_err(at(&policy))?;
    }
    let archive = format!("{folder}.tar.gz");
    run(Command::new("tar").args(["--create", "--gzip", "--file", &archive, &folder]).current_dir(dist))?;
    std::fs::remove_dir_all(&staged).map_err(at(&staged))
}

/// Makes the wheel. Without zig, pip gets the build tool.
fn wheel(dist: &Path, zig: bool) -> Outcome {
    let client = root().join("clients/python");
    let mut command = if zig {
        let mut maturin = Command::new("maturin");
        maturin.args(["build", "--release", "--zig", "--compatibility", MANYLINUX, "--out"]).arg(dist);
        maturin
    } else {
        let mut pip = Command::new("python3");
        pip.args(["-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]).arg(dist).arg(&client);
        pip
    };
    run(command.current_dir(&client).env("CARGO_TARGET_DIR", root().join("target"))).map(drop)
}

/// Returns the target triple of the compiler.
fn target() -> Outcome<String> {
    let printed = run(Command::new("rustc").arg("-vV"))?;
    let host = printed.lines().find_map(|line| line.strip_prefix("host: "));
    host.map(str::to_owned).ok_or_else(|| "rustc -vV names no host".to_owned())
}

fn cargo() -> Command {
    let mut command = Command::new("cargo");
    command.current_dir(root());
    command
}

/// Runs a command without Cargo's variables, on which build scripts depend, and returns its stdout.
fn run(command: &mut Command) -> Outcome<String> {
    eprintln!("{command:?}");
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("CARGO_") && name != "CARGO_HOME") {
        // The target folder is set for the wheel.
        if !command.get_envs().any(|(set, _)| set == name.as_str()) {
            command.env_remove(&name);
        }
    }
    let output =
        command.stderr(std::process::Stdio::inherit()).output().map_err(|cause| format!("{command:?}: {cause}"))?;
    if !output.status.success() {
        return Err(format!("{command:?} failed: {}", output.status));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Returns the files of a folder, sorted.
fn files(folder: &Path) -> Outcome<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(at(folder))?;
    let mut paths: Vec<PathBuf> =
        entries.filter_map(|entry| Some(entry.ok()?.path())).filter(|path| path.is_file()).collect();
    paths.sort();
    Ok(paths)
}

fn name(path: &Path) -> String {
    path.file_name().map_or(String::new(), |name| name.to_string_lossy().into_owned())
}

fn write(path: &Path, text: &str) -> Outcome {
    twinstep_files::write(path, text).map_err(at(path))
}

fn at(path: &Path) -> impl FnOnce(std::io::Error) -> String {
    let path = path.display().to_string();
    move |cause| format!("{path}: {cause}")
}
