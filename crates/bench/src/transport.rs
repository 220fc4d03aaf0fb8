//! Round trips without physics: the task `counter`, compared with a raw TCP ping-pong.

use twinstep_client::RemoteVecEnv;
use twinstep_model::{AgentCommands, ResetRequest, StepBatch, VecEnv};
use twinstep_protocol::convert;

use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::link::Link;
use crate::tcp::PingPong;
use crate::throughput::{Throughput, WINDOWS, measure as pace, median};

/// Number of environments in a message, and its link.
const CASES: [(usize, Link); 7] = [
    (1, Link::Tcp),
    (64, Link::Tcp),
    (64, Link::LowLatency),
    (1024, Link::Tcp),
    (1024, Link::SharedMemory),
    (4096, Link::Tcp),
    (4096, Link::SharedMemory),
];

/// Measures round trips per second and median latency of each case.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut rows = Vec::new();
    for (num_envs, link) in CASES {
        let (ours, tcp) = compare(num_envs, link, window_s, interrupted)?;
        let profile = link.suffix();
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
    link: Link,
    window_s: f64,
    interrupted: Interrupted,
) -> Result<(Throughput, Throughput), BenchError> {
    let server = link.server(&["--task", "counter"])?;
    let mut env = RemoteVecEnv::connect(&server.options(num_envs)).map_err(failed)?;
    env.reset(&ResetRequest::default()).map_err(failed)?;
    let actions = vec![0.1; num_envs * env.spec().action_len()];
    let mut tcp = {
        let request = convert::encode_actions(&actions, &AgentCommands::default(), None, 1, 1);
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
