//! Logs of robots of any tree: an arm whose gains nobody recorded is evaluated and identified.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command as Process, Output};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use twinstep_diagnose::{Diagnosis, ParameterValue};
use twinstep_effects::{Effect, JointEffect, JointScope, NominalGain, TreeModelFile};
use twinstep_inference::{
    Candidate, IdentifyOptions, JointLog, ParameterRequest, WindowLength, evaluate, identify, windows,
};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, TreeModel};
use twinstep_sim::{Placement, SimConfig, SimdPrecision, TreeCommand, TreeSimulation};
use twinstep_tests::python::{Programs, root};

const RATE_HZ: f64 = 100.0;
/// Hidden numbers of every joint of the arm.
const KP: f64 = 20.0;
const KD: f64 = 0.6;
const DELAY_S: f64 = 0.033;
/// Turn of the base about x: the arm hangs on a wall.
const WALL: [f64; 4] = [std::f64::consts::FRAC_1_SQRT_2, std::f64::consts::FRAC_1_SQRT_2, 0.0, 0.0];

fn arm() -> TreeModelFile {
    TreeModelFile::load(root().join("data/robots/so101.xml")).unwrap()
}

/// Returns the arm with its hidden numbers.
fn hidden() -> TreeModel {
    let mut robot = arm().nominal;
    for (index, joint) in robot.joints.iter_mut().enumerate() {
        joint.armature = 0.02 + 0.004 * index as f64;
        joint.viscous_friction = 0.3;
        joint.coulomb_friction = 0.15 - 0.02 * index as f64;
        joint.actuator.command_delay = DELAY_S;
    }
    robot
}

/// Middle of the motion of a joint [rad]. The gripper does not reach its limit.
fn middle(joint: usize) -> f64 {
    if joint == 5 { 0.8 } else { 0.0 }
}

/// Returns the command of a joint at a time: sines, and a step every two seconds, because slow motion does not show a delay.
fn command(joint: usize, t: f64) -> f64 {
    let step = if (t / 2.0).floor() % 2.0 == 0.0 { 0.15 } else { -0.15 };
    middle(joint) + 0.35 * ((2.0 + 0.7 * joint as f64) * t).sin() + 0.15 * ((7.0 + joint as f64) * t).sin() + step
}

/// Returns a log of positions alone, in steps of an encoder of 12 bits. The actuator of the simulation delays the commands.
fn log(seconds: f64) -> Log {
    let robot = hidden();
    let config = SimConfig { base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
    let start = Placement { base_orientation: WALL, ..Placement::at_rest(0.0, (0..6).map(middle).collect()) };
    let mut arm = TreeSimulation::with_precision(&robot, &config, 1000.0, SimdPrecision::Double, 1, &start).unwrap();
    let rows = (seconds * RATE_HZ) as usize;
    let mut columns: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for row in 0..rows {
        let t = row as f64 / RATE_HZ;
        let q_cmd: Vec<f64> = (0..6).map(|joint| command(joint, t)).collect();
        columns.entry("t".to_owned()).or_default().push(t);
        for (joint, tree) in robot.tree.joints.iter().enumerate() {
            let encoder = std::f64::consts::TAU / 4096.0;
            let q = (arm.states()[0].state.q[joint] / encoder).round() * encoder;
            columns.entry(format!("q_{}", tree.name)).or_default().push(q);
            columns.entry(format!("q_cmd_{}", tree.name)).or_default().push(q_cmd[joint]);
        }
        let command = TreeCommand::hold(q_cmd.iter().map(|q| *q as f32).collect(), KP as f32, KD as f32);
        arm.step(&[command], 10).unwrap();
    }
    let segments = vec![Segment { name: "sines".to_owned(), base: BaseMount::Fixed }];
    let meta = Meta { base_quat: Some(WALL), ..Meta::new(RATE_HZ, TorqueSensor::None, segments) };
    Log::new(meta, columns).unwrap()
}

#[test]
fn identification_recovers_gains_delay_friction_and_rotor_of_an_arm_on_a_wall() {
    let (file, log) = (arm(), log(24.0));
    let joint_log = JointLog::new(&log, &file.nominal.tree, |_| true).unwrap();
    assert!(joint_log.has_unknown_gains());
    let requests = ParameterRequest::DEFAULT.map(|request| ParameterRequest(request.to_owned())).to_vec();
    let options = IdentifyOptions { requests, actuator_hz: 1000.0, stop: Arc::default() };
    let found = identify(&file, &joint_log, &options, &mut |_, _, _| {}).unwrap();
    let truth = hidden();
    let mut covered = 0;
    for estimate in &found.estimates {
        let joint = estimate.parameter.joints[0];
        let expected = match estimate.parameter.name().as_str() {
            name if name.contains(".kp") => KP,
            name if name.contains(".kd") => KD,
            _ => estimate.parameter.quantity.get(&truth.joints[joint]),
        };
        let [low, high] = estimate.interval;
        covered += usize::from((low..=high).contains(&expected));
        assert!(expected > 0.5 * low && expected < 2.0 * high, "{estimate:?}, {expected}");
    }
    // At one gain and without commanded velocities, kd and viscous friction are one number: only their sum is known.
    let pairs: Vec<_> = found.correlated.iter().map(|(one, other, _)| (one.as_str(), other.as_str())).collect();
    assert!(pairs.contains(&("viscous_friction@elbow_flex", "pd_gain@elbow_flex.kd")), "{pairs:?}");
    assert!(covered * 10 >= found.estimates.len() * 8, "{covered} of {}", found.estimates.len());
    let delay = found.estimates.iter().find(|estimate| estimate.parameter.name() == "command_delay@all").unwrap();
    assert!((delay.value - DELAY_S).abs() < 0.003, "{delay:?}");
    let error = |file: &TreeModelFile| {
        evaluate(&joint_log, &Candidate::of(file).unwrap(), 1000.0).unwrap().0.q_rmse_rad.unwrap()
    };
    let (before, after) = (error(&file), error(&found.model));
    assert!(before > 0.02 && after < 0.002, "{before} -> {after} rad");
}

#[test]
fn only_unknown_gains_become_those_of_the_model_file_and_other_joints_keep_their_effects() {
    let mut file = arm();
    file.effects.push(JointEffect {
        effect: Effect::named("coulomb_friction").unwrap(),
        scope: JointScope::All,
        values: vec![0.05],
        intervals: vec![None],
    });
    let mut log = log(6.0);
    let meta = Meta { kp: Some(Gain::Uniform(KP)), ..log.meta().clone() };
    log = Log::new(meta, columns_of(&log)).unwrap();
    let joint_log = JointLog::new(&log, &file.nominal.tree, |_| true).unwrap();
    let requests = vec![ParameterRequest("coulomb_friction@gripper".to_owned())];
    let options = IdentifyOptions { requests, actuator_hz: 1000.0, stop: Arc::default() };
    let found = identify(&file, &joint_log, &options, &mut |_, _, _| {}).unwrap().model;
    assert_eq!(found.kp, None, "the log states kp");
    assert!(found.kd.as_ref().unwrap().of("gripper").is_some());
    let friction = |file: &TreeModelFile, joint: usize| file.tree_model().unwrap().joints[joint].coulomb_friction;
    assert!((friction(&found, 0) - friction(&file, 0)).abs() < 1e-12, "an effect of all joints stays at the others");
    let error = |file: &TreeModelFile| {
        evaluate(&joint_log, &Candidate::of(file).unwrap(), 1000.0).unwrap().0.q_rmse_rad.unwrap()
    };
    assert!(error(&found) < error(&file), "{} -> {} rad", error(&file), error(&found));
}

#[test]
fn short_selections_gaps_and_missing_cells_are_no_panic() {
    let (file, whole) = (arm(), log(4.0));
    let short = JointLog::new(&whole, &file.nominal.tree, |row| (100..120).contains(&row)).unwrap();
    let requests = vec![ParameterRequest("armature@all".to_owned())];
    let options = IdentifyOptions { requests, actuator_hz: 1000.0, stop: Arc::default() };
    let all = JointLog::new(&whole, &file.nominal.tree, |_| true).unwrap();
    let [of_short, of_all] = [short, all].map(|log| {
        let [low, high] = identify(&file, &log, &options, &mut |_, _, _| {}).unwrap().estimates[0].interval;
        high - low
    });
    assert!(of_short > 2.0 * of_all, "0.1 s tell less than 4 s: {of_short} and {of_all} kg·m²");

    let mut columns = columns_of(&whole);
    columns.insert("dq_gripper".to_owned(), vec![f64::NAN; whole.rows()]);
    let missing = Log::new(whole.meta().clone(), columns.clone()).unwrap();
    let missing = JointLog::new(&missing, &file.nominal.tree, |_| true).unwrap();
    assert!(evaluate(&missing, &Candidate::of(&file).unwrap(), 1000.0).is_ok());

    columns.get_mut("t").unwrap().iter_mut().skip(200).for_each(|t| *t += 1e6);
    let gap = Log::new(whole.meta().clone(), columns.clone()).unwrap();
    assert_eq!(JointLog::new(&gap, &file.nominal.tree, |_| true).unwrap().selected.len(), 2);
    columns.get_mut("t").unwrap().iter_mut().for_each(|t| *t *= 1e9);
    let nanoseconds = Log::new(whole.meta().clone(), columns).unwrap();
    let error = JointLog::new(&nanoseconds, &file.nominal.tree, |_| true).unwrap_err().to_string();
    assert!(error.contains("20 to 2000 Hz"), "{error}");
}

#[test]
fn interrupted_identification_gives_the_best_values_so_far_with_the_intervals_of_the_priors() {
    let (file, log) = (arm(), log(4.0));
    let joint_log = JointLog::new(&log, &file.nominal.tree, |_| true).unwrap();
    let requests = vec![ParameterRequest("armature@each".to_owned())];
    let stop = Arc::new(AtomicBool::new(true));
    let options = IdentifyOptions { requests, actuator_hz: 1000.0, stop };
    let found = identify(&file, &joint_log, &options, &mut |_, _, _| {}).unwrap();
    assert!(found.interrupted && found.estimates.iter().all(|estimate| estimate.is_wide), "{:?}", found.estimates);
    assert!(found.model.tree_model().is_ok());
}

#[test]
fn tilt_of_the_base_matters() {
    let file = TreeModelFile { kp: Some(NominalGain::All(KP)), kd: Some(NominalGain::All(KD)), ..arm() };
    let log = log(4.0);
    let mut candidate = Candidate::of(&file).unwrap();
    candidate.robot = hidden();
    let mut joint_log = JointLog::new(&log, &file.nominal.tree, |_| true).unwrap();
    let error = |log: &JointLog| evaluate(log, &candidate, 1000.0).unwrap().0.q_rmse_rad.unwrap();
    // Half a step of the encoder, and nothing else: the shifted commands are those that the actuator delays.
    let on_the_wall = error(&joint_log);
    assert!(on_the_wall < 0.001, "{on_the_wall} rad");
    joint_log.selected[0].base_orientation = None;
    assert!(error(&joint_log) > 5.0 * on_the_wall, "{} rad", error(&joint_log));
}

fn columns_of(log: &Log) -> BTreeMap<String, Vec<f64>> {
    let channels = log.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec()));
    channels.chain([("t".to_owned(), log.t().to_vec())]).collect()
}

fn twinstep(args: &[&str], folder: &Path) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Process::new(programs.twinstep()).args(args).current_dir(folder).output().unwrap()
}

#[test]
fn program_identifies_an_arm_and_evaluates_it_on_other_rows() {
    let folder = tempfile::tempdir().unwrap();
    log(12.0).write(folder.path().join("arm")).unwrap();
    let robot = root().join("data/robots/so101.xml");
    let model = "[joints.rename]\nshoulder_pan = \"pan\"\n";
    std::fs::write(folder.path().join("renamed.toml"), format!("robot = {:?}\n{model}", robot.display().to_string()))
        .unwrap();
    let robot = robot.to_str().unwrap();
    let run = |args: &[&str]| {
        let output = twinstep(args, folder.path());
        (output.status.code(), String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap())
    };
    let q_rmse = |model: &str| {
        let (code, out, error) = run(&["evaluate", "arm", "--model", model, "--from", "8", "--json"]);
        assert_eq!(code, Some(0), "{error}");
        serde_json::from_str::<serde_json::Value>(&out).unwrap()["q_rmse_rad"].as_f64().unwrap()
    };
    let effects = "coulomb_friction@each,viscous_friction@each,armature@each,command_delay@all";
    let (code, out, error) =
        run(&["identify", "arm", "--model", robot, "--until", "8", "--effects", effects, "--out", "fit.toml"]);
    assert_eq!(code, Some(0), "{error}");
    assert!(out.contains("pd_gain@elbow_flex.kp") && out.contains("95 % interval"), "{out}");
    assert!(error.contains("neither log nor model file states kp of elbow_flex"), "{error}");
    let (before, after) = (q_rmse(robot), q_rmse("fit.toml"));
    assert!(after < 0.2 * before, "{before} -> {after} rad on rows that were not fitted");

    let (code, _, error) = run(&["evaluate", "arm", "--model", "renamed.toml"]);
    assert_eq!(code, Some(2), "{error}");
    assert!(
        error.contains("the robot has no joint `shoulder_pan` of the log") && error.contains("[joints.rename]"),
        "{error}"
    );
    let (_, _, error) = run(&["identify", "arm", "--model", robot, "--effects", "backlash@all", "--out", "no.toml"]);
    assert!(error.contains("`backlash@all` cannot be estimated; possible: pd_gain, armature"), "{error}");
    let (_, _, error) = run(&["identify", "arm", "--model", robot, "--effects", "armature@knee", "--out", "no.toml"]);
    assert!(
        error.contains(
            "`knee` is not a joint of the robot; possible: all (one value), each, shoulder_pan, shoulder_lift"
        ),
        "{error}"
    );
    let (_, _, error) = run(&["evaluate", "arm", "--model", robot, "--segment", "chirp"]);
    assert!(error.contains("the log has no segment `chirp`; its segments are sines"), "{error}");
    let (_, _, error) = run(&["diagnose", "arm", "--out", "diagnosis"]);
    assert!(error.contains("has no `kp`") && error.contains("identify"), "{error}");
}

/// Returns a log of 8 s whose gains are known.
fn log_with_gains() -> Log {
    let log = log(8.0);
    let meta = Meta { kp: Some(Gain::Uniform(KP)), kd: Some(Gain::Uniform(KD)), ..log.meta().clone() };
    Log::new(meta, columns_of(&log)).unwrap()
}

#[test]
fn start_of_a_window_is_not_compared_and_a_short_one_is_compared_in_its_second_half() {
    let tree = arm().nominal.tree;
    for (seconds, unseen) in [(8.0, 0.4), (0.3, 0.15)] {
        let joint_log = JointLog::new(&log(seconds), &tree, |_| true).unwrap();
        for window in windows(&joint_log, &tree, WindowLength::IDENTIFICATION) {
            let after = joint_log.t[window.first_compared] - joint_log.t[window.rows.start];
            assert!((after - unseen).abs() < 0.015, "{after} s of a log of {seconds} s");
        }
    }
}

#[test]
fn program_names_what_an_arm_has_and_its_file_lacks_from_positions_alone() {
    let folder = tempfile::tempdir().unwrap();
    log_with_gains().write(folder.path().join("arm")).unwrap();
    let robot = root().join("data/robots/so101.xml");
    let output = twinstep(&["diagnose", "arm", "--model", robot.to_str().unwrap(), "--out", "found"], folder.path());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = std::fs::read_to_string(folder.path().join("found/findings.json")).unwrap();
    let diagnosis: Diagnosis = serde_json::from_str(&text).unwrap();
    let names: Vec<&str> = diagnosis.findings.iter().map(|cause| cause.effect.as_str()).collect();
    // The file states 0.6 N·m·s/rad, twice as much as the arm has: a cause may take away what a file states.
    for name in ["coulomb_friction", "armature", "viscous_friction", "command_delay"] {
        assert!(names.contains(&name), "{text}");
    }
    let viscous = diagnosis.findings.iter().find(|cause| cause.effect == "viscous_friction").unwrap();
    let ParameterValue::Number(coefficient) = viscous.parameters["coefficient_nms"].value else {
        panic!("{viscous:?}")
    };
    assert!((coefficient + 0.3).abs() < 0.03, "{coefficient}");
    let [before, after] = [diagnosis.baseline, diagnosis.extended].map(|errors| errors.q_rmse_rad.unwrap());
    assert!(after < 0.05 * before, "{before} -> {after} rad on held-out rows");
    let model = TreeModelFile::load(folder.path().join("found").join(&diagnosis.extended_model)).unwrap();
    assert!(!model.effects.is_empty());
}

#[test]
fn drives_of_an_unknown_robot_need_torques_and_velocities() {
    let folder = tempfile::tempdir().unwrap();
    let positions = log_with_gains();
    positions.write(folder.path().join("positions")).unwrap();
    let mut columns = columns_of(&positions);
    for joint in positions.joints() {
        columns.insert(format!("tau_measured_{joint}"), vec![0.1; positions.rows()]);
    }
    let meta = Meta { tau_sensor: TorqueSensor::MotorCurrent, ..positions.meta().clone() };
    Log::new(meta, columns).unwrap().write(folder.path().join("torques")).unwrap();
    for (log, expected) in [("positions", "give the robot's file with --model"), ("torques", "has no `dq`")] {
        let output = twinstep(&["diagnose", log, "--out", "found"], folder.path());
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.code() == Some(2) && error.contains(expected), "{error}");
    }
}

#[test]
fn diagnosis_in_simulations_ends_within_a_second_of_sigterm() {
    let folder = tempfile::tempdir().unwrap();
    log_with_gains().write(folder.path().join("arm")).unwrap();
    let robot = root().join("data/robots/so101.xml");
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let mut command = Process::new(programs.twinstep());
    command.args(["diagnose", "arm", "--out", "found", "--model"]).arg(robot).current_dir(folder.path());
    let mut child = command.spawn().unwrap();
    std::thread::sleep(std::time::Duration::from_secs(2));
    assert!(child.try_wait().unwrap().is_none(), "it was complete before the signal");
    Process::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    let start = std::time::Instant::now();
    let status = child.wait().unwrap();
    assert!(start.elapsed().as_secs_f64() < 2.0, "{:.1} s", start.elapsed().as_secs_f64());
    assert_eq!(status.code(), Some(130));
    assert!(!folder.path().join("found/findings.json").exists());
}
