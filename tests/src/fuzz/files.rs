//! Files that users give to the program: examples that are texts, and reading as the commands do.

use std::io::Write;
use std::path::Path;

use twinstep_effects::{
    CATALOGUE, Effect, EffectEntry, ModelFile, ModelFileError, RobotSampler, Scope, Target, TreeModelFile, parse_toml,
};
use twinstep_ensemble::{ActuatorNetworkRobot, Checkpoint, Ensemble, Inference};
use twinstep_env_server::{Config, ConfigFileError, SimEnvFactory};
use twinstep_excite::CommandSequence;
use twinstep_identify::{EffectAtScope, GlobalSearch};
use twinstep_logs::{ColumnMap, Log, LogError};
use twinstep_model::{BaseMount, Joint, MjcfOptions, go2, mjcf, stream};
use twinstep_protocol::{Secret, keys};
use twinstep_robot_files::{QuadrupedNames, RobotFileError, TreeMjcf, quadruped, read_robot, write_mjcf};

use super::format::{Format, Outcome, examples_in};
use super::{log_examples, policies, weights_examples};

/// Returns bytes compressed with gzip.
pub fn compressed(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    written.expect("a Vec takes all bytes")
}

/// A robot with controllers and a keyframe, beside an object.
const SCENE: &str = r#"<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="base"><joint type="free" armature="0.1" damping="0.2" frictionloss="0.1"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<body name="leg"><joint name="hip"/><joint name="knee" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
<geom name="foot" size="0.1" contype="0" conaffinity="0"/></body></body>
<body name="ball"><freejoint/><geom size="0.1" mass="1"/></body></worldbody>
<contact><pair geom1="foot" geom2="floor"/></contact>
<actuator><position joint="hip" kp="20" kv="1"/><general joint="knee" biastype="affine" gainprm="9" biasprm="0 -9 -1"/></actuator>
<keyframe><key name="home" qpos="0 0 1 1 0 0 0 0.1 0.2 1 1 1 1 0 0 0"/></keyframe></mujoco>"#;

/// Model file of a robot of any tree with every table.
const TREE: &str = r#"robot = "go2"
[control]
kp = { hip = 20.0 }
kd = 0.5
[joints.rename]
FL_hip = "hip"
[groups]
foot = ["FL_calf", "RR_calf"]
hip = ["hip"]
[shapes]
FL_calf = [{ sphere = 0.02, at = [0.0, 0.0, -0.2] }, { box = [0.1, 0.1, 0.1], rpy = [0.1, 0.2, 0.3] }]
trunk = [{ capsule = [0.05, 0.2] }]
"#;

/// Returns the examples of a text format.
pub fn text_examples(format: Format) -> Vec<Vec<u8>> {
    match format {
        Format::Model => model_files(),
        Format::Urdf => examples_in("data/robots", "", ".urdf"),
        Format::Mjcf => {
            let exported = mjcf(&go2(), &MjcfOptions::default()).into_bytes();
            [examples_in("data/robots", "", ".xml"), vec![exported, SCENE.into()]].concat()
        }
        Format::Config => {
            let default = toml::to_string(&Config::default()).expect("a config is plain data");
            vec![default.into_bytes(), CONFIG.into(), JUMP_CONFIG.into()]
        }
        Format::Commands => vec![COMMANDS.into()],
        Format::ColumnMap => vec![COLUMN_MAP.into()],
        Format::Search => vec![SEARCH.into()],
        Format::Zenoh => examples_in("examples/security", "", ".json5"),
        _ => ARGUMENTS.iter().map(|text| text.as_bytes().to_vec()).collect(),
    }
}

/// Velocity commands of a run.
const COMMANDS: &str = "start_s,end_s,vx,vy,wz\n0,5,1,0,-0.5\n5,10,-0.25,0.5,1\n10,12.5,0,0,0\n";

/// Map of columns with every kind of entry.
const COLUMN_MAP: &str = r#"
t = { column = "stamp", unit = "ns" }
"q_*" = { column = "pos_*", unit = "deg" }
q_FL_calf = "knee"
"dq_*" = { scale = -1.0, offset = 0.5 }
[meta]
rate_hz = 500
tau_sensor = "none"
segments = [{ name = "walk", base = "floating" }]
"#;

/// Config file of another task.
const JUMP_CONFIG: &str = r#"
[task]
name = "jump"
target_x_m = [0.2, 0.9]
target_yaw_rad = [-0.5, 0.5]
reward.success = 5.0
walk.reward.action_rate = -0.01
"#;

/// Config file with the keys that have no default, and rough terrain.
const CONFIG: &str = r#"
[server]
name = "go2-lab_3"
listen = "tcp/0.0.0.0:7447"
connect = ["tcp/10.0.0.7:7447"]
max_envs_per_client = 64
lease_idle_s = 600.0
seed = 7
[task]
name = "walk"
max_episode_s = 20.0
[sim]
engine = "rapier"
physics_hz = 400
solver_iterations = 4
base = "fixed"
terrain.rough = { height_m = 0.05, cell_m = 0.1, size_m = 20.0, seed = 1 }
[randomise]
mass_scale = [0.9, 1.1]
payload_kg = [-1.0, 3.0]
effects = true
"#;

/// Interrupted identification with two free parameters.
const SEARCH: &str = r#"{"problem_key":"friction@all","distribution":{"mean":[[0.0,0.0],2,null],"sigma":0.5,
"covariance":[[1.0,0.0,0.0,1.0],2,2],"root":[[1.0,0.0,0.0,1.0],2,2],"inverse_root":[[1.0,0.0,0.0,1.0],2,2],
"path":[[0.0,0.0],2,null],"sigma_path":[[0.0,0.0],2,null],"weights":[0.6,0.4],"generation":0},"best":[0.1,0.2],
"lowest":12.5,"best_cost_history":[14.0,12.5]}"#;

/// Arguments, and keys of the protocol.
const ARGUMENTS: [&str; 6] = [
    "coulomb_friction@calf,payload@base",
    "FL_hip",
    "00112233445566778899aabbccddeeff",
    "floating",
    "twinstep/0123456789abcdef/env/00c0ffee00c0ffee/step",
    "twinstep/live/server/0123456789abcdef/go2",
];

/// Returns the model files of the robots, and one with all effects of the catalogue.
fn model_files() -> Vec<Vec<u8>> {
    let mut all = ModelFile::default();
    for effect in CATALOGUE {
        let Some(values) = prior_values(effect) else { continue };
        let scope = match effect.target {
            Target::Joints | Target::Supply => Scope::All,
            Target::Bodies | Target::Imu => Scope::Base,
            Target::Ground => Scope::Ground,
        };
        let mut entry = EffectEntry::new(effect, scope, values).expect("values of the prior are allowed");
        entry.intervals = entry.values.iter().map(|value| Some([value - 1e-4, value + 1e-4])).collect();
        all.effects.push(entry);
    }
    let actuator = "robot = \"go2\"\n\n[control]\nkp = 25.0\npolicy_hz = 100.0\n\n[actuator]\n\
                    ensemble = \"actuators.safetensors\"\ndraw = \"step\"\nsample = true\n";
    let mut files = examples_in("data/robots", "", ".toml");
    files.extend([all.to_toml().into_bytes(), actuator.into(), TREE.into()]);
    files
}

/// Returns values a tenth of the way from no effect to the end of the prior. Returns `None` for `inertia`.
fn prior_values(effect: &Effect) -> Option<Vec<f64>> {
    let value = |parameter: &twinstep_effects::Parameter| {
        let [low, high] = parameter.bounds;
        let value = 0.9 * parameter.no_effect_value + 0.1 * parameter.prior_range[1];
        vec![value.clamp(low, high); parameter.count]
    };
    (effect.name != "inertia").then(|| effect.parameters.iter().flat_map(value).collect())
}

/// Writes an input to a file in `folder` and reads it.
pub fn read(format: Format, bytes: &[u8], folder: &Path) -> Outcome {
    match format {
        Format::Argument => read_arguments(bytes),
        Format::Csv => read_log(bytes, "data.csv", folder),
        Format::CsvGz => read_log(bytes, "data.csv.gz", folder),
        Format::Parquet => read_log(bytes, "data.parquet", folder),
        Format::Mcap => read_log(bytes, "data.mcap", folder),
        Format::Meta => {
            write(folder, "data.csv", &log_examples::csv());
            read_log(bytes, "meta.json", folder)
        }
        Format::Ensemble => read_ensemble(&write(folder, "ensemble", bytes)),
        Format::Training => {
            outcome(Checkpoint::read(&write(folder, "training", bytes)), |checkpoint| checkpoint.curves().count() > 0)
        }
        Format::Bag => read_log(bytes, "bag.db3", folder),
        Format::PolicyConfig => policies::read(format, bytes, &write(folder, "deploy.yaml", bytes)),
        Format::PolicyConfigPy => policies::read(format, bytes, &write(folder, "go2_config.py", bytes)),
        Format::Policy | Format::Onnx | Format::Mapping | Format::LowState | Format::RpcResponse => {
            policies::read(format, bytes, &write(folder, "policy", bytes))
        }
        text => match std::str::from_utf8(bytes) {
            Ok(text_of_file) => read_text(text, text_of_file, folder),
            Err(_) => Outcome::Refused,
        },
    }
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> std::path::PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap_or_else(|error| panic!("cannot write {}: {error}", path.display()));
    path
}

fn outcome<T, E: std::fmt::Display>(result: Result<T, E>, is_accepted: impl FnOnce(T) -> bool) -> Outcome {
    match result {
        Ok(value) => Outcome::checked(is_accepted(value)),
        Err(error) => {
            assert!(!error.to_string().is_empty(), "an error has a text");
            Outcome::Refused
        }
    }
}

fn read_text(format: Format, text: &str, folder: &Path) -> Outcome {
    match format {
        Format::ColumnMap => outcome(ColumnMap::parse(text), |_| true),
        Format::Model => {
            copy_robots(folder);
            read_model(&write(folder, "model.toml", text.as_bytes()), text)
        }
        Format::Urdf | Format::Mjcf => match read_robot(text, None) {
            Ok(file) => {
                read_robot(&write_mjcf(&file.tree, &TreeMjcf::default()), None)
                    .expect("a robot that was read can be written and read");
                if let Ok((robot, _)) = quadruped(&file, &QuadrupedNames::default(), go2().control) {
                    assert!(mjcf(&robot, &MjcfOptions::default()).contains("<mujoco"), "the robot can be exported");
                }
                Outcome::Accepted
            }
            Err(RobotFileError::Xml(_)) => Outcome::Refused,
            Err(error) => outcome(Err::<(), _>(error), |()| true).max_decoded(),
        },
        Format::Config => read_config(text),
        Format::Commands => outcome(CommandSequence::parse(text), |commands| {
            let again = CommandSequence::parse(&commands.to_csv()).expect("a written file can be read");
            assert!(again == commands, "a written file has the same commands");
            commands.at(0.5 * commands.duration_s()).iter().all(|velocity| velocity.is_finite())
        }),
        Format::Search => outcome(serde_json::from_str::<GlobalSearch>(text), |_| true),
        _ => outcome(zenoh::Config::from_json5(text), |_| true),
    }
}

/// Copies the robot files that the examples of model files name, unless they are in `folder` already.
fn copy_robots(folder: &Path) {
    for name in [
        "a1.xml",
        "b2.urdf",
        "go1.urdf",
        "so101.xml",
        "g1.xml",
        "anymal_c.xml",
        "mini_cheetah.xml",
        "aliengo.xml",
        "spot.xml",
    ] {
        if !folder.join(name).exists() {
            let content = examples_in("data/robots", name, "").remove(0);
            write(folder, name, &content);
        }
    }
}

fn read_model(path: &Path, text: &str) -> Outcome {
    match ModelFile::load(path) {
        Ok(file) => {
            let again = ModelFile::parse(&file.to_toml(), "the written file").expect("a written file can be read");
            assert!(file == again, "a written file has the same content");
            let has_intervals = file.effects.iter().flat_map(|entry| &entry.intervals).any(Option::is_some);
            if has_intervals && let Ok(sampler) = RobotSampler::new(file) {
                sampler.sample(&mut stream(0, "fuzz", 0));
            }
            Outcome::Accepted
        }
        Err(ModelFileError::OfTree { .. }) => read_tree_model(path),
        Err(error) => {
            assert!(!error.to_string().is_empty(), "an error has a text");
            if parse_toml::<toml::Table>(text).is_ok() { Outcome::Decoded } else { Outcome::Refused }
        }
    }
}

fn read_tree_model(path: &Path) -> Outcome {
    match TreeModelFile::load(path) {
        Ok(file) => {
            let again = TreeModelFile::parse(&file.to_toml(), "the written file").expect("a written file can be read");
            assert!(file == again, "a written file has the same content");
            Outcome::Accepted
        }
        Err(error) => {
            assert!(!error.to_string().is_empty(), "an error has a text");
            Outcome::Decoded
        }
    }
}

fn read_config(text: &str) -> Outcome {
    match Config::parse(text, "config.toml") {
        Ok(mut config) => {
            // A mutated path must not open other files of this machine.
            config.server.model = None;
            let factory = SimEnvFactory::new(config);
            if factory.is_ok() { Outcome::Accepted } else { Outcome::Decoded }
        }
        Err(ConfigFileError::Malformed { .. }) => Outcome::Refused,
        Err(error) => outcome(Err::<(), _>(error), |()| true).max_decoded(),
    }
}

impl Outcome {
    /// Returns [`Outcome::Decoded`] for input whose syntax is valid, whatever a later check found.
    fn max_decoded(self) -> Self {
        if self == Outcome::Refused { Outcome::Decoded } else { self }
    }
}

/// Reads a log as `twinstep log --json` does.
fn read_log(bytes: &[u8], name: &str, folder: &Path) -> Outcome {
    let path = write(folder, name, bytes);
    if name != "meta.json" {
        write(folder, "meta.json", log_examples::meta_without_joints().as_bytes());
    }
    let data = if name == "meta.json" { folder.join("data.csv") } else { path };
    let log = Log::open(&data).or_else(|error| Log::open_commands(&data).map_err(|_| error));
    match log {
        Ok(log) => {
            let description = log.describe();
            let text = format!("{description}{:?}", serde_json::to_string(&description));
            assert!(!text.is_empty(), "a description has a text");
            Outcome::Accepted
        }
        Err(error) => {
            assert!(!error.to_string().is_empty(), "an error has a text");
            if is_malformed(&error) { Outcome::Refused } else { Outcome::Decoded }
        }
    }
}

/// Returns true if the file is not of its format, or has no columns of a log.
fn is_malformed(error: &LogError) -> bool {
    use LogError::{Mcap, McapMessage, McapType, MetaSyntax, MissingColumn, NotANumber, Parquet, RaggedRow, Read};
    matches!(
        error,
        Read { .. }
            | Mcap { .. }
            | McapType { .. }
            | McapMessage { .. }
            | MetaSyntax { .. }
            | MissingColumn { .. }
            | NotANumber { .. }
            | Parquet { .. }
            | RaggedRow { .. }
    )
}

/// Reads an ensemble and evaluates it as a server does.
fn read_ensemble(path: &Path) -> Outcome {
    outcome(Ensemble::read(path), |ensemble| {
        let errors = [[[0.1, -0.5]; 12]];
        if ensemble.description.joints.len() == 12 {
            Inference::new(&ensemble, 1).step(&errors);
        }
        let robot = ActuatorNetworkRobot::new(&ModelFile::default(), ensemble, weights_examples::settings());
        robot.is_ok_and(|robot| {
            drop(robot.actuators(1, true));
            true
        })
    })
}

fn read_arguments(bytes: &[u8]) -> Outcome {
    let Ok(text) = std::str::from_utf8(bytes) else { return Outcome::Refused };
    let effects = text.split(',').all(|part| part.parse::<EffectAtScope>().map_err(|e| e.to_string()).is_ok());
    let sid = "0123456789abcdef";
    let is_key = keys::parse(text, sid).is_some() || keys::parse_live_server(text).is_some();
    let is_value = text.parse::<Scope>().is_ok()
        || text.parse::<Joint>().is_ok()
        || text.parse::<BaseMount>().is_ok()
        || text.parse::<Secret>().is_ok();
    let is_valid = effects || is_key || is_value || keys::parse_live_client(text, sid).is_some();
    if is_valid { Outcome::Accepted } else { Outcome::Refused }
}
