//! Runs a server inside the program, with custom settings.
//!
//! `cargo run --release -p twinstep-examples --example server_in_process`

use std::sync::Arc;

use miette::IntoDiagnostic;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{Config, Server, SimEnvFactory};
use twinstep_model::{ResetRequest, VecEnv};

fn main() -> miette::Result<()> {
    let mut config = Config::default();
    config.server.listen = "tcp/127.0.0.1:7449".to_owned();
    config.randomise.payload_kg = [0.0, 2.0];
    let factory = SimEnvFactory::new(config.clone()).into_diagnostic()?;
    let server = Server::start(&config.server, Arc::new(factory)).into_diagnostic()?;

    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&config.server.listen, 4)).into_diagnostic()?;
    env.reset(&ResetRequest::seeded(1, 4)).into_diagnostic()?;
    for _ in 0..50 {
        env.step(&[0.0; 48]).into_diagnostic()?;
    }
    println!("{} environment steps served", server.env_steps());

    env.close().into_diagnostic()?;
    server.shutdown();
    Ok(())
}
