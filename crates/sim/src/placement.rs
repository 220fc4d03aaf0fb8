//! Initial state of a robot of any tree.

use glam::DQuat;
use twinstep_model::{BaseMount, InitialState, RobotTree};

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
    use glam::{DAffine3, DVec3};
    use twinstep_model::go2;

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
}
