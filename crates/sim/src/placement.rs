//! Initial state of a robot of any tree.

use twinstep_model::InitialState;

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
