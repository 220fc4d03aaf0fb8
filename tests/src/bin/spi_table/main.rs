//! SPI-Active on hidden robots in MuJoCo: models for equal robot time, then tasks on the models, judged on the robots.
//!
//! `cargo build --release --workspace && target/release/spi_table --out spi-table`. Needs Python with the package's extra
//! `mujoco`; `TWINSTEP_PYTHON` is its interpreter. Each step is a command of `twinstep` whose result is kept, so that the
//! same command continues after an interruption. `ledger.csv` has the command and the time of each step.

mod table;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use twinstep_tests::fine_tuning::{FineTuning, TASKS, Task};
use twinstep_tests::mujoco_ground_truth::{Collection, EffectSet, MujocoGroundTruth};
use twinstep_tests::python::root;
use twinstep_tests::resumable::{Resumable, Step, print_result, text};

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
    /// Effects that are hidden: `a` or `b`.
    #[arg(long, value_enum, default_value_t = EffectSet::A)]
    set: EffectSet,
    /// Command sequences that each design simulates.
    #[arg(long, default_value_t = 1000)]
    candidates: u32,
    /// Environment steps of the fine-tuning of each method.
    #[arg(long, default_value_t = 5_000_000)]
    tune_steps: u64,
    /// Simulated robots of each evaluation.
    #[arg(long, default_value_t = 16)]
    evaluated: u32,
    /// Tasks: walk, jump (0.85 m forward), turn (a jump with a turn of 135°), track, attitude.
    #[arg(long, value_delimiter = ',', default_value = "walk,jump")]
    tasks: Vec<String>,
    /// Methods: vanilla, heavy, spi, truth, and spi- with random or a criterion, such as spi-d-optimal. `truth` learns on
    /// the hidden robot, in the batch engine. Four learn on models that are identified from the logs of spi-random: `gradient`
    /// by gradient steps alone, `ours` with further effects among the unknowns, from the model of spi-random, `one-gain` and `one-tanh` with another motor
    /// model in place of a saturation for each joint type: one gain, or one saturation, for all joints.
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

impl Args {
    /// Returns the ways of choosing the commands of the second log, `random` first.
    fn collections(&self) -> Vec<&str> {
        let designed = self.methods.iter().filter_map(|method| method.strip_prefix("spi-"));
        std::iter::once("random").chain(designed.filter(|method| *method != "random")).collect()
    }
}

/// Effects that the method `ours` identifies besides the unknowns of the others: what a Go2 may have, by joint type or for all.
///
/// `joint_elasticity` is not among them: the stiffest gear that the batch engine integrates is not without effect.
const OURS: [&str; 14] = [
    "command_delay@all",
    "drive_lag@all",
    "torque_speed_limit@all",
    "torque_gain@all",
    "armature@hip",
    "armature@thigh",
    "armature@calf",
    "viscous_friction@hip",
    "viscous_friction@thigh",
    "viscous_friction@calf",
    "coulomb_friction@hip",
    "coulomb_friction@thigh",
    "coulomb_friction@calf",
    "load_friction@all",
];

/// Methods whose models are identified from the logs of `spi-random`.
const FROM_RANDOM_LOGS: [&str; 4] = ["gradient", "ours", "one-gain", "one-tanh"];

fn main() -> ExitCode {
    print_result(campaign(&Args::parse()))
}

fn campaign(args: &Args) -> Step<String> {
    if args.set == EffectSet::B && args.methods.iter().any(|method| method == "one-gain" || method == "one-tanh") {
        return Err("--methods: one-gain and one-tanh replace the saturations of set a; set b has none".to_owned());
    }
    for seed in (args.first..args.first + args.robots).filter(|_| !args.table) {
        let robot = Robot::new(args, seed)?;
        robot.collect()?;
        FROM_RANDOM_LOGS.into_iter().try_for_each(|method| robot.identify(method))?;
        for task in TASKS.iter().filter(|task| args.tasks.iter().any(|name| name == task.name)) {
            let start = Resumable::new(&args.out)?.nominal(task.name)?;
            if task.has_start() {
                let name = format!("start-{}", task.name);
                robot.tuning().evaluate(task, &name, &start.join("policy.safetensors"))?;
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
    hidden: MujocoGroundTruth,
    seed: u64,
}

impl<'a> Robot<'a> {
    fn new(args: &'a Args, seed: u64) -> Step<Self> {
        Ok(Self { args, hidden: MujocoGroundTruth::new(&args.out, seed, args.set)?, seed })
    }

    /// Identifies the robot from logs of random and of designed commands. The first log is the same for all.
    fn collect(&self) -> Step {
        let done = |method: &str| self.commands().path(method).join("report.md").exists();
        let missing: Vec<_> = self.args.collections().into_iter().filter(|method| !done(method)).collect();
        if missing.is_empty() {
            return Ok(());
        }
        let (_server, endpoint) = self.hidden.serve("walk")?;
        let collection = Collection { rounds: 1, seconds: 25.0, segment_s: 5.0, candidates: self.args.candidates };
        missing.iter().try_for_each(|method| self.hidden.identify(method, collection, self.seed, &endpoint))
    }

    /// Identifies the robot from both logs of random commands, unless the model of the method is there, and evaluates the model on
    /// the held-out log.
    fn identify(&self, method: &str) -> Step {
        let Some(model) = self.model(method).filter(|_| self.trains(method)) else { return Ok(()) };
        if !model.exists() {
            let logs = ["1-random", "2-random"].map(|stage| self.commands().path("random").join(stage).join("log"));
            let partial = model.with_extension("partial.toml");
            let [one, other, out] = [&logs[0], &logs[1], &partial].map(|path| path.display().to_string());
            let (effects, seed) = (self.unknowns(method).join(","), self.seed.to_string());
            let mut options = vec!["--effects", &effects, "--seed", &seed, "--out", &out];
            if method == "gradient" {
                options.extend(["--generations", "0"]);
            }
            // A search for twice as many unknowns from the ideal robot ends in a local minimum.
            let start = self.commands().path("random/2-random/model.toml").display().to_string();
            if method == "ours" {
                options.extend(["--start", &start]);
            }
            let _ = std::fs::remove_file(&partial);
            self.commands().run(&[&["identify", &one, &other][..], &options].concat())?;
            std::fs::rename(partial, &model).map_err(text)?;
        }
        let errors = self.commands().path(&format!("{method}-held-out.json"));
        if errors.exists() {
            return Ok(());
        }
        let log = self.commands().path("random/held-out/log");
        let [model, log] = [model, log].map(|path| path.display().to_string());
        std::fs::write(errors, self.commands().run(&["evaluate", &log, "--model", &model, "--json"])?).map_err(text)
    }

    /// Returns the effects that a method of [`FROM_RANDOM_LOGS`] identifies. `gradient` differs from `spi-random` in the search alone.
    fn unknowns(&self, method: &str) -> Vec<&'static str> {
        let mut effects = self.args.set.unknowns();
        let motor = match method {
            "one-gain" => Some("torque_gain@all"),
            "one-tanh" => Some("torque_saturation@all"),
            _ => None,
        };
        if let Some(motor) = motor {
            effects.retain(|effect| !effect.starts_with("torque_saturation"));
            effects.push(motor);
        }
        if method == "ours" {
            effects.extend(OURS.iter().filter(|effect| !self.args.set.unknowns().contains(effect)));
        }
        effects
    }

    /// Returns true if a method is compared.
    fn trains(&self, method: &str) -> bool {
        self.args.methods.iter().any(|other| other == method)
    }

    fn commands(&self) -> &Resumable {
        &self.hidden.commands
    }

    /// Continues a training on the model of a method, and evaluates the policy.
    fn tune_and_evaluate(&self, task: &Task, method: &str, start: &Path) -> Step {
        let heavy = std::fs::read_to_string(root().join("examples/spi-active/heavy.toml")).map_err(text)?;
        let randomise = if method == "heavy" { heavy.as_str() } else { "" };
        let name = format!("{method}-{}", task.name);
        let policy = self.tuning().train(task, &name, self.model(method).as_deref(), randomise, start)?;
        self.tuning().evaluate(task, &name, &policy).map(drop)
    }

    fn tuning(&self) -> FineTuning<'_> {
        let Args { tune_steps, evaluated, .. } = *self.args;
        FineTuning { robot: &self.hidden, steps: tune_steps, evaluated, seed: self.seed }
    }

    /// Returns the model on which a method trains; `None` for the ideal Go2.
    fn model(&self, method: &str) -> Option<PathBuf> {
        let path = match method {
            "spi" => "random/1-random/model.toml".to_owned(),
            "spi-random" => "random/2-random/model.toml".to_owned(),
            "truth" => "hidden.toml".to_owned(),
            _ if FROM_RANDOM_LOGS.contains(&method) => format!("{method}.toml"),
            _ => format!("{}/2-active/model.toml", method.strip_prefix("spi-")?),
        };
        Some(self.commands().path(&path))
    }
}
