//! `twinstep view`: a policy, a log, a robot file or the robots of an endpoint in the browser.

use std::path::{Path, PathBuf};

use twinstep_client::ConnectOptions;
use twinstep_viewer::{Frame, SceneInfo, static_page, write_mcap};
use twinstep_workflows::Observer;

use crate::exit::{CommandResult, Failure, input, other};
use crate::view_policy::WalkArgs;
use crate::web_view::PageArgs;
use crate::{view_endpoint, view_log, view_policy, view_tree};

/// Look at a policy, a log, a robot file or the robots of an endpoint in the browser.
///
/// POLICY (*.safetensors, *.onnx): robots walk with it in simulation. The page has pause and slow motion, sliders for the
/// velocity command, pushes and a new start.
///
/// LOG (a file or folder, also MCAP): the measured robot, with pause, slow motion and a slider for the time. With --model
/// the simulation under the same commands is its ghost: it starts from measured states, every 0.5 s with a floating base,
/// once per segment with a fixed one. The curves are the errors joint by joint. A log of another robot than a quadruped like
/// the Go2 is shown with the shapes of its --model (URDF, MJCF or a model file), without a ghost.
///
/// ROBOT (*.urdf, *.xml, a model file *.toml, or a name such as g1): its joints move one after the other through their ranges.
///
/// ENDPOINT (tcp/HOST:PORT, also tls, quic): the robots that step at a server (the newest lease, up to 64 robots), or the
/// robot of `twinstep robot`. They are looked at only, and without an open page the server draws nothing.
///
/// It prints the address of the page. On a remote machine: `ssh -L 7480:localhost:7480 HOST`, then http://localhost:7480.
/// `twinstep serve`, `train`, `run` and `robot` show their robots with --view.
///
/// With --html the motion of a policy or a log is written into one file that any browser plays, without Twinstep and without a
/// network. With --mcap it is written with Foxglove's schemas: scene and curves in Foxglove, poses in Rerun.
///
/// Examples: `twinstep view data/policies/walk.safetensors --robots 16`, `twinstep view walk.mcap --model extended.toml`,
/// `twinstep view arm.urdf` and `twinstep view tcp/127.0.0.1:7447`
#[derive(clap::Args)]
pub struct Args {
    /// Policy file, log, robot file, or endpoint.
    target: String,
    /// Model file of the simulated robots. Default for a policy: the ideal Go2; for a log: no simulation.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// Zenoh configuration file (JSON5) for an endpoint with TLS, user and password; see examples/security.
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Name of the robot, if an endpoint has several.
    #[arg(long, value_name = "NAME")]
    robot: Option<String>,
    /// Id of the server (see `twinstep list`), if an endpoint has several. Default: the one with the most free environments.
    #[arg(long, value_name = "ID")]
    server: Option<String>,
    #[command(flatten)]
    walk: WalkArgs,
    #[command(flatten)]
    page: PageArgs,
    /// Write the page with its motion into this file instead of serving it.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["listen", "token_file"])]
    html: Option<PathBuf>,
    /// Write the motion into this MCAP file with Foxglove's schemas instead of serving a page.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["listen", "token_file"])]
    mcap: Option<PathBuf>,
    /// Length of the motion in the file [s]; a log may be shorter.
    #[arg(long, value_name = "S", default_value_t = 20.0, value_parser = seconds)]
    seconds: f64,
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|_| "must be a number of seconds".to_owned())?;
    if (0.1..=600.0).contains(&seconds) { Ok(seconds) } else { Err("must be 0.1 to 600 s".to_owned()) }
}

/// The target does not exist.
#[derive(Debug, thiserror::Error)]
#[error(
    "there is no file or folder {0}\n  give a policy (*.safetensors, *.onnx), a log, a robot file (*.urdf, *.xml), or an endpoint (tcp/HOST:PORT)"
)]
struct NoTarget(String);

/// Shows the target until a signal.
pub fn run(args: &Args) -> CommandResult {
    let observer = Observer::terminal()?;
    let path = Path::new(&args.target);
    if !path.exists() && !view_tree::is_robot(path) {
        if !view_endpoint::is_endpoint(&args.target) {
            return Err(input(NoTarget(args.target.clone())));
        }
        let (zenoh, robot, server_id) = (args.zenoh.clone(), args.robot.clone(), args.server.clone());
        let options = ConnectOptions { zenoh, robot, server_id, ..ConnectOptions::new(&args.target, 1) };
        if args.html.is_some() || args.mcap.is_some() {
            return Err(Failure::Input(miette::miette!(
                "`--html` and `--mcap` are for a policy or a log; {} is an endpoint\n  record it first: `twinstep run POLICY --endpoint {} \
                 --log FILE`, then `twinstep view FILE --html ...`",
                args.target,
                args.target
            )));
        }
        return view_endpoint::run(&options, &args.page, &observer);
    }
    let model = args.model.as_deref();
    let is_policy = path.extension().is_some_and(|extension| extension == "safetensors" || extension == "onnx");
    if args.html.is_none() && args.mcap.is_none() {
        return if is_policy {
            view_policy::run(path, model, &args.walk, &args.page, &observer)
        } else if view_tree::is_robot(path) {
            view_tree::run(path, &args.page, &observer)
        } else {
            view_log::run(path, model, &args.page, &observer)
        };
    }
    let (scene, frames) = if is_policy {
        view_policy::motion(path, model, &args.walk, args.seconds, &observer)?
    } else if view_tree::is_robot(path) {
        view_tree::motion(path, args.seconds)?
    } else {
        view_log::motion(path, model, args.seconds, &observer)?
    };
    if let Some(file) = &args.html {
        write_page(file, &static_page(&scene, &frames))?;
    }
    args.mcap.as_ref().map_or(Ok(()), |file| write_recording(file, &scene, &frames))
}

fn write_recording(file: &Path, scene: &SceneInfo, frames: &[Frame]) -> CommandResult {
    let mut bytes = std::io::Cursor::new(Vec::new());
    write_mcap(&mut bytes, scene, frames).map_err(other)?;
    write_file("--mcap", file, bytes.get_ref())?;
    println!("written to {} ({:.1} MB)", file.display(), bytes.get_ref().len() as f64 / 1e6);
    Ok(())
}

fn write_page(file: &Path, page: &str) -> CommandResult {
    write_file("--html", file, page.as_bytes())?;
    println!("written to {} ({:.1} MB); open it in a browser", file.display(), page.len() as f64 / 1e6);
    Ok(())
}

fn write_file(flag: &str, file: &Path, bytes: &[u8]) -> CommandResult {
    twinstep_files::write(file, bytes).map_err(|cause| {
        Failure::Input(miette::miette!("`{flag}` = {}: cannot write the file: {cause}", file.display()))
    })
}
