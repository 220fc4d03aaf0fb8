//! Round trips without physics: the task `counter`, compared with a raw TCP ping-pong.

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_model::{ResetRequest, StepBatch, VecEnv};
use twinstep_protocol::convert;

use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::tcp::PingPong;
use crate::throughput::{Throughput, WINDOWS, measure as pace, median};
use twinstep_client::ServerProcess;

/// Number of environments in a message, and whether it uses shared memory.
const CASES: [(usize, bool); 6] = [(1, false), (64, false), (1024, false), (1024, true), (4096, false), (4096, true)];

/// Measures round trips per second and median latency of each case.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = Vec::new();
    for (num_envs, shared_memory) in CASES {
        let (ours, tcp) = compare(num_envs, shared_memory, window_s, interrupted)?;
        let profile = if shared_memory { ", shared memory" } else { "" };
        let reference = Some("raw TCP ping-pong with the same payloads".to_owned());
        rows.push(Measurement {
            case: format!("transport, {num_envs} envs{profile}"),
            value: ours.per_second,
            unit: "round trips/s",
            reference: reference.clone(),
            ratio: Some(ours.per_second / tcp.per_second),
        });
        rows.push(Measurement {
            case: format!("transport, {num_envs} envs{profile}, p50"),
            value: ours.median_us,
            unit: "us",
            reference,
            ratio: Some(tcp.median_us / ours.median_us),
        });
    }
    Ok(rows)
}

/// Measures windows of Twinstep and of TCP alternately, so that both have the same load of the machine.
fn compare(
    num_envs: usize,
    shared_memory: bool,
    window_s: f64,
    interrupted: Interrupted,
) -> Result<(Throughput, Throughput), BenchError> {
    let mut flags = vec!["--task", "counter"];
    if shared_memory {
        flags.push("--shared-memory");
    }
    let server = ServerProcess::start(&flags).map_err(failed)?;
    let options = ConnectOptions { shared_memory, ..ConnectOptions::new(&server.endpoint, num_envs) };
    let mut env = RemoteVecEnv::connect(&options).map_err(failed)?;
    env.reset(&ResetRequest::default()).map_err(failed)?;
    let actions = vec![0.1; num_envs * env.spec().action_len()];
    let mut tcp = {
        let request = convert::encode_actions(&actions, None, None, 1, 1);
        let reply = convert::encode_step(&StepBatch::new(num_envs, env.spec()), 1, false);
        PingPong::start(request.len(), reply.len())?
    };
    let (mut ours, mut reference) = (Vec::new(), Vec::new());
    for _ in 0..WINDOWS {
        check(interrupted)?;
        ours.push(pace(window_s, || env.step(&actions).map(drop).map_err(failed))?);
        reference.push(pace(window_s, || tcp.once())?);
    }
    Ok((median(&ours), median(&reference)))
}
