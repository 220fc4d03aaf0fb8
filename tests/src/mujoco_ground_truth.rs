//! Ground truth in MuJoCo: robots with hidden effects, and their identification by `twinstep spi-active`.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use rand::RngExt;
use twinstep_effects::{EffectEntry, ModelFile};
use twinstep_model::stream;

use crate::ground_truth_robot::effect;
use crate::process::Process;
use crate::resumable::{Resumable, Step, text};

/// Effects that are hidden.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum EffectSet {
    /// A payload, and for each joint type a saturation and a dry friction.
    A,
    /// A shifted centre of mass, a delay of the commands, and for each joint type a rotor inertia and a viscous friction.
    B,
}

impl EffectSet {
    /// Returns the effects with their scopes.
    fn effects(self) -> &'static [&'static str] {
        match self {
            Self::A => &[
                "payload@base",
                "torque_saturation@hip",
                "torque_saturation@thigh",
                "torque_saturation@calf",
                "coulomb_friction@hip",
                "coulomb_friction@thigh",
                "coulomb_friction@calf",
            ],
            Self::B => &[
                "com_shift@base",
                "command_delay@all",
                "armature@hip",
                "armature@thigh",
                "armature@calf",
                "viscous_friction@hip",
                "viscous_friction@thigh",
                "viscous_friction@calf",
            ],
        }
    }

    /// Returns the effects that are identified.
    pub fn unknowns(self) -> Vec<&'static str> {
        self.effects().iter().copied().chain(GROUND).collect()
    }
}

/// Effects that are identified with them: MuJoCo's ground differs from that of the batch engine.
const GROUND: [&str; 2] = ["ground_stiffness@ground", "ground_friction@ground"];
/// Noise of the robot's sensors.
const SENSORS: &str = "[randomise.noise]\njoint_position_rad = 0.0005\njoint_velocity_rad_s = 0.1\n\
                       joint_torque_nm = 0.35\nangular_velocity_rad_s = 0.02\n";
/// Duration of a jump in a log of jumps [s].
const JUMP_S: &str = "1.4";

/// A robot with hidden effects, and the folder of its results.
pub struct MujocoGroundTruth {
    /// Commands whose results are in the folder of the robot.
    pub commands: Resumable,
    /// Model file of the robot.
    pub model: PathBuf,
    set: EffectSet,
}

/// Settings of the identification with `twinstep spi-active`.
#[derive(Clone, Copy, Debug)]
pub struct Collection {
    /// Number of logs after the first one.
    pub rounds: u32,
    /// Duration of a log [s].
    pub seconds: f64,
    /// Duration of a command [s].
    pub segment_s: f64,
    /// Command sequences that each design simulates.
    pub candidates: u32,
}

impl MujocoGroundTruth {
    /// Creates the robot of a seed with effects of a set. Its results are in a folder of that name in `out`.
    pub fn new(out: &Path, seed: u64, set: EffectSet) -> Step<Self> {
        let commands = Resumable::new(&out.join(seed.to_string()))?;
        let model = commands.path("hidden.toml");
        let hidden = hidden(seed, set).to_toml();
        if std::fs::read_to_string(&model).is_ok_and(|other| other != hidden) {
            return Err(format!("{}: another robot has results in this folder; choose another --out", model.display()));
        }
        std::fs::write(&model, hidden).map_err(text)?;
        Ok(Self { commands, model, set })
    }

    /// Starts the robot with a task. Returns its endpoint.
    pub fn serve(&self, task: &str) -> Step<(Process, String)> {
        serve(&self.commands, task, &self.model)
    }

    /// Identifies the robot from logs of random commands, or of commands that a criterion designed. The first log and the held-out
    /// one are copies of those of `random`, if `method` is another.
    pub fn identify(&self, method: &str, collection: Collection, seed: u64, endpoint: &str) -> Step {
        for stage in ["1-random", "held-out"].iter().filter(|_| method != "random") {
            let of = |method: &str| self.commands.path(method).join(stage);
            copy(&of("random"), &of(method))?;
        }
        let config = self.commands.path(&format!("{method}.toml"));
        let Collection { rounds, seconds, segment_s, candidates } = collection;
        // The ground is an unknown because the contact laws of both engines differ; its values are of no use.
        let of_interest: &[&str] = if method == "qoed" { self.set.effects() } else { &[] };
        let unknowns = self.set.unknowns();
        let settings = format!(
            "policy = \"data/policies/walk.safetensors\"\nunknowns = {unknowns:?}\nendpoint = \"{endpoint}\"\n\
             method = \"{method}\"\nrounds = {rounds}\nseconds = {seconds:?}\nsegment_s = {segment_s:?}\n\
             candidates = {candidates}\nof_interest = {of_interest:?}\nfast = true\nseed = {seed}\n"
        );
        std::fs::write(&config, settings).map_err(text)?;
        self.commands.run(&["spi-active", &config.display().to_string()]).map(drop)
    }
}

/// Starts a robot in MuJoCo with a task and with noise of the sensors. Returns its endpoint.
pub fn serve(commands: &Resumable, task: &str, model: &Path) -> Step<(Process, String)> {
    let config = commands.path(&format!("{task}-server.toml"));
    std::fs::write(&config, format!("[task]\nname = \"{task}\"\n[sim]\nengine = \"mujoco\"\n{SENSORS}"))
        .map_err(text)?;
    let [config, model] = [&config, model].map(|path| path.display().to_string());
    let arguments = ["serve", "--config", &config, "--model", &model, "--envs", "2", "--listen", "tcp/127.0.0.1:0"];
    let ends = ["--lease-grace-s", "0.1", "--until-stdin-closes"];
    let arguments: Vec<String> = arguments.iter().chain(&ends).map(ToString::to_string).collect();
    Process::listening(&commands.twinstep, &arguments)
}

/// Records jumps of a robot with the task `jump` in one log, each an episode. Returns the folder of the log.
pub fn record_jumps(commands: &Resumable, endpoint: &str, jumps: u64) -> Step<PathBuf> {
    let (log, partial) = (commands.path("held-out"), commands.path("held-out.partial"));
    if !log.exists() {
        let _ = std::fs::remove_dir_all(&partial);
        for jump in 0..jumps {
            let (one, seed) = (partial.join(jump.to_string()).display().to_string(), (1000 + jump).to_string());
            let run = ["run", "data/policies/jump.safetensors", "--endpoint", endpoint, "--torque", "--fast"];
            commands.run(&[&run[..], &["--seconds", JUMP_S, "--seed", &seed, "--log", &one]].concat())?;
        }
        merge_logs(&partial, jumps)?;
        std::fs::rename(&partial, &log).map_err(text)?;
    }
    Ok(log)
}

/// Returns the hidden robot of a seed with effects of a set.
fn hidden(seed: u64, set: EffectSet) -> ModelFile {
    let mut random = stream(seed, "spi_table", 0);
    let mut draw = |low: f64, high: f64| random.random_range(low..high);
    let entries = set.effects().iter().map(|name| {
        let (name, scope) = name.split_once('@').expect("an effect with its scope");
        let values = match (name, scope) {
            ("payload", _) => vec![draw(0.5, 2.5), draw(-0.08, 0.08), draw(-0.04, 0.04), draw(0.0, 0.08)],
            ("com_shift", _) => vec![draw(-0.03, 0.03), draw(-0.02, 0.02), draw(-0.02, 0.02)],
            ("torque_saturation", _) => vec![draw(18.0, 30.0)],
            ("command_delay", _) => vec![draw(0.002, 0.01)],
            ("armature", _) => vec![draw(0.005, 0.03)],
            ("viscous_friction", _) => vec![draw(0.1, 0.5)],
            (_, "calf") => vec![draw(0.2, 0.8)],
            _ => vec![draw(0.1, 0.5)],
        };
        let (effect, scope) = effect(name, scope);
        EffectEntry::new(effect, scope, values).expect("values within the allowed range")
    });
    ModelFile { effects: entries.collect(), ..ModelFile::default() }
}

/// Copies a folder, unless it is there.
fn copy(from: &Path, to: &Path) -> Step {
    if to.exists() {
        return Ok(());
    }
    let partial = to.with_extension("partial");
    copy_into(from, &partial)?;
    std::fs::rename(&partial, to).map_err(text)
}

fn copy_into(from: &Path, to: &Path) -> Step {
    std::fs::create_dir_all(to).map_err(text)?;
    for entry in std::fs::read_dir(from).map_err(text)? {
        let path = entry.map_err(text)?.path();
        let target = to.join(path.file_name().ok_or("an entry has a name")?);
        if path.is_dir() {
            copy_into(&path, &target)?;
        } else {
            std::fs::copy(&path, &target).map(drop).map_err(text)?;
        }
    }
    Ok(())
}

/// Merges the logs `0` to `count − 1` in `folder` into one log there: each is an episode.
fn merge_logs(folder: &Path, count: u64) -> Step {
    let (mut merged, mut start) = (String::new(), 0.0);
    for log in 0..count {
        let path = folder.join(log.to_string());
        let table = std::fs::read_to_string(path.join("data.csv")).map_err(text)?;
        let mut lines = table.lines();
        let header = lines.next().ok_or("a log has a header")?;
        if log == 0 {
            merged = header.to_owned() + "\n";
            std::fs::copy(path.join("meta.json"), folder.join("meta.json")).map_err(text)?;
        }
        let mut end = start;
        for line in lines {
            let (time, rest) = line.split_once(',').ok_or("a row has columns")?;
            let (_, rest) = rest.split_once(',').ok_or("a row has columns")?;
            end = start + time.parse::<f64>().map_err(text)?;
            let _ = writeln!(merged, "{end:.3},{log},{rest}");
        }
        start = end + 0.5;
        std::fs::remove_dir_all(&path).map_err(text)?;
    }
    std::fs::write(folder.join("data.csv"), merged).map_err(text)
}
