//! Identification: recovery of known effects in simulation, and the recording of a real Go2 with the program.

use std::collections::BTreeMap;
use std::process::Command as Process;

use rand::RngExt;
use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, EffectEntry, Scope, apply_effects};
use twinstep_identify::nuisance::NuisanceModel;
use twinstep_identify::{
    EstimateStatus, Experiment, GlobalSearch, Identification, IdentifyError, IdentifyOptions, RecordError, Stage,
    WindowConfig, evaluate, identify, record,
};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{
    Actuator, Backend, BaseMount, Command, FIXED_BASE_HEIGHT, InitialState, JOINT_NAMES, Precision, RobotModel, go2,
    stream,
};
use twinstep_sim::{BatchBackend, BatchRollout, Engine, RapierBackend, SimConfig};
use twinstep_tests::python::{Programs, root};

/// Effects to identify and their true values.
const HIDDEN: [(&str, &str, f64); 5] = [
    ("coulomb_friction", "calf", 0.8),
    ("coulomb_friction", "hip", 0.25),
    ("viscous_friction", "thigh", 0.2),
    ("armature", "calf", 0.015),
    ("command_delay", "all", 0.007),
];

fn named(name: &str) -> &'static Effect {
    Effect::named(name).unwrap()
}

fn scope(text: &str) -> Scope {
    text.parse().unwrap()
}

fn ground_truth() -> RobotModel {
    let entries: Vec<_> = HIDDEN
        .iter()
        .map(|(name, joints, value)| EffectEntry::new(named(name), scope(joints), vec![*value]).unwrap())
        .collect();
    apply_effects(&go2(), &entries).unwrap()
}

/// Returns a log of 8 s of chirps with a fixed base and noisy encoders.
///
/// It is simulated with the other engine and a smaller step.
pub fn log_of(robot: &RobotModel) -> Log {
    chirp_log(robot, 1600)
}

/// Returns the log of a robot with a fixed base whose joints follow a chirp over this number of rows of 5 ms.
pub fn chirp_log(robot: &RobotModel, rows: u32) -> Log {
    chirp_log_with(robot, rows, None, 0.4)
}

/// Returns a log like [`chirp_log`] that starts at this frequency [Hz], of a robot with an external actuator.
pub fn chirp_log_with(robot: &RobotModel, rows: u32, external: Option<Box<dyn Actuator>>, from_hz: f64) -> Log {
    let chirp = Chirp { rows, from_hz, amplitude: 0.3, gains: [25.0, 0.6] };
    chirp.log(robot, external)
}

/// Chirp of all joints around the default pose.
pub struct Chirp {
    /// Number of rows of 5 ms.
    pub rows: u32,
    /// Frequency at the start [Hz].
    pub from_hz: f64,
    /// Amplitude of the commands [rad].
    pub amplitude: f64,
    /// Position gain [N·m/rad] and velocity gain [N·m·s/rad].
    pub gains: [f64; 2],
}

impl Chirp {
    /// Returns the log of a robot with a fixed base, with noisy encoders.
    pub fn log(&self, robot: &RobotModel, external: Option<Box<dyn Actuator>>) -> Log {
        let [kp, kd] = self.gains;
        let config = SimConfig {
            engine: Engine::Rapier,
            base: BaseMount::Fixed,
            physics_hz: Some(2000),
            threads: 1,
            ..SimConfig::default()
        };
        let backend = RapierBackend::new(robot.clone(), config, 1).unwrap();
        let mut backend = if let Some(external) = external { backend.with_actuator(external) } else { backend };
        let pose = go2().control.default_pose_f32();
        backend.reset(&[(0, InitialState::at_rest(FIXED_BASE_HEIGHT as f32, pose))]).unwrap();
        let mut columns = BTreeMap::<String, Vec<f64>>::new();
        let mut random = stream(5, "noise", 0);
        for row in 0..self.rows {
            let t = f64::from(row) * 0.005;
            let phase = std::f64::consts::TAU * (self.from_hz + 0.15 * t) * t;
            let mut command = Command::hold(pose, kp as f32, kd as f32);
            columns.entry("t".to_owned()).or_default().push(t);
            for (joint, name) in JOINT_NAMES.iter().enumerate() {
                command.q[joint] += (self.amplitude * (phase + joint as f64).sin()) as f32;
                let noise = 0.002 * (random.random::<f64>() + random.random::<f64>() + random.random::<f64>() - 1.5);
                // Resolution of the encoder.
                let measured = ((f64::from(backend.measured().q[0][joint]) + noise) / 0.0005).round() * 0.0005;
                columns.entry(format!("q_{name}")).or_default().push(measured);
                columns.entry(format!("dq_{name}")).or_default().push(f64::from(backend.measured().dq[0][joint]));
                columns.entry(format!("q_cmd_{name}")).or_default().push(f64::from(command.q[joint]));
            }
            backend.step(&[command], &[true], 1).unwrap();
        }
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(200.0, TorqueSensor::None, segments);
        (meta.kp, meta.kd) = (Some(Gain::Uniform(kp)), Some(Gain::Uniform(kd)));
        meta.joints = JOINT_NAMES.map(str::to_owned).to_vec();
        Log::new(meta, columns).unwrap()
    }
}

#[test]
fn lead_of_the_encoder_positions_is_eliminated_from_the_residuals_of_a_hanging_robot() {
    let mut robot = go2();
    robot.joints.iter_mut().for_each(|joint| joint.actuator.encoder_lead = 0.001);
    let experiments = [Experiment::new(&log_of(&robot), &go2(), WindowConfig::DIAGNOSIS).unwrap()];
    let mut simulator = simulator();
    let mut residuals = experiments[0].residuals(&mut simulator, &[go2()], Precision::Single).remove(0);
    let (count, before) = (residuals.len(), mean_square(&residuals));
    let nuisance = NuisanceModel::of_encoder_lead(&experiments, &go2(), &mut simulator).unwrap();
    nuisance.project_out(&mut residuals);
    let after = mean_square(&residuals[..count]);
    println!("{before} -> {after} noise variances");
    assert!(after < 0.5 * before, "{before} -> {after} noise variances");
}

fn mean_square(residuals: &[f64]) -> f64 {
    residuals.iter().map(|residual| residual * residual).sum::<f64>() / residuals.len() as f64
}

fn simulator() -> BatchRollout {
    BatchRollout::new(&go2(), &SimConfig::default()).unwrap()
}

/// Identifies `effects` from `log`. `progress` returns false to interrupt the search.
fn identified(log: &Log, effects: &[(&str, &str)], progress: fn(usize) -> bool) -> Identification {
    resume(None, log, effects, progress).unwrap()
}

fn resume(
    search: Option<GlobalSearch>,
    log: &Log,
    effects: &[(&str, &str)],
    progress: fn(usize) -> bool,
) -> Result<Identification, IdentifyError> {
    let experiment = Experiment::new(log, &go2(), WindowConfig::IDENTIFICATION).unwrap();
    let effects: Vec<_> = effects.iter().map(|(name, joints)| (named(name), scope(joints))).collect();
    let model = ModelFile::default();
    let mut progress = |_: Stage, step: usize, _: f64| progress(step);
    let options = IdentifyOptions { resume: search, ..IdentifyOptions::default() };
    identify(&model, &effects, &[experiment], &mut simulator(), &options, &mut progress)
}

#[test]
fn hidden_effects_are_recovered_with_intervals_that_cover_them() {
    let log = log_of(&ground_truth());
    let found = identified(&log, &HIDDEN.map(|(name, joints, _)| (name, joints)), |_| true);
    for (finding, (name, _, truth)) in found.findings.iter().zip(HIDDEN) {
        println!("{name}: {} {:?}, truth {truth}", finding.value, finding.interval);
        assert_eq!(finding.verdict, EstimateStatus::Identified);
        let tolerance = if name == "command_delay" { 0.0005 } else { 0.1 * truth };
        assert!((finding.value - truth).abs() < tolerance, "{name}: {} instead of {truth}", finding.value);
        let [low, high] = finding.interval.unwrap();
        assert!(low < finding.value && finding.value < high && high - low < truth, "{name}: {low} to {high}");
    }
    let before = evaluate(&log, &go2(), &mut simulator(), |_| true).unwrap().q_rmse_rad.unwrap();
    let fitted = found.model.robot_model().unwrap();
    let after = evaluate(&log, &fitted, &mut simulator(), |_| true).unwrap().q_rmse_rad.unwrap();
    assert!(after < 0.1 * before, "{before} -> {after} rad");
    assert_eq!(ModelFile::parse(&found.model.to_toml(), "fitted").unwrap(), found.model);
}

#[test]
fn parameters_that_are_not_identifiable_are_reported_and_not_fitted() {
    // With a fixed base, a payload on it and the ground have no effect.
    let log = log_of(&go2());
    let found = identified(&log, &[("payload", "base"), ("ground_friction", "ground")], |_| true);
    assert!(found.findings.iter().all(|finding| finding.verdict == EstimateStatus::NotIdentifiable));
    assert_eq!(found.model, ModelFile::default());
}

#[test]
fn interrupted_search_returns_the_best_candidate_and_can_be_resumed() {
    let log = log_of(&ground_truth());
    let effects = [("coulomb_friction", "calf")];
    let found = identified(&log, &effects, |step| step < 2);
    assert!(found.rms[1] < found.rms[0], "{:?}", found.rms);
    let search = found.checkpoint.expect("the search was interrupted");
    let stored = serde_json::to_string(&search).unwrap();
    let resumed = resume(Some(serde_json::from_str(&stored).unwrap()), &log, &effects, |_| true).unwrap();
    let uninterrupted = identified(&log, &effects, |_| true);
    assert_eq!(resumed.model, uninterrupted.model, "the result does not depend on the interruption");
    let other = resume(Some(search), &log, &[("coulomb_friction", "hip")], |_| true);
    assert!(matches!(other, Err(IdentifyError::ResumeMismatch { .. })));
}

#[test]
fn supply_sag_is_identified_from_a_log_with_varying_voltage() {
    let mut robot = go2();
    robot.derating.voltage_exponent = 1.5;
    let rows = 1600;
    // The supply voltage oscillates.
    let voltage: Vec<f64> = (0..rows).map(|row| 25.0 + 3.0 * (f64::from(row) * 0.005).sin()).collect();
    let motion = log_of(&go2());
    let columns = motion.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec()));
    let columns = columns.chain([("t".to_owned(), motion.t().to_vec()), ("battery_V".to_owned(), voltage)]);
    let motion = Log::new(motion.meta().clone(), columns).unwrap();
    let config = SimConfig { base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
    let backend = |_, robot: &RobotModel| {
        BatchBackend::new(robot.clone(), config, 1).map_err(|error| RecordError::Backend(Box::new(error)))
    };
    let log = record(&motion, &robot, None, backend, "sagging".to_owned(), &mut |_| true).unwrap();
    let found = identified(&log, &[("supply_sag", "all")], |_| true);
    let [low, high] = found.findings[0].interval.unwrap();
    assert!((low..high).contains(&1.5) && high - low < 0.5, "{:?}", found.findings[0]);
}

pub fn twinstep(arguments: &[&str]) -> std::process::Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Process::new(programs.twinstep()).args(arguments).current_dir(root()).output().unwrap()
}

fn q_rmse(arguments: &[&str]) -> f64 {
    let output = twinstep(&[&["evaluate", "--json", "data/go2_air_chirp"], arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let evaluation: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(evaluation["torque_rmse_nm"].is_null(), "this log has no torque");
    evaluation["q_rmse_rad"].as_f64().unwrap()
}

/// The model is fitted to the first 10 s and evaluated on the last 6 s. The split was chosen before the first fit.
#[test]
fn identification_reduces_the_held_out_error_on_a_real_go2_by_65_percent() {
    let folder = tempfile::tempdir().unwrap();
    let fitted = folder.path().join("fitted.toml");
    let fitted = fitted.to_str().unwrap();
    let output = twinstep(&["identify", "data/go2_air_chirp", "--until", "10", "--out", fitted]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    println!("{}", String::from_utf8_lossy(&output.stdout));
    let (ideal, after) = (q_rmse(&["--from", "10"]), q_rmse(&["--from", "10", "--model", fitted]));
    println!("held-out rows: {ideal} -> {after} rad");
    assert!(after < 0.35 * ideal, "{ideal} -> {after} rad on held-out rows");
}

#[test]
fn errors_on_the_command_line_are_named() {
    for (effects, expected) in [
        ("coulomb_friction", "has no scope"),
        ("friction@calf", "not in the catalogue"),
        ("coulomb_friction@knee", "is not a scope"),
        ("payload@all", "cannot have scope"),
    ] {
        let output = twinstep(&["identify", "data/go2_air_chirp", "--effects", effects, "--out", "/dev/null"]);
        assert_eq!(output.status.code(), Some(2));
        assert!(output.stdout.is_empty());
        let error = String::from_utf8_lossy(&output.stderr);
        assert!(error.contains(expected), "{error}");
    }
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("fitted.toml");
    let output = twinstep(&["identify", "data/go2_air_chirp", "--resume", "--out", out.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("cannot resume from"));
    let output = twinstep(&["identify", "data/go2_air_chirp", "--out", "/nowhere/fitted.toml"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).starts_with("error: cannot write /nowhere/fitted.toml"));
    let output = twinstep(&["evaluate", "data/go2_air_chirp", "--from", "100"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("select no row"));
    let output = twinstep(&["effects", "friction"]);
    assert_eq!(output.status.code(), Some(2));
}

#[test]
fn effects_prints_the_equation_and_parameters_of_every_effect() {
    let list = String::from_utf8(twinstep(&["effects"]).stdout).unwrap();
    for effect in twinstep_effects::CATALOGUE {
        assert!(list.contains(effect.name));
        let page = String::from_utf8(twinstep(&["effects", effect.name]).stdout).unwrap();
        assert!(page.contains(effect.equation) && page.contains(effect.parameters[0].name), "{page}");
        assert!(page.contains("--plot"));
    }
}

#[test]
fn identify_benchmark_reports_rollouts_and_a_whole_search_with_their_goals() {
    let output = twinstep(&["bench", "identify", "--json", "--window-s", "0.01", "--python", "/no/python"]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && stderr.contains("skipped: MuJoCo"), "{stderr}");
    let results: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = results["rows"].as_array().unwrap();
    assert!(rows.iter().map(|row| row["unit"].as_str().unwrap()).eq(["robot-s/s", "robot-s/s", "robot-s/s", "s", "s"]));
    assert!(rows.iter().all(|row| row["value"].as_f64().unwrap() > 0.0));
    assert!(rows[0]["ratio"].is_null(), "without MuJoCo there is no baseline");
    assert!(rows[1]["reference"].as_str().unwrap().starts_with("f32"));
    let number = |row: usize, key: &str| rows[row][key].as_f64().unwrap();
    for (row, aim) in [(3, 10.0), (4, 20.0)] {
        assert!((number(row, "ratio") * number(row, "value") - aim).abs() < 1e-9);
    }
}
