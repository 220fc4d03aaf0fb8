//! Runs two agents on one server, each with its own robots. Start `twinstep serve` first.
//!
//! `cargo run --release -p twinstep-examples --example two_agents [ENDPOINT]`

use std::thread;

use miette::IntoDiagnostic;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_model::{ResetRequest, VecEnv};

fn main() -> miette::Result<()> {
    let endpoint = std::env::args().nth(1).unwrap_or_else(|| "tcp/127.0.0.1:7447".to_owned());
    let agents = [("stander", 0.0, 2), ("croucher", 0.6, 3)].map(|(name, bend, num_envs)| {
        let endpoint = endpoint.clone();
        thread::spawn(move || agent(name, &endpoint, bend, num_envs))
    });
    for agent in agents {
        agent.join().map_err(|_| miette::miette!("an agent panicked"))??;
    }
    Ok(())
}

/// Bends every knee by `bend` for two seconds and prints the final position of one knee.
fn agent(name: &str, endpoint: &str, bend: f32, num_envs: usize) -> miette::Result<()> {
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(endpoint, num_envs)).into_diagnostic()?;
    env.reset(&ResetRequest::seeded(1, num_envs)).into_diagnostic()?;
    let one: [f32; 12] = std::array::from_fn(|joint| [0.0, bend, -bend][joint % 3]);
    for _ in 0..100 {
        env.step(&one.repeat(num_envs)).into_diagnostic()?;
    }
    let batch = env.step(&one.repeat(num_envs)).into_diagnostic()?;
    println!("{name}: {num_envs} robots, knee of FL at {:+.2} rad from the default pose", batch.obs[9 + 2]);
    env.close().into_diagnostic()
}
