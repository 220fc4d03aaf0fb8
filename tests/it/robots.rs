//! Robots from files: Go1 and B2 from URDF, A1, Aliengo and Spot from MJCF, in both engines.

use std::path::PathBuf;

use twinstep_effects::ModelFile;
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_envs::{TaskConfig, trot};
use twinstep_model::{AutoresetMode, Ground, InitialState, ResetRequest, VecEnv, go2};
use twinstep_sim::Engine;

use crate::remote;

/// Model file, and sum of the masses in its source [kg].
const ROBOTS: [(&str, f64); 5] =
    [("go1", 12.743), ("a1", 12.453), ("b2", 61.711), ("aliengo", 24.937), ("spot", 50.340)];

fn model(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join(format!("data/robots/{name}.toml"))
}

fn env(engine: Engine, name: &str) -> Box<dyn VecEnv> {
    let mut config = Config { ..remote::config(TaskConfig::default()) };
    config.sim.engine = engine;
    config.sim.threads = 1;
    config.server.model = Some(model(name));
    remote::walk(&mut config).reset_joint_noise_rad = 0.0;
    SimEnvFactory::new(config).unwrap().build(1, AutoresetMode::Disabled, Some(1000)).unwrap()
}

#[test]
fn robots_from_files_have_the_mass_and_the_names_of_their_sources() {
    for (name, mass) in ROBOTS {
        let robot = ModelFile::load(model(name)).unwrap().robot_model().unwrap();
        assert_eq!(robot.name, name);
        assert!((robot.total_mass() - mass).abs() < 0.005, "{name}: {} kg", robot.total_mass());
    }
    let go1 = ModelFile::load(model("go1")).unwrap().robot_model().unwrap();
    assert_eq!((go1.joints[0].viscous_friction, go1.joints[0].coulomb_friction), (0.01, 0.2), "damping and friction");
}

#[test]
fn robots_from_files_stand_and_trot_in_both_engines() {
    for (name, _) in ROBOTS {
        let robot = ModelFile::load(model(name)).unwrap().robot_model().unwrap();
        let pose = robot.control.default_pose_f32();
        let [.., nominal] = InitialState::standing_on(&Ground::FLAT, &robot, pose, 0.0).base_position;
        let standing = [Engine::Batch, Engine::Rapier].map(|engine| {
            let mut env = env(engine, name);
            assert_eq!(env.spec().robot, name);
            env.reset(&ResetRequest::seeded(1, 1)).unwrap();
            // Entry 6 of the privileged observation is the height of the base.
            for _ in 0..100 {
                env.step(&[0.0; 12]).unwrap();
            }
            let standing = env.critic_obs()[6];
            for step in 0..150 {
                let action = trot::action(step as f32 * env.spec().policy_dt as f32);
                assert!(!env.step(&action).unwrap().terminated[0], "{name}, {engine:?}: falls after {step} steps");
            }
            let trotting = env.critic_obs()[6];
            assert!((trotting / standing - 1.0).abs() < 0.2, "{name}, {engine:?}: {trotting} m, standing {standing} m");
            standing
        });
        // The legs bend under the weight.
        assert!(standing.iter().all(|height| (0.85..1.0).contains(&(height / nominal))), "{name}: {standing:?} m");
        assert!((standing[0] / standing[1] - 1.0).abs() < 0.01, "{name}: {standing:?} m, which should be equal");
    }
}

#[test]
fn model_of_a_robot_file_is_written_with_its_tables_and_read_back() {
    let file = ModelFile::load(model("b2")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let copy = folder.path().join("copy.toml");
    std::fs::write(&copy, file.to_toml()).unwrap();
    assert_eq!(ModelFile::load(&copy).unwrap(), file);
}

#[test]
fn robot_file_alone_is_a_model_with_the_control_settings_of_the_go2() {
    let robot = ModelFile::load(model("go1").with_extension("urdf")).unwrap().robot_model().unwrap();
    assert_eq!((robot.name.as_str(), robot.control), ("go1", go2().control));
}

#[test]
fn invalid_robots_are_refused_with_key_value_and_what_is_expected() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.toml");
    let error = |text: &str| {
        std::fs::write(&path, text).unwrap();
        ModelFile::load(&path).unwrap_err().to_string()
    };
    let urdf = model("go1").with_extension("urdf");
    let robot = format!("robot = {:?}\n", urdf.to_str().unwrap());
    let names = format!("[joints]\nnames = {:?}\n", ["a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k", "l"]);
    for (text, expected) in [
        (
            "robot = \"spot\"".to_owned(),
            "`robot` = \"spot\" is unknown; possible: \"go2\", or a file that ends with .urdf",
        ),
        ("robot = \"missing.urdf\"".to_owned(), "`robot`: cannot read "),
        (format!("{robot}[control]\nkp = -1.0"), "`control.kp` is -1; 0 to 100000 N·m/rad expected"),
        (
            format!("{robot}[control]\nactuator_hz = 200.0\npolicy_hz = 60.0"),
            "`control.policy_hz` is 60; a rate of which",
        ),
        (format!("{robot}{names}"), "`control.actuator_hz` is missing"),
        ("robot = \"go2\"\n[joints]".to_owned(), "the names of the built-in `go2` are fixed"),
    ] {
        let error = error(&text);
        assert!(error.contains(expected), "{error}");
    }
}
