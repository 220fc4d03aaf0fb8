//! Torque that is added to the laws: in the engines, and learned from what a diagnosis leaves.

use std::path::Path;

use twinstep_diagnose::Diagnosis;
use twinstep_effects::{Effect, EffectEntry, ModelFile, NetworkMode, apply_effects};
use twinstep_logs::Log;
use twinstep_model::{
    Actuator, ActuatorMode, ActuatorSnapshot, ActuatorTap, Backend, BackendError, BaseMount, Command,
    FIXED_BASE_HEIGHT, InitialState, Measured, PerJoint, RobotModel, go2,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};
use twinstep_tests::process::Process;
use twinstep_tests::python::Programs;

use crate::identify::{chirp_log_with, twinstep};

/// Actuator that adds `constant` + `cubic`·e³ [N·m] to the torque of each joint, for the position error e [rad].
#[derive(Clone, Copy)]
struct ErrorTorque {
    tap: ActuatorTap,
    constant: f32,
    cubic: f32,
}

impl Actuator for ErrorTorque {
    fn mode(&self) -> ActuatorMode {
        ActuatorMode::AddAt(self.tap)
    }

    fn torques(
        &mut self,
        commands: &[Command],
        _: &[bool],
        measured: &Measured,
        tau: &mut [PerJoint],
    ) -> Result<(), BackendError> {
        for (robot, tau) in tau.iter_mut().enumerate() {
            for (joint, tau) in tau.iter_mut().enumerate() {
                let error = commands[robot].q[joint] - measured.q[robot][joint];
                *tau = self.constant + self.cubic * error.powi(3);
            }
        }
        Ok(())
    }

    fn reset(&mut self, _: usize, _: u64) {}

    fn snapshot(&self, _: usize) -> ActuatorSnapshot {
        ActuatorSnapshot::new(())
    }

    fn restore(&mut self, _: usize, _: &ActuatorSnapshot) {}
}

/// Gains at which a hanging robot holds its pose [N·m/rad], [N·m·s/rad].
const HOLDING: [f32; 2] = [100.0, 3.0];

/// Returns the joint positions of a hanging robot that has held its pose for 2 s [rad].
fn held(mut backend: impl Backend) -> PerJoint {
    let pose = go2().control.default_pose_f32();
    backend.reset(&[(0, InitialState::at_rest(FIXED_BASE_HEIGHT as f32, pose))]).unwrap();
    backend.step(&[Command::hold(pose, HOLDING[0], HOLDING[1])], &[true], 400).unwrap();
    backend.measured().q[0]
}

/// Checks that 1 N·m at `tap` deflects the joints of `robot` like `torque` [N·m] at the links, in both engines.
fn check_deflection(robot: &RobotModel, tap: ActuatorTap, torque: f32) {
    let sim = |engine| SimConfig { engine, base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
    let added = || Box::new(ErrorTorque { tap, constant: 1.0, cubic: 0.0 });
    let batch = || BatchBackend::new(robot.clone(), sim(Engine::Batch), 1).unwrap();
    let rapier = || RapierBackend::new(robot.clone(), sim(Engine::Rapier), 1).unwrap();
    for (without, with) in
        [(held(batch()), held(batch().with_actuator(added()))), (held(rapier()), held(rapier().with_actuator(added())))]
    {
        for (joint, (without, with)) in without.iter().zip(&with).enumerate() {
            let stiffness = torque / (with - without);
            // Motor constants scale the gains too; gravity adds a few N·m/rad.
            let expected = HOLDING[0] * if tap == ActuatorTap::Current { torque } else { 1.0 };
            assert!((stiffness / expected - 1.0).abs() < 0.1, "joint {joint}, {tap:?}: {stiffness} N·m/rad");
        }
    }
}

#[test]
fn added_torque_deflects_a_held_joint_and_passes_the_motor_constant_only_at_the_current() {
    let gain = EffectEntry::new(Effect::named("torque_gain").unwrap(), "all".parse().unwrap(), vec![0.7]).unwrap();
    check_deflection(&apply_effects(&go2(), &[gain]).unwrap(), ActuatorTap::Current, 0.7);
    check_deflection(&go2(), ActuatorTap::Output, 1.0);
}

/// Records a hanging robot whose position gain grows with the error, which no law of the catalogue does.
fn record(path: &Path, rows: u32, from_hz: f64) -> Log {
    let hidden = ErrorTorque { tap: ActuatorTap::Output, constant: 0.0, cubic: 150.0 };
    let log = chirp_log_with(&go2(), rows, Some(Box::new(hidden)), from_hz);
    log.write(path).unwrap();
    log
}

/// Returns the closed-loop error of a model on a log [rad].
fn error(model: &Path, log: &Path) -> f64 {
    let output = twinstep(&["evaluate", "--json", "--model", model.to_str().unwrap(), log.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    report["q_rmse_rad"].as_f64().unwrap()
}

#[test]
fn what_no_law_explains_is_learned_and_improves_the_prediction_of_another_motion() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let text = |name: &str| file(name).to_str().unwrap().to_owned();
    record(&file("log.parquet"), 1600, 0.4);
    record(&file("other.parquet"), 1000, 0.6);
    let output = twinstep(&["diagnose", &text("log.parquet"), "--out", &text("diagnosis"), "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let diagnosis: Diagnosis = serde_json::from_slice(&output.stdout).unwrap();
    let learned = diagnosis.learned_residual.as_ref().unwrap_or_else(|| panic!("{diagnosis:#?}"));
    assert_eq!((learned.tap.as_str(), diagnosis.extended), ("output", learned.after));
    assert!(learned.after.q_rmse_rad.unwrap() < 0.8 * learned.before.q_rmse_rad.unwrap());
    let report = std::fs::read_to_string(file("diagnosis/report.html")).unwrap();
    assert!(report.contains("Learned residual") && report.contains("Where it does not know"));

    // The same laws without the networks.
    let extended = ModelFile::load(file("diagnosis/extended.toml")).unwrap();
    assert_eq!(extended.actuator.as_ref().unwrap().mode, NetworkMode::Residual);
    std::fs::write(file("laws.toml"), ModelFile { actuator: None, ..extended }.to_toml()).unwrap();
    let [before, after] =
        ["laws.toml", "diagnosis/extended.toml"].map(|model| error(&file(model), &file("other.parquet")));
    assert!(after < 0.7 * before, "{before} -> {after} rad");

    // By hand, from the nominal robot: the networks alone.
    std::fs::write(file("nominal.toml"), "robot = \"go2\"\n").unwrap();
    let (log, nominal, out) = (text("log.parquet"), text("nominal.toml"), text("hand.safetensors"));
    let fit = ["fit", &log, "--residual", &nominal, "--input", "torque", "--rate-hz", "100", "--out", &out];
    let fitted = twinstep(&[&fit[..], &["--members", "2", "--hidden", "12", "--joint-input", "kind"]].concat());
    assert!(fitted.status.success(), "{}", String::from_utf8_lossy(&fitted.stderr));
    let by_hand = "robot = \"go2\"\n[actuator]\nmode = \"residual\"\nensemble = \"hand.safetensors\"\n";
    let too_fast = twinstep(&["fit", &log, "--residual", &nominal, "--rate-hz", "900", "--out", &out]);
    let refusal = String::from_utf8_lossy(&too_fast.stderr).into_owned();
    assert!(
        too_fast.status.code() == Some(2) && refusal.contains("`--rate-hz`") && refusal.contains("200 Hz"),
        "{refusal}"
    );
    std::fs::write(file("by_hand.toml"), by_hand).unwrap();
    let [before, after] = ["nominal.toml", "by_hand.toml"].map(|model| error(&file(model), &file("other.parquet")));
    assert!(after < 0.8 * before, "{before} -> {after} rad");

    let model = text("diagnosis/extended.toml");
    let serve = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes", "--model", &model].map(str::to_owned);
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    Process::listening(&program, &serve).unwrap();
}
