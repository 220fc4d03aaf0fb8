//! The motion of a log: the measured robot, and the simulation under the same commands as its ghost.

use twinstep_identify::{Experiment, WindowConfig};
use twinstep_logs::Log;
use twinstep_model::{FIXED_BASE_HEIGHT, Ground, InitialState, Joint, PerJoint, Pose, RobotModel, Scene, frames};
use twinstep_sim::BatchRollout;
use twinstep_viewer::{RobotFrame, SceneInfo, static_page};

use crate::failure::{Failure, input};
use crate::player::{Curves, Player};
use crate::robot_file::SimulatedRobot;

/// Returns a page that plays the first seconds of a log, with the simulation of `robot` as its ghost.
pub fn page_with_ghost(log: Log, title: String, robot: SimulatedRobot, seconds: f64) -> Result<String, Failure> {
    let (player, scene) = player(log, title, robot, true)?;
    Ok(static_page(&scene, &player.motion(seconds)))
}

/// Returns a player of a log, and its scene.
pub fn player(log: Log, title: String, robot: SimulatedRobot, has_ghost: bool) -> Result<(Player, SceneInfo), Failure> {
    let SimulatedRobot { robot, mut simulator } = robot;
    let measured = measured_poses(&log, &robot);
    let simulated = if has_ghost { simulated_poses(&log, &robot, &mut simulator)? } else { Vec::new() };
    let info = SceneInfo::new(title, &measured[0].scene(&robot), &robot);
    let scene = SceneInfo { is_interactive: true, has_ghost, ..info };
    let times = log.t().to_vec();
    let motion = Motion { log, robot, measured, simulated };
    Ok((Player::new(times, move |row| motion.at(row)), scene))
}

/// Pose of the robot at one time.
#[derive(Clone, Copy)]
struct RobotPose {
    base: Pose,
    q: PerJoint,
}

impl RobotPose {
    fn scene(&self, robot: &RobotModel) -> Scene {
        Scene::new(robot, self.base, &self.q, &Ground::FLAT)
    }
}

/// Returns the measured pose of each row. A position that was not measured is that of a robot that stands or hangs at the
/// origin.
fn measured_poses(log: &Log, robot: &RobotModel) -> Vec<RobotPose> {
    let default_pose = robot.control.default_pose_f32();
    let columns = Joint::ALL.map(|joint| log.q(joint.name()));
    let channel = |name: &str| log.channel(name);
    let position = ["pos_x", "pos_y", "pos_z"].map(channel);
    let orientation = ["quat_w", "quat_x", "quat_y", "quat_z"].map(channel);
    let mut poses = Vec::with_capacity(log.rows());
    for (segment, rows) in log.segments() {
        for row in rows {
            let at = |column: Option<&[f64]>, missing: f32| column.map_or(missing, |column| column[row] as f32);
            let q = std::array::from_fn(|joint| at(columns[joint], default_pose[joint]));
            let quaternion =
                [(0, 1.0), (1, 0.0), (2, 0.0), (3, 0.0)].map(|(part, missing)| at(orientation[part], missing));
            let standing = InitialState::standing_on(&Ground::FLAT, robot, q, 0.0).base_position[2];
            let height = if segment.base.is_fixed() { FIXED_BASE_HEIGHT as f32 } else { standing };
            let place = [at(position[0], 0.0), at(position[1], 0.0), at(position[2], height)];
            let base = Pose { position: place.into(), rotation: frames::world_from_base(quaternion).normalize() };
            poses.push(RobotPose { base, q });
        }
    }
    poses
}

/// Returns the simulated pose of each row; `None` for rows that are not simulated.
fn simulated_poses(
    log: &Log,
    robot: &RobotModel,
    simulator: &mut BatchRollout,
) -> Result<Vec<Option<RobotPose>>, Failure> {
    let experiment = Experiment::new(log, robot, WindowConfig::EVALUATION).map_err(input)?;
    let mut poses = vec![None; log.rows()];
    for pose in experiment.simulated_poses(simulator, robot) {
        let rotation = frames::world_from_base(pose.orientation);
        poses[pose.row] = Some(RobotPose { base: Pose { position: pose.position.into(), rotation }, q: pose.q });
    }
    Ok(poses)
}

/// A log with the robot at each row, and with its simulation, if there is one.
struct Motion {
    log: Log,
    robot: RobotModel,
    measured: Vec<RobotPose>,
    /// Empty without a model.
    simulated: Vec<Option<RobotPose>>,
}

impl Motion {
    fn at(&self, row: usize) -> (RobotFrame, Curves) {
        let measured = self.measured[row];
        let tau = Joint::ALL.map(|joint| self.log.tau_measured(joint.name()).map(|column| column[row] as f32));
        let torque = tau.into_iter().collect::<Option<Vec<f32>>>();
        let mut robot = RobotFrame { torque, ..RobotFrame::of_scene(&measured.scene(&self.robot)) };
        let mut curves = Vec::new();
        if self.simulated.is_empty() {
            let position = |joint: Joint| (format!("{} [rad]", joint.name()), f64::from(measured.q[joint.index()]));
            curves.extend(Joint::ALL.map(position));
        } else {
            let simulated = self.simulated[row];
            let unknown = vec![[f32::NAN; 7]; robot.poses.len()];
            robot.ghost = simulated.map_or(unknown, |pose| pose.scene(&self.robot).pose);
            let error = |joint: Joint| {
                let index = joint.index();
                let error = simulated.map_or(f64::NAN, |pose| f64::from(pose.q[index] - measured.q[index]));
                (format!("{} error [rad]", joint.name()), error)
            };
            curves.extend(Joint::ALL.map(error));
        }
        (robot, curves)
    }
}
