//! Environments of robots of any tree: in process, and over the network.

use std::path::PathBuf;
use std::sync::Arc;

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory, TreeEnvFactory};
use twinstep_envs::{PoseConfig, TaskConfig, WalkConfig, check_vec_env};
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv};
use twinstep_sim::{CourseTerrain, Engine, Terrain};
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

/// Reward terms that are the same quantity in both engines. The others count contacts of other shapes.
const SAME_TERMS: [&str; 11] = [
    "track_linear_velocity",
    "track_angular_velocity",
    "linear_velocity_z",
    "angular_velocity_xy",
    "flat_orientation",
    "base_height",
    "joint_torque",
    "action_rate",
    "joint_position_limits",
    "hip_deviation",
    "stand_still",
];

#[test]
fn go2_as_a_tree_walks_as_the_quadruped() {
    let mut config = config(TaskConfig::default());
    config.sim.threads = 1;
    let mut tree = TreeEnvFactory::new(&config).unwrap().build(4, AutoresetMode::Disabled, None).unwrap();
    let mut quadruped = SimEnvFactory::new(config).unwrap().build(4, AutoresetMode::Disabled, None).unwrap();
    assert_eq!(tree.spec().hash(), quadruped.spec().hash(), "a policy of one is a policy of the other");
    let request = ResetRequest::seeded(7, 4);
    let (one, other) = (tree.reset(&request).unwrap().to_vec(), quadruped.reset(&request).unwrap().to_vec());
    let mut obs = [one, other];
    for step in 0..100 {
        for (index, (one, other)) in obs[0].iter().zip(&obs[1]).enumerate() {
            let name = tree.spec().observation_entry(index % 45);
            let bound = if name.starts_with("joint_velocity") { 1.0 } else { 0.05 };
            assert!((one - other).abs() < bound, "step {step}, {name}: {one} {other}");
        }
        let actions: Vec<f32> = (0..48).map(|entry| 0.2 * (0.3 * step as f32 + entry as f32).sin()).collect();
        let steps = [&mut tree, &mut quadruped].map(|env| env.step(&actions).unwrap().clone());
        let terms = [&tree, &quadruped].map(|env| env.scene(1).unwrap().reward_terms);
        for (index, name) in quadruped.spec().reward_terms.iter().enumerate() {
            let (one, other) = (terms[0][index], terms[1][index]);
            let is_same = SAME_TERMS.contains(&name.as_str());
            assert!(!is_same || (one - other).abs() < 4e-3, "step {step}, {name}: {one} {other}");
        }
        obs = steps.map(|batch| batch.obs);
    }
}

#[test]
fn every_legged_robot_walks_and_an_arm_is_told_what_it_lacks() {
    for (name, feet) in [("g1", 2), ("anymal_c", 4), ("mini_cheetah", 4)] {
        let config = Config { task: TaskConfig::default(), ..pose_config(name) };
        let factory = TreeEnvFactory::new(&config).unwrap();
        assert_eq!(factory.control().feet.len(), feet, "{name}");
        let mut env = factory.build(3, AutoresetMode::SameStep, Some(20)).unwrap();
        let joints = env.spec().action_len();
        assert_eq!((env.spec().obs_len(), env.spec().critic_obs_len()), (9 + 3 * joints, 7 + feet), "{name}");
        check_vec_env(env.as_mut(), 45).unwrap_or_else(|error| panic!("{name}: {error}"));
        env.reset(&ResetRequest::default()).unwrap();
        env.set_velocity_commands(&[[0.3, 0.0, 0.1]; 3]).unwrap();
        (0..10).for_each(|_| drop(env.step(&vec![0.0; 3 * joints]).unwrap().clone()));
        let batch = env.step(&vec![0.0; 3 * joints]).unwrap();
        assert_eq!(batch.obs[6..9], [0.3, 0.0, 0.1]);
        // It stands on its feet.
        let force: f32 = batch.critic_obs[7..7 + feet].iter().sum();
        assert!(force > 20.0 && batch.terminated == [false; 3], "{name}: {force} N");
    }
    let arm = Config { task: TaskConfig::default(), ..pose_config("so101") };
    let error = TreeEnvFactory::new(&arm).err().unwrap().to_string();
    assert_eq!(error, "`task.name` = walk is not allowed: `pose` for a robot whose base is fixed");
}

#[test]
fn episodes_of_a_tree_have_their_own_robots_and_are_pushed() {
    let observe = |change: &dyn Fn(&mut Config)| {
        let mut config = pose_config("mini_cheetah");
        change(&mut config);
        let mut env = env(&config, 2, AutoresetMode::SameStep);
        env.reset(&ResetRequest::seeded(3, 2)).unwrap();
        (0..15).for_each(|_| drop(env.step(&[0.1; 24]).unwrap().clone()));
        env.obs().to_vec()
    };
    let nominal = observe(&|_| {});
    for change in [
        (&|config: &mut Config| config.randomise.mass_scale = [1.3, 1.3]) as &dyn Fn(&mut Config),
        &|config| config.randomise.payload_kg = [2.0, 2.0],
        &|config| config.randomise.kp_scale = [0.7, 0.7],
        &|config| config.randomise.command_delay_ms = [20.0, 20.0],
        &|config| config.randomise.noise.joint_position_rad = 0.1,
        &|config| {
            config.randomise.push_m_s = [1.0, 1.0];
            config.randomise.push_interval_s = [0.1, 0.1];
        },
    ] {
        let changed = observe(change);
        let difference = nominal.iter().zip(&changed).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
        assert!(difference > 0.005, "{difference}");
        assert!(changed[..54] != changed[54..], "each robot has its own episode");
    }
}

const CONTROLLED: &str = r#"<mujoco model="leg"><worldbody><body name="base">
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  <body name="thigh"><joint name="hip" axis="0 1 0"/><inertial pos="0 0 -0.1" mass="1" diaginertia="0.1 0.1 0.1"/>
    <body name="shank" pos="0 0 -0.2"><joint name="knee" axis="0 1 0"/><inertial pos="0 0 -0.1" mass="1" diaginertia="0.1 0.1 0.1"/></body>
  </body></body></worldbody>
  <actuator><position name="hip" joint="hip" kp="30" kv="2"/>
    <general name="knee" joint="knee" gear="2" biastype="affine" gainprm="10" biasprm="0 -10 -1"/></actuator>
  <keyframe><key name="other" qpos="1 1"/><key name="home" qpos="0.3 -0.6"/></keyframe></mujoco>"#;

#[test]
fn robot_file_with_its_own_controllers_and_home_needs_no_model_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("leg.xml");
    std::fs::write(&path, CONTROLLED).unwrap();
    let spec = |model: PathBuf| {
        let mut config = pose_config("so101");
        config.server.model = Some(model);
        TreeEnvFactory::new(&config)
            .map(|factory| factory.build(1, AutoresetMode::Disabled, None).unwrap().spec().clone())
    };
    let own = spec(path).unwrap();
    // The gear of the second one is 2.
    assert_eq!(own.joint_gains, [[30.0, 2.0], [40.0, 4.0]]);
    assert_eq!(own.default_pose, [0.3, -0.6]);
    assert_eq!(own.action_scale, 0.25, "there are no torque limits");
    let model = folder.path().join("leg.toml");
    let text = "robot = \"leg.xml\"\n[joints.rename]\nhip = \"Hip\"\n[control]\nkp = { knee = 5.0 }\ndefault_pose = { knee = 0.0 }\n";
    std::fs::write(&model, text).unwrap();
    let stated = spec(model).unwrap();
    assert_eq!((stated.joint_gains, stated.default_pose), (vec![[30.0, 2.0], [5.0, 4.0]], vec![0.3, 0.0]));
    let limited = folder.path().join("limited.xml");
    std::fs::write(&limited, CONTROLLED.replace("kv=\"2\"", "kv=\"2\" forcerange=\"-24 24\"")).unwrap();
    assert_eq!(spec(limited).unwrap().action_scale, 0.4, "half of the torque of the hip");
    let motors = folder.path().join("motors.xml");
    let motor = "<motor name=\"hip\" joint=\"hip\"/>";
    std::fs::write(&motors, CONTROLLED.replace("<position name=\"hip\" joint=\"hip\" kp=\"30\" kv=\"2\"/>", motor))
        .unwrap();
    let error = spec(motors).unwrap_err().to_string();
    assert!(error.contains("states no `kp` of joint `hip`"), "{error}");
}

#[test]
fn gains_of_a_robot_file_are_those_that_mujoco_compiles() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("leg.xml");
    let position = "<position name=\"hip\" joint=\"hip\" kp=\"30\" kv=\"2\"/>";
    let spec = |text: &str| {
        std::fs::write(&path, text).unwrap();
        let mut config = pose_config("so101");
        config.server.model = Some(path.clone());
        let factory = TreeEnvFactory::new(&config).map_err(|error| error.to_string())?;
        Ok::<_, String>(factory.build(1, AutoresetMode::Disabled, None).unwrap().spec().clone())
    };
    // Shortcuts and <general> share their defaults.
    let shared = "<default><general biastype=\"affine\" gainprm=\"100\" biasprm=\"0 -100 -5\"/></default><worldbody>";
    let text = CONTROLLED.replace("<worldbody>", shared).replace(position, "<position name=\"hip\" joint=\"hip\"/>");
    assert_eq!(spec(&text).unwrap().joint_gains[0], [100.0, 5.0]);
    // A positive third number is a ratio of the critical damping, so that the gain is not known.
    let error = spec(&CONTROLLED.replace("biasprm=\"0 -10 -1\"", "biasprm=\"0 -10 1\"")).unwrap_err();
    assert!(error.contains("states no `kp` of joint `knee`"), "{error}");
    let error = spec(&CONTROLLED.replace("kp=\"30\"", "kp=\"-30\"")).unwrap_err();
    assert!(error.contains("`kp` of <position> is \"-30\"") && error.contains("0 or more expected"), "{error}");
    // A joint that nothing drives needs none, and a base without mass is one.
    let text =
        CONTROLLED.replace("<inertial pos=\"0 0 0\" mass=\"1\" diaginertia=\"1 1 1\"/>", "").replace(position, "");
    assert_eq!(spec(&text).unwrap().joint_gains, [[0.0, 0.0], [40.0, 4.0]]);
    // The pose of the robot is found among those of other things.
    let ball = "<worldbody><body name=\"ball\"><freejoint/><geom size=\"0.1\" mass=\"1\"/></body>";
    let home = CONTROLLED.replace("<worldbody>", ball).replace("qpos=\"0.3 -0.6\"", "qpos=\"9 9 9 1 0 0 0 0.3 -0.6\"");
    assert_eq!(spec(&home).unwrap().default_pose, [0.3, -0.6]);
}

#[test]
fn intervals_of_a_model_file_are_sampled_in_each_episode() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("worn.toml");
    let robot = root().join("data/robots/so101.xml");
    let worn = || {
        let text = format!(
            "robot = {robot:?}\n[control]\nkp = 15.0\nkd = 0.6\n[[effect]]\nname = \"coulomb_friction\"\nscope = \"all\"\n\
             torque_nm = 0.3\ninterval = {{ torque_nm = [0.05, 0.6] }}\n"
        );
        std::fs::write(&model, text).unwrap();
        let mut config = pose_config("so101");
        config.server.model = Some(model.clone());
        config.randomise.effects = true;
        config
    };
    let observe = |effects: bool| {
        let mut config = worn();
        config.randomise.effects = effects;
        let mut env = env(&config, 2, AutoresetMode::SameStep);
        env.reset(&ResetRequest { seeds: Some(vec![5, 5]), ..ResetRequest::default() }).unwrap();
        (0..5).for_each(|_| drop(env.step(&[0.5; 12]).unwrap().clone()));
        env.obs().to_vec()
    };
    let (sampled, stated) = (observe(true), observe(false));
    assert_eq!(sampled[..30], sampled[30..], "one seed is one robot");
    let moved = sampled.iter().zip(&stated).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
    assert!(moved > 1e-4, "{moved}: the friction is not that of the file");
}

/// A course is of 8 m patches; robots start in the middle of theirs, evenly over kinds and levels.
#[test]
fn robot_of_another_tree_stands_on_the_patches_of_a_course_and_observes_frames() {
    let terrain = CourseTerrain { stairs_m: Some([0.05, 0.15]), levels: 2, seed: 1, ..CourseTerrain::default() };
    let walk = WalkConfig { frames: 2, critic_heights: true, heading_probability: 1.0, ..WalkConfig::default() };
    for name in ["anymal_c", "spot"] {
        let mut config = Config { task: TaskConfig::Walk(walk.clone()), ..pose_config(name) };
        config.sim.terrain = Terrain::Course(terrain);
        let mut env = TreeEnvFactory::new(&config).unwrap().build(8, AutoresetMode::SameStep, None).unwrap();
        env.reset(&ResetRequest::seeded(1, 8)).unwrap();
        assert_eq!((env.spec().obs_len(), env.mean_level()), (2 * 45, Some(0.5)), "{name}");
        for _ in 0..25 {
            assert_eq!(env.step(&[0.0; 96]).unwrap().terminated, [false; 8], "{name}");
        }
        for robot in 0..8 {
            let ([x, y, ..], [middle_x, middle_y]) =
                (env.scene(robot).unwrap().pose[0], terrain.patches().centre(robot / 2 % 2, robot % 2));
            assert!((x - middle_x).hypot(y - middle_y) < 0.2, "{name}, robot {robot}: {x} {y}");
        }
    }
    let mut pose = pose_config("spot");
    pose.sim.terrain = Terrain::Course(terrain);
    let error = TreeEnvFactory::new(&pose).err().unwrap().to_string();
    assert_eq!(error, "`sim.terrain`: a course is for the task `walk`; `pose` has another ground");
}

#[test]
fn settings_that_a_tree_does_not_have_are_refused_by_name() {
    let error = |change: &dyn Fn(&mut Config)| {
        let mut config = pose_config("g1");
        change(&mut config);
        TreeEnvFactory::new(&config).err().unwrap().to_string()
    };
    let jump = error(&|config| config.task = TaskConfig::named("jump").unwrap());
    assert_eq!(jump, "`task.name`: a robot of any tree has the tasks `pose` and `walk`");
    let payload = error(&|config| config.randomise.payload_kg = [-20.0, 0.0]);
    assert!(payload.contains("`randomise.payload_kg`"), "{payload}");
    let terrain = error(&|config| {
        config.sim.engine = Engine::Mujoco;
        config.sim.terrain = Terrain::SlopeRad(0.1);
    });
    assert!(terrain.contains("`flat` in the engine `mujoco`"), "{terrain}");
    let weight = error(&|config| config.sim.physics_hz = Some(300));
    assert!(weight.contains("a multiple of the actuator rate"), "{weight}");
    let walk =
        SimEnvFactory::new(Config { task: TaskConfig::default(), ..pose_config("g1") }).err().unwrap().to_string();
    assert!(walk.contains("this is the model file of a robot of any tree"), "{walk}");
}
