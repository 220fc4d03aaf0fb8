//! What a [`TreeSimulation`](crate::TreeSimulation) exchanges with an engine.

use twinstep_model::TreeModel;

use crate::Placement;
use crate::tree_error::{TreeError, check_joints};

/// Commands of one robot of `n` joints for one actuator period. Each has an entry for each joint.
///
/// The torque of each joint is `kp (q − q_measured) + kd (dq − dq_measured) + tau_ff`, clipped to the joint's limit.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeCommand {
    /// Commanded position [rad or m].
    pub q: Vec<f32>,
    /// Commanded velocity [rad/s or m/s].
    pub dq: Vec<f32>,
    /// Feed-forward torque [N·m or N].
    pub tau_ff: Vec<f32>,
    /// Position gain [N·m/rad or N/m].
    pub kp: Vec<f32>,
    /// Velocity gain [N·m·s/rad or N·s/m].
    pub kd: Vec<f32>,
}

impl TreeCommand {
    /// Returns a command that holds `q` [rad or m] with gains `kp` and `kd` on every joint.
    pub fn hold(q: Vec<f32>, kp: f32, kd: f32) -> Self {
        let n = q.len();
        Self { q, dq: vec![0.0; n], tau_ff: vec![0.0; n], kp: vec![kp; n], kd: vec![kd; n] }
    }
}

/// Sensor readings and true state of one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeReadings {
    /// Pose and velocity of the base, and readings of the encoders.
    pub state: Placement,
    /// Estimated torque of each joint, mean over the last actuator period [N·m or N].
    pub tau: Vec<f64>,
    /// Normal force on each shape of the tree in the last step [N]; zero if it does not touch the ground.
    pub shape_force: Vec<f64>,
}

impl TreeReadings {
    /// Returns readings of zero.
    pub(crate) fn zero(robot: &TreeModel) -> Self {
        let joints = robot.joints.len();
        Self {
            state: Placement::at_rest(0.0, vec![0.0; joints]),
            tau: vec![0.0; joints],
            shape_force: vec![0.0; robot.tree.shapes.len()],
        }
    }
}

impl TreeCommand {
    /// Checks the command for a robot with this number of joints.
    pub(crate) fn check(&self, num_joints: usize) -> Result<(), TreeError> {
        let Self { q, dq, tau_ff, kp, kd } = self;
        for (field, values) in [("q", q), ("dq", dq), ("tau_ff", tau_ff), ("kp", kp), ("kd", kd)] {
            check_joints(field, values.iter().map(|value| f64::from(*value)), num_joints)?;
        }
        Ok(())
    }
}

/// Engine that simulates robots of one tree.
pub(crate) trait TreeEngine: Send {
    /// Resets a robot to a state, with the parameters of `model`.
    fn place(&mut self, robot: usize, model: &TreeModel, state: &Placement) -> Result<(), TreeError>;
    /// Adds a velocity [m/s] to that of a robot's base, in the world frame. It has no effect on a fixed base.
    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), TreeError>;
    /// Copies the readings of a robot.
    fn read(&self, robot: usize, readings: &mut TreeReadings);
    /// Advances every robot by `count`: actuator periods, physics steps of each. Runs on the threads of the current pool if `parallel`.
    fn advance(
        &mut self,
        commands: &[TreeCommand],
        count: [usize; 2],
        states: &mut [TreeReadings],
        parallel: bool,
    ) -> Result<(), TreeError>;
}
