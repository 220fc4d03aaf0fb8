//! `twinstep fit` as a process, with a robot whose actuators have a torque delay and saturate.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;
use std::process::{Command, Output};

use twinstep_effects::{EffectEntry, apply_effects};
use twinstep_ensemble::{DataSet, Ensemble, Split, epistemic_uncertainty};
use twinstep_identify::{RecordError, Sensor, apply_sensors, record};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, RobotModel, go2};
use twinstep_sim::{BatchBackend, Engine, SimConfig};
use twinstep_tests::ground_truth_robot::effect;
use twinstep_tests::python::Programs;

const RATE_HZ: f64 = 200.0;
const ROWS: usize = 2400;
/// Standard deviation of the torque sensor [N·m].
const NOISE: f64 = 0.1;

fn twinstep(arguments: &[&str]) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Command::new(programs.twinstep()).args(arguments).output().unwrap()
}

fn robot() -> RobotModel {
    let entries = [("torque_delay", 0.008), ("torque_saturation", 5.0)].map(|(name, value)| {
        let (effect, scope) = effect(name, "all");
        EffectEntry::new(effect, scope, vec![value]).unwrap()
    });
    apply_effects(&go2(), &entries).unwrap()
}

/// Returns a log of 12 s of square waves with a fixed base, with an amplitude of about `amplitude` [rad].
fn log(amplitude: f64) -> Log {
    let mut columns = BTreeMap::<String, Vec<f64>>::new();
    for row in 0..ROWS {
        let time = row as f64 / RATE_HZ;
        columns.entry("t".to_owned()).or_default().push(time);
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            let phase = joint as f64;
            let side = (TAU * (0.9 + 0.05 * phase) * time + phase).sin().signum();
            let offset = amplitude * side * (1.0 + 0.5 * (0.7 * time + phase).sin());
            let cell = go2().control.default_pose[joint] + offset;
            columns.entry(format!("q_cmd_{name}")).or_default().push(cell);
        }
    }
    let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
    let mut meta = Meta::new(RATE_HZ, TorqueSensor::MotorCurrent, segments);
    meta.joints = JOINT_NAMES.map(str::to_owned).to_vec();
    (meta.kp, meta.kd) = (Some(Gain::Uniform(25.0)), Some(Gain::Uniform(0.6)));
    let motion = Log::new_commands(meta, columns).unwrap();
    let robot = robot();
    let backend = |_, robot: &RobotModel| {
        let config = SimConfig { engine: Engine::Batch, base: BaseMount::Fixed, threads: 1, ..SimConfig::default() };
        BatchBackend::new(robot.clone(), config, 1).map_err(|error| RecordError::Backend(Box::new(error)))
    };
    let exact =
        record(&motion, &robot, None, backend, "a robot with delay and saturation".to_owned(), &mut |_| true).unwrap();
    apply_sensors(&exact, &[Sensor { quantity: "tau_measured", sigma: NOISE, resolution: 0.0 }], 1).unwrap()
}

fn fit(log: &Path, out: &Path, more: &[&str]) -> Output {
    let files = ["fit", log.to_str().unwrap(), "--out", out.to_str().unwrap()];
    twinstep(&[&files, more].concat())
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn ensemble_predicts_delay_and_saturation_and_is_more_uncertain_on_unseen_motion() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out, plot) =
        (folder.path().join("air.parquet"), folder.path().join("air.safetensors"), folder.path().join("curves.svg"));
    let gentle = log(0.1);
    gentle.write(&path).unwrap();
    let small = ["--members", "2", "--hidden", "8", "--epochs", "40", "--plot", plot.to_str().unwrap()];
    let output = fit(&path, &out, &small);
    assert!(output.status.success(), "{}", stderr(&output));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(text.contains("mixture, scaled") && text.contains("epochs of each member: "), "{text}");
    assert!(std::fs::read_to_string(&plot).unwrap().contains("Training of 2 networks"));

    let ensemble = Ensemble::read(&out).unwrap();
    let euf = |data: &DataSet| {
        let (mut error, mut ideal, mut sum, mut count) = (0.0, 0.0, 0.0, 0.0);
        for (run, rows) in data.runs(Split::Test).zip(ensemble.predict(data.runs(Split::Test))) {
            let first = run.torques.len() - rows.len();
            for ((members, torque), [dq, ddq]) in rows.iter().zip(&run.torques[first..]).zip(&run.inputs[first..]) {
                let (means, variances): (Vec<_>, Vec<_>) =
                    members.iter().map(|member| (member.mean, member.variance)).unzip();
                error += (means.iter().sum::<f64>() / means.len() as f64 - torque).powi(2);
                ideal += (25.0 * dq + 0.6 * ddq - torque).powi(2);
                sum += epistemic_uncertainty(&means, &variances);
                count += 1.0;
            }
        }
        [(error / count).sqrt(), (ideal / count).sqrt(), sum / count]
    };
    let [error, ideal, seen] = euf(&DataSet::new(&[("gentle".to_owned(), gentle)]).unwrap());
    assert!(error < 0.3 * ideal, "RMSE {error} N·m, ideal PD {ideal} N·m");
    let [_, _, unseen] = euf(&DataSet::new(&[("violent".to_owned(), log(0.3))]).unwrap());
    assert!(unseen > 2.0 * seen, "epistemic uncertainty {seen} on seen motion, {unseen} on unseen motion");
}

#[test]
fn cross_evaluation_shows_lower_error_and_uncertainty_for_wider_training_data() {
    let folder = tempfile::tempdir().unwrap();
    let paths = [("gentle.csv", 0.1), ("violent.csv", 0.3)].map(|(name, amplitude)| {
        let path = folder.path().join(name);
        log(amplitude).write(&path).unwrap();
        path.to_str().unwrap().to_owned()
    });
    let out = folder.path().join("cross");
    let cross = |more: &[&str]| {
        let settings = ["--cross", "--members", "3", "--hidden", "8", "--epochs", "30", "--out", out.to_str().unwrap()];
        let output = twinstep(&[&["fit", &paths[0], &paths[1]], &settings[..], more].concat());
        assert!(output.status.success(), "{}", stderr(&output));
        std::fs::read_to_string(out.join("cross.csv")).unwrap()
    };
    let numbers = cross(&[]);
    let cells: Vec<Vec<f64>> = numbers
        .lines()
        .skip(1)
        .map(|line| line.split(',').skip(2).map(|cell| cell.parse().unwrap()).collect())
        .collect();
    let [gentle_on_gentle, gentle_on_violent, violent_on_gentle, violent_on_violent] = &cells[..] else {
        panic!("four cells: {numbers}")
    };
    assert!(gentle_on_violent[0] > 1.5 * violent_on_violent[0], "{numbers}");
    assert!(gentle_on_violent[2] > 1.5 * gentle_on_gentle[2], "{numbers}");
    assert!(violent_on_gentle[0] < gentle_on_violent[0], "{numbers}");
    assert!(std::fs::read_to_string(out.join("cross.svg")).unwrap().contains("gentle on violent: RMSE"));
    let written = |name: &str| std::fs::metadata(out.join(name)).unwrap().modified().unwrap();
    let before = written("2.safetensors");
    assert_eq!(cross(&["--resume"]), numbers);
    assert_eq!(written("2.safetensors"), before, "a trained ensemble is not trained again");
}

#[test]
fn resumed_training_is_bitwise_identical_to_uninterrupted_training() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("air.csv");
    log(0.1).write(&path).unwrap();
    let [once, twice] = ["once", "twice"].map(|name| folder.path().join(name));
    let settings = ["--members", "2", "--hidden", "4", "--epochs", "40"];
    let whole = fit(&path, &once, &settings);
    assert!(whole.status.success(), "{}", stderr(&whole));

    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let files = ["fit", path.to_str().unwrap(), "--out", twice.to_str().unwrap()];
    let mut ended = Command::new(programs.twinstep()).args(files).args(settings).spawn().unwrap();
    // Interrupt it after the first checkpoint. The result must not depend on the time of the interruption.
    let saved = folder.path().join("twice.training");
    while !std::fs::read(&saved).is_ok_and(|content| !content.is_empty()) && ended.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    Command::new("kill").args(["-INT", &ended.id().to_string()]).status().unwrap();
    let code = ended.wait().unwrap().code();
    if code == Some(130) {
        let resumed = fit(&path, &twice, &[&settings[..], &["--resume"]].concat());
        assert!(resumed.status.success(), "{}", stderr(&resumed));
    } else {
        assert_eq!(code, Some(0));
    }
    assert_eq!(std::fs::read(once).unwrap(), std::fs::read(twice).unwrap());
}

#[test]
fn logs_unsuitable_for_training_are_rejected_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("none.safetensors");
    let chirps = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("data/go2_air_chirp");
    let output = fit(&chirps, &out, &[]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("has no measured torque"), "{}", stderr(&output));
    assert!(!out.exists());

    let path = folder.path().join("air.csv");
    log(0.1).write(&path).unwrap();
    let output = fit(&path, &out, &["--resume"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr(&output).contains("none.safetensors.training"), "{}", stderr(&output));
}
