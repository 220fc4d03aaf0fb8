//! Initial state of a robot of any tree.

use glam::{DQuat, DVec3};
use twinstep_model::{BaseMount, Ground, InitialState, RobotTree, TreeModel};

use crate::tree_error::{TreeError, check_finite, check_joints};

/// State to which a robot is reset.
#[derive(Clone, Debug, PartialEq)]
pub struct Placement {
    /// Position of the base frame's origin in the world frame [m].
    pub base_position: [f64; 3],
    /// Rotation world-from-base, `[w, x, y, z]`.
    pub base_orientation: [f64; 4],
    /// Velocity of the base frame's origin, in the world frame [m/s].
    pub base_linear_velocity: [f64; 3],
    /// Angular velocity of the base, in the base frame [rad/s].
    pub base_angular_velocity: [f64; 3],
    /// Encoder readings of the joint positions [rad or m].
    pub q: Vec<f64>,
    /// Joint velocities [rad/s or m/s].
    pub dq: Vec<f64>,
}

impl Placement {
    /// Returns the state at rest and upright at height `base_height` [m], with joints at `q` [rad or m].
    pub fn at_rest(base_height: f64, q: Vec<f64>) -> Self {
        Self {
            base_position: [0.0, 0.0, base_height],
            base_orientation: [1.0, 0.0, 0.0, 0.0],
            base_linear_velocity: [0.0; 3],
            base_angular_velocity: [0.0; 3],
            dq: vec![0.0; q.len()],
            q,
        }
    }
}

impl Placement {
    /// Returns the state at rest with the joints at `q`: a fixed base where its file has it, a free one upright with its lowest contact
    /// point on flat ground.
    pub fn of(robot: &RobotTree, q: Vec<f64>) -> Self {
        if !robot.base.is_some_and(BaseMount::is_fixed) {
            return Self::at_rest(robot.standing_height(&q), q);
        }
        let DQuat { w, x, y, z } = DQuat::from_mat3(&robot.world_from_base.matrix3);
        Self {
            base_position: robot.world_from_base.translation.to_array(),
            base_orientation: [w, x, y, z],
            ..Self::at_rest(0.0, q)
        }
    }

    /// Returns the state at rest with the joints at `q`: a fixed base where its file has it, a free one upright above the origin, with the
    /// contact points of the robot on or above the ground.
    pub fn standing_on(ground: &Ground, robot: &TreeModel, q: Vec<f64>) -> Self {
        Self::standing_at(ground, robot, q, [0.0; 3])
    }

    /// Returns the state as [`Placement::standing_on`] does, with a free base above another point of the ground: x [m], y [m], and
    /// the yaw of the robot [rad].
    pub fn standing_at(ground: &Ground, robot: &TreeModel, q: Vec<f64>, [x, y, yaw]: [f64; 3]) -> Self {
        let mut state = Self::of(&robot.tree, q);
        if robot.tree.base.is_some_and(BaseMount::is_fixed) {
            return state;
        }
        let (poses, turn) = (robot.tree.base_from_bodies(&state.q), DQuat::from_rotation_z(yaw));
        state.base_orientation = [turn.w, turn.x, turn.y, turn.z];
        [state.base_position[0], state.base_position[1]] = [x, y];
        let needed = robot.points.iter().map(|point| {
            let centre = turn * poses[point.body].transform_point3(point.centre);
            let DVec3 { x, y, z } = centre + DVec3::new(x, y, 0.0);
            f64::from(ground.height(x as f32, y as f32)) + point.radius - z
        });
        let height = needed.fold(f64::NEG_INFINITY, f64::max);
        if height.is_finite() {
            state.base_position[2] = height;
        }
        state
    }

    /// Checks the state for a robot with this number of joints.
    pub(crate) fn check(&self, num_joints: usize) -> Result<(), TreeError> {
        check_joints("q", self.q.iter().copied(), num_joints)?;
        check_joints("dq", self.dq.iter().copied(), num_joints)?;
        check_finite("base_position", self.base_position.into_iter())?;
        check_finite("base_orientation", self.base_orientation.into_iter())?;
        check_finite("base_linear_velocity", self.base_linear_velocity.into_iter())?;
        check_finite("base_angular_velocity", self.base_angular_velocity.into_iter())
    }
}

impl From<&InitialState> for Placement {
    fn from(state: &InitialState) -> Self {
        Self {
            base_position: state.base_position.map(f64::from),
            base_orientation: state.base_orientation.map(f64::from),
            base_linear_velocity: state.base_linear_velocity.map(f64::from),
            base_angular_velocity: state.base_angular_velocity.map(f64::from),
            q: state.q.map(f64::from).to_vec(),
            dq: state.dq.map(f64::from).to_vec(),
        }
    }
}

#[cfg(test)]
mod tests {
    use glam::DAffine3;
    use twinstep_model::{TreeShape, TreeShapeKind, go2};

    use super::*;

    #[test]
    fn fixed_base_is_where_its_file_has_it() {
        let turn = DQuat::from_rotation_x(0.5);
        let place = DAffine3::from_rotation_translation(turn, DVec3::new(0.1, 0.2, 0.3));
        let tree = RobotTree { base: Some(BaseMount::Fixed), world_from_base: place, ..RobotTree::from(&go2()) };
        let placement = Placement::of(&tree, vec![0.0; 12]);
        assert_eq!(placement.base_position, [0.1, 0.2, 0.3]);
        let [w, x, y, z] = placement.base_orientation;
        assert!(DQuat::from_xyzw(x, y, z, w).angle_between(turn) < 1e-6);
        let free = RobotTree { base: Some(BaseMount::Floating), ..tree };
        assert_eq!(Placement::of(&free, vec![0.0; 12]).base_orientation, [1.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn robot_stands_on_the_highest_ground_under_its_points() {
        let shape = |body: usize| TreeShape {
            name: String::new(),
            body,
            kind: TreeShapeKind::Sphere(0.02),
            body_from_shape: DAffine3::from_translation(DVec3::new(0.0, 0.0, -0.2)),
        };
        let tree = RobotTree { shapes: [3, 6, 9, 12].map(shape).to_vec(), ..RobotTree::from(&go2()) };
        let robot = TreeModel::new(tree).expect("equal limits");
        let q = go2().control.default_pose.to_vec();
        let flat = Placement::standing_on(&Ground::FLAT, &robot, q.clone()).base_position[2];
        assert!((flat - robot.tree.standing_height(&q)).abs() < 1e-9);
        let raised = Ground { point: [0.0, 0.0, 0.3], ..Ground::FLAT };
        let height = Placement::standing_on(&raised, &robot, q.clone()).base_position[2];
        assert!((height - flat - 0.3).abs() < 1e-6, "{height}");
        let slope = Ground { normal: [-0.2f32.sin(), 0.0, 0.2f32.cos()], ..Ground::FLAT };
        let here = Placement::standing_on(&slope, &robot, q.clone()).base_position[2];
        let there = Placement::standing_at(&slope, &robot, q, [2.0, -1.0, std::f64::consts::PI]);
        assert_eq!(there.base_position[..2], [2.0, -1.0]);
        assert!((there.base_orientation[3] - 1.0).abs() < 1e-9, "{:?}", there.base_orientation);
        // Turned round, the rear feet are ahead: the robot is nearly as long behind its base as before it.
        assert!((there.base_position[2] - here - 2.0 * 0.2f64.tan()).abs() < 0.03, "{there:?}");
    }
}
