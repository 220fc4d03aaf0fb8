//! SPI-Active on hidden robots in MuJoCo: models for equal robot time, then tasks on the models, judged on the robots.
//!
//! `cargo build --release --workspace && target/release/spi_table --out spi-table`. Needs Python with the package's extra
//! `mujoco`; `TWINSTEP_PYTHON` is its interpreter. Each step is a command of `twinstep` whose result is kept, so that the
//! same command continues after an interruption. `ledger.csv` has the command and the time of each step.

mod table;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use rand::RngExt;
use twinstep_effects::{EffectEntry, ModelFile};
use twinstep_model::stream;
use twinstep_tests::ground_truth_robot::effect;
use twinstep_tests::process::Process;
use twinstep_tests::python::root;
use twinstep_tests::resumable::{Resumable, Step, text};

/// Compare methods on hidden robots.
#[derive(Parser)]
struct Args {
    /// Folder of all results.
    #[arg(long)]
    out: PathBuf,
    /// Number of hidden robots. Each is the seed of its commands and trainings.
    #[arg(long, default_value_t = 5)]
    robots: u64,
    /// Seed of the first robot.
    #[arg(long, default_value_t = 1)]
    first: u64,
    /// Command sequences that each design simulates.
    #[arg(long, default_value_t = 1000)]
    candidates: u32,
    /// Environment steps of the fine-tuning of each method.
    #[arg(long, default_value_t = 5_000_000)]
    tune_steps: u64,
    /// Simulated robots of each evaluation.
    #[arg(long, default_value_t = 16)]
    evaluated: u32,
    /// Tasks: walk, jump, track.
    #[arg(long, value_delimiter = ',', default_value = "walk,jump")]
    tasks: Vec<String>,
    /// Methods: vanilla, heavy, spi, truth, and spi- with random or a criterion, such as spi-d-optimal. `truth` learns on
    /// the hidden robot, in the batch engine.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "vanilla,heavy,spi,spi-random,spi-trace,spi-d-optimal,spi-qoed,truth"
    )]
    methods: Vec<String>,
    /// Print the table of what is complete, and run nothing.
    #[arg(long)]
    table: bool,
}

/// Effects that are hidden.
const HIDDEN: [&str; 7] = [
    "payload@base",
    "torque_saturation@hip",
    "torque_saturation@thigh",
    "torque_saturation@calf",
    "coulomb_friction@hip",
    "coulomb_friction@thigh",
    "coulomb_friction@calf",
];
/// Effects that are identified with them: MuJoCo's ground differs from that of the batch engine.
const GROUND: [&str; 2] = ["ground_stiffness@ground", "ground_friction@ground"];
/// Noise of the robot's sensors.
const SENSORS: &str = "[randomise.noise]\njoint_position_rad = 0.0005\njoint_velocity_rad_s = 0.1\n\
                       joint_torque_nm = 0.35\nangular_velocity_rad_s = 0.02\n";
impl Args {
    /// Returns the ways of choosing the commands of the second log, `random` first.
    fn collections(&self) -> Vec<&str> {
        let designed = self.methods.iter().filter_map(|method| method.strip_prefix("spi-"));
        std::iter::once("random").chain(designed.filter(|method| *method != "random")).collect()
    }
}

/// A task and its error.
struct Task {
    name: &'static str,
    settings: &'static str,
    /// Name of the error in the table.
    error: &'static str,
    /// JSON pointer to it in the evaluation.
    pointer: &'static str,
    /// JSON pointer to the share of the robots that did not fall.
    up: &'static str,
    /// Duration of the evaluation [s].
    seconds: u32,
}

impl Task {
    /// Returns true if the policy from which the methods start is evaluated on the same targets.
    fn has_start(&self) -> bool {
        self.settings.is_empty()
    }
}

const TASKS: [Task; 3] = [
    Task {
        name: "walk",
        settings: "",
        error: "velocity RMS [m/s]",
        pointer: "/rows/0/velocity_rms",
        up: "/rows/0/up",
        seconds: 20,
    },
    Task {
        name: "jump",
        settings: "target_x_m = [0.85, 0.85]\n",
        error: "landing error of a jump of 0.85 m [m]",
        pointer: "/rows/0/targets/1/l_jump",
        up: "/rows/0/targets/1/up",
        seconds: 3,
    },
    Task {
        name: "track",
        settings: "",
        error: "L_track, circle [m + rad]",
        pointer: "/rows/0/paths/0/l_track",
        up: "/rows/0/paths/0/up",
        seconds: 20,
    },
];

fn main() -> ExitCode {
    let args = Args::parse();
    match campaign(&args) {
        Ok(table) => {
            print!("{table}");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn campaign(args: &Args) -> Step<String> {
    for seed in (args.first..args.first + args.robots).filter(|_| !args.table) {
        let robot = Robot::new(args, seed)?;
        robot.collect()?;
        for task in TASKS.iter().filter(|task| args.tasks.iter().any(|name| name == task.name)) {
            let start = Resumable::new(&args.out)?.nominal(task.name)?;
            if task.has_start() {
                robot.evaluate(task, "start", &start.join("policy.safetensors"))?;
            }
            args.methods.iter().try_for_each(|method| robot.tune_and_evaluate(task, method, &start))?;
        }
        std::fs::write(args.out.join("table.md"), table::text(args)?).map_err(text)?;
    }
    table::text(args)
}

/// A hidden robot and the folder of its results.
struct Robot<'a> {
    args: &'a Args,
    commands: Resumable,
    seed: u64,
}

impl<'a> Robot<'a> {
    fn new(args: &'a Args, seed: u64) -> Step<Self> {
        let commands = Resumable::new(&args.out.join(seed.to_string()))?;
        std::fs::write(commands.path("hidden.toml"), hidden(seed).to_toml()).map_err(text)?;
        Ok(Self { args, commands, seed })
    }

    /// Identifies the robot from logs of random and of designed commands. The first log is the same for all.
    fn collect(&self) -> Step {
        let done = |method: &str| self.commands.path(method).join("report.md").exists();
        let missing: Vec<_> = self.args.collections().into_iter().filter(|method| !done(method)).collect();
        if missing.is_empty() {
            return Ok(());
        }
        let (_server, endpoint) = self.server()?;
        for method in missing {
            for stage in ["1-random", "held-out"].iter().filter(|_| method != "random") {
                let of = |method: &str| self.commands.path(method).join(stage);
                copy(&of("random"), &of(method))?;
            }
            let config = self.commands.path(&format!("{method}.toml"));
            let (Args { candidates, .. }, seed) = (self.args, self.seed);
            // What differs between the engines does not matter.
            let of_interest: &[&str] = if method == "qoed" { &HIDDEN } else { &[] };
            let unknowns: Vec<&str> = HIDDEN.into_iter().chain(GROUND).collect();
            let settings = format!(
                "policy = \"data/policies/walk.safetensors\"\nunknowns = {unknowns:?}\nendpoint = \"{endpoint}\"\n\
                 method = \"{method}\"\ncandidates = {candidates}\nof_interest = {of_interest:?}\nfast = true\nseed = {seed}\n"
            );
            std::fs::write(&config, settings).map_err(text)?;
            self.commands.run(&["spi-active", &config.display().to_string()])?;
        }
        Ok(())
    }

    /// Starts the hidden robot. Returns its endpoint.
    fn server(&self) -> Step<(Process, String)> {
        let (config, hidden) = (self.commands.path("server.toml"), self.commands.path("hidden.toml"));
        std::fs::write(&config, format!("[task]\nname = \"walk\"\n[sim]\nengine = \"mujoco\"\n{SENSORS}"))
            .map_err(text)?;
        let [config, hidden] = [config, hidden].map(|path| path.display().to_string());
        let arguments =
            ["serve", "--config", &config, "--model", &hidden, "--envs", "2", "--listen", "tcp/127.0.0.1:0"];
        let ends = ["--lease-grace-s", "0.1", "--until-stdin-closes"];
        let arguments: Vec<String> = arguments.iter().chain(&ends).map(ToString::to_string).collect();
        Process::listening(&self.commands.twinstep, &arguments)
    }

    /// Continues a training on the model of a method, and evaluates the policy.
    fn tune_and_evaluate(&self, task: &Task, method: &str, start: &Path) -> Step {
        let out = self.commands.path(&format!("{method}-{}", task.name));
        let config = self.commands.path(&format!("{method}-{}.toml", task.name));
        let heavy = std::fs::read_to_string(root().join("examples/spi-active/heavy.toml")).map_err(text)?;
        let randomise = if method == "heavy" { heavy } else { String::new() };
        let settings = format!("[task]\nname = \"{}\"\n{}{randomise}", task.name, task.settings);
        std::fs::write(&config, settings).map_err(text)?;
        let [from, config] = [start.join("checkpoint.safetensors"), config].map(|path| path.display().to_string());
        let (steps, seed) = (self.args.tune_steps.to_string(), self.seed.to_string());
        let mut arguments =
            vec!["train", task.name, "--config", &config, "--from", &from, "--steps", &steps, "--seed", &seed];
        let model = self.model(method).map(|path| path.display().to_string());
        arguments.extend(model.iter().flat_map(|model| ["--model", model.as_str()]));
        self.commands.step(&out.join("evaluation.json"), &arguments, &out)?;
        self.evaluate(task, method, &out.join("policy.safetensors"))
    }

    /// Returns the model on which a method trains; `None` for the ideal Go2.
    fn model(&self, method: &str) -> Option<PathBuf> {
        let path = match method {
            "spi" => "random/1-random/model.toml".to_owned(),
            "spi-random" => "random/2-random/model.toml".to_owned(),
            "truth" => "hidden.toml".to_owned(),
            _ => format!("{}/2-active/model.toml", method.strip_prefix("spi-")?),
        };
        Some(self.commands.path(&path))
    }

    /// Evaluates a policy on the hidden robot in MuJoCo.
    fn evaluate(&self, task: &Task, method: &str, policy: &Path) -> Step {
        let result = self.commands.path(&format!("{method}-{}.json", task.name));
        if result.exists() {
            return Ok(());
        }
        let hidden = self.commands.path("hidden.toml").display().to_string();
        let (policy, robots) = (policy.display().to_string(), self.args.evaluated.to_string());
        let seconds = task.seconds.to_string();
        let json = self.commands.run(
            &[
                &["evaluate-policy", &policy, "--engine", "mujoco", "--model", &hidden, "--condition", "nominal"][..],
                &["--robots", &robots, "--seconds", &seconds, "--json"],
            ]
            .concat(),
        )?;
        std::fs::write(&result, json).map_err(text)
    }
}

/// Returns the hidden robot of a seed: a payload, and for each joint type a saturation and a dry friction.
fn hidden(seed: u64) -> ModelFile {
    let mut random = stream(seed, "spi_table", 0);
    let mut draw = |low: f64, high: f64| random.random_range(low..high);
    let entries = HIDDEN.map(|name| {
        let (name, scope) = name.split_once('@').expect("an effect with its scope");
        let values = match (name, scope) {
            ("payload", _) => vec![draw(0.5, 2.5), draw(-0.08, 0.08), draw(-0.04, 0.04), draw(0.0, 0.08)],
            ("torque_saturation", _) => vec![draw(18.0, 30.0)],
            (_, "calf") => vec![draw(0.2, 0.8)],
            _ => vec![draw(0.1, 0.5)],
        };
        let (effect, scope) = effect(name, scope);
        EffectEntry::new(effect, scope, values).expect("values within the allowed range")
    });
    ModelFile { effects: entries.to_vec(), ..ModelFile::default() }
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
