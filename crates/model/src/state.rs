//! Commands, robot states and initial states.

use glam::{Quat, Vec3};

use crate::{Ground, NUM_JOINTS, PerJoint, PerLeg, Pose, RobotModel, body_poses, frames};

/// Command of one robot for one actuator period.
///
/// The torque of each joint is `kp (q − q_measured) + kd (dq − dq_measured) + tau_ff`, clipped to the joint's limit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Command {
    /// Commanded joint position [rad].
    pub q: PerJoint,
    /// Commanded joint velocity [rad/s].
    pub dq: PerJoint,
    /// Feed-forward torque [N·m].
    pub tau_ff: PerJoint,
    /// Position gain [N·m/rad].
    pub kp: PerJoint,
    /// Velocity gain [N·m·s/rad].
    pub kd: PerJoint,
    /// Factor on the torque for supply voltage and motor temperature; 1 unless a log contains them.
    pub derating_factor: PerJoint,
}

impl Command {
    /// Returns a command that holds `q` [rad] with gains `kp` [N·m/rad] and `kd` [N·m·s/rad] on every joint.
    pub fn hold(q: PerJoint, kp: f32, kd: f32) -> Self {
        Self {
            q,
            dq: [0.0; NUM_JOINTS],
            tau_ff: [0.0; NUM_JOINTS],
            kp: [kp; NUM_JOINTS],
            kd: [kd; NUM_JOINTS],
            derating_factor: [1.0; NUM_JOINTS],
        }
    }
}

/// States of a batch of robots: every array has one entry per robot.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotStates {
    /// Joint position [rad].
    pub q: Vec<PerJoint>,
    /// Joint velocity [rad/s].
    pub dq: Vec<PerJoint>,
    /// Torque that the actuator applied in its last period [N·m].
    pub tau: Vec<PerJoint>,
    /// Position of the base frame's origin in the world frame [m].
    pub base_position: Vec<[f32; 3]>,
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub base_orientation: Vec<[f32; 4]>,
    /// Velocity of the base frame's origin, in the world frame [m/s].
    pub base_linear_velocity: Vec<[f32; 3]>,
    /// Angular velocity of the base, in the base frame [rad/s].
    pub base_angular_velocity: Vec<[f32; 3]>,
    /// Normal force on each foot, mean over the last physics step [N].
    pub foot_force: Vec<PerLeg>,
    /// True if the trunk or a thigh touches the ground.
    pub body_contact: Vec<bool>,
    /// Epistemic uncertainty of the actuators, mean over the joints [nat]; 0 if they do not estimate it.
    pub epistemic_uncertainty: Vec<f32>,
}

impl RobotStates {
    /// Returns the states of `num_robots` robots at rest at the origin.
    pub fn new(num_robots: usize) -> Self {
        Self {
            q: vec![[0.0; NUM_JOINTS]; num_robots],
            dq: vec![[0.0; NUM_JOINTS]; num_robots],
            tau: vec![[0.0; NUM_JOINTS]; num_robots],
            base_position: vec![[0.0; 3]; num_robots],
            base_orientation: vec![[1.0, 0.0, 0.0, 0.0]; num_robots],
            base_linear_velocity: vec![[0.0; 3]; num_robots],
            base_angular_velocity: vec![[0.0; 3]; num_robots],
            foot_force: vec![[0.0; 4]; num_robots],
            body_contact: vec![false; num_robots],
            epistemic_uncertainty: vec![0.0; num_robots],
        }
    }

    /// Returns mutable views of consecutive chunks of up to `robots` robots.
    pub fn chunks_mut(&mut self, robots: usize) -> impl Iterator<Item = RobotStatesMut<'_>> {
        let joints = self.q.chunks_mut(robots).zip(self.dq.chunks_mut(robots)).zip(self.tau.chunks_mut(robots));
        let poses = self.base_position.chunks_mut(robots).zip(self.base_orientation.chunks_mut(robots));
        let velocities =
            self.base_linear_velocity.chunks_mut(robots).zip(self.base_angular_velocity.chunks_mut(robots));
        let contacts = self.foot_force.chunks_mut(robots).zip(self.body_contact.chunks_mut(robots));
        joints.zip(poses).zip(velocities).zip(contacts).map(|((((joints, tau), pose), velocity), contact)| {
            RobotStatesMut {
                q: joints.0,
                dq: joints.1,
                tau,
                base_position: pose.0,
                base_orientation: pose.1,
                base_linear_velocity: velocity.0,
                base_angular_velocity: velocity.1,
                foot_force: contact.0,
                body_contact: contact.1,
            }
        })
    }

    /// Returns a mutable view of all robots.
    pub fn all_mut(&mut self) -> RobotStatesMut<'_> {
        RobotStatesMut {
            q: &mut self.q,
            dq: &mut self.dq,
            tau: &mut self.tau,
            base_position: &mut self.base_position,
            base_orientation: &mut self.base_orientation,
            base_linear_velocity: &mut self.base_linear_velocity,
            base_angular_velocity: &mut self.base_angular_velocity,
            foot_force: &mut self.foot_force,
            body_contact: &mut self.body_contact,
        }
    }

    /// Copies the state of robot `from` of `other` to `robot`.
    pub fn copy_robot(&mut self, robot: usize, other: &RobotStates, from: usize) {
        self.q[robot] = other.q[from];
        self.dq[robot] = other.dq[from];
        self.tau[robot] = other.tau[from];
        self.base_position[robot] = other.base_position[from];
        self.base_orientation[robot] = other.base_orientation[from];
        self.base_linear_velocity[robot] = other.base_linear_velocity[from];
        self.base_angular_velocity[robot] = other.base_angular_velocity[from];
        self.foot_force[robot] = other.foot_force[from];
        self.body_contact[robot] = other.body_contact[from];
        self.epistemic_uncertainty[robot] = other.epistemic_uncertainty[from];
    }

    /// Returns the name of the first quantity of `robot` that is not finite, or `None` if all are.
    pub fn first_not_finite(&self, robot: usize) -> Option<&'static str> {
        let quantities: [(&'static str, &[f32]); 7] = [
            ("q", &self.q[robot]),
            ("dq", &self.dq[robot]),
            ("tau", &self.tau[robot]),
            ("base_position", &self.base_position[robot]),
            ("base_orientation", &self.base_orientation[robot]),
            ("base_linear_velocity", &self.base_linear_velocity[robot]),
            ("base_angular_velocity", &self.base_angular_velocity[robot]),
        ];
        quantities.into_iter().find(|(_, values)| values.iter().any(|value| !value.is_finite())).map(|(name, _)| name)
    }
}

/// Mutable view of some robots of a [`RobotStates`], with the fields that a physics step writes.
#[allow(missing_docs, reason = "documented in `RobotStates`")]
pub struct RobotStatesMut<'a> {
    pub q: &'a mut [PerJoint],
    pub dq: &'a mut [PerJoint],
    pub tau: &'a mut [PerJoint],
    pub base_position: &'a mut [[f32; 3]],
    pub base_orientation: &'a mut [[f32; 4]],
    pub base_linear_velocity: &'a mut [[f32; 3]],
    pub base_angular_velocity: &'a mut [[f32; 3]],
    pub foot_force: &'a mut [PerLeg],
    pub body_contact: &'a mut [bool],
}

/// State to which a robot is reset.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitialState {
    /// Position of the base frame's origin in the world frame [m].
    pub base_position: [f32; 3],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub base_orientation: [f32; 4],
    /// Velocity of the base frame's origin, in the world frame [m/s].
    pub base_linear_velocity: [f32; 3],
    /// Angular velocity of the base, in the base frame [rad/s].
    pub base_angular_velocity: [f32; 3],
    /// Joint position [rad].
    pub q: PerJoint,
    /// Joint velocity [rad/s].
    pub dq: PerJoint,
    /// Differences of this robot's mass, payload and ground friction from the model's.
    pub randomisation: RandomisationSample,
    /// Random seed of the robot's actuators.
    pub actuator_seed: u64,
}

impl InitialState {
    /// Returns the state at rest and upright at height `base_height` [m], with joints at `q` [rad].
    pub fn at_rest(base_height: f32, q: PerJoint) -> Self {
        Self {
            base_position: [0.0, 0.0, base_height],
            base_orientation: [1.0, 0.0, 0.0, 0.0],
            base_linear_velocity: [0.0; 3],
            base_angular_velocity: [0.0; 3],
            q,
            dq: [0.0; NUM_JOINTS],
            randomisation: RandomisationSample::default(),
            actuator_seed: 0,
        }
    }

    /// Returns the state at rest above the origin of `ground`, parallel to its plane, with joints at `q` [rad].
    ///
    /// The collision point with the least distance to the ground is `clearance` [m] above it. The points are the feet,
    /// the knees, the calf ends and the lower corners of the trunk.
    pub fn standing_on(ground: &Ground, robot: &RobotModel, q: PerJoint, clearance: f32) -> Self {
        let rotation = Quat::from_rotation_arc(Vec3::Z, ground.up());
        let poses = body_poses(robot, Pose { position: Vec3::ZERO, rotation }, &q);
        let shapes = &robot.shapes;
        let half = shapes.trunk_half_size.as_vec3();
        let corners = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)].map(|(x, y)| half * Vec3::new(x, y, -1.0));
        let trunk = corners.map(|corner| (poses[0].transform(corner), 0.0));
        let legs = (0..4).flat_map(|leg| {
            let calf = poses[3 + 3 * leg];
            let [knee, shin] = shapes.calf_ends.map(|end| (end, shapes.calf_radius));
            [knee, shin, (shapes.foot_centre, shapes.foot_radius)]
                .map(|(centre, radius)| (calf.transform(centre.as_vec3()), radius as f32))
        });
        let lift = trunk
            .into_iter()
            .chain(legs)
            .map(|(point, radius)| ground.clearance_height(point.x, point.y, radius) - point.z)
            .fold(f32::NEG_INFINITY, f32::max);
        Self { base_orientation: frames::to_wxyz(rotation), ..Self::at_rest(lift + clearance, q) }
    }
}

/// One sample of domain randomisation: differences of a robot and its ground from the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RandomisationSample {
    /// Factor on the mass and inertia of every body.
    pub mass_scale: f32,
    /// Point mass at the trunk's centre of mass [kg].
    pub payload: f32,
    /// Shift of the trunk's centre of mass in the base frame [m].
    pub com_shift: [f32; 3],
    /// Factor on the ground's friction coefficient.
    pub friction_scale: f32,
}

impl Default for RandomisationSample {
    /// No difference from the model.
    fn default() -> Self {
        Self { mass_scale: 1.0, payload: 0.0, com_shift: [0.0; 3], friction_scale: 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use proptest::prelude::*;

    use super::*;
    use crate::{HeightField, go2};

    /// Returns the vertical distance of each foot's sphere from the ground [m].
    fn gaps(placement: &InitialState, ground: &Ground) -> [f32; 4] {
        let robot = go2();
        let world_from_base = Pose {
            position: Vec3::from(placement.base_position),
            rotation: frames::world_from_base(placement.base_orientation),
        };
        let poses = body_poses(&robot, world_from_base, &placement.q);
        std::array::from_fn(|leg| {
            let centre = poses[3 + 3 * leg].transform(robot.shapes.foot_centre.as_vec3());
            centre.z - ground.clearance_height(centre.x, centre.y, robot.shapes.foot_radius as f32)
        })
    }

    /// Height of the rear feet above the front feet in the default pose with a level trunk [m].
    const REAR_FEET: f32 = 0.01;

    #[test]
    fn base_height_of_the_standing_default_pose_is_0_32_m() {
        let robot = go2();
        let placement = InitialState::standing_on(&Ground::FLAT, &robot, robot.control.default_pose_f32(), 0.0);
        assert!((placement.base_position[2] - 0.3235).abs() < 1e-4, "{:?}", placement.base_position);
        let [front_left, front_right, rear_left, rear_right] = gaps(&placement, &Ground::FLAT);
        assert!(front_left.abs().max(front_right.abs()) < 1e-6, "{front_left} {front_right}");
        assert!((rear_left - REAR_FEET).abs().max((rear_right - REAR_FEET).abs()) < 1e-3, "{rear_left} {rear_right}");
    }

    #[test]
    fn feet_have_the_same_distance_to_a_slope_as_to_flat_ground() {
        let robot = go2();
        let ground = Ground { normal: [-0.3f32.sin(), 0.0, 0.3f32.cos()], ..Ground::FLAT };
        let [level, sloping] = [&Ground::FLAT, &ground].map(|ground| {
            gaps(&InitialState::standing_on(ground, &robot, robot.control.default_pose_f32(), 0.0), ground)
        });
        for (level, sloping) in level.iter().zip(sloping) {
            assert!((level - sloping * 0.3f32.cos()).abs() < 1e-5, "{level} {sloping}");
        }
    }

    proptest! {
        #[test]
        fn lowest_foot_has_the_requested_clearance_on_rough_ground(seed: u64, bend in -0.2f32..0.2) {
            let robot = go2();
            let field = HeightField::random_uniform(0.1, 0.1, 40, seed).expect("a field");
            let ground = Ground { height_field: Some(Arc::new(field)), ..Ground::FLAT };
            let q = robot.control.default_pose_f32().map(|q| q + bend);
            let gaps = gaps(&InitialState::standing_on(&ground, &robot, q, 0.01), &ground);
            let nearest = gaps.into_iter().fold(f32::INFINITY, f32::min);
            prop_assert!((nearest - 0.01).abs() < 1e-5, "{gaps:?}");
        }
    }
}
