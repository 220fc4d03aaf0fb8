//! `twinstep u2e`: its stages through the real processes, killed, interrupted and continued.

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant, SystemTime};

use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, root};

fn program() -> Command {
    let mut command = Command::new(Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep());
    command.arg("u2e").stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).split_whitespace().collect::<Vec<_>>().join(" ")
}

fn run(config: &Path) -> Output {
    program().arg(config).output().unwrap()
}

/// Number of environment steps of the training of an exploration policy, and of one update.
const STEPS: [usize; 2] = [40_960, 1024];

fn write_config(path: &Path, endpoint: &str, more: &str) {
    let policy = root().join("data/policies/walk.safetensors");
    let [total, _] = STEPS;
    let text = format!(
        "policy = \"{}\"\nendpoint = \"{endpoint}\"\nseconds = 4.0\nsegment_s = 1.0\n{more}\n\
         [fit]\nmembers = 2\nhidden = 8\nepochs = 3\n\
         [train]\nnum_envs = 64\ngroups = 2\nhorizon = 16\ntotal_steps = {total}\n",
        policy.display()
    );
    std::fs::write(path, text).unwrap();
}

fn serve(folder: &Path) -> (Process, String) {
    let model = folder.join("hidden.toml");
    let effects = "[[effect]]\nname = \"torque_saturation\"\nscope = \"all\"\nkappa_nm = 20.0\n\
                   [[effect]]\nname = \"torque_delay\"\nscope = \"all\"\ndelay_s = 0.004\n";
    std::fs::write(&model, format!("robot = \"go2\"\n{effects}")).unwrap();
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "8", "--model"];
    let serve: Vec<String> = serve.iter().chain(&[model.to_str().unwrap()]).map(ToString::to_string).collect();
    Process::listening(&Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep(), &serve).unwrap()
}

/// Starts the command and waits until a file exists.
fn started_until(config: &Path, exists: &Path) -> Child {
    let mut child = program().arg(config).spawn().unwrap();
    let deadline = Instant::now() + Duration::from_mins(3);
    while !exists.exists() {
        if let Some(status) = child.try_wait().unwrap() {
            panic!("{status} without {}: {}", exists.display(), text(&child.wait_with_output().unwrap().stderr));
        }
        assert!(Instant::now() < deadline, "no {} after 3 min", exists.display());
        std::thread::sleep(Duration::from_millis(2));
    }
    child
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

fn modified(path: &Path) -> SystemTime {
    path.metadata().unwrap().modified().unwrap()
}

#[test]
fn killed_and_interrupted_command_repeats_no_stage_and_ends_with_a_robot_to_train_on() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, endpoint) = serve(folder.path());
    let config = folder.path().join("tiny.toml");
    let out = folder.path().join("tiny");
    // In real time, so that the log is incomplete when the command is killed.
    write_config(&config, &endpoint, "iterations = 1\nfast = false\n");
    let mut killed = started_until(&config, &out.join("0-base/log.partial/data.csv"));
    signal(&killed, "-KILL");
    killed.wait().unwrap();
    assert!(!out.join("0-base/log").exists(), "an incomplete log is not kept");

    write_config(&config, &endpoint, "iterations = 1\nfast = true\n");
    let training = out.join("1-explore/training");
    let mut killed = started_until(&config, &training.join("progress.csv"));
    signal(&killed, "-KILL");
    killed.wait().unwrap();
    let first =
        ["log", "ensemble.safetensors", "evaluation.json", "commands.csv"].map(|name| out.join("0-base").join(name));
    let before = first.clone().map(|path| modified(&path));
    assert!(!out.join("1-explore/policy.safetensors").exists());

    let interrupted = started_until(&config, &training.join("progress.csv"));
    while rows(&training) < 3 {
        std::thread::sleep(Duration::from_millis(2));
    }
    signal(&interrupted, "-INT");
    let interrupted = interrupted.wait_with_output().unwrap();
    assert_eq!(interrupted.status.code(), Some(130), "{}", text(&interrupted.stderr));
    assert!(text(&interrupted.stderr).ends_with("interrupted; the same command continues"));
    let done = rows(&training);
    assert!(done < STEPS[0] / STEPS[1], "the training was complete: {done}");

    let finished = run(&config);
    assert!(finished.status.success(), "{}", text(&finished.stderr));
    assert_eq!(first.map(|path| modified(&path)), before, "a complete stage is kept");
    assert_eq!(rows(&training), STEPS[0] / STEPS[1], "the training continued at its checkpoint");
    let report = std::fs::read_to_string(out.join("report.md")).unwrap();
    assert!(report.contains("The end after 1 iterations.") && report.contains("| 1-explore | 0.13 |"), "{report}");
    assert!(std::fs::read_to_string(out.join("progress.html")).unwrap().contains("<svg"));
    check_results(&out);

    let again = run(&config);
    assert!(again.status.success() && text(&again.stdout).contains("The end after 1 iterations."));
    write_config(&config, &endpoint, "iterations = 2\nfast = true\n");
    let other = text(&run(&config).stderr);
    assert!(other.contains("settings.toml differs"), "{other}");
}

/// Returns the number of updates in the table of a training.
fn rows(training: &Path) -> usize {
    let text = std::fs::read_to_string(training.join("progress.csv")).unwrap_or_default();
    text.lines().count().saturating_sub(1)
}

/// Checks the numbers of the last iteration, and that the robot with the ensemble can be simulated.
fn check_results(out: &Path) {
    let text = std::fs::read_to_string(out.join("1-explore/evaluation.json")).unwrap();
    let evaluation: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert!(evaluation["uncertainty"].as_f64().unwrap() > 0.0, "{text}");
    assert_eq!(evaluation["collection"]["seconds"], 4.0);
    assert_eq!(evaluation["on_logs"].as_array().unwrap().len(), 2);
    // 3 epochs of 8 units: the torque has a standard deviation of several N·m.
    assert!(evaluation["on_logs"][1]["torque_rmse_nm"].as_f64().unwrap() < 4.0, "{text}");
    let policy = root().join("data/policies/walk.safetensors");
    let evaluated = Command::new(Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep())
        .args(["evaluate-policy", policy.to_str().unwrap(), "--robots", "2", "--seconds", "1"])
        .args(["--condition", "nominal", "--engine", "batch", "--model"])
        .arg(out.join("robot.toml"))
        .output()
        .unwrap();
    assert!(evaluated.status.success(), "{}", self::text(&evaluated.stderr));
}

#[test]
fn random_excitation_needs_no_training_and_is_stopped_by_the_rule() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, endpoint) = serve(folder.path());
    let config = folder.path().join("random.toml");
    // Any decrease below 100 % ends it: after the second log that can be compared.
    write_config(&config, &endpoint, "method = \"random\"\nfast = true\niterations = 5\nthreshold = 1.0\n");
    let output = run(&config);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let out = folder.path().join("random");
    assert!(out.join("2-random/evaluation.json").exists() && !out.join("3-random").exists());
    let report = std::fs::read_to_string(out.join("report.md")).unwrap();
    assert!(report.contains("decreases by less than 1: the end"), "{report}");
}

#[test]
fn invalid_settings_are_named_before_a_robot_moves() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("u2e.toml");
    let cases = [
        ("iterations = 1000", "`iterations` = 1000 is outside 0 to 100"),
        ("method = \"best\"", "unknown variant `best`, expected one of `explore`, `random`, `base`"),
        ("stop = \"soon\"", "unknown variant `soon`, expected `uncertainty` or `never`"),
        ("threshold = nan", "`threshold` = NaN is outside 0 to 1"),
        ("rounds = 2", "unknown field `rounds`"),
        ("model = \"missing.toml\"", "missing.toml"),
        ("held_out = \"missing\"", "missing"),
        ("draw = \"never\"", "unknown variant `never`, expected `episode` or `step`"),
        ("[explore]\nmax_residual = 3.0", "`explore.max_residual` = 3 is not allowed: 0.01 to 2"),
        ("[explore]\nbase = \"walk\"", "`explore.base` is not a setting here"),
        ("[randomise]\nkp_scale = [0.9, 1.1]", "an ensemble is valid for one pair of gains"),
    ];
    for (more, expected) in cases {
        write_config(&config, "tcp/127.0.0.1:1", more);
        check_rejected(&config, expected);
    }
    let policy = root().join("data/policies/walk.safetensors");
    for (table, expected) in [
        ("[fit]\nmembers = 1\n", "`fit.members` = 1 is outside 2 to 100"),
        ("[fit]\nmember = 6\n", "unknown field `member`"),
        ("[train]\nhorizon = 0\n", "horizon"),
    ] {
        std::fs::write(&config, format!("policy = \"{}\"\n{table}", policy.display())).unwrap();
        check_rejected(&config, expected);
    }
    let model = folder.path().join("law.toml");
    std::fs::write(&model, "robot = \"go2\"\n[[effect]]\nname = \"torque_delay\"\nscope = \"all\"\ndelay_s = 0.004\n")
        .unwrap();
    std::fs::write(&config, format!("policy = \"{}\"\nmodel = \"{}\"\n", policy.display(), model.display())).unwrap();
    check_rejected(&config, "`model`: effect `torque_delay` on all is part of this ensemble");
}

fn check_rejected(config: &Path, expected: &str) {
    let output = run(config);
    let error = text(&output.stderr);
    assert!(output.status.code() == Some(2) && error.contains(expected), "{expected}: {error}");
    assert!(!config.with_extension("").exists(), "nothing is written");
}
