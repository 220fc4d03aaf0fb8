//! Robots of any tree in the browser: a log, or a robot file whose joints move one after the other.

use std::path::Path;

use glam::{DAffine3, DQuat, DVec3};
use twinstep_effects::{TreeModelFile, shipped_robots};
use twinstep_inference::joint_indices;
use twinstep_logs::Log;
use twinstep_model::{BaseMount, Ground, RobotTree, Scene, TreeJointKind, TreeModel};
use twinstep_viewer::{Frame, RobotFrame, SceneInfo};

use twinstep_workflows::Observer;

use crate::exit::{CommandResult, Failure, input};
use crate::web_view::PageArgs;
use twinstep_workflows::player::{Curves, Player};
use twinstep_workflows::tree_model::of_any_tree;

/// Time in which a joint moves from the default pose to both ends of its range and back [s].
const SWEEP_S: f64 = 2.0;
/// Rows per second of a sweep.
const SWEEP_HZ: f64 = 60.0;
/// Largest motion of a joint to either side [rad or m]: a wheel has no range.
const MAX_SWEEP: f64 = std::f64::consts::PI;

/// Returns true for a robot file, a model file, or the name of a robot in this program.
pub fn is_robot(path: &Path) -> bool {
    let is_shipped = || shipped_robots().any(|name| Path::new(name) == path);
    (!path.exists() && is_shipped())
        || path.extension().is_some_and(|end| ["urdf", "xml", "mjcf", "toml"].iter().any(|known| end == *known))
}

/// Shows the robot of a file until a signal.
pub fn run(path: &Path, page: &PageArgs, observer: &Observer) -> CommandResult {
    let (mut player, scene) = robot(path)?;
    let page = page.open(scene)?;
    player.run(page.hub(), observer)
}

/// Returns the first seconds of the motion of a robot's joints.
pub fn motion(path: &Path, seconds: f64) -> Result<(SceneInfo, Vec<Frame>), Failure> {
    let (player, scene) = robot(path)?;
    Ok((scene, player.motion(seconds)))
}

/// Returns a player of the robot of a file: its joints move one after the other.
fn robot(path: &Path) -> Result<(Player, SceneInfo), Failure> {
    let file = of_any_tree(Some(path))?;
    let model = file.tree_model().map_err(|cause| Failure::Input(miette::miette!("{}: {cause}", path.display())))?;
    let (pose, tree) = (file.pose(), model.tree.clone());
    let base = standing_base(&model, &pose);
    let scene = info(path, &tree, base, &pose);
    let ranges: Vec<[f64; 2]> = model.joints.iter().map(|joint| joint.range).collect();
    let rows = (ranges.len().max(1) as f64 * SWEEP_S * SWEEP_HZ) as usize;
    let times = (0..=rows).map(|row| row as f64 / SWEEP_HZ).collect();
    let at = move |row: usize| {
        let q = sweep(&pose, &ranges, row as f64 / SWEEP_HZ);
        let robot = RobotFrame::of_scene(&Scene::of_tree(&tree, base, &q, &Ground::FLAT));
        (robot, curves(&tree, &q))
    };
    Ok((Player::new(times, at), scene))
}

/// Returns joint positions at a time since the first joint began to move.
fn sweep(pose: &[f64], ranges: &[[f64; 2]], time: f64) -> Vec<f64> {
    let mut q = pose.to_vec();
    let joint = (time / SWEEP_S) as usize;
    if let (Some(moving), Some([low, high])) = (q.get_mut(joint), ranges.get(joint)) {
        let angle = std::f64::consts::TAU * (time / SWEEP_S).fract();
        let end = if angle.sin() > 0.0 { high.min(*moving + MAX_SWEEP) } else { low.max(*moving - MAX_SWEEP) };
        *moving += angle.sin().abs() * (end - *moving);
    }
    q
}

/// Returns a player of a log of the robot of a model file.
pub fn log(log: &Log, path: &Path, file: &TreeModelFile) -> Result<(Player, SceneInfo), Failure> {
    let model = file.tree_model().map_err(|cause| Failure::Input(miette::miette!("{cause}")))?;
    let indices = joint_indices(log.joints(), &model.tree).map_err(input)?;
    let (tree, poses) = (model.tree.clone(), measured_poses(log, &model, &indices, &file.pose()));
    let scene = info(path, &tree, poses[0].0, &poses[0].1);
    let log = log.clone();
    let times = log.t().to_vec();
    let at = move |row: usize| {
        let (base, q) = &poses[row];
        let scene = Scene::of_tree(&tree, *base, q, &Ground::FLAT);
        let mut torque = vec![f32::NAN; tree.joints.len()];
        for (name, joint) in log.joints().iter().zip(&indices) {
            if let Some(column) = log.tau_measured(name) {
                torque[*joint] = column[row] as f32;
            }
        }
        (RobotFrame { torque: Some(torque), ..RobotFrame::of_scene(&scene) }, curves(&tree, q))
    };
    Ok((Player::new(times, at), scene))
}

/// Returns world-from-base and joint positions of each row. What was not measured is that of a robot that stands at the origin.
fn measured_poses(log: &Log, model: &TreeModel, indices: &[usize], default_pose: &[f64]) -> Vec<(DAffine3, Vec<f64>)> {
    let position = ["pos_x", "pos_y", "pos_z"].map(|name| log.channel(name));
    let orientation = ["quat_w", "quat_x", "quat_y", "quat_z"].map(|name| log.channel(name));
    let pose = |row: usize| {
        let mut q = default_pose.to_vec();
        for (name, joint) in log.joints().iter().zip(indices) {
            if let Some(column) = log.q(name) {
                q[*joint] = column[row];
            }
        }
        let mut base = standing_base(model, &q);
        if let [Some(w), Some(x), Some(y), Some(z)] = orientation {
            let rotation = DQuat::from_xyzw(x[row], y[row], z[row], w[row]).normalize();
            base = DAffine3::from_rotation_translation(rotation, base.translation);
        } else if let Some([w, x, y, z]) = log.meta().base_quat {
            let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
            base = DAffine3::from_rotation_translation(rotation, base.translation);
        }
        for (part, column) in position.iter().enumerate() {
            if let Some(column) = column {
                base.translation[part] = column[row];
            }
        }
        (base, q)
    };
    (0..log.rows()).map(pose).collect()
}

/// Returns world-from-base of a robot at the place of its file, or standing at the origin.
fn standing_base(model: &TreeModel, q: &[f64]) -> DAffine3 {
    if model.tree.base == Some(BaseMount::Fixed) {
        return model.tree.world_from_base;
    }
    DAffine3::from_translation(DVec3::new(0.0, 0.0, model.tree.standing_height(q)))
}

fn info(path: &Path, tree: &RobotTree, base: DAffine3, q: &[f64]) -> SceneInfo {
    let scene = Scene::of_tree(tree, base, q, &Ground::FLAT);
    let title = format!("{}: each joint moves to both ends of its range", path.display());
    SceneInfo { is_interactive: true, ..SceneInfo::of_tree(title, &scene, tree) }
}

fn curves(tree: &RobotTree, q: &[f64]) -> Curves {
    let unit = |kind: TreeJointKind| if kind == TreeJointKind::Prismatic { "m" } else { "rad" };
    tree.joints.iter().zip(q).map(|(joint, q)| (format!("{} [{}]", joint.name, unit(joint.kind)), *q)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joints_move_one_after_the_other_within_their_ranges() {
        let (pose, ranges) = ([0.5, 0.0], [[0.0, 2.0], [f64::NEG_INFINITY, f64::INFINITY]]);
        assert_eq!(sweep(&pose, &ranges, 0.0), pose);
        assert!((sweep(&pose, &ranges, 0.25 * SWEEP_S)[0] - 2.0).abs() < 1e-12);
        assert!(sweep(&pose, &ranges, 0.75 * SWEEP_S)[0].abs() < 1e-12);
        let wheel = sweep(&pose, &ranges, 1.25 * SWEEP_S);
        assert_eq!((wheel[0], wheel[1]), (0.5, MAX_SWEEP));
    }
}
