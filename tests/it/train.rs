//! `twinstep train` and `twinstep evaluate-policy` as processes.

use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::time::{Duration, Instant};

use twinstep_policy::Policy;
use twinstep_tests::python::{Programs, root};

fn program() -> Command {
    Command::new(Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep())
}

fn twinstep(arguments: &[&str]) -> Output {
    program().args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

#[test]
fn training_writes_its_folder_and_is_resumed_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("walk");
    let out_text = out.to_str().unwrap();
    let trained = twinstep(&["train", "walk", "--out", out_text, "--envs", "64", "--steps", "6144", "--seed", "5"]);
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    for name in ["policy.safetensors", "policy.onnx", "evaluation.json", "config.toml", "curve.svg"] {
        assert!(out.join(name).metadata().unwrap().len() > 100, "{name}");
    }
    let table = || std::fs::read_to_string(out.join("progress.csv")).unwrap();
    assert_eq!(table().lines().count(), 1 + 4, "a header and 6144 / (64 · 24) updates");
    let (policy, header) = Policy::read(out.join("policy.safetensors")).unwrap();
    assert_eq!((header.origin.env_steps, header.origin.seed, header.origin.curve.len()), (6144, 5, 4));
    let head = Command::new("git").args(["rev-parse", "HEAD"]).current_dir(root()).output();
    let head = head.ok().filter(|output| output.status.success()).map(|output| text(&output.stdout).trim().to_owned());
    assert_eq!(header.origin.revision, head, "the revision of the sources, if they are in a repository");

    let again = twinstep(&["train", "walk", "--out", out_text]);
    assert_eq!(again.status.code(), Some(2), "an earlier training is not overwritten");
    assert!(text(&again.stderr).contains("continue it with --resume"), "{}", text(&again.stderr));

    // A crash between two checkpoints leaves rows of updates that are repeated.
    let after_the_checkpoint = "5,7680,1.0\n6,92";
    std::fs::write(out.join("progress.csv"), table() + after_the_checkpoint).unwrap();
    let resumed = twinstep(&["train", "walk", "--out", out_text, "--resume", "--steps", "9216", "--json"]);
    assert!(resumed.status.success(), "{}", text(&resumed.stderr));
    let evaluation: serde_json::Value = serde_json::from_slice(&resumed.stdout).unwrap();
    assert_eq!(evaluation["robots"], 256);
    assert_eq!(table().lines().count(), 1 + 6);
    let (longer, header) = Policy::read(out.join("policy.safetensors")).unwrap();
    assert!(header.origin.env_steps == 9216 && longer.actor != policy.actor);
}

/// A limit of the file size fails as a full disk does: in the middle of a file.
#[test]
fn full_disk_costs_a_training_neither_its_steps_nor_the_last_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("walk");
    let (out_text, checkpoint) = (out.to_str().unwrap(), out.join("checkpoint.safetensors"));
    let trained = twinstep(&["train", "walk", "--out", out_text, "--envs", "64", "--steps", "3072", "--seed", "5"]);
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let before = std::fs::read(&checkpoint).unwrap();
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let script = "trap '' XFSZ; ulimit -f 4; exec \"$@\"";
    let resume = ["train", "walk", "--out", out_text, "--resume", "--steps", "12288"];
    let full = Command::new("sh").args(["-c", script, "sh"]).arg(program).args(resume).output().unwrap();
    assert_eq!(full.status.code(), Some(1));
    let error = text(&full.stderr);
    assert!(error.contains("checkpoint.safetensors") && error.contains("too large"), "{error}");
    assert_eq!(std::fs::read(&checkpoint).unwrap(), before, "the earlier checkpoint stays whole");
    let resumed = twinstep(&["train", "walk", "--out", out_text, "--resume", "--steps", "4608"]);
    assert!(resumed.status.success(), "{}", text(&resumed.stderr));
}

#[test]
fn equal_seeds_give_equal_policies() {
    let folder = tempfile::tempdir().unwrap();
    let policy = |name: &str, seed: &str| {
        let out = folder.path().join(name);
        let arguments = ["train", "--out", out.to_str().unwrap(), "--envs", "32", "--steps", "1536", "--seed", seed];
        let output = twinstep(&arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
        Policy::read(out.join("policy.safetensors")).unwrap().0
    };
    let first = policy("first", "1");
    assert!(first == policy("again", "1"));
    assert!(first != policy("other", "2"));
}

/// A server process, which is killed when it is dropped.
struct ServerChild {
    child: Child,
    endpoint: String,
    /// Open as long as the server runs: a program may not find its output closed.
    _output: BufReader<ChildStdout>,
}

impl ServerChild {
    /// Starts a server of the training's robots at `listen` and waits until it listens.
    fn start(listen: &str, flags: &[&str]) -> Self {
        let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
        let mut child = Command::new(program)
            .args(["serve", "--listen", listen, "--physics-hz", "400"])
            .args(flags)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        let mut output = BufReader::new(child.stdout.take().unwrap());
        output.read_line(&mut line).unwrap();
        let endpoint = line.trim().strip_prefix("listening ").unwrap().to_owned();
        Self { child, endpoint, _output: output }
    }
}

impl Drop for ServerChild {
    fn drop(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

#[test]
fn training_on_the_robots_of_servers_gives_the_same_policy_as_in_process() {
    let folder = tempfile::tempdir().unwrap();
    // The robots of a training by rollouts are free again for the 256 of the evaluation.
    let servers = [(); 2].map(|()| ServerChild::start("tcp/127.0.0.1:0", &["--envs", "256"]));
    let old_server = ServerChild::start("tcp/127.0.0.1:0", &["--envs", "320", "--max-rollout-steps", "0"]);
    let config = folder.path().join("config.toml");
    std::fs::write(&config, "[sim]\nphysics_hz = 400\n[train]\nnum_envs = 49\ngroups = 4\ntotal_steps = 4704\n")
        .unwrap();
    let policy = |name: &str, endpoints: &[&str]| {
        let out = folder.path().join(name);
        let arguments = ["train", "--out", out.to_str().unwrap(), "--config", config.to_str().unwrap()];
        let endpoints = endpoints.iter().flat_map(|endpoint| ["--endpoint", endpoint]);
        let output = twinstep(&arguments.into_iter().chain(endpoints).collect::<Vec<_>>());
        assert!(output.status.success(), "{}", text(&output.stderr));
        (Policy::read(out.join("policy.safetensors")).unwrap().0, text(&output.stderr))
    };
    let (local, _) = policy("local", &[]);
    assert!(policy("one", &[&servers[0].endpoint]).0 == local);
    assert!(policy("two", &[&servers[0].endpoint, &servers[1].endpoint]).0 == local);
    let (stepped, log) = policy("stepped", &[&old_server.endpoint]);
    assert!(stepped == local);
    assert!(log.contains("the server has no rollouts; each step is a request"), "{log}");
}

#[test]
fn training_continues_while_one_of_two_servers_is_killed_and_restarted() {
    let folder = tempfile::tempdir().unwrap();
    let flags = ["--envs", "300"];
    let (kept, killed) = (ServerChild::start("tcp/127.0.0.1:0", &flags), ServerChild::start("tcp/127.0.0.1:0", &flags));
    let out = folder.path().join("walk");
    let (log_path, second) = (folder.path().join("log"), killed.endpoint.clone());
    let endpoints = format!("{},{second}", kept.endpoint);
    let train = |rest: &[&str]| {
        let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
        let mut command = Command::new(program);
        command.args(["train", "--out", out.to_str().unwrap(), "--endpoint", &endpoints]).args(rest);
        command.stdout(Stdio::null()).stderr(std::fs::File::create(&log_path).unwrap());
        command.spawn().unwrap()
    };
    // Steps so far, after each update.
    let steps = || -> Vec<u64> {
        let table = std::fs::read_to_string(out.join("progress.csv")).unwrap_or_default();
        let complete = table.lines().skip(1).filter(|line| line.matches(',').count() > 10);
        complete.map(|line| line.split(',').nth(1).unwrap().parse::<f64>().unwrap() as u64).collect()
    };
    let wait_for = |what: &str, is_done: &dyn Fn() -> bool| {
        let since = Instant::now();
        while !is_done() {
            let log = std::fs::read_to_string(&log_path).unwrap();
            assert!(since.elapsed() < Duration::from_mins(2), "{what}: {log}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let logged = |text: &str| std::fs::read_to_string(&log_path).unwrap().matches(text).count();
    let has_increment = |from: usize, increment: u64| {
        let steps = steps();
        steps.len() > from + 2 && steps[from..].windows(2).any(|pair| pair[1] - pair[0] == increment)
    };

    let mut training = train(&["--envs", "32", "--steps", "1000000000"]);
    wait_for("all 32 robots are trained on", &|| has_increment(0, 32 * 24));
    drop(killed);
    wait_for("the server is lost", &|| logged("robots lost") == 4);
    let lost = steps().len();
    wait_for("16 robots are trained on", &|| has_increment(lost, 16 * 24));
    let _restarted = ServerChild::start(&second, &flags);
    wait_for("the robots are leased again", &|| logged("robots leased again") == 4);
    let leased = steps().len();
    wait_for("all 32 robots are trained on again", &|| has_increment(leased, 32 * 24));
    assert!(Command::new("kill").args(["-INT", &training.id().to_string()]).status().unwrap().success());
    assert_eq!(training.wait().unwrap().code(), Some(130));

    let done = *steps().last().unwrap();
    let total = (done + 10 * 32 * 24).to_string();
    let mut resumed = train(&["--resume", "--steps", &total]);
    assert!(resumed.wait().unwrap().success(), "{}", std::fs::read_to_string(&log_path).unwrap());
    let (_, header) = Policy::read(out.join("policy.safetensors")).unwrap();
    assert_eq!(header.origin.env_steps, done + 10 * 32 * 24);
    assert_eq!(steps().last(), Some(&header.origin.env_steps));
}

#[test]
fn policy_is_evaluated_on_each_engine_and_refused_where_it_does_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("walk");
    let trained = twinstep(&["train", "--out", out.to_str().unwrap(), "--envs", "32", "--steps", "768"]);
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let policy = out.join("policy.safetensors");
    let policy = policy.to_str().unwrap();
    let film = folder.path().join("film.svg");
    let film = film.to_str().unwrap();
    let evaluated = twinstep(&["evaluate-policy", policy, "--robots", "4", "--seconds", "2", "--json", "--film", film]);
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rows: Vec<_> =
        report["rows"].as_array().unwrap().iter().map(|row| (&row["condition"], &row["engine"])).collect();
    assert_eq!(rows.len(), 9);
    let shares = report["rows"][0]["by_speed"].as_array().unwrap();
    let share: f64 = shares.iter().map(|bin| bin["share"].as_f64().unwrap()).sum();
    assert!((share - 1.0).abs() < 1e-9 && std::fs::read_to_string(film).unwrap().starts_with("<svg"));
    assert!(rows.contains(&(&"nominal".into(), &"rapier".into())), "{rows:?}");

    let model = folder.path().join("soft.toml");
    std::fs::write(&model, "robot = \"go2\"\n[control]\nkp = 20.0\n").unwrap();
    let other = twinstep(&["evaluate-policy", policy, "--robots", "4", "--model", model.to_str().unwrap()]);
    assert_eq!(other.status.code(), Some(2));
    assert!(text(&other.stderr).contains("the policy was trained with spec"), "{}", text(&other.stderr));
}

#[test]
fn shipped_policy_walks_in_both_engines() {
    let policy = root().join("data/policies/walk.safetensors");
    let arguments = ["evaluate-policy", policy.to_str().unwrap(), "--robots", "32", "--seconds", "6", "--json"];
    let evaluated = twinstep(&arguments);
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    for row in report["rows"].as_array().unwrap() {
        let number = |key: &str| row[key].as_f64().unwrap();
        // A robot that stands still has 0.65 m/s.
        assert!(number("velocity_rms") < 0.35 && number("swing_height") > 0.03, "{row}");
        // It was trained on flat ground.
        let has_steps = row["condition"] == "steps" || row["condition"] == "robust";
        assert!(has_steps || number("up") > 0.9 && number("velocity_rms") < 0.3, "{row}");
        // A Go2 lifts 149 N: 20 to 200 W are a cost of transport of 0.2 to 2 at some 0.6 m/s.
        assert!((20.0..200.0).contains(&number("power")), "{row}");
    }
}

#[test]
fn training_on_a_course_names_its_level_and_its_policy_is_judged_on_one() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("terrain");
    let flags = ["train", "walk", "--terrain", "--envs", "28", "--steps", "3000", "--out", out.to_str().unwrap()];
    let trained = twinstep(&flags);
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let table = std::fs::read_to_string(out.join("progress.csv")).unwrap();
    let mut rows = table.lines().map(|row| row.split(',').collect::<Vec<_>>());
    let column = rows.next().unwrap().iter().position(|name| *name == "mean_level").unwrap();
    let levels: Vec<f64> = rows.map(|row| row[column].parse().unwrap()).collect();
    assert!(!levels.is_empty() && levels.iter().all(|level| (0.0..=9.0).contains(level)), "{levels:?}");
    let policy = out.join("policy.safetensors");
    assert_eq!(Policy::read(&policy).unwrap().0.spec.obs_len(), 5 * 45);
    let judged = twinstep(&["evaluate-policy", policy.to_str().unwrap(), "--course", "--robots", "14", "--json"]);
    assert!(judged.status.success(), "{}", text(&judged.stderr));
    let report: serde_json::Value = serde_json::from_slice(&judged.stdout).unwrap();
    let kinds = report["rows"].as_array().unwrap();
    let robots =
        kinds.iter().flat_map(|kind| kind["levels"].as_array().unwrap()).map(|level| level["robots"].as_u64().unwrap());
    assert_eq!((kinds.len(), robots.sum::<u64>()), (7, 14));
    let jump = root().join("data/policies/jump.safetensors");
    let refused = twinstep(&["evaluate-policy", jump.to_str().unwrap(), "--course"]);
    assert!(text(&refused.stderr).contains("`--course` is for policies of `walk`, and this is one of `jump`"));
}

#[test]
fn shipped_policy_of_terrain_climbs_slopes_waves_and_steps() {
    let policy = root().join("data/policies/walk_terrain.safetensors");
    let judged = twinstep(&["evaluate-policy", policy.to_str().unwrap(), "--course", "--robots", "700", "--json"]);
    assert!(judged.status.success(), "{}", text(&judged.stderr));
    let report: serde_json::Value = serde_json::from_slice(&judged.stdout).unwrap();
    for (kind, least) in
        [("slope_up", 9), ("slope_down", 9), ("stairs_up", 6), ("stairs_down", 8), ("wave", 9), ("rough", 9)]
    {
        let row = report["rows"].as_array().unwrap().iter().find(|row| row["kind"] == kind).unwrap();
        assert!(row["passed"].as_u64().unwrap() >= least, "{row}");
    }
}

#[test]
fn ground_of_one_kind_has_one_level_with_the_robots_and_pushes_of_a_condition() {
    let policy = root().join("data/policies/walk_terrain.safetensors");
    let judge = |more: &[&str]| {
        let judged =
            twinstep(&[&["evaluate-policy", policy.to_str().unwrap(), "--robots", "64", "--json"], more].concat());
        (judged.status.success(), text(&judged.stdout), text(&judged.stderr))
    };
    let arrived = |more: &[&str]| {
        let (_, json, errors) = judge(more);
        let report: serde_json::Value = serde_json::from_str(&json).unwrap_or_else(|_| panic!("{errors}"));
        let rows = report["rows"].as_array().unwrap().clone();
        let kinds: Vec<_> = rows.iter().map(|row| row["kind"].as_str().unwrap().to_owned()).collect();
        assert_eq!(kinds, ["stairs_up", "stairs_down"]);
        assert!(
            rows.iter().all(|row| row["levels"].as_array().unwrap().len() == 1 && row["levels"][0]["robots"] == 32)
        );
        rows.iter().map(|row| row["levels"][0]["arrived"].as_u64().unwrap()).sum::<u64>()
    };
    let calm = arrived(&["--ground", "stairs=0.1", "--speed", "0.5"]);
    let pushed = arrived(&["--ground", "stairs=0.1", "--speed", "0.5", "--condition", "robust"]);
    assert!(calm >= 58 && pushed <= calm, "{calm} {pushed}");
    // Who stands in the middle does not arrive.
    assert_eq!(arrived(&["--ground", "stairs=0.1", "--speed", "0"]), 0);
    let (is_ok, _, error) = judge(&["--speed", "0.5"]);
    assert!(!is_ok && error.contains("--course") && error.contains("--ground"), "{error}");
    for (ground, reason) in [("sand=1", "slope, stairs, obstacles, wave or rough"), ("stairs=2", "stairs_m")] {
        let (is_ok, _, error) = judge(&["--ground", ground]);
        assert!(!is_ok && error.contains(reason), "{error}");
    }
}

#[test]
fn shipped_policy_follows_a_circle_a_figure_of_eight_and_a_square() {
    let policy = root().join("data/policies/track.safetensors");
    let arguments = ["evaluate-policy", policy.to_str().unwrap(), "--robots", "8", "--seconds", "8", "--json"];
    let evaluated = twinstep(&arguments);
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let nominal = rows.iter().filter(|row| row["condition"] == "nominal");
    for errors in nominal.flat_map(|row| row["paths"].as_array().unwrap()) {
        let l_track = errors["l_track"].as_f64().unwrap();
        assert!(errors["up"] == 1.0, "{errors}");
        // Blind robots drift.
        let limits = if errors["motion_capture"] == true { 0.0..0.15 } else { 0.15..4.0 };
        assert!(limits.contains(&l_track), "{errors}");
    }
    assert_eq!(rows.iter().map(|row| row["paths"].as_array().unwrap().len()).max(), Some(6));
    let of_seed = |seed| {
        let short = ["--robots", "2", "--seconds", "1", "--engine", "batch", "--json", "--seed", seed];
        twinstep(&[&arguments[..2], &short].concat()).stdout
    };
    assert!(of_seed("1") == of_seed("1") && of_seed("1") != of_seed("2"), "the seed is that of the robots");
}

/// In rapier, which the policy has not seen, thighs touch the ground as well.
#[test]
fn shipped_policy_gets_up_from_any_orientation_in_two_engines() {
    let policy = root().join("data/policies/getup.safetensors");
    let options = ["--robots", "64", "--condition", "nominal", "--condition", "robots", "--json"];
    let evaluated = twinstep(&[&["evaluate-policy", policy.to_str().unwrap()][..], &options].concat());
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let engines: Vec<&str> = rows.iter().map(|row| row["engine"].as_str().unwrap()).collect();
    assert_eq!(engines, ["batch", "rapier", "batch"]);
    for row in rows {
        let number = |name: &str| row[name].as_f64().unwrap();
        assert!(number("within_3_s") > 0.8 && number("at_end") > 0.9 && number("median_s") < 1.5, "{row}");
    }
}

#[test]
fn shipped_policy_follows_roll_and_pitch_in_two_engines() {
    let policy = root().join("data/policies/attitude.safetensors");
    let options = ["--robots", "16", "--seconds", "10", "--condition", "nominal", "--condition", "delay", "--json"];
    let evaluated = twinstep(&[&["evaluate-policy", policy.to_str().unwrap()][..], &options].concat());
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    assert_eq!(
        rows.iter().map(|row| row["engine"].as_str().unwrap()).collect::<Vec<_>>(),
        ["batch", "rapier", "batch"]
    );
    for row in rows {
        let l_attitude = row["l_attitude"].as_f64().unwrap();
        // A robot that stands still has the mean of its references, 0.18 rad.
        // One that ignores the commanded height has an error of 0.012 m.
        let limit = if row["condition"] == "nominal" { 0.03 } else { 0.08 };
        assert!(row["up"] == 1.0 && l_attitude < limit && row["height_rms"].as_f64().unwrap() < 0.009, "{row}");
    }
}

#[test]
fn shipped_policy_jumps_to_its_target_in_two_engines() {
    let policy = root().join("data/policies/jump.safetensors");
    let evaluated = twinstep(&["evaluate-policy", policy.to_str().unwrap(), "--robots", "8", "--json"]);
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    assert!(rows.iter().all(|row| row["condition"] != "pushes"), "a jump is over before the first push");
    let nominal: Vec<_> = rows.iter().filter(|row| row["condition"] == "nominal").collect();
    assert_eq!(nominal.len(), 2, "batch and rapier");
    for landings in nominal.iter().flat_map(|row| row["targets"].as_array().unwrap()) {
        assert!(landings["landed"] == 1.0 && landings["up"] == 1.0, "{landings}");
        assert!(
            landings["l_jump"].as_f64().unwrap() < 0.1 && landings["flight_s"].as_f64().unwrap() > 0.06,
            "{landings}"
        );
    }
}

#[test]
fn shipped_policy_turns_by_135_degrees_mostly_in_flight_in_two_engines() {
    let policy = root().join("data/policies/jump_turn.safetensors");
    let evaluated = twinstep(&["evaluate-policy", policy.to_str().unwrap(), "--robots", "8", "--json"]);
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let nominal: Vec<_> =
        report["rows"].as_array().unwrap().iter().filter(|row| row["condition"] == "nominal").collect();
    assert_eq!(nominal.len(), 2, "batch and rapier");
    assert!(nominal.iter().all(|row| row["targets"].as_array().unwrap().len() == 3));
    for landings in nominal.iter().flat_map(|row| row["targets"].as_array().unwrap()) {
        let number = |name: &str| landings[name].as_f64().unwrap();
        let target = landings["target"][2].as_f64().unwrap();
        assert!(landings["landed"] == 1.0 && landings["up"] == 1.0 && number("yaw_error") < 0.2, "{landings}");
        // The rest is turned while the feet push.
        assert!((number("flight_turn") - target).abs() < 0.3 * target.abs() + 0.05, "{landings}");
    }
}

#[test]
fn shipped_policy_follows_each_gait_in_two_engines() {
    let policy = root().join("data/policies/gait.safetensors");
    let evaluated =
        twinstep(&["evaluate-policy", policy.to_str().unwrap(), "--robots", "16", "--seconds", "6", "--json"]);
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let rows = report["rows"].as_array().unwrap();
    let conditions: Vec<_> = rows.iter().map(|row| (&row["condition"], &row["engine"])).collect();
    assert_eq!(serde_json::to_string(&conditions).unwrap(), GAIT_CONDITIONS);
    for row in &rows[..2] {
        let motions = row["gaits"].as_array().unwrap();
        let names: Vec<_> = motions.iter().map(|motion| motion["gait"].as_str().unwrap()).collect();
        assert_eq!(names, ["trot", "pace", "bound", "pronk"]);
        for motion in motions {
            let number = |name: &str| motion[name].as_f64().unwrap();
            assert!(number("up") > 0.9 && number("followed") >= 0.75, "{motion}");
            assert!(number("frequency_error") < 0.03 && number("phase_error") < 0.06, "{motion}");
            assert!(number("velocity_rms") < 0.35 && number("duty_factor") < 0.6, "{motion}");
        }
    }
}

const GAIT_CONDITIONS: &str =
    r#"[["nominal","batch"],["nominal","rapier"],["robots","batch"],["pushes","batch"],["delay","batch"]]"#;

#[test]
fn jump_is_trained_for_the_targets_of_its_config() {
    let folder = tempfile::tempdir().unwrap();
    let (config, out) = (folder.path().join("jump.toml"), folder.path().join("jump"));
    std::fs::write(&config, "[task]\nname = \"jump\"\ntarget_x_m = [0.3, 0.5]\n").unwrap();
    let arguments = ["train", "--config", config.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let trained = twinstep(&[&arguments[..], &["--envs", "32", "--steps", "768", "--json"]].concat());
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let targets: serde_json::Value = serde_json::from_slice(&trained.stdout).unwrap();
    let distances: Vec<_> = targets.as_array().unwrap().iter().map(|landings| &landings["target"][0]).collect();
    assert_eq!(serde_json::to_string(&distances).unwrap(), "[0.3,0.4,0.5]");
    let (policy, _) = Policy::read(out.join("policy.safetensors")).unwrap();
    assert_eq!((policy.spec.task.as_str(), policy.spec.obs_len(), policy.spec.max_episode_steps), ("jump", 49, 150));
    std::fs::write(&config, "[task]\nname = \"jump\"\ntarget_x_m = [0.5, 0.3]\n").unwrap();
    let refused_out = folder.path().join("refused");
    let refused = twinstep(&["train", "--config", config.to_str().unwrap(), "--out", refused_out.to_str().unwrap()]);
    assert!(!refused_out.exists(), "nothing is written");
    assert!(
        text(&refused.stderr).contains("`task.target_x_m` = [0.5, 0.3] is not allowed"),
        "{}",
        text(&refused.stderr)
    );
}

#[test]
fn task_of_the_config_file_is_trained_and_another_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("track.toml");
    std::fs::write(&config, "[task]\nname = \"track\"\npath = \"circle\"\n").unwrap();
    let train = |task: &[&str], out: &str| {
        let out = folder.path().join(out);
        let arguments = ["--config", config.to_str().unwrap(), "--out", out.to_str().unwrap()];
        twinstep(&[&["train"], task, &arguments, &["--envs", "32", "--steps", "768"]].concat())
    };
    let trained = train(&[], "track");
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let (policy, _) = Policy::read(folder.path().join("track/policy.safetensors")).unwrap();
    assert_eq!((policy.spec.task.as_str(), policy.spec.obs_len()), ("track", 48));
    let start = folder.path().join("track/checkpoint.safetensors");
    let tuned = train(&["--from", start.to_str().unwrap(), "--seed", "2"], "tuned");
    assert!(tuned.status.success(), "{}", text(&tuned.stderr));
    let (tuned, header) = Policy::read(folder.path().join("tuned/policy.safetensors")).unwrap();
    let distance = |one: &Policy, other: &Policy| {
        one.actor
            .weights()
            .iter()
            .zip(other.actor.weights())
            .map(|(one, other)| (one - other).abs())
            .fold(0.0, f32::max)
    };
    // One update moves a weight by a few times the learning rate of 0.001; other networks differ by 0.1 and more.
    assert!((1e-6..0.03).contains(&distance(&policy, &tuned)) && header.origin.env_steps == 768);
    let policy_file = folder.path().join("track/policy.safetensors");
    let tuned = train(&["--from", policy_file.to_str().unwrap(), "--seed", "2"], "tuned_policy");
    assert!(tuned.status.success(), "{}", text(&tuned.stderr));
    let (tuned, _) = Policy::read(folder.path().join("tuned_policy/policy.safetensors")).unwrap();
    assert!((1e-6..0.03).contains(&distance(&policy, &tuned)), "the actor is that of the policy");
    let other = folder.path().join("other");
    let refused = twinstep(&["train", "--out", other.to_str().unwrap(), "--from", start.to_str().unwrap()]);
    assert!(text(&refused.stderr).contains("the policy was trained with spec"), "{}", text(&refused.stderr));
    let refused = train(&["walk"], "walk");
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("`walk` is not the task of the config file, `track`"));
    std::fs::write(&config, "[task]\nname = \"track\"\nspeed = 9.0\n").unwrap();
    assert!(text(&train(&[], "fast").stderr).contains("`task.speed` = 9 is not allowed: 0.05 to 5"));
}

#[test]
fn unknown_instruction_set_is_rejected_with_those_that_exist() {
    let output = program().arg("effects").env("TWINSTEP_SIMD", "neon").output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let error = text(&output.stderr);
    assert!(error.contains("`TWINSTEP_SIMD` = \"neon\" is not allowed: this processor has portable"), "{error}");
}

#[test]
fn shipped_robust_policy_walks_pushed_delayed_and_on_other_robots_and_grounds() {
    let policy = root().join("data/policies/walk_robust.safetensors");
    let arguments = ["evaluate-policy", policy.to_str().unwrap(), "--engine", "batch"];
    let evaluated = twinstep(&[&arguments[..], &["--robots", "64", "--seconds", "8", "--json"]].concat());
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    for row in report["rows"].as_array().unwrap() {
        assert!(row["up"].as_f64().unwrap() > 0.9 && row["velocity_rms"].as_f64().unwrap() < 0.25, "{row}");
    }
}

#[test]
fn bad_settings_are_rejected_with_the_key_before_anything_is_simulated() {
    let folder = tempfile::tempdir().unwrap();
    let error = |config: &str| {
        let path = folder.path().join("config.toml");
        std::fs::write(&path, config).unwrap();
        let out = folder.path().join("out");
        let output = twinstep(&["train", "--out", out.to_str().unwrap(), "--config", path.to_str().unwrap()]);
        assert_eq!(output.status.code(), Some(2), "{config}: {}", text(&output.stderr));
        text(&output.stderr)
    };
    assert!(error("[train]\ngamma = 2.0").contains("`train.gamma` = 2 is not allowed: 0 to 1"));
    assert!(error("[train]\ngama = 0.9").contains("unknown field `gama`"));
    assert!(error("[task.reward]\nfeet_slip = nan").contains("`task.reward.feet_slip` = NaN is not allowed"));
    assert!(error("[train]\nnum_envs = 0").contains("`train.num_envs` = 0 is not allowed"));
    let resumed = twinstep(&["train", "--out", folder.path().join("none").to_str().unwrap(), "--resume"]);
    assert_eq!(resumed.status.code(), Some(2));
    assert!(text(&resumed.stderr).contains("cannot read"), "{}", text(&resumed.stderr));
}
