//! `twinstep spi-active`: its stages through the real processes, interrupted and continued.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, root};

fn program() -> Command {
    let mut command = Command::new(Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep());
    command.arg("spi-active").stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).split_whitespace().collect::<Vec<_>>().join(" ")
}

fn run(config: &Path) -> Output {
    program().arg(config).output().unwrap()
}

fn write_config(path: &Path, endpoint: &str, more: &str) {
    let policy = root().join("data/policies/walk.safetensors");
    let text = format!(
        "policy = \"{}\"\nendpoint = \"{endpoint}\"\nunknowns = [\"payload@base\"]\ncandidates = 32\nseconds = 4.0\n\
         segment_s = 1.0\n{more}",
        policy.display()
    );
    std::fs::write(path, text).unwrap();
}

/// Starts the command and sends it a signal when a file exists. Returns what it wrote to stderr.
fn interrupted_when(config: &Path, exists: &Path, signal: &str) -> String {
    let child = program().arg(config).spawn().unwrap();
    let deadline = Instant::now() + Duration::from_mins(2);
    while !exists.exists() {
        assert!(Instant::now() < deadline, "no {} after 2 min", exists.display());
        std::thread::sleep(Duration::from_millis(5));
    }
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let output = child.wait_with_output().unwrap();
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(130), "{error}");
    error
}

#[test]
fn hidden_payload_is_found_and_an_interrupted_command_continues() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("hidden.toml");
    std::fs::write(
        &model,
        "robot = \"go2\"\n\n[[effect]]\nname = \"payload\"\nscope = \"base\"\nmass_kg = 2.0\nposition_m = [0.0, 0.0, 0.05]\n",
    )
    .unwrap();
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "1", "--model"];
    let serve: Vec<String> = serve.iter().chain(&[model.to_str().unwrap()]).map(ToString::to_string).collect();
    let twinstep = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let (_server, endpoint) = Process::listening(&twinstep, &serve).unwrap();
    let config = folder.path().join("spi.toml");
    // The pace is no setting on which results depend.
    write_config(&config, &endpoint, "fast = false\n");

    let out = folder.path().join("spi");
    let first_log = out.join("1-random/log");
    let ended = interrupted_when(&config, &out.join("1-random/log.partial/data.csv"), "-TERM");
    assert!(ended.contains("the same command continues") && !first_log.exists(), "an incomplete log: {ended}");

    write_config(&config, &endpoint, "fast = true\n");
    let interrupted = interrupted_when(&config, &first_log, "-INT");
    assert!(interrupted.ends_with("the same command continues"), "{interrupted}");
    assert!(!out.join("report.md").exists());
    let recorded = first_log.metadata().unwrap().modified().unwrap();

    let continued = run(&config);
    assert!(continued.status.success(), "{}", text(&continued.stderr));
    assert_eq!(first_log.metadata().unwrap().modified().unwrap(), recorded, "a complete log is kept");
    let report = std::fs::read_to_string(out.join("report.md")).unwrap();
    let row = |name: &str| -> Vec<&str> {
        let line = report.lines().find(|line| line.starts_with(&format!("| {name}"))).unwrap();
        line.split('|').map(str::trim).collect()
    };
    let error = |model: &str| row(model)[4].parse::<f64>().unwrap();
    assert!(error("2-active") < 0.3 * error("start"), "{report}");
    assert_eq!((row("1-random")[2], row("2-active")[2]), ("4", "8"), "robot time");
    let mass: f64 = row("payload@base mass_kg")[4].split(' ').next().unwrap().parse().unwrap();
    assert!((mass - 2.0).abs() < 0.2, "{report}");

    write_config(&config, &endpoint, "fast = true\nrounds = 2\n");
    let other = run(&config);
    assert_eq!(other.status.code(), Some(2));
    assert!(text(&other.stderr).contains("settings.toml differs"), "{}", text(&other.stderr));
}

#[test]
fn invalid_settings_are_named_before_a_robot_moves() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("spi.toml");
    let cases = [
        ("rounds = 1000\n", "`rounds` = 1000 is outside 0 to 100"),
        ("method = \"best\"\n", "unknown variant `best`, expected one of `trace`, `d-optimal`, `qoed`, `random`"),
        ("robots = 2\n", "unknown field `robots`"),
        ("room_m = nan\n", "`room_m` = NaN is outside 0.1 to 1000"),
        ("model = \"missing.toml\"\n", "missing.toml"),
    ];
    for (more, expected) in cases {
        write_config(&config, "tcp/127.0.0.1:1", more);
        let output = run(&config);
        let error = text(&output.stderr);
        assert!(output.status.code() == Some(2) && error.contains(expected), "{error}");
        assert!(!folder.path().join("spi").exists(), "nothing is written");
    }
    std::fs::write(&config, "policy = \"walk.safetensors\"\nunknowns = [\"payload\"]\n").unwrap();
    let error = text(&run(&config).stderr);
    assert!(error.contains("`unknowns`: ") && error.contains("payload"), "{error}");
    let policy = root().join("data/policies/walk.safetensors");
    let wrong = [
        ("[\"payload@base\", \"payload@base\"]", "`unknowns`: `payload@base` is named twice"),
        ("[\"armature@base\"]", "`unknowns`: `armature` cannot have scope \"base\""),
    ];
    for (unknowns, expected) in wrong {
        std::fs::write(&config, format!("policy = \"{}\"\nunknowns = {unknowns}\n", policy.display())).unwrap();
        let error = text(&run(&config).stderr);
        assert!(error.contains(expected) && !folder.path().join("spi").exists(), "{error}");
    }
}
