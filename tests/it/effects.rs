//! Effects of the catalogue do the same in both engines.

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_effects::{CATALOGUE, Effect, EffectEntry, Scope, Target, apply_effects};
use twinstep_envs::TaskName;
use twinstep_model::{
    Backend, BaseMount, Command, InitialState, NUM_JOINTS, PerJoint, ResetRequest, RobotModel, VecEnv, go2,
};
use twinstep_sim::{BatchBackend, Engine, RapierBackend, SimConfig};

use crate::remote;

/// A joint rattles in its play, and small differences grow: the motions part in time, and the size of the change is held.
const RATTLES: &str = "backlash";
/// The engines have two laws of a contact, which agree only while it is stiff: how much a soft ground changes is not held
/// (docs/physics.md has the numbers).
const DISAGREES: &str = "ground_stiffness";

/// Actuator periods of the motion.
const PERIODS: usize = 200;

fn config(engine: Engine, base: BaseMount) -> SimConfig {
    SimConfig { engine, base, physics_hz: Some(2000), threads: 1, ..SimConfig::default() }
}

/// Joint positions and torques in each actuator period of a chirp in the air, or of a sway on the feet.
fn motion(backend: &mut impl Backend, base: BaseMount) -> Vec<PerJoint> {
    let pose = go2().control.default_pose_f32();
    let height = if base == BaseMount::Fixed { 1.0 } else { 0.3236 };
    backend.reset(&[(0, InitialState::at_rest(height, pose))]).unwrap();
    let mut rows = Vec::new();
    for period in 0..PERIODS {
        let t = period as f32 * 0.005;
        let swing = (std::f32::consts::TAU * (1.0 + 1.5 * t) * t).sin();
        let target =
            std::array::from_fn(|j| pose[j] + if base == BaseMount::Fixed { 0.3 * swing } else { 0.08 * swing });
        backend.step(&[Command::hold(target, 30.0, 0.75)], &[true], 1).unwrap();
        rows.push(backend.states().q[0]);
        rows.push(backend.states().tau[0].map(|tau| 0.02 * tau));
        let [x, y, z] = backend.states().base_angular_velocity[0];
        rows.push([[x, y, z].map(|rate| 0.2 * rate); 4].concat().try_into().unwrap());
    }
    rows
}

fn in_both(robot: &RobotModel, base: BaseMount) -> [Vec<PerJoint>; 2] {
    let mut rapier = RapierBackend::new(robot.clone(), config(Engine::Rapier, base), 1).unwrap();
    let mut batch = BatchBackend::new(robot.clone(), config(Engine::Batch, base), 1).unwrap();
    [motion(&mut rapier, base), motion(&mut batch, base)]
}

fn rms(one: &[PerJoint], other: &[PerJoint]) -> f32 {
    let squares = one.iter().flatten().zip(other.iter().flatten()).map(|(one, other)| (one - other).powi(2));
    (squares.sum::<f32>() / (one.len() * NUM_JOINTS) as f32).sqrt()
}

fn entry(effect: &'static Effect) -> EffectEntry {
    let scope = match effect.target {
        Target::Joints | Target::Supply => Scope::All,
        Target::Bodies | Target::Base => Scope::Base,
        Target::Ground => Scope::Ground,
    };
    let values = effect.parameters.iter().flat_map(|parameter| {
        let [low, high] = parameter.prior_range;
        std::iter::repeat_n(low + 0.7 * (high - low), parameter.count)
    });
    let values = match effect.name {
        // A trunk twice as heavy and wide.
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
fn effects_do_the_same_in_both_engines() {
    // These need a log's voltage, temperature or torque channel, and leave the motion alone.
    let elsewhere = ["supply_sag", "thermal_derating", "torque_sensor_delay"];
    for effect in CATALOGUE.into_iter().filter(|effect| !elsewhere.contains(&effect.name)) {
        let base = if effect.target == Target::Joints { BaseMount::Fixed } else { BaseMount::Floating };
        let ideal = in_both(&go2(), base);
        let [rapier, batch] = in_both(&apply_effects(&go2(), &[entry(effect)]).unwrap(), base);
        let (apart, changed) = (rms(&rapier, &batch), rms(&batch, &ideal[1]));
        println!(
            "{:<20} changes {changed:.5}, engines {apart:.5} apart, ideal {:.5}",
            effect.name,
            rms(&ideal[0], &ideal[1])
        );
        let ideal_apart = rms(&ideal[0], &ideal[1]);
        assert!(
            changed > 3.0 * ideal_apart,
            "`{}` changes {changed}, the engines differ by {ideal_apart}",
            effect.name
        );
        if effect.name == DISAGREES {
            continue;
        }
        if effect.name == RATTLES {
            let in_rapier = rms(&rapier, &ideal[0]);
            assert!((0.8..1.25).contains(&(in_rapier / changed)), "`{}`: {in_rapier} and {changed}", effect.name);
        } else {
            assert!(
                apart < 0.15 * changed + 2.0 * ideal_apart,
                "`{}`: {apart} apart, it changes {changed}",
                effect.name
            );
        }
    }
}

/// Joints that are held by more friction than their actuators have torque stay where they are, over the wire too.
#[test]
fn server_simulates_the_effects_of_its_model_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("stiff.toml");
    let friction = "[[effect]]\nname = \"coulomb_friction\"\nscope = \"all\"\ntorque_nm = 20.0\n";
    std::fs::write(&path, format!("robot = \"go2\"\n{friction}")).unwrap();
    let moved = |model: Option<std::path::PathBuf>| {
        let mut config = remote::config(TaskName::Walk);
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
    let (ideal, held) = (moved(None), moved(Some(path)));
    assert!(ideal > 0.05, "{ideal} rad");
    assert!(held < 0.3 * ideal, "{held} rad, without friction {ideal}");
}
