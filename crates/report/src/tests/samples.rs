//! Logs and constructed diagnoses for the tests of the report.

use std::collections::BTreeMap;
use std::path::Path;

use twinstep_diagnose::{
    AlternativeCause, Cause, CorrelatedPair, Diagnosis, DiscriminatedPair, Estimate, NextExperiment, ParameterValue,
    Promise, Reduction, RmsErrors, Unexplained,
};
use twinstep_effects::{Effect, ModelFile};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, go2};
use twinstep_sim::{BatchBackend, BatchRollout, SimConfig};

use crate::report_data::{LogFacts, Provenance, ReportData};
use twinstep_identify::record;

const RECORDING: &str = "data/go2_air_chirp";

/// Returns the recording of a real Go2 with a fixed base in the air.
pub fn recording() -> Log {
    Log::open(Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(RECORDING)).unwrap()
}

/// Returns the report data of `log` for the ideal Go2 and `extended`.
pub fn evidence(log: &Log, extended: &ModelFile) -> ReportData {
    let mut simulator = BatchRollout::new(&go2(), &SimConfig::default()).unwrap();
    let provenance = Provenance {
        command: format!("twinstep diagnose {RECORDING} --out out"),
        date: "2026-11-21".to_owned(),
        model: "the ideal go2".to_owned(),
        logs: vec![LogFacts::of(RECORDING, log)],
        motions: vec!["motion_before.html".to_owned()],
    };
    let causes: Vec<_> = extended.effects.iter().map(|entry| (entry.effect, entry.scope)).collect();
    ReportData::gather(log, &ModelFile::default(), extended, &causes, &mut simulator, provenance).unwrap()
}

/// Returns a model file with entries of name, scope, parameter and value.
fn model(entries: &[[&str; 4]]) -> ModelFile {
    let entry = |[name, scope, parameter, value]: &[&str; 4]| {
        format!("[[effect]]\nname = \"{name}\"\nscope = \"{scope}\"\n{parameter} = {value}\n")
    };
    ModelFile::parse(&format!("robot = \"go2\"\n{}", entries.iter().map(entry).collect::<String>()), "test").unwrap()
}

/// Returns a diagnosis with three causes, and the extended model.
pub fn findings() -> (Diagnosis, ModelFile) {
    let extended = model(&[
        ["coulomb_friction", "calf", "torque_nm", "1.0"],
        ["armature", "calf", "inertia_kgm2", "0.015"],
        ["viscous_friction", "thigh", "coefficient_nms", "0.3"],
    ]);
    let mut friction = cause("coulomb_friction", "calf", "torque_nm", [1.0, 0.94, 1.06]);
    friction.held_out_gain = 0.44;
    friction.score_nats = 412.0;
    friction.evidence =
        "Friction of about 1 N·m at the calves, at any speed, with the sign of the velocity.".to_owned();
    friction.rivals = vec![alternative("viscous_friction", "calf", 0.31), alternative("coulomb_friction", "all", 0.29)];
    let mut armature = cause("armature", "calf", "inertia_kgm2", [0.015, 0.011, 0.019]);
    armature.held_out_gain = 0.21;
    armature.ambiguous_with = vec!["command_delay@calf".to_owned()];
    armature.evidence = "Fast motion of the calves lags as with a rotor inertia of 0.015 kg·m².".to_owned();
    armature.rivals = vec![alternative("command_delay", "calf", 0.209)];
    let mut viscous = cause("viscous_friction", "thigh", "coefficient_nms", [0.3, 0.21, 0.39]);
    viscous.held_out_gain = 0.12;
    viscous.evidence = "Friction at the thighs is proportional to their velocity.".to_owned();
    viscous.rivals = vec![alternative("coulomb_friction", "thigh", 0.08)];
    let diagnosis = Diagnosis {
        baseline: errors(0.036),
        extended: errors(0.014),
        noise_floor: errors(0.002),
        findings: vec![friction, armature, viscous],
        joint_gains: BTreeMap::new(),
        also_fitted: Vec::new(),
        confusable: vec![CorrelatedPair {
            effects: ["command_delay".to_owned(), "armature".to_owned()],
            correlation: -0.97,
            experiment: "a chirp of the calves to 10 Hz at twice the gain".to_owned(),
        }],
        unexplained: Unexplained {
            fraction: 0.14,
            depends_on: vec!["q_FR_hip".to_owned()],
            law: Vec::new(),
            text: "The residual is above the noise at the front right hip, near its joint limit.".to_owned(),
        },
        learned_residual: None,
        next_experiment: Some(NextExperiment {
            motion: "next_experiment".to_owned(),
            parts: vec![DiscriminatedPair {
                effects: ["armature@calf".to_owned(), "command_delay@calf".to_owned()],
                predicted_nats: 80.0,
                median_nats: 20.0,
            }],
            text: "Run steps, 10 s of small steps. It discriminates between armature@calf and command_delay@calf."
                .to_owned(),
        }),
        decisions: Vec::new(),
        not_reported: Vec::new(),
        promise: Some(Promise {
            all: Reduction { predicted: 0.58, interval: [0.5, 0.63], found: 0.61 },
            by_joint: BTreeMap::new(),
            by_motion: BTreeMap::new(),
        }),
        extended_model: "extended.toml".to_owned(),
    };
    (diagnosis, extended)
}

fn errors(q: f64) -> RmsErrors {
    RmsErrors { torque_rmse_nm: None, q_rmse_rad: Some(q) }
}

fn cause(effect: &str, scope: &str, parameter: &str, [value, low, high]: [f64; 3]) -> Cause {
    let [value, low, high] = [value, low, high].map(ParameterValue::Number);
    Cause {
        effect: effect.to_owned(),
        scope: scope.to_owned(),
        parameters: [(parameter.to_owned(), Estimate { value, low, high })].into(),
        held_out_gain: 0.5,
        score_nats: 88.0,
        threshold_nats: 14.2,
        ambiguous_with: Vec::new(),
        posterior: Vec::new(),
        drifts: None,
        remedy: Effect::named(effect).expect("known").remedy.to_owned(),
        rivals: Vec::new(),
        evidence: String::new(),
    }
}

fn alternative(effect: &str, scope: &str, held_out_gain: f64) -> AlternativeCause {
    AlternativeCause { effect: effect.to_owned(), scope: scope.to_owned(), held_out_gain }
}

/// Returns the simulated log of a chirp of all joints, with torques.
pub fn chirp(robot: &ModelFile, base: BaseMount) -> Log {
    let segments = vec![Segment { name: "chirp".to_owned(), base }];
    let meta = Meta {
        kp: Some(Gain::Uniform(30.0)),
        kd: Some(Gain::Uniform(1.0)),
        ..Meta::new(200.0, TorqueSensor::MotorCurrent, segments)
    };
    let t: Vec<f64> = (0..1200).map(|row| f64::from(row) * 0.005).collect();
    let pose = go2().control.default_pose;
    let command = |joint: usize| t.iter().map(|t| pose[joint] + 0.2 * (2.0 + t).powi(2).sin()).collect();
    let commands = JOINT_NAMES.iter().enumerate().map(|(joint, name)| (format!("q_cmd_{name}"), command(joint)));
    let motion = Log::new_commands(meta, [("t".to_owned(), t.clone())].into_iter().chain(commands)).unwrap();
    let robot = robot.robot_model().unwrap();
    let backend = |base, robot: &twinstep_model::RobotModel| {
        let config = SimConfig { threads: 1, base, ..SimConfig::default() };
        Ok(BatchBackend::new(robot.clone(), config, 1).expect("a backend"))
    };
    record(&motion, &robot, None, backend, "test".to_owned(), &mut |_| true).unwrap()
}

/// Returns a simulated log with torques, its diagnosis, and the model that it was simulated with.
pub fn simulated() -> (Log, Diagnosis, ModelFile) {
    let extended = model(&[
        ["viscous_friction", "FL_thigh", "coefficient_nms", "0.3"],
        ["command_delay", "all", "delay_s", "0.008"],
    ]);
    let diagnosis = Diagnosis {
        findings: vec![
            cause("viscous_friction", "FL_thigh", "coefficient_nms", [0.3, 0.28, 0.31]),
            cause("command_delay", "all", "delay_s", [0.008, 0.0075, 0.0081]),
        ],
        baseline: RmsErrors { torque_rmse_nm: Some(0.84), q_rmse_rad: Some(0.03) },
        extended: RmsErrors { torque_rmse_nm: Some(0.07), q_rmse_rad: Some(0.003) },
        joint_gains: BTreeMap::new(),
        also_fitted: Vec::new(),
        confusable: Vec::new(),
        unexplained: Unexplained::default(),
        ..findings().0
    };
    (chirp(&extended, BaseMount::Fixed), diagnosis, extended)
}

/// Returns the log of a standing robot with a payload on its base, and the model that it was simulated with.
pub fn loaded() -> (Log, ModelFile) {
    let extended = ModelFile::parse(
        "robot = \"go2\"\n[[effect]]\nname = \"payload\"\nscope = \"base\"\n\
         mass_kg = 3.0\nposition_m = [0.1, 0.0, 0.05]",
        "test",
    );
    let extended = extended.unwrap();
    (chirp(&extended, BaseMount::Floating), extended)
}

/// Returns the recording of one leg.
pub fn three_joints() -> Log {
    let log = recording();
    let leg = |name: &str| name.ends_with("_RR_hip") || name.ends_with("_RR_thigh") || name.ends_with("_RR_calf");
    let channels = log.channels().filter(|(name, _)| leg(name) || !name.contains('_'));
    let channels: Vec<_> = channels.map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
    let meta = Meta { joints: Vec::new(), ..log.meta().clone() };
    Log::new(meta, [("t".to_owned(), log.t().to_vec())].into_iter().chain(channels)).unwrap()
}
