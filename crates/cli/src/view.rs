//! `twinstep view`: a policy or a log in the browser.

use std::path::PathBuf;

use crate::exit::{CommandResult, Signals, input};
use crate::view_policy::WalkArgs;
use crate::web_view::PageArgs;
use crate::{view_log, view_policy};

/// Look at a policy or a log in the browser.
///
/// POLICY (*.safetensors, *.onnx): robots walk with it in simulation. The page has pause and slow motion, sliders for the
/// velocity command, pushes and a new start.
///
/// LOG (a file or folder, also MCAP): the measured robot, with pause, slow motion and a slider for the time. With --model
/// the simulation under the same commands is its ghost: it starts from measured states, every 0.5 s with a floating base,
/// once per segment with a fixed one. The curves are the errors joint by joint.
///
/// It prints the address of the page. On a remote machine: `ssh -L 7480:localhost:7480 HOST`, then http://localhost:7480.
/// `twinstep serve`, `train`, `run` and `robot` show their robots with --view.
///
/// Examples: `twinstep view data/policies/walk.safetensors --robots 16` and `twinstep view walk.mcap --model extended.toml`
#[derive(clap::Args)]
pub struct Args {
    /// Policy file or log.
    target: PathBuf,
    /// Model file of the simulated robots. Default for a policy: the ideal Go2; for a log: no simulation.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    #[command(flatten)]
    walk: WalkArgs,
    #[command(flatten)]
    page: PageArgs,
}

/// The target does not exist.
#[derive(Debug, thiserror::Error)]
#[error("there is no file or folder {}\n  give a policy (*.safetensors, *.onnx) or a log", .0.display())]
struct NoTarget(PathBuf);

/// Shows the target until a signal.
pub fn run(args: &Args) -> CommandResult {
    let signals = Signals::listen()?;
    if !args.target.exists() {
        return Err(input(NoTarget(args.target.clone())));
    }
    match args.target.extension().and_then(|extension| extension.to_str()) {
        Some("safetensors" | "onnx") => {
            view_policy::run(&args.target, args.model.as_deref(), &args.walk, &args.page, &signals)
        }
        _ => view_log::run(&args.target, args.model.as_deref(), &args.page, &signals),
    }
}
