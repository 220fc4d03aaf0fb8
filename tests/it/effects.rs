//! Comparison of all effects of the catalogue between batch and rapier, and of a served model file with the ideal robot.

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_effects::{CATALOGUE, Effect, EffectEntry, Scope, Target, apply_effects};
use twinstep_envs::TaskConfig;
use twinstep_model::{
    BaseMount, Command, InitialState, NUM_JOINTS, PerJoint, ResetRequest, RobotModel, Simulator, VecEnv, go2,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};

use crate::remote;

/// The effect with chaotic motion: small differences grow over time, so only the size of the change is compared.
const CHAOTIC: &str = "backlash";
/// The effect that is not compared: the contact models agree only for stiff contacts (see `docs/physics.md`).
const NOT_COMPARED: &str = "ground_stiffness";

/// Length of the motion [actuator periods].
const PERIODS: usize = 200;

fn config(engine: Engine, base: BaseMount) -> SimConfig {
    SimConfig { engine, base, physics_hz: Some(2000), threads: 1, ..SimConfig::default() }
}

/// Returns the initial state of the motion.
pub fn start(base: BaseMount) -> InitialState {
    let height = if base == BaseMount::Fixed { 1.0 } else { 0.3236 };
    InitialState::at_rest(height, go2().control.default_pose_f32())
}

fn motion(backend: &mut impl Simulator, base: BaseMount) -> Vec<PerJoint> {
    backend.reset(&[(0, start(base))]).unwrap();
    rows(backend, base)
}

/// Returns joint positions, torques and angular velocities of each actuator period, scaled to comparable sizes.
///
/// The motion is a chirp with a fixed base, or sway with a floating base.
pub fn rows(backend: &mut impl Simulator, base: BaseMount) -> Vec<PerJoint> {
    let pose = go2().control.default_pose_f32();
    let mut rows = Vec::new();
    for period in 0..PERIODS {
        let t = period as f32 * 0.005;
        let swing = (std::f32::consts::TAU * (1.0 + 1.5 * t) * t).sin();
        let target =
            std::array::from_fn(|j| pose[j] + if base == BaseMount::Fixed { 0.3 * swing } else { 0.08 * swing });
        backend.step(&[Command::hold(target, 30.0, 0.75)], &[true], 1).unwrap();
        rows.push(backend.measured().q[0]);
        rows.push(backend.measured().tau[0].map(|tau| 0.02 * tau));
        let [x, y, z] = backend.measured().gyro[0];
        rows.push([[x, y, z].map(|rate| 0.2 * rate); 4].concat().try_into().unwrap());
    }
    rows
}

fn in_both(robot: &RobotModel, base: BaseMount) -> [Vec<PerJoint>; 2] {
    let mut rapier = RapierBackend::new(robot.clone(), config(Engine::Rapier, base), 1).unwrap();
    let mut batch = BatchBackend::new(robot.clone(), config(Engine::Batch, base), 1).unwrap();
    [motion(&mut rapier, base), motion(&mut batch, base)]
}

/// Returns the RMS difference.
pub fn rms(one: &[PerJoint], other: &[PerJoint]) -> f32 {
    let squares = one.iter().flatten().zip(other.iter().flatten()).map(|(one, other)| (one - other).powi(2));
    (squares.sum::<f32>() / (one.len() * NUM_JOINTS) as f32).sqrt()
}

/// Returns an entry with values for which the effect changes the motion.
pub fn entry(effect: &'static Effect) -> EffectEntry {
    let scope = match effect.target {
        Target::Joints | Target::Supply => Scope::All,
        Target::Bodies | Target::Imu => Scope::Base,
        Target::Ground => Scope::Ground,
    };
    let values = effect.parameters.iter().flat_map(|parameter| {
        let [low, high] = parameter.prior_range;
        std::iter::repeat_n(low + 0.7 * (high - low), parameter.count)
    });
    let values = match effect.name {
        // A trunk with 1.5 times the mass and inertia.
        "inertia" => {
            let body = go2().trunk;
            body.scaled(1.5).log_cholesky().to_vec()
        }
        "torque_saturation" => vec![4.0],
        "torque_speed_limit" => vec![6.0],
        "ground_friction" => vec![0.05],
        "joint_elasticity" => vec![250.0],
        "gyro_bias" => vec![0.3, -0.2, 0.1],
        _ => values.collect(),
    };
    EffectEntry::new(effect, scope, values).unwrap()
}

#[test]
fn effects_agree_between_the_engines() {
    // These depend on a logged voltage, temperature or torque and do not change the motion here.
    let log_effects = ["supply_sag", "thermal_derating", "torque_sensor_delay"];
    for effect in CATALOGUE.into_iter().filter(|effect| !log_effects.contains(&effect.name)) {
        let base = if effect.target == Target::Joints { BaseMount::Fixed } else { BaseMount::Floating };
        let ideal = in_both(&go2(), base);
        let [rapier, batch] = in_both(&apply_effects(&go2(), &[entry(effect)]).unwrap(), base);
        let (difference, changed) = (rms(&rapier, &batch), rms(&batch, &ideal[1]));
        println!(
            "{:<20} change {changed:.5}, difference between engines {difference:.5}, without effect {:.5}",
            effect.name,
            rms(&ideal[0], &ideal[1])
        );
        let ideal_difference = rms(&ideal[0], &ideal[1]);
        assert!(
            changed > 3.0 * ideal_difference,
            "`{}`: change {changed}, difference between engines {ideal_difference}",
            effect.name
        );
        if effect.name == NOT_COMPARED {
            continue;
        }
        if effect.name == CHAOTIC {
            let in_rapier = rms(&rapier, &ideal[0]);
            assert!((0.8..1.25).contains(&(in_rapier / changed)), "`{}`: {in_rapier} and {changed}", effect.name);
        } else {
            assert!(
                difference < 0.15 * changed + 2.0 * ideal_difference,
                "`{}`: difference {difference}, change {changed}",
                effect.name
            );
        }
    }
}

/// Joints whose friction exceeds the actuator torque do not move, also on a server.
#[test]
fn server_simulates_the_effects_of_its_model_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stiff.toml");
    let friction = "[[effect]]\nname = \"coulomb_friction\"\nscope = \"all\"\ntorque_nm = 20.0\n";
    std::fs::write(&path, format!("robot = \"go2\"\n{friction}")).unwrap();
    let moved = |model: Option<std::path::PathBuf>| {
        let mut config = remote::config(TaskConfig::default());
        config.server.model = model;
        let (server, endpoint) = remote::start(&config);
        let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 1)).unwrap();
        let before = env.reset(&ResetRequest::seeded(1, 1)).unwrap()[9..21].to_vec();
        let mut after = before.clone();
        for _ in 0..5 {
            after = env.step(&[0.3; 12]).unwrap().obs[9..21].to_vec();
        }
        server.shutdown();
        before.iter().zip(&after).map(|(before, after)| (before - after).abs()).fold(0.0, f32::max)
    };
    let (ideal, with_friction) = (moved(None), moved(Some(path)));
    assert!(ideal > 0.05, "{ideal} rad");
    assert!(with_friction < 0.3 * ideal, "{with_friction} rad, without friction {ideal} rad");
}
