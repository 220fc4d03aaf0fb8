//! `twinstep list`: shows the servers that are visible at an endpoint.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use twinstep_client::{ConnectOptions, Discovery, ServerInfo};

use crate::exit::{CommandResult, other};

/// List the servers that are visible at an endpoint, with their tasks, free environments and load.
///
/// ENDPOINT is that of a server, of a robot, or of a router to which servers are connected (`twinstep serve --connect`).
/// The load is the number of environment steps per second, of all clients of the server together.
///
/// Example: `twinstep list tcp/192.168.1.5:7447`
#[derive(clap::Args)]
pub struct Args {
    /// Zenoh endpoint to connect to.
    #[arg(default_value = "tcp/127.0.0.1:7447")]
    endpoint: String,
    /// Time over which the load is measured [s].
    #[arg(long, default_value_t = 1.0, value_name = "S", value_parser = interval)]
    interval_s: f64,
    /// Zenoh configuration file (JSON5) for TLS, user and password; see examples/security.
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Print one JSON array and nothing else on stdout.
    #[arg(long)]
    json: bool,
}

/// A row of the list. Of a server that does not answer only the first three entries are known.
#[derive(serde::Serialize)]
struct Row {
    robot: String,
    server_id: String,
    is_reachable: bool,
    server_version: Option<String>,
    task: Option<String>,
    free_envs: Option<u64>,
    max_envs: Option<u64>,
    env_steps_per_s: Option<f64>,
}

fn interval(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "must be a number of seconds".to_owned())?;
    if (0.1..=60.0).contains(&seconds) { Ok(seconds) } else { Err("must be 0.1 to 60 s".to_owned()) }
}

/// Lists the servers, and measures their load between two looks.
pub fn run(args: &Args) -> CommandResult {
    let options = ConnectOptions { zenoh: args.zenoh.clone(), ..ConnectOptions::new(&args.endpoint, 1) };
    let discovery = Discovery::open(&options).map_err(other)?;
    let (before, since) = (discovery.servers(), Instant::now());
    if !before.is_empty() {
        std::thread::sleep(Duration::from_secs_f64(args.interval_s));
    }
    let elapsed_s = since.elapsed().as_secs_f64();
    let rows: Vec<Row> = discovery.servers().into_iter().map(|server| row(server, &before, elapsed_s)).collect();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&rows).map_err(other)?);
    } else {
        print(&rows, &args.endpoint);
    }
    Ok(())
}

fn row(server: ServerInfo, before: &[ServerInfo], elapsed_s: f64) -> Row {
    let steps_before = before
        .iter()
        .find(|earlier| earlier.server_id == server.server_id)
        .and_then(|earlier| earlier.hello.as_ref())
        .map(|hello| hello.env_steps);
    let hello = server.hello.as_ref();
    let steps = hello.zip(steps_before).map(|(hello, before)| hello.env_steps.saturating_sub(before));
    Row {
        is_reachable: hello.is_some(),
        server_version: hello.map(|hello| hello.server_version.clone()),
        task: hello.map(|hello| hello.spec.task.clone()),
        free_envs: hello.map(|hello| hello.free_envs),
        max_envs: hello.map(|hello| hello.max_envs),
        env_steps_per_s: steps.map(|steps| (steps as f64 / elapsed_s).round()),
        robot: server.robot,
        server_id: server.server_id,
    }
}

fn print(rows: &[Row], endpoint: &str) {
    if rows.is_empty() {
        println!("no server is visible at {endpoint}\n  start one with `twinstep serve --connect {endpoint}`");
        return;
    }
    println!("{:<16} {:<17} {:<10} {:>13} {:>12}  version", "robot", "server", "task", "free envs", "env-steps/s");
    for row in rows {
        let (Some(free), Some(max)) = (row.free_envs, row.max_envs) else {
            println!("{:<16} {:<17} does not answer", row.robot, row.server_id);
            continue;
        };
        let load = row.env_steps_per_s.map_or_else(|| "?".to_owned(), |load| format!("{load:.0}"));
        let (task, version) = (row.task.as_deref().unwrap_or("?"), row.server_version.as_deref().unwrap_or("?"));
        let envs = format!("{free} of {max}");
        println!("{:<16} {:<17} {task:<10} {envs:>13} {load:>12}  {version}", row.robot, row.server_id);
    }
}
