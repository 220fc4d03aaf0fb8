//! `twinstep train`: trains a policy by proximal policy optimisation.

use std::path::PathBuf;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_envs::{Randomisation, TaskConfig};
use twinstep_learning::{PpoConfig, Trainer, evaluate};
use twinstep_model::{AutoresetMode, VecEnv};
use twinstep_sim::SimConfig;

use crate::exit::{CommandResult, Failure, Signals, input, other};

/// Train.
#[derive(clap::Args)]
pub struct Args {
    /// The task.
    #[arg(default_value = "walk")]
    task: String,
    /// Config file.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Config file of a training.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct TrainConfig {
    task: TaskConfig,
    sim: SimConfig,
    randomise: Randomisation,
    train: PpoConfig,
}

fn envs(config: &TrainConfig, num_envs: usize, groups: usize, threads: usize) -> Result<Vec<Box<dyn VecEnv>>, Failure> {
    let sim = SimConfig { threads, ..config.sim };
    let config = Config { task: config.task.clone(), sim, randomise: config.randomise, ..Config::default() };
    let factory = SimEnvFactory::new(config).map_err(input)?;
    (0..groups)
        .map(|group| {
            let robots = num_envs / groups + usize::from(group < num_envs % groups);
            factory.build(robots, AutoresetMode::SameStep, None).map_err(input)
        })
        .collect()
}

/// Trains.
pub fn run(args: &Args) -> CommandResult {
    let start = Instant::now();
    let signals = Signals::listen()?;
    let text = match &args.config {
        Some(path) => std::fs::read_to_string(path).map_err(input)?,
        None => String::new(),
    };
    let config: TrainConfig = toml::from_str(&text).map_err(input)?;
    let mut trainer = Trainer::new(
        config.train.clone(),
        envs(&config, config.train.num_envs, config.train.groups, 1)?,
        None,
        args.seed,
    )
    .map_err(input)?;
    let (mut rollout, mut update) = (0.0, 0.0);
    while trainer.learner().env_steps < config.train.total_steps {
        signals.check()?;
        let it = trainer.iterate().map_err(other)?;
        rollout += it.rollout_time.as_secs_f64();
        update += it.update_time.as_secs_f64();
        if it.iteration % 20 == 0 {
            let rms = it.statistics.velocity_rms().unwrap_or_default();
            eprintln!(
                "{:4} {:.2}M {:5.1}s rew/step {:.4} v {:.3} w {:.3} falls {} eps {} std {:.3} kl {:.4} lr {:.5} clip {:.2} vl {:.4} rollout {:.1} update {:.1}",
                it.iteration,
                it.env_steps as f64 / 1e6,
                start.elapsed().as_secs_f64(),
                it.statistics.reward / it.statistics.steps as f64,
                rms[0],
                rms[1],
                it.statistics.falls,
                it.statistics.episodes,
                it.action_std,
                it.kl,
                it.learning_rate,
                it.clipped_share,
                it.value_loss,
                rollout,
                update
            );
        }
    }
    let policy = trainer.learner().policy(trainer.spec());
    let fresh = TrainConfig { task: TaskConfig::default(), ..config.clone() };
    let mut env = envs(&fresh, 256, 1, 0)?.remove(0);
    let evaluation = evaluate(&policy, env.as_mut(), 20.0, 12345, |_| ()).map_err(other)?;
    println!("{:.1} s total; {evaluation:?}", start.elapsed().as_secs_f64());
    Ok(())
}
