//! Motion and contact of the feet, for reward terms.

use glam::Vec3;
use twinstep_model::{FootKinematics, GroundTruth, PerLeg, frames};

use crate::task::RobotView;

/// Contact force above which a foot is on the ground [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;

/// Motion of a foot in the world frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FootState {
    /// Height of the foot's centre above the ground under it [m].
    pub height: f32,
    /// Horizontal speed [m/s].
    pub horizontal_speed: f32,
    /// Vertical velocity [m/s].
    pub vertical_velocity: f32,
}

/// Returns the motion of the feet of a simulated robot in the order FL, FR, RL, RR.
pub fn foot_states(kinematics: &FootKinematics, robot: &RobotView, truth: &GroundTruth) -> [FootState; 4] {
    let (measured, index) = (robot.measured, robot.index);
    let world_from_base = frames::world_from_base(measured.orientation[index]);
    let base_position = Vec3::from(truth.base_position[index]);
    let base_velocity = Vec3::from(truth.base_linear_velocity[index]);
    let angular_velocity = Vec3::from(truth.base_angular_velocity[index]);
    kinematics.feet(&measured.q[index], &measured.dq[index]).map(|foot| {
        let position = base_position + world_from_base * foot.position;
        let velocity = base_velocity + world_from_base * (foot.velocity + angular_velocity.cross(foot.position));
        FootState {
            height: position.z - robot.ground.height(position.x, position.y),
            horizontal_speed: velocity.x.hypot(velocity.y),
            vertical_velocity: velocity.z,
        }
    })
}

/// Contacts of the feet over the policy steps of an episode.
///
/// A foot counts as on the ground if it touches it in this or in the last step: contact flickers, and the force is that
/// of the last physics step only.
#[derive(Clone, Copy, Debug, Default)]
pub struct FootContacts {
    touched: [bool; 4],
    on_ground: [bool; 4],
    air_time: PerLeg,
    touchdown_air_time: PerLeg,
}

impl FootContacts {
    /// Updates the contacts after a policy step with the normal force on each foot [N].
    pub fn update(&mut self, foot_force: &PerLeg, policy_dt: f32) {
        for (leg, force) in foot_force.iter().enumerate() {
            let touches = *force > CONTACT_FORCE_THRESHOLD;
            self.on_ground[leg] = touches || self.touched[leg];
            self.touched[leg] = touches;
            self.touchdown_air_time[leg] = if self.on_ground[leg] { self.air_time[leg] } else { 0.0 };
            self.air_time[leg] = if self.on_ground[leg] { 0.0 } else { self.air_time[leg] + policy_dt };
        }
    }

    /// Returns whether each foot is on the ground.
    pub fn on_ground(&self) -> [bool; 4] {
        self.on_ground
    }

    /// Returns the air time of each foot that touched down in the last step, 0 for the others [s].
    pub fn touchdown_air_time(&self) -> PerLeg {
        self.touchdown_air_time
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
        let view = RobotView { measured: &states.measured, truth: Some(&states.truth), ground: &ground, index: 0 };
        let kinematics = FootKinematics::new(&robot);
        let feet = foot_states(&kinematics, &view, &states.truth);
        let relative = kinematics.feet(&states.measured.q[0], &states.measured.dq[0]);
        for (foot, motion) in feet.iter().zip(relative) {
            // Velocity of a point of a rigid body: v + omega x r.
            let expected = (0.4 - motion.position.y).hypot(motion.position.x);
            assert!((foot.horizontal_speed - expected).abs() < 1e-6);
            assert!((foot.height - (0.3 + motion.position.z)).abs() < 1e-6);
        }
    }
}
