//! `twinstep excite` and `twinstep run --commands`.

use std::path::Path;
use std::process::{Command, Output};

use twinstep_tests::process::Process;
use twinstep_tests::python::{Programs, root};

const POLICY: &str = "data/policies/walk.safetensors";

fn twinstep(arguments: &[&str]) -> Output {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    Command::new(program).args(arguments).current_dir(root()).output().unwrap()
}

fn failure(arguments: &[&str]) -> String {
    let output = twinstep(arguments);
    assert!(!output.status.success() && output.stdout.is_empty(), "{arguments:?}");
    // The report is wrapped to the width of the terminal.
    String::from_utf8_lossy(&output.stderr).split_whitespace().collect::<Vec<_>>().join(" ")
}

fn excite(folder: &Path, more: &[&str]) -> Vec<String> {
    let own = ["excite", POLICY, "--unknowns", "payload@base,coulomb_friction@calf", "--out"];
    let folder = folder.to_str().unwrap();
    own.iter().chain(&[folder]).chain(more).map(ToString::to_string).collect()
}

#[test]
fn designed_commands_are_followed_by_a_served_robot_and_its_log_is_identified() {
    let folder = tempfile::tempdir().unwrap();
    let design = folder.path().join("design");
    let arguments = excite(&design, &["--seconds", "3", "--segment-s", "1", "--candidates", "64", "--room", "5"]);
    let output = twinstep(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(text.starts_with("64 sequences in ") && text.contains("coulomb_friction@calf torque_nm"), "{text}");
    let report: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(design.join("design.json")).unwrap()).unwrap();
    assert!(report["design"]["value"].as_f64() > report["random"]["value"].as_f64(), "{report}");
    // A robot with a payload follows the commands; the payload is found in its log.
    let model = folder.path().join("hidden.toml");
    std::fs::write(
        &model,
        "robot = \"go2\"\n\n[[effect]]\nname = \"payload\"\nscope = \"base\"\nmass_kg = 2.0\nposition_m = [0.0, 0.0, 0.05]\n",
    )
    .unwrap();
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "1", "--model"];
    let serve: Vec<String> = serve.iter().chain(&[model.to_str().unwrap()]).map(ToString::to_string).collect();
    let (_server, endpoint) = Process::listening(&program, &serve).unwrap();
    let [commands, log, fitted] =
        ["design/commands.csv", "log", "fitted.toml"].map(|name| folder.path().join(name).display().to_string());
    let run = twinstep(&["run", POLICY, "--endpoint", &endpoint, "--commands", &commands, "--log", &log, "--fast"]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let identify = twinstep(&["identify", &log, "--effects", "payload@base", "--out", &fitted]);
    assert!(identify.status.success(), "{}", String::from_utf8_lossy(&identify.stderr));
    let text = String::from_utf8_lossy(&identify.stdout).into_owned();
    let mass: f64 =
        text.lines().find(|line| line.contains("mass_kg")).unwrap().split_whitespace().nth(2).unwrap().parse().unwrap();
    assert!((mass - 2.0).abs() < 0.2, "{text}");
    let rows = std::fs::read_to_string(Path::new(&log).join("data.csv")).map(|text| text.lines().count());
    assert_eq!(rows.unwrap(), 1 + 150, "3 s at 50 Hz, and the header");
}

#[test]
fn designed_gaits_are_followed_by_a_served_robot() {
    const GAIT_POLICY: &str = "data/policies/gait.safetensors";
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let design = twinstep(
        &[
            &[
                "excite",
                GAIT_POLICY,
                "--unknowns",
                "payload@base,ground_friction@ground",
                "--of-interest",
                "payload@base",
            ][..],
            &["--criterion", "qoed", "--seconds", "3", "--segment-s", "1", "--candidates", "40", "--room", "5"],
            &["--out", &path("design")],
        ]
        .concat(),
    );
    let text = String::from_utf8_lossy(&design.stdout).into_owned();
    assert!(design.status.success(), "{}", String::from_utf8_lossy(&design.stderr));
    assert!(text.contains("Hz, phases"), "{text}");
    let commands = std::fs::read_to_string(path("design/commands.csv")).unwrap();
    assert!(commands.starts_with("start_s,end_s,vx,vy,wz,step_frequency,phase_fr,phase_rl,phase_rr\n"), "{commands}");
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let serve = ["serve", "--task", "gait", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "1"];
    let (_server, endpoint) = Process::listening(&program, &serve.map(ToOwned::to_owned)).unwrap();
    let (commands, log) = (path("design/commands.csv"), path("log"));
    let run =
        twinstep(&["run", GAIT_POLICY, "--endpoint", &endpoint, "--commands", &commands, "--log", &log, "--fast"]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let rows = std::fs::read_to_string(Path::new(&log).join("data.csv")).map(|text| text.lines().count());
    assert_eq!(rows.unwrap(), 1 + 150, "3 s at 50 Hz, and the header");
    // A robot that walks as it likes has no gait command.
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--envs", "1"];
    let (_walker, endpoint) = Process::listening(&program, &serve.map(ToOwned::to_owned)).unwrap();
    let error = failure(&["run", POLICY, "--endpoint", &endpoint, "--commands", &commands, "--fast"]);
    assert!(error.contains("the task `walk` has no gait command"), "{error}");
}

#[test]
fn unknowns_are_the_causes_that_a_diagnosis_could_not_tell_apart() {
    let folder = tempfile::tempdir().unwrap();
    let cause = serde_json::json!({
        "effect": "payload", "scope": "base", "parameters": {}, "held_out_gain": 0.5, "score_nats": 50.0,
        "threshold_nats": 10.0, "ambiguous_with": ["com_shift@base"], "posterior": [], "rivals": [], "evidence": "",
    });
    let errors = serde_json::json!({"torque_rmse_nm": null, "q_rmse_rad": 0.01});
    let findings = serde_json::json!({
        "baseline": errors, "extended": errors, "noise_floor": errors, "findings": [cause], "confusable": [],
        "unexplained": {"fraction": 0.1, "depends_on": [], "text": ""}, "next_experiment": null,
        "extended_model": "extended.toml",
    });
    std::fs::write(folder.path().join("findings.json"), findings.to_string()).unwrap();
    std::fs::write(folder.path().join("extended.toml"), "robot = \"go2\"\n").unwrap();
    let (findings, out) = (folder.path().to_str().unwrap(), folder.path().join("design"));
    let more = ["--seconds", "2", "--segment-s", "1", "--candidates", "32", "--room", "5"];
    let output =
        twinstep(&[&["excite", POLICY, "--findings", findings, "--out", out.to_str().unwrap()][..], &more].concat());
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("payload@base mass_kg") && text.contains("com_shift@base"), "{text}");
    assert!(!text.contains("coulomb_friction"), "{text}");
}

#[test]
fn invalid_arguments_and_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let fails = |more: &[&str]| failure(&excite(folder.path(), more).iter().map(String::as_str).collect::<Vec<_>>());
    let cases: [(&[&str], &str); 5] = [
        (&["--seconds", "7", "--segment-s", "2"], "`--seconds` = 7 is not a multiple of `--segment-s` = 2"),
        (&["--room", "0"], "`--room` = 0 is outside 0.1 to 1000"),
        (&["--criterion", "best"], "criterion `best` does not exist; choose trace, d-optimal, a-optimal or qoed"),
        (&["--criterion", "a-optimal", "--of-interest", "armature@all"], "`armature@all` is not one of the unknowns"),
        (&["--model", "missing.toml"], "missing.toml"),
    ];
    for (more, expected) in cases {
        let error = fails(more);
        assert!(error.contains(expected), "{more:?}: {error}");
    }
    let commands = folder.path().join("commands.csv");
    std::fs::write(&commands, "start_s,end_s,vx,vy,wz\n0,5,1,0,nan\n").unwrap();
    // Read before anything is connected: nothing listens at this endpoint.
    let error = failure(&["run", POLICY, "--endpoint", "tcp/127.0.0.1:1", "--commands", commands.to_str().unwrap()]);
    assert!(error.contains("line 2: `wz` = `nan` is not a finite number"), "{error}");
}
