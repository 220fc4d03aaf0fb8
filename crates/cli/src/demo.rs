//! `twinstep demo`: a Go2 learns to walk and is stepped over Zenoh; then a real recording is compared with the simulation
//! and diagnosed.

use std::path::{Path, PathBuf};
use std::time::Instant;

use indicatif::ProgressBar;
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_model::{ResetRequest, VecEnv, go2};
use twinstep_sim::SimConfig;

use twinstep_client::ServerProcess;
use twinstep_identify::replay::replay;
use twinstep_logs::recording;
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_report::{film_strip, joint_plot, joint_table};
use twinstep_sim::BatchRollout;

use twinstep_workflows::{DiagnoseOptions, TrainConfig, TrainOptions, progress_lines};

use crate::diagnose::diagnose_and_print;
use crate::exit::{CommandResult, Signals, input, other};
use crate::train;
use crate::web_view::ViewArgs;

/// Frames of the film strip, and policy steps between two of them.
const FILM_FRAMES: usize = 15;
const FILM_STEPS: u64 = 4;

/// Show the main features in two minutes; needs only this program.
///
/// Trains a policy that walks; a page in the browser shows the robots while they learn. Starts a server in another process, connects to it over Zenoh, and lets the policy walk
/// its robots. Then compares a recording of a real Go2, with a fixed base in the air, with the simulation joint by
/// joint. At the end it diagnoses the recording: it reports which effects explain the difference, and writes the HTML
/// report.
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
    /// Number of environment steps of the training. With a million the robot does not walk yet.
    #[arg(long, default_value_t = 8_000_000, value_name = "N")]
    train_steps: u64,
    /// Folder for the policy, the plots, the recording and the diagnosis.
    #[arg(long, default_value = "twinstep-demo", value_name = "DIR")]
    out: PathBuf,
}

/// Runs the parts of the demo.
pub fn run(args: &Args) -> CommandResult {
    eprintln!("1. A Go2 learns to walk: {:.1} million steps of 1024 robots.", args.train_steps as f64 / 1e6);
    let mut config = TrainConfig::default();
    config.train.total_steps = args.train_steps;
    let page = ViewArgs::default_page();
    let training = TrainOptions { page, ..TrainOptions::new(args.out.join("walk"), config, 1) };
    // The demo repeats its own training.
    training.remove_checkpoint().map_err(other)?;
    train::train_and_print(&training, false)?;
    let signals = Signals::listen()?;
    walk(args, &training.policy(), &signals)?;
    compare(&args.out, &signals)
}

fn walk(args: &Args, policy: &Path, signals: &Signals) -> CommandResult {
    let num_envs = args.envs as usize;
    eprintln!("\n2. A server in another process simulates {num_envs} Go2; this process walks them over Zenoh.");
    let (policy, _) = Policy::read(policy).map_err(other)?;
    let mut runner = PolicyRunner::new(&policy);
    let server = ServerProcess::start(&["--envs", &num_envs.to_string()]).map_err(other)?;
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&server.endpoint, num_envs)).map_err(other)?;
    let mut obs = env.reset(&ResetRequest::seeded(1, num_envs)).map_err(other)?.to_vec();
    let dt = env.spec().policy_dt;
    let steps = (f64::from(args.seconds) / dt) as u64;
    let bar = ProgressBar::with_draw_target(Some(steps * num_envs as u64), progress_lines::target())
        .with_style(progress_lines::style("   {bar:32} {pos}/{len} env-steps  {per_sec}  ETA {eta}"));
    let (since, mut falls) = (Instant::now(), 0);
    let mut actions = vec![0.0; num_envs * env.spec().action_len()];
    let mut frames = Vec::new();
    for step in 0..steps {
        signals.check()?;
        if step % FILM_STEPS == 0 && frames.len() < FILM_FRAMES {
            frames.push((step as f64 * dt, env.scene(0).map_err(other)?));
        }
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions).map_err(other)?;
        falls += batch.terminated.iter().filter(|fell| **fell).count();
        obs.copy_from_slice(&batch.obs);
        bar.inc(num_envs as u64);
    }
    bar.finish_and_clear();
    let (wall, env_steps) = (since.elapsed().as_secs_f64(), steps * num_envs as u64);
    println!(
        "walked {num_envs} robots for {} s of simulated time in {wall:.1} s: {:.0} env-steps/s, {:.0} times real time",
        args.seconds,
        env_steps as f64 / wall,
        env_steps as f64 * dt / wall,
    );
    println!("falls: {falls}");
    let film = args.out.join("walk.svg");
    twinstep_files::write(&film, film_strip(&frames)).map_err(other)?;
    println!("film strip of the first robot: {}", film.display());
    env.close().map_err(other)
}

fn compare(out: &Path, signals: &Signals) -> CommandResult {
    eprintln!("\n3. A recording of a real Go2, with a fixed base in the air, compared with the ideal simulation.");
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
    eprintln!("\n4. Diagnosis: which effects explain the difference?");
    diagnose_and_print(&DiagnoseOptions::new(vec![folder], out.join("diagnosis")), false).map(drop)
}
