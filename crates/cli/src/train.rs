//! `twinstep train`: trains a policy by proximal policy optimisation.

use std::path::PathBuf;

use twinstep_envs::TaskConfig;
use twinstep_workflows::{Observer, Start, TrainConfig, TrainOptions, train};

use crate::exit::{CommandResult, Failure};
use crate::web_view::ViewArgs;

/// Train a policy by proximal policy optimisation.
///
/// Simulates the robots on all cores, or runs the policy on the robots of servers (--endpoint), and
/// learns from the trajectories. The folder then contains:
///
///   policy.safetensors     the policy, with the spec of its environment
///   policy.onnx            the same for other runtimes: input `obs` [batch, N], output `action`
///   evaluation.json        errors and falls of 256 fresh robots
///   config.toml            all settings; --config config.toml repeats the training
///   progress.csv           errors, falls, rewards and times of every update, also for TensorBoard
///   curve.svg              learning curve
///   checkpoint.safetensors state of the training, saved every 10 s; before it checkpoint.previous.*
///   exploration.*          task `explore`: base policy and residual as one policy of `walk`
///
/// Ctrl-C saves the training and ends it; --resume continues it. Equal seeds and settings give
/// equal policies.
///
/// Examples: `twinstep train walk --out walk --seed 1`, or on the robot that a diagnosis found:
/// `twinstep train walk --out walk --model diagnosis/extended.toml --randomise-effects`, or from an
/// earlier training: `twinstep train walk --out tuned --from walk/checkpoint.safetensors --model
/// extended.toml --steps 5000000`, or any robot: `twinstep train pose --out arm --model arm.toml
/// --steps 1000000`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
#[allow(clippy::struct_excessive_bools, reason = "each is a flag of the command")]
pub struct Args {
    /// Task to learn. Default: that of the config file, else walk.
    #[arg(value_parser = ["walk", "track", "jump", "gait", "attitude", "explore", "getup", "pose"])]
    task: Option<String>,
    /// Folder to write.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Config file (TOML) with [task], [sim], [randomise] and [train]. Flags override its values.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Learn to walk over slopes, stairs, obstacles, waves and rough ground, with the settings of
    /// data/policies/walk_terrain.toml. The progress names the mean level that the robots have reached.
    #[arg(long, conflicts_with_all = ["config", "endpoint", "resume"])]
    terrain: bool,
    /// Model file of the robot, or the name of one in this program, such as spot (docs/robots.md). Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Sample every parameter of the model file that has an interval, for every robot in every episode.
    #[arg(long)]
    randomise_effects: bool,
    /// Seed of networks, robots, commands and exploration.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Total number of environment steps. Default: 8 million.
    #[arg(long, value_name = "N")]
    steps: Option<u64>,
    /// Time after which the training ends even if steps are left [min].
    #[arg(long, value_name = "MIN", allow_negative_numbers = true)]
    minutes: Option<f64>,
    /// Number of robots. Default: 1024.
    #[arg(long, value_name = "N")]
    envs: Option<usize>,
    /// Train on the robots of a server at this Zenoh endpoint, such as tcp/127.0.0.1:7447; repeat it to divide the
    /// robots among several servers. A server that is lost is left out until it is back. The settings [task], [sim] and
    /// [randomise] are then those of the servers. Default: simulate in this process.
    #[arg(long, value_name = "ENDPOINT", value_delimiter = ',', conflicts_with_all = ["model", "randomise_effects"])]
    endpoint: Vec<String>,
    /// Policy of `walk` to whose actions the task `explore` adds a residual. With --endpoint: that of the servers.
    #[arg(long, value_name = "FILE")]
    base: Option<PathBuf>,
    /// Start with the networks of this checkpoint.safetensors of another training, or with the actor of this
    /// policy.safetensors and an untrained critic: fine-tuning. Task and gains must be the same; robot, rewards and
    /// randomisation may differ.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Continue the training in the folder with its settings and seed.
    #[arg(long, conflicts_with_all = ["config", "model", "randomise_effects", "seed", "envs"])]
    resume: bool,
    #[command(flatten)]
    view: ViewArgs,
    /// Print the evaluation as JSON on stdout.
    #[arg(long)]
    json: bool,
}

/// Trains, then evaluates the policy.
pub fn run(args: &Args) -> CommandResult {
    train_and_print(&args.options()?, args.json)
}

/// Trains, evaluates the policy and prints the evaluation.
pub fn train_and_print(options: &TrainOptions, json: bool) -> CommandResult {
    let observer = Observer::terminal()?;
    let trained = train(options, &observer)?;
    let (evaluation, table) = trained.evaluate(&observer)?;
    if json {
        println!("{evaluation}");
    } else {
        let (steps, out) = (trained.env_steps as f64 / 1e6, trained.out.display());
        println!("trained {steps:.1} million steps in {:.1} s; policy and curves in {out}", trained.seconds);
        print!("{table}");
    }
    Ok(())
}

impl Args {
    fn options(&self) -> Result<TrainOptions, Failure> {
        let start = if self.resume {
            Start::Resume { total_steps: self.steps }
        } else {
            Start::New { config: Box::new(self.config()?), seed: self.seed, from: self.from.clone() }
        };
        let (out, endpoints, page) = (self.out.clone(), self.endpoint.clone(), self.view.options());
        Ok(TrainOptions { out, start, minutes: self.minutes, endpoints, page })
    }

    fn config(&self) -> Result<TrainConfig, Failure> {
        let mut config = match &self.config {
            Some(path) => TrainConfig::load(path)?,
            None if self.terrain => TrainConfig::terrain(),
            None => TrainConfig::default(),
        };
        if let Some(task) = self.task.as_deref().filter(|task| *task != config.task.name()) {
            if self.terrain {
                return Err(Failure::Input(miette::miette!(
                    "`--terrain` is for the task `walk`, and `{task}` is named"
                )));
            }
            if config.task != TaskConfig::default() {
                let of_config = config.task.name();
                return Err(Failure::Input(miette::miette!(
                    "`{task}` is not the task of the config file, `{of_config}`\n  name the same task, or none"
                )));
            }
            let of_task = TrainConfig::of_task(task).expect("the argument was checked");
            config = if self.config.is_none() { of_task } else { TrainConfig { task: of_task.task, ..config } };
        }
        match (&mut config.task, &self.base) {
            (TaskConfig::Explore(explore), base) => {
                let base = base.as_ref().unwrap_or(&explore.base);
                explore.base = base.canonicalize().unwrap_or_else(|_| base.clone());
            }
            (other, Some(_)) => {
                return Err(Failure::Input(miette::miette!(
                    "`--base` is for the task `explore`, and the task is `{}`",
                    other.name()
                )));
            }
            _ => {}
        }
        // The folder may be used from another working directory.
        config.model = self.model.clone().or(config.model).map(|path| path.canonicalize().unwrap_or(path));
        if config.has_tree() && self.config.is_none() {
            config.sim.physics_hz = None;
        }
        config.randomise.effects |= self.randomise_effects;
        if let Some(envs) = self.envs {
            (config.train.num_envs, config.train.groups) = (envs, config.train.groups.min(envs.max(1)));
        }
        config.train.total_steps = self.steps.unwrap_or(config.train.total_steps);
        Ok(config)
    }
}
