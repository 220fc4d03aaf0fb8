//! Environments of robots of any tree: in process, and over the network.

use std::path::PathBuf;
use std::sync::Arc;

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory, TreeEnvFactory};
use twinstep_envs::{PoseConfig, TaskConfig, check_vec_env};
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv};
use twinstep_sim::{Engine, Terrain};
use twinstep_tests::python::root;

use crate::remote::{config, start_with};

const ROBOTS: [(&str, usize); 6] =
    [("g1", 29), ("so101", 6), ("anymal_c", 12), ("mini_cheetah", 12), ("aliengo", 12), ("spot", 12)];

fn model(name: &str) -> PathBuf {
    root().join(format!("data/robots/{name}.toml"))
}

fn pose_config(name: &str) -> Config {
    let mut config = config(TaskConfig::Pose(PoseConfig::default()));
    config.server.model = Some(model(name));
    config.sim.threads = 1;
    config
}

fn env(config: &Config, num_envs: usize, autoreset: AutoresetMode) -> Box<dyn VecEnv> {
    TreeEnvFactory::new(config).unwrap().build(num_envs, autoreset, Some(20)).unwrap()
}

#[test]
fn every_shipped_robot_keeps_the_contract_of_an_environment() {
    for (name, joints) in ROBOTS {
        let mut config = pose_config(name);
        if ["aliengo", "spot"].contains(&name) {
            // Their model files are those of quadrupeds; the robot file has no gains.
            config.server.model = Some(model(name).with_extension("xml"));
            let error = TreeEnvFactory::new(&config).err().unwrap().to_string();
            assert!(error.contains("the model file states no `kp` of joint `FL_hip`"), "{error}");
            continue;
        }
        for autoreset in [AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled] {
            let mut env = env(&config, 3, autoreset);
            assert_eq!((env.spec().robot.as_str(), env.spec().action_len()), (name, joints));
            check_vec_env(env.as_mut(), 45).unwrap_or_else(|error| panic!("{name}, {autoreset:?}: {error}"));
        }
    }
}

#[test]
fn engines_agree_on_the_first_second_of_an_arm() {
    let observe = |engine: Engine| {
        let mut config = pose_config("so101");
        config.sim.engine = engine;
        let mut env = TreeEnvFactory::new(&config).unwrap().build(1, AutoresetMode::Disabled, Some(1000)).unwrap();
        env.reset(&ResetRequest::seeded(3, 1)).unwrap();
        for step in 0..50 {
            env.step(&[0.5 * (0.2 * step as f32).sin(); 6]).unwrap();
        }
        env.obs().to_vec()
    };
    let (batch, rapier) = (observe(Engine::Batch), observe(Engine::Rapier));
    for (one, other) in batch[6..12].iter().zip(&rapier[6..12]) {
        assert!((one - other).abs() < 0.01, "{batch:?}\n{rapier:?}");
    }
}

#[test]
fn humanoid_is_stepped_over_the_network_as_in_process() {
    let config = pose_config("g1");
    let (server, endpoint) = start_with(&config, Arc::new(TreeEnvFactory::new(&config).unwrap()));
    let options = ConnectOptions {
        autoreset: AutoresetMode::SameStep,
        max_episode_steps: Some(20),
        ..ConnectOptions::new(&endpoint, 2)
    };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut local = env(&config, 2, AutoresetMode::SameStep);
    assert_eq!((remote.spec(), remote.spec().hash()), (local.spec(), local.spec().hash()));
    assert_eq!(remote.spec().joint_gains.len(), 29);
    let request = ResetRequest::seeded(5, 2);
    assert_eq!(remote.reset(&request).unwrap(), local.reset(&request).unwrap());
    for step in 0..45 {
        let actions: Vec<f32> = (0..58).map(|entry| 0.3 * (0.4 * (step + entry) as f32).sin()).collect();
        assert_eq!(remote.step(&actions).unwrap(), local.step(&actions).unwrap(), "step {step}");
    }
    remote.close().unwrap();
    server.shutdown();
}

#[test]
fn settings_that_a_tree_does_not_have_are_refused_by_name() {
    let error = |change: &dyn Fn(&mut Config)| {
        let mut config = pose_config("g1");
        change(&mut config);
        TreeEnvFactory::new(&config).err().unwrap().to_string()
    };
    let walk = error(&|config| config.task = TaskConfig::default());
    assert_eq!(walk, "`task.name`: a robot of any tree has the task `pose`");
    let terrain = error(&|config| config.sim.terrain = Terrain::SlopeRad(0.1));
    assert!(terrain.contains("`sim.terrain`: the task `pose` is on flat ground"), "{terrain}");
    let randomise = error(&|config| config.randomise.kp_scale = [0.9, 1.1]);
    assert!(randomise.contains("`randomise`: robots of the task `pose` are not randomised yet"), "{randomise}");
    let engine = error(&|config| config.sim.engine = Engine::Mujoco);
    assert!(engine.contains("`batch` or `rapier` for a robot of any tree"), "{engine}");
    let weight = error(&|config| config.sim.physics_hz = Some(300));
    assert!(weight.contains("a multiple of the actuator rate"), "{weight}");
    let walk =
        SimEnvFactory::new(Config { task: TaskConfig::default(), ..pose_config("g1") }).err().unwrap().to_string();
    assert!(walk.contains("this is the model file of a robot of any tree"), "{walk}");
}
