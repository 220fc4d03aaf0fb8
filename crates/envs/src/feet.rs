//! Motion and contact of the feet, for reward terms.

use glam::Vec3;
use twinstep_model::{Feet, FootMotion, PerLeg, frames};

use crate::task::{RobotView, Truth};

/// Contact force above which a foot is on the ground [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;

/// Motion of a foot in the world frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootState {
    /// Height of the foot's centre above the ground under it [m].
    pub height: f32,
    /// Horizontal speed [m/s].
    pub horizontal_speed: f32,
    /// Vertical velocity [m/s].
    pub vertical_velocity: f32,
}

/// Returns the motion of the feet of a simulated robot.
pub fn foot_states(feet: &Feet, robot: &RobotView, truth: &Truth) -> Vec<FootState> {
    let world_from_base = frames::world_from_base(robot.orientation);
    let base_position = Vec3::from(truth.base_position);
    let base_velocity = Vec3::from(truth.base_linear_velocity);
    let angular_velocity = Vec3::from(truth.base_angular_velocity);
    let state = |foot: FootMotion| {
        let position = base_position + world_from_base * foot.position;
        let velocity = base_velocity + world_from_base * (foot.velocity + angular_velocity.cross(foot.position));
        FootState {
            height: position.z - robot.ground.height(position.x, position.y),
            horizontal_speed: velocity.x.hypot(velocity.y),
            vertical_velocity: velocity.z,
        }
    };
    feet.motions(robot.q, robot.dq).map(state).collect()
}

/// Returns a value for each of the four feet of a quadruped.
pub fn per_leg(values: impl IntoIterator<Item = f32>) -> PerLeg {
    let mut values = values.into_iter();
    std::array::from_fn(|_| values.next().expect("a quadruped has four feet"))
}

/// Contacts of the feet over the policy steps of an episode.
///
/// A foot counts as on the ground if it touches it in this or in the last step: contact flickers, and the force is that
/// of the last physics step only.
#[derive(Clone, Debug, Default)]
pub struct FootContacts {
    touched: Vec<bool>,
    on_ground: Vec<bool>,
    air_time: Vec<f32>,
    touchdown_air_time: Vec<f32>,
}

impl FootContacts {
    /// Updates the contacts after a policy step with the normal force on each foot [N].
    pub fn update(&mut self, foot_force: &[f32], policy_dt: f32) {
        self.resize(foot_force.len());
        for (foot, force) in foot_force.iter().enumerate() {
            let touches = *force > CONTACT_FORCE_THRESHOLD;
            self.on_ground[foot] = touches || self.touched[foot];
            self.touched[foot] = touches;
            self.touchdown_air_time[foot] = if self.on_ground[foot] { self.air_time[foot] } else { 0.0 };
            self.air_time[foot] = if self.on_ground[foot] { 0.0 } else { self.air_time[foot] + policy_dt };
        }
    }

    fn resize(&mut self, feet: usize) {
        self.touched.resize(feet, false);
        self.on_ground.resize(feet, false);
        self.air_time.resize(feet, 0.0);
        self.touchdown_air_time.resize(feet, 0.0);
    }

    /// Returns whether each foot is on the ground; empty before the first step.
    pub fn on_ground(&self) -> &[bool] {
        &self.on_ground
    }

    /// Returns the air time of each foot that touched down in the last step, 0 for the others [s].
    pub fn touchdown_air_time(&self) -> &[f32] {
        &self.touchdown_air_time
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, RobotStates, go2};

    use super::*;

    #[test]
    fn air_time_is_reported_once_at_touchdown_and_one_missing_contact_is_no_swing() {
        let mut contacts = FootContacts::default();
        let mut step = |force: f32| {
            contacts.update(&[force, 0.0, 0.0, 0.0], 0.02);
            (contacts.on_ground()[0], contacts.touchdown_air_time()[0])
        };
        assert_eq!([step(50.0), step(0.0), step(50.0)], [(true, 0.0); 3], "contact flickers");
        step(0.0);
        assert_eq!([step(0.0), step(0.0), step(0.0)], [(false, 0.0); 3]);
        let (on_ground, air_time) = step(30.0);
        assert!(on_ground && (air_time - 0.06).abs() < 1e-6, "{air_time}");
        assert_eq!(step(30.0), (true, 0.0));
    }

    #[test]
    fn feet_of_a_turning_robot_move_with_its_base() {
        let robot = go2();
        let mut states = RobotStates::new(1);
        states.measured.q[0] = robot.control.default_pose_f32();
        states.truth.base_position[0] = [2.0, 3.0, 0.3];
        states.truth.base_linear_velocity[0] = [0.4, 0.0, 0.0];
        states.truth.base_angular_velocity[0] = [0.0, 0.0, 1.0];
        let ground = Ground::FLAT;
        let view = RobotView::of(&states.measured, Some(&states.truth), &ground, 0);
        let kinematics = Feet::from(&robot);
        let feet = foot_states(&kinematics, &view, &view.truth.expect("a simulator"));
        let relative = kinematics.motions(&states.measured.q[0], &states.measured.dq[0]);
        for (foot, motion) in feet.iter().zip(relative) {
            // Velocity of a point of a rigid body: v + omega x r.
            let expected = (0.4 - motion.position.y).hypot(motion.position.x);
            assert!((foot.horizontal_speed - expected).abs() < 1e-6);
            assert!((foot.height - (0.3 + motion.position.z)).abs() < 1e-6);
        }
    }
}
