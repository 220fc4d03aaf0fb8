//! `twinstep demo`: steps robots over Zenoh, then compares a real recording with the simulation and diagnoses it.

use std::path::{Path, PathBuf};
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_model::{ResetRequest, VecEnv, go2};
use twinstep_sim::SimConfig;

use twinstep_client::ServerProcess;
use twinstep_envs::trot;
use twinstep_identify::replay::replay;
use twinstep_logs::recording;
use twinstep_report::{joint_plot, joint_table};
use twinstep_sim::BatchRollout;

use crate::diagnose;
use crate::exit::{CommandResult, Signals, input, other};

/// Show the main features in two minutes; needs only this program.
///
/// Starts a server in another process, connects to it over Zenoh and steps robots in a scripted trot. Then compares a
/// recording of a real Go2, with a fixed base in the air, with the simulation joint by joint. At the end it diagnoses
/// the recording: it reports which effects explain the difference, and writes the HTML report.
///
/// Example: `twinstep demo --envs 256 --seconds 5`
#[derive(clap::Args)]
pub struct Args {
    /// Number of robots.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    envs: u32,
    /// Simulated time [s].
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=3600))]
    seconds: u32,
    /// Folder for the plot, the recording and the diagnosis.
    #[arg(long, default_value = "twinstep-demo", value_name = "DIR")]
    out: PathBuf,
}

/// Runs the three parts of the demo.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    walk(args, &signals)?;
    compare(&args.out, &signals)
}

fn walk(args: &Args, signals: &Signals) -> CommandResult {
    let num_envs = args.envs as usize;
    eprintln!("1. A server in another process simulates {num_envs} Go2; this process steps them over Zenoh.");
    let server = ServerProcess::start(&["--envs", &num_envs.to_string()]).map_err(other)?;
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&server.endpoint, num_envs)).map_err(other)?;
    env.reset(&ResetRequest::seeded(1, num_envs)).map_err(other)?;
    let dt = env.spec().policy_dt as f32;
    let steps = (args.seconds as f32 / dt) as u64;
    let bar = ProgressBar::new(steps * num_envs as u64).with_style(
        ProgressStyle::with_template("   {bar:32} {pos}/{len} env-steps  {per_sec}  ETA {eta}")
            .expect("the template is valid"),
    );
    let (since, mut ended) = (Instant::now(), 0);
    for step in 0..steps {
        signals.check()?;
        let action = trot::action(step as f32 * dt);
        let batch = env.step(&action.repeat(num_envs)).map_err(other)?;
        ended += batch.ended.len();
        bar.inc(num_envs as u64);
    }
    bar.finish_and_clear();
    let (wall, env_steps) = (since.elapsed().as_secs_f64(), steps * num_envs as u64);
    println!(
        "stepped {num_envs} robots for {} s of simulated time in {wall:.1} s: {:.0} env-steps/s, {:.0} times real time",
        args.seconds,
        env_steps as f64 / wall,
        env_steps as f64 * f64::from(dt) / wall,
    );
    println!("ended episodes (falls, or the time limit): {ended}");
    env.close().map_err(other)
}

fn compare(out: &Path, signals: &Signals) -> CommandResult {
    eprintln!("\n2. A recording of a real Go2, with a fixed base in the air, compared with the ideal simulation.");
    let folder = out.join("go2_air_chirp");
    let log = recording::unpack(&folder).map_err(input)?;
    let mut simulator = BatchRollout::new(&go2(), &SimConfig::default()).map_err(other)?;
    let replayed = replay(&log, &go2(), &mut simulator).map_err(other)?;
    signals.check()?;
    println!("\n{}", joint_table(&replayed));
    let picture = out.join("replay.svg");
    joint_plot::write_svg(&replayed, "Real Go2 in the air compared with the ideal simulation", &picture)
        .map_err(other)?;
    println!("measured and simulated position of each joint: {}", picture.display());
    println!("recording, as a log folder: {}", folder.display());
    eprintln!("\n3. Diagnosis: which effects explain the difference?");
    diagnose::run(&diagnose::Args::new(folder, out.join("diagnosis")))
}
