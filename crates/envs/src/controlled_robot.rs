//! A robot as tasks see it: its joints and how they are controlled, its feet and its size.

use glam::DVec3;
use twinstep_effects::TreeGroups;
use twinstep_model::{BaseMount, ContactPoint, Feet, Foot, JOINT_NAMES, RobotModel, TreeModel, go2};

use crate::config::ConfigError;

/// Height above the lowest contact point within which a link stands on the ground in the default pose [m].
const STANDS_WITHIN_M: f64 = 0.02;
/// Largest component of a joint's axis to the left at which it does not swing a leg forward.
const SIDEWAYS: f64 = 0.5;

/// A robot of any tree and how it is controlled.
#[derive(Clone, Debug, PartialEq)]
pub struct ControlledRobot {
    /// Name of the robot.
    pub name: String,
    /// Names of the joints.
    pub joints: Vec<String>,
    /// Position gain [N·m/rad] and velocity gain [N·m·s/rad] of each joint.
    pub gains: Vec<[f64; 2]>,
    /// Joint positions to which actions are relative [rad or m].
    pub default_pose: Vec<f64>,
    /// Lowest and highest position of each joint.
    pub ranges: Vec<[f64; 2]>,
    /// Torque limit of each joint [N·m or N].
    pub torque_limits: Vec<f64>,
    /// Joint offset of an action of 1 [rad or m].
    pub action_scale: f64,
    /// Actuator period [s].
    pub actuator_dt: f64,
    /// Number of actuator periods per policy period.
    pub decimation: usize,
    /// Height of the base in the default pose [m]; `None` if the base is fixed.
    pub standing_height: Option<f64>,
    /// Mass of all bodies [kg].
    pub mass: f64,
    /// Links on which it stands; none of a robot with a fixed base.
    pub feet: Feet,
    /// Joints that a walk does not need: those whose axis does not point sideways, and those that carry no foot.
    ///
    /// They are the hips of a quadruped, and of a humanoid also the waist and the arms.
    pub hips: Vec<usize>,
}

impl ControlledRobot {
    /// Returns the policy period [s].
    pub fn policy_dt(&self) -> f64 {
        self.actuator_dt * self.decimation as f64
    }

    /// Returns the default pose in single precision.
    pub fn default_pose_f32(&self) -> Vec<f32> {
        self.default_pose.iter().map(|position| *position as f32).collect()
    }

    /// Returns weight times standing height relative to that of the Go2, a scale for torques: 1 for a robot with a fixed base.
    pub fn torque_scale(&self) -> f64 {
        let go2 = Self::from(&go2());
        let moment = |robot: &Self| robot.standing_height.map(|height| robot.mass * height);
        moment(self).zip(moment(&go2)).map_or(1.0, |(own, reference)| own / reference)
    }

    /// Returns the robot with the feet and hips that its tree has in the default pose, or those of its `groups`.
    pub fn with_feet(mut self, robot: &TreeModel, groups: &TreeGroups) -> Result<Self, ConfigError> {
        let links = match &groups.foot {
            Some(names) => names.iter().map(|name| link(robot, name)).collect::<Result<Vec<_>, _>>()?,
            None => standing_links(robot, &self.default_pose),
        };
        let feet = links.into_iter().map(|body| foot(robot, body)).collect::<Result<Vec<_>, _>>()?;
        self.feet = Feet::new(&robot.tree, feet);
        self.hips = match &groups.hip {
            Some(names) => names.iter().map(|name| joint(robot, name)).collect::<Result<_, _>>()?,
            None => hips(robot, &self.feet, &self.default_pose),
        };
        Ok(self)
    }
}

impl From<&RobotModel> for ControlledRobot {
    fn from(robot: &RobotModel) -> Self {
        let control = &robot.control;
        let feet = Feet::from(robot);
        let pose = control.default_pose_f32();
        let soles = feet.motions(&pose, &[0.0; JOINT_NAMES.len()]).zip(feet.feet());
        let lowest = soles.map(|(foot, sole)| f64::from(foot.position.z) - sole.radius).fold(0.0, f64::min);
        let bodies = robot.legs.iter().flat_map(|leg| &leg.bodies).chain([&robot.trunk]);
        Self {
            name: robot.name.clone(),
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            gains: control.kp.into_iter().zip(control.kd).map(|(kp, kd)| [kp, kd]).collect(),
            default_pose: control.default_pose.to_vec(),
            ranges: robot.joints.iter().map(|joint| joint.range).collect(),
            torque_limits: robot.joints.iter().map(|joint| joint.torque_limit).collect(),
            action_scale: control.action_scale,
            actuator_dt: control.actuator_dt(),
            decimation: control.decimation,
            standing_height: Some(-lowest),
            mass: bodies.map(|body| body.mass).sum(),
            feet,
            hips: (0..JOINT_NAMES.len()).step_by(3).collect(),
        }
    }
}

/// Returns the links that touch the ground when the robot stands upright in a pose.
fn standing_links(robot: &TreeModel, pose: &[f64]) -> Vec<usize> {
    if robot.tree.base.is_some_and(BaseMount::is_fixed) {
        return Vec::new();
    }
    let poses = robot.tree.base_from_bodies(pose);
    let bottom = |point: &ContactPoint| poses[point.body].transform_point3(point.centre).z - point.radius;
    let lowest = robot.points.iter().map(bottom).fold(f64::INFINITY, f64::min);
    let mut links: Vec<_> = robot.points.iter().filter(|point| bottom(point) < lowest + STANDS_WITHIN_M).collect();
    links.dedup_by_key(|point| point.body);
    links.into_iter().map(|point| point.body).filter(|body| *body > 0).collect()
}

/// Returns the foot whose sole is at the points of a link.
fn foot(robot: &TreeModel, body: usize) -> Result<Foot, ConfigError> {
    let points: Vec<_> = robot.points.iter().filter(|point| point.body == body).collect();
    let name = robot.tree.bodies[body].name.clone();
    if points.is_empty() {
        let allowed = "a link with a sphere, a capsule or a box that touches the ground".to_owned();
        return Err(ConfigError { field: "groups.foot".to_owned(), value: name, allowed });
    }
    let mean = 1.0 / points.len() as f64;
    let centre = points.iter().map(|point| point.centre).sum::<DVec3>() * mean;
    let radius = points.iter().map(|point| point.radius).sum::<f64>() * mean;
    Ok(Foot { name, body, centre, radius })
}

fn hips(robot: &TreeModel, feet: &Feet, pose: &[f64]) -> Vec<usize> {
    let poses = robot.tree.base_from_bodies(pose);
    let swings = |joint: usize| {
        let axis = poses[joint + 1].transform_vector3(robot.tree.joints[joint].axis);
        let carries = (0..feet.len()).any(|foot| feet.joints(foot).any(|other| other == joint));
        carries && axis.y.abs() > SIDEWAYS
    };
    (0..robot.joints.len()).filter(|joint| !swings(*joint)).collect()
}

fn link(robot: &TreeModel, name: &str) -> Result<usize, ConfigError> {
    let names = || robot.tree.bodies.iter().map(|body| body.name.as_str()).collect::<Vec<_>>().join(", ");
    robot.tree.link(name).ok_or_else(|| ConfigError {
        field: "groups.foot".to_owned(),
        value: name.to_owned(),
        allowed: format!("a link of the robot: {}", names()),
    })
}

fn joint(robot: &TreeModel, name: &str) -> Result<usize, ConfigError> {
    let names = || robot.tree.joints.iter().map(|joint| joint.name.as_str()).collect::<Vec<_>>().join(", ");
    robot.tree.joint(name).ok_or_else(|| ConfigError {
        field: "groups.hip".to_owned(),
        value: name.to_owned(),
        allowed: format!("a joint of the robot: {}", names()),
    })
}
