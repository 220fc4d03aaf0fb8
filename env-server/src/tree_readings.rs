//! What a task sees of a simulated robot of any tree.

use twinstep_envs::{RobotView, Truth};
use twinstep_model::{Feet, Ground, TreeModel};
use twinstep_sim::TreeReadings;

/// Contact force above which a link touches the ground [N].
const CONTACT_FORCE_THRESHOLD: f64 = 1.0;

/// Readings of one robot in single precision.
#[derive(Clone)]
pub struct RobotRow {
    q: Vec<f32>,
    pub dq: Vec<f32>,
    tau: Vec<f32>,
    pub orientation: [f32; 4],
    pub gyro: [f32; 3],
    pub base_position: [f32; 3],
    pub base_linear_velocity: [f32; 3],
    foot_force: Vec<f32>,
    body_contact: bool,
    /// Index of the foot that each shape belongs to; `None` of another link.
    foot_of_shape: Vec<Option<usize>>,
}

impl RobotRow {
    /// Returns readings of zero.
    pub fn new(robot: &TreeModel, feet: &Feet) -> Self {
        let zero = vec![0.0; robot.joints.len()];
        let foot = |body: usize| feet.feet().iter().position(|foot| foot.body == body);
        Self {
            q: zero.clone(),
            dq: zero.clone(),
            tau: zero,
            orientation: [1.0, 0.0, 0.0, 0.0],
            gyro: [0.0; 3],
            base_position: [0.0; 3],
            base_linear_velocity: [0.0; 3],
            foot_force: vec![0.0; feet.len()],
            body_contact: false,
            foot_of_shape: robot.tree.shapes.iter().map(|shape| foot(shape.body)).collect(),
        }
    }

    /// Copies the readings of a robot.
    pub fn read(&mut self, readings: &TreeReadings) {
        let state = &readings.state;
        copy(&mut self.q, &state.q);
        copy(&mut self.dq, &state.dq);
        copy(&mut self.tau, &readings.tau);
        copy(&mut self.orientation, &state.base_orientation);
        copy(&mut self.gyro, &state.base_angular_velocity);
        copy(&mut self.base_position, &state.base_position);
        copy(&mut self.base_linear_velocity, &state.base_linear_velocity);
        self.foot_force.fill(0.0);
        self.body_contact = false;
        for (force, foot) in readings.shape_force.iter().zip(&self.foot_of_shape) {
            match foot {
                Some(foot) => self.foot_force[*foot] += *force as f32,
                None => self.body_contact |= *force > CONTACT_FORCE_THRESHOLD,
            }
        }
    }

    /// Returns the robot on this ground.
    pub fn view<'a>(&'a self, ground: &'a Ground) -> RobotView<'a> {
        RobotView {
            q: &self.q,
            dq: &self.dq,
            tau: &self.tau,
            orientation: self.orientation,
            gyro: self.gyro,
            truth: Some(Truth {
                base_position: self.base_position,
                base_linear_velocity: self.base_linear_velocity,
                base_angular_velocity: self.gyro,
                foot_force: &self.foot_force,
                body_contact: self.body_contact,
                epistemic_uncertainty: 0.0,
            }),
            ground,
        }
    }
}

fn copy(own: &mut [f32], values: &[f64]) {
    for (own, value) in own.iter_mut().zip(values) {
        *own = *value as f32;
    }
}
