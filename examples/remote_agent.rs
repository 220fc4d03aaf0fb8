//! Steps robots of a server with a proportional policy. Start `twinstep serve` first.
//!
//! `cargo run --release -p twinstep-examples --example remote_agent [ENDPOINT]`

use miette::IntoDiagnostic;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_model::{ResetRequest, VecEnv};

const NUM_ENVS: usize = 16;

fn main() -> miette::Result<()> {
    let endpoint = std::env::args().nth(1).unwrap_or_else(|| "tcp/127.0.0.1:7447".to_owned());
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(endpoint, NUM_ENVS)).into_diagnostic()?;
    let (obs_len, action_len) = (env.spec().obs_len(), env.spec().action_len());
    let mut obs = env.reset(&ResetRequest::seeded(1, NUM_ENVS)).into_diagnostic()?.to_vec();
    let mut total = 0.0;
    for _ in 0..250 {
        // The policy moves every joint back towards the default pose, in proportion to its offset (obs 9..21).
        let actions: Vec<f32> = obs
            .chunks_exact(obs_len)
            .flat_map(|row| row[9..9 + action_len].iter().map(|offset| -0.3 * offset))
            .collect();
        let batch = env.step(&actions).into_diagnostic()?;
        total += batch.reward.iter().sum::<f32>();
        obs.clone_from(&batch.obs);
    }
    println!("mean reward of {NUM_ENVS} robots over 5 s: {:.4}", total / (250.0 * NUM_ENVS as f32));
    env.close().into_diagnostic()
}
