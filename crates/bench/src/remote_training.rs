//! Training on the robots of a server, by rollouts, compared with the same training in process.

use twinstep_client::{ConnectOptions, RemoteCollector, RemoteVecEnv, ServerProcess};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_learning::{PpoConfig, Trainer};
use twinstep_model::AutoresetMode;
use twinstep_policy::{Collector, StepCollector};
use twinstep_sim::SimConfig;

use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::throughput::{WINDOWS, measure as pace, median};

/// Rate of the physics of `twinstep train` [Hz].
pub(crate) const PHYSICS_HZ: u32 = 400;

/// Measures env-steps/s of rollouts and updates, on a server on this machine and in process.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = Vec::new();
    for num_envs in [64, 1024, 4096] {
        let config = PpoConfig { num_envs, total_steps: u64::MAX, ..PpoConfig::default() };
        let (envs, hz) = (num_envs.to_string(), PHYSICS_HZ.to_string());
        let server = ServerProcess::start(&["--envs", &envs, "--physics-hz", &hz]).map_err(failed)?;
        let mut remote = trainer(&config, |robots| remote_collector(&server.endpoint, robots))?;
        let mut local = trainer(&config, local_collector)?;
        let (mut ours, mut reference) = (Vec::new(), Vec::new());
        for _ in 0..WINDOWS {
            check(interrupted)?;
            ours.push(pace(window_s, || remote.iterate().map(drop).map_err(failed))?);
            reference.push(pace(window_s, || local.iterate().map(drop).map_err(failed))?);
        }
        let (ours, reference) = (median(&ours).per_second, median(&reference).per_second);
        let steps = config.batch_len() as f64;
        rows.push(Measurement {
            case: format!("training in process, {num_envs} envs"),
            value: reference * steps,
            unit: "env-steps/s",
            reference: None,
            ratio: None,
        });
        rows.push(Measurement {
            case: format!("training by rollouts over Zenoh, {num_envs} envs"),
            value: ours * steps,
            unit: "env-steps/s",
            reference: Some("the same training in process".to_owned()),
            ratio: Some(ours / reference),
        });
    }
    Ok(rows)
}

fn trainer(
    config: &PpoConfig,
    collector: impl Fn(usize) -> Result<Box<dyn Collector>, BenchError>,
) -> Result<Trainer, BenchError> {
    let robots = config.num_envs / config.groups;
    let collectors = (0..config.groups).map(|_| collector(robots)).collect::<Result<_, _>>()?;
    let mut trainer = Trainer::new(config.clone(), collectors, None, 1).map_err(failed)?;
    // The first iterations allocate the arrays.
    trainer.iterate().map_err(failed)?;
    Ok(trainer)
}

fn remote_collector(endpoint: &str, num_envs: usize) -> Result<Box<dyn Collector>, BenchError> {
    let options =
        ConnectOptions { autoreset: AutoresetMode::SameStep, critic: true, ..ConnectOptions::new(endpoint, num_envs) };
    let env = RemoteVecEnv::connect(&options).map_err(failed)?;
    Ok(Box::new(RemoteCollector::new(env, &options)))
}

fn local_collector(num_envs: usize) -> Result<Box<dyn Collector>, BenchError> {
    let sim = SimConfig { physics_hz: Some(PHYSICS_HZ), threads: 1, ..SimConfig::default() };
    let config = Config { sim, ..Config::default() };
    let env = SimEnvFactory::new(config).and_then(|factory| factory.build(num_envs, AutoresetMode::SameStep, None));
    Ok(Box::new(StepCollector(env.map_err(failed)?)))
}
