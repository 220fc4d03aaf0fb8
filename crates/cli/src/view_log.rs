//! A log in the browser: the measured robot, and the simulation under the same commands as its ghost.

use std::path::Path;

use twinstep_effects::TreeModelFile;
use twinstep_inference::joint_indices;
use twinstep_viewer::{Frame, SceneInfo};
use twinstep_workflows::Observer;
use twinstep_workflows::log_motion::player;
use twinstep_workflows::open_log::open_log;
use twinstep_workflows::player::Player;
use twinstep_workflows::robot_file::SimulatedRobot;
use twinstep_workflows::tree_model::tree_model;

use crate::exit::{CommandResult, Failure, input};
use crate::view_tree;
use crate::web_view::PageArgs;

/// Plays a log until a signal.
pub fn run(path: &Path, model: Option<&Path>, page: &PageArgs, observer: &Observer) -> CommandResult {
    let (mut player, scene) = open(path, model, observer)?;
    let page = page.open(scene)?;
    player.run(page.hub(), observer)
}

/// Returns the first seconds of a log.
pub fn motion(
    path: &Path,
    model: Option<&Path>,
    seconds: f64,
    observer: &Observer,
) -> Result<(SceneInfo, Vec<Frame>), Failure> {
    let (player, scene) = open(path, model, observer)?;
    Ok((scene, player.motion(seconds)))
}

fn open(path: &Path, model: Option<&Path>, observer: &Observer) -> Result<(Player, SceneInfo), Failure> {
    let log = open_log(path, observer)?;
    if let Some(file) = model.map(|_| tree_model(model, &log)).transpose()?.flatten() {
        return view_tree::log(&log, path, &file);
    }
    // The pose of joints that the robot does not have would be the default one, whatever the log says.
    joint_indices(log.joints(), &TreeModelFile::go2().nominal.tree).map_err(input)?;
    let robot = SimulatedRobot::load(model, &log, path)?;
    let what = if model.is_some() { "measured motion and its simulation" } else { "measured motion" };
    player(log, format!("{what}: {}", path.display()), robot, model.is_some())
}
