//! `twinstep u2e`: collect, fit, train an exploration policy, collect, fit, …, as one resumable command.

use std::path::PathBuf;

use twinstep_workflows::{Observer, u2e};

use crate::exit::CommandResult;

/// Learn the actuators of a robot with uncertainty-guided exploration (U2E).
///
/// The base policy walks the robot at the endpoint, simulated or real. An ensemble of actuator networks is fitted to the
/// log. An exploration policy is then trained in the simulator that the ensemble drives, for motion on which its members
/// disagree; it walks the robot, the ensemble is refitted to all logs from its present weights, and so on. The folder of
/// CONFIG, without its extension, receives:
///
///   0-base                the log of the base policy, the ensemble, and what it predicts (evaluation.json)
///   1-explore, 2-explore  the training, the exploration policy, its log, and the ensemble of all logs so far
///   robot.toml            the robot with the newest ensemble, for `twinstep train --model` and `twinstep serve --model`
///   report.md             uncertainty, torque errors, robot time and falls; also progress.html, which grows
///
/// It ends after `iterations` logs of exploration, or earlier, by the rule of U2E: when the uncertainty of a new log, by
/// the ensemble before it, is less than `threshold` below that of the log before, relatively.
///
/// The same command continues after Ctrl-C, a crash or a power failure: what a stage has completed is kept, a training
/// continues at its checkpoint, and a log that was interrupted is recorded again. The robot walks without a question as
/// soon as a stage needs a log, `room_m` around where it then stands.
///
/// CONFIG (TOML); `policy` is required, the others have these defaults:
///
///   policy = "data/policies/walk.safetensors"   base policy, of the task `walk`
///   endpoint = "tcp/127.0.0.1:7447"
///   method = "explore"        or "random": base policy with noise on its actions; "base": base policy alone
///   iterations = 3            largest number of logs after the first one
///   stop = "uncertainty"      or "never": all iterations
///   threshold = 0.1           relative decrease of the uncertainty below which the iterations end
///   seconds = 60.0            duration of each log
///   segment_s = 5.0           duration of a velocity command, which is random
///   room_m = 3.0              largest distance from the start
///   action_noise = 0.2        of method "random": standard deviation in units of `action_scale`
///   draw = "episode"          or "step" (U2E): when a simulated robot draws another member of the ensemble
///   fast = false              step a simulated robot as fast as it answers
///   seed = 1
///   robot, zenoh              as of `twinstep run`; without a default
///   model                     model file with effects behind the torque sensor, such as friction and payload
///   held_out                  log that no ensemble learns from: the ensembles are compared on it
///   [fit]                     members = 6, hidden = 32, joint_input = "pooled", epochs = 100, smooth_hz
///   [explore]                 max_residual = 0.5, uncertainty_weight = 10.0, task_weight = 0.5, and [explore.walk]
///   [randomise]               as of `twinstep train`
///   [train]                   as of `twinstep train`; total_steps = 2000000
///
/// Example: `twinstep serve --envs 1 --engine mujoco --model hidden.toml` and, in another terminal,
/// `twinstep u2e examples/u2e.toml`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
#[allow(clippy::doc_link_with_quotes, reason = "it is TOML")]
pub struct Args {
    /// Config file (TOML).
    config: PathBuf,
}

/// Runs the stages that are not complete.
pub fn run(args: &Args) -> CommandResult {
    print!("{}", u2e(&args.config, &Observer::terminal()?)?);
    println!("\nwritten to {}", args.config.with_extension("").join("report.md").display());
    Ok(())
}
