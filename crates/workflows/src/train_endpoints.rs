//! Environments of servers for `twinstep train --endpoint`.

use twinstep_client::{ConnectOptions, RemoteCollector, RemoteVecEnv};
use twinstep_learning::PpoConfig;
use twinstep_model::AutoresetMode;
use twinstep_policy::{Collector, StepCollector};

use crate::failure::{Failure, other};

/// Returns the options of a connection for training.
fn connect_options(endpoint: &str, num_envs: usize) -> ConnectOptions {
    ConnectOptions { autoreset: AutoresetMode::SameStep, critic: true, ..ConnectOptions::new(endpoint, num_envs) }
}

/// Leases environments of the first server that grants them.
pub fn remote_env(endpoints: &[String], num_envs: usize) -> Result<RemoteVecEnv, Failure> {
    let connect = |endpoint: &String| RemoteVecEnv::connect(&connect_options(endpoint, num_envs));
    let (last, others) = endpoints.split_last().expect("there is an endpoint");
    others.iter().find_map(|endpoint| connect(endpoint).ok()).map_or_else(|| connect(last), Ok).map_err(other)
}

/// Leases the environments of each group. The groups are divided among the servers in order.
pub fn remote_collectors(endpoints: &[String], config: &PpoConfig) -> Result<Vec<Box<dyn Collector>>, Failure> {
    let PpoConfig { num_envs, groups, horizon, .. } = *config;
    let mut collectors = Vec::new();
    for group in 0..groups {
        let robots = num_envs / groups + usize::from(group < num_envs % groups);
        let endpoint = &endpoints[group * endpoints.len() / groups];
        collectors.push(remote_collector(endpoint, robots, horizon)?);
    }
    Ok(collectors)
}

fn remote_collector(endpoint: &str, num_envs: usize, horizon: usize) -> Result<Box<dyn Collector>, Failure> {
    let options = connect_options(endpoint, num_envs);
    let env = RemoteVecEnv::connect(&options).map_err(other)?;
    match env.max_rollout_steps() {
        0 => {
            tracing::warn!(endpoint, num_envs, "the server has no rollouts; each step is a request");
            Ok(Box::new(StepCollector(Box::new(env))))
        }
        max if (horizon as u64) > max => Err(Failure::Input(miette::miette!(
            "`train.horizon` = {horizon} is not allowed: the server at {endpoint} has rollouts of at most {max} steps\n  \
             use a shorter horizon, or start the server with a larger `--max-rollout-steps`"
        ))),
        _ => Ok(Box::new(RemoteCollector::new(env, &options))),
    }
}
