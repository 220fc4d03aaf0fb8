//! Environments with physics: the same walk over Zenoh and in process.

use twinstep_client::{GroupedVecEnv, RemoteVecEnv};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv};

use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::link::Link;
use crate::throughput::{Throughput, WINDOWS, measure as pace, median};
use twinstep_envs::trot;

/// Groups in flight, environments of each, and their link.
const GROUPED: [(usize, usize, Link); 5] =
    [(3, 64, Link::Tcp), (3, 64, Link::LowLatency), (2, 512, Link::Tcp), (4, 256, Link::Tcp), (2, 2048, Link::Tcp)];

/// Measures env-steps/s, remote compared with in process.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = Vec::new();
    for num_envs in [64, 1024, 4096] {
        let (remote, local) = compare(num_envs, window_s, interrupted)?;
        let env_steps = num_envs as f64;
        rows.push(Measurement {
            case: format!("walk in process, {num_envs} envs"),
            value: local.per_second * env_steps,
            unit: "env-steps/s",
            reference: None,
            ratio: None,
        });
        rows.push(Measurement {
            case: format!("walk over Zenoh, {num_envs} envs"),
            value: remote.per_second * env_steps,
            unit: "env-steps/s",
            reference: Some("the same envs in process".to_owned()),
            ratio: Some(remote.per_second / local.per_second),
        });
    }
    for (groups, group_envs, link) in GROUPED {
        let (remote, local) = compare_groups(groups, group_envs, link, window_s, interrupted)?;
        rows.push(Measurement {
            case: format!("walk over Zenoh, {groups} groups of {group_envs} envs in flight{}", link.suffix()),
            value: remote.per_second * (groups * group_envs) as f64,
            unit: "env-steps/s",
            reference: Some(format!("{} envs in process", groups * group_envs)),
            ratio: Some(remote.per_second / local.per_second),
        });
    }
    Ok(rows)
}

/// Compares groups in flight with as many environments in process. One call steps every environment once.
fn compare_groups(
    groups: usize,
    group_envs: usize,
    link: Link,
    window_s: f64,
    interrupted: Interrupted,
) -> Result<(Throughput, Throughput), BenchError> {
    let num_envs = groups * group_envs;
    let server = link.server(&[])?;
    let mut remote = GroupedVecEnv::connect(&server.options(num_envs), groups).map_err(failed)?;
    let mut local = SimEnvFactory::new(Config::default())
        .and_then(|host| host.build(num_envs, AutoresetMode::NextStep, None))
        .map_err(failed)?;
    let request = ResetRequest::seeded(1, num_envs);
    remote.reset(&request).map_err(failed)?;
    local.reset(&request).map_err(failed)?;
    let policy_dt = remote.spec().policy_dt as f32;
    let actions = |steps: u32| trot::action(steps as f32 * policy_dt).repeat(group_envs);
    let (mut remote_steps, mut local_steps) = (0, 0);
    for group in 0..groups {
        remote.send(group, &actions(remote_steps)).map_err(failed)?;
    }
    let (mut ours, mut reference) = (Vec::new(), Vec::new());
    for _ in 0..WINDOWS {
        check(interrupted)?;
        ours.push(pace(window_s, || {
            remote_steps += 1;
            for group in 0..groups {
                remote.recv(group).map_err(failed)?;
                remote.send(group, &actions(remote_steps)).map_err(failed)?;
            }
            Ok(())
        })?);
        reference.push(pace(window_s, || step(&mut *local, &mut local_steps))?);
    }
    Ok((median(&ours), median(&reference)))
}

fn compare(num_envs: usize, window_s: f64, interrupted: Interrupted) -> Result<(Throughput, Throughput), BenchError> {
    let server = Link::Tcp.server(&[])?;
    let mut remote = RemoteVecEnv::connect(&server.options(num_envs)).map_err(failed)?;
    let mut local = SimEnvFactory::new(Config::default())
        .and_then(|host| host.build(num_envs, AutoresetMode::NextStep, None))
        .map_err(failed)?;
    let request = ResetRequest::seeded(1, num_envs);
    remote.reset(&request).map_err(failed)?;
    local.reset(&request).map_err(failed)?;
    // Both execute the same trot, with the same contacts.
    let (mut remote_steps, mut local_steps) = (0, 0);
    let (mut ours, mut reference) = (Vec::new(), Vec::new());
    for _ in 0..WINDOWS {
        check(interrupted)?;
        ours.push(pace(window_s, || step(&mut remote, &mut remote_steps))?);
        reference.push(pace(window_s, || step(&mut *local, &mut local_steps))?);
    }
    Ok((median(&ours), median(&reference)))
}

fn step(env: &mut dyn VecEnv, steps: &mut u32) -> Result<(), BenchError> {
    let action = trot::action(*steps as f32 * env.spec().policy_dt as f32);
    *steps += 1;
    env.step(&action.repeat(env.num_envs())).map(drop).map_err(failed)
}
