//! The Python client: lints, types, tests, installation and fault injection.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use twinstep_tests::fault::Fault;
use twinstep_tests::fault_injection::{self, FaultPlan};
use twinstep_tests::python::{Programs, outside_cargo, python, root, run};
use twinstep_tests::test_bed::TestBedConfig;

const FAULTS: &str = env!("CARGO_BIN_EXE_faults");

/// Returns the target folder of the workspace.
pub fn target() -> PathBuf {
    Path::new(FAULTS).ancestors().nth(2).unwrap().to_owned()
}

fn client() -> PathBuf {
    root().join("clients/python")
}

/// Runs a Python module in the client's folder with the test environment. Does nothing if there is no Python.
fn check(module: &str, arguments: &[&str]) {
    let Some(python) = python(&target()).unwrap() else { return };
    let programs = Programs::beside(FAULTS).unwrap();
    // Cargo replaces the program at every build, also at that of a test beside this one: for a moment there is none.
    let folder = tempfile::tempdir_in(target()).unwrap();
    let program = folder.path().join("twinstep");
    let link = || std::fs::hard_link(programs.twinstep(), &program).is_ok();
    let is_linked = (0..100).any(|_| {
        link() || {
            std::thread::sleep(Duration::from_millis(50));
            false
        }
    });
    assert!(is_linked, "{} cannot be linked", programs.0.display());
    let mut command = Command::new(&python);
    command
        .args(["-m", module])
        .args(arguments)
        .current_dir(client())
        .env("TWINSTEP_SERVER", &program)
        .env("PYTHONPATH", client().join("src"));
    run(&mut command).unwrap_or_else(|printed| panic!("{printed}"));
}

#[test]
fn python_is_formatted_and_linted() {
    check("ruff", &["check", "."]);
    check("ruff", &["format", "--check", "."]);
}

#[test]
fn python_types_are_correct() {
    let python = target().join("python/bin/python");
    check("pyright", &["--pythonpath", python.to_str().unwrap()]);
}

#[test]
fn python_tests_pass() {
    check("pytest", &["-q", "-x"]);
}

#[test]
fn python_client_continues_after_every_fault() {
    let Some(python) = python(&target()).unwrap() else { return };
    let script = client().join("tests/fault_client.py");
    // `env` sets the variable for the client only, not for the other processes of the test bed.
    let program = vec!["env".to_owned(), format!("PYTHONPATH={}", client().join("src").display())];
    let client = [program, vec![python.display().to_string(), script.display().to_string()]].concat();
    let plan = FaultPlan {
        commands: TestBedConfig { program: FAULTS.into(), server: Vec::new(), client: Some(client) },
        faults: 30,
        kinds: Fault::ALL.to_vec(),
        lanes: 6,
        seed: 2,
    };
    let tally = fault_injection::run(&plan, &AtomicBool::new(false), |_| ());
    assert!(tally.failures.is_empty() && tally.unfinished.is_empty(), "{tally:#?}");
}

#[test]
fn wheel_installs_without_rust_into_an_empty_environment_and_steps() {
    let Some(python) = python(&target()).unwrap() else { return };
    Programs::beside(FAULTS).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let venv = folder.path().join("venv");
    run(Command::new(&python).args(["-m", "venv"]).arg(&venv)).unwrap();
    let empty = venv.join("bin/python");
    let dist = folder.path().join("dist");
    let wheel = ["-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"];
    run(outside_cargo(&mut Command::new(&empty))
        .args(wheel)
        .arg(&dist)
        .arg(client())
        .env("CARGO_TARGET_DIR", target()))
    .unwrap();
    let wheel = std::fs::read_dir(&dist).unwrap().next().unwrap().unwrap().path();
    // Neither `cargo` nor another `twinstep` is on the path. The dependencies come from the test environment: only the
    // wheel and the program in it are tested.
    let path = format!("{}:/usr/bin:/bin", venv.join("bin").display());
    let install = ["-m", "pip", "install", "--quiet", "--no-deps", "--no-index"];
    run(Command::new(&empty).args(install).arg(wheel).env("PATH", &path)).unwrap();
    let site = run(Command::new(&python).args(["-c", "import site; print(site.getsitepackages()[0])"])).unwrap();
    let site = String::from_utf8(site.stdout).unwrap();
    let first_step = "import gymnasium, twinstep\n\
                      env = gymnasium.make('twinstep/Go2-Walk-v0')\n\
                      env.reset(seed=1)\n\
                      env.step(env.action_space.sample())\n\
                      env.close()\n\
                      assert 'venv' in twinstep.__file__";
    let mut command = Command::new(&empty);
    command.args(["-c", first_step]).current_dir(folder.path()).env("PYTHONPATH", site.trim()).env("PATH", path);
    run(&mut command).unwrap_or_else(|printed| panic!("{printed}"));
}
