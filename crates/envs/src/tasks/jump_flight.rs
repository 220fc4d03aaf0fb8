//! Stages of a jump, and where it lands.

use twinstep_model::PerLeg;

use crate::path::GroundPose;

/// Acceleration of gravity [m/s²].
const GRAVITY: f32 = 9.81;
/// Normal force above which a foot touches the ground [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;
/// Time without contact of any foot after which the robot is in flight [s].
const MIN_AIR_TIME: f32 = 0.06;

/// Stage of a jump.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Stage {
    /// The robot has not left the ground.
    #[default]
    BeforeTakeOff,
    /// No foot has touched the ground for at least 60 ms.
    Flight,
    /// A foot has touched the ground after the flight.
    Landed,
}

/// Motion of a robot that jumps, in the world frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct JumpMotion {
    /// Pose of the base on the ground.
    pub pose: GroundPose,
    /// Height of the base above the ground [m].
    pub height: f32,
    /// Velocity of the base [m/s].
    pub velocity: [f32; 3],
    /// Yaw rate of the base [rad/s].
    pub yaw_rate: f32,
    /// Distance of the lowest point of each foot from the ground [m].
    pub foot_clearance: PerLeg,
    /// Vertical velocity of each foot [m/s].
    pub foot_velocity_z: PerLeg,
    /// Normal force on each foot [N].
    pub foot_force: PerLeg,
}

impl JumpMotion {
    /// Returns the pose after a flight until the base is at `height` [m] again, or the pose now if it cannot get there.
    pub fn landing_at(&self, height: f32) -> GroundPose {
        self.after(fall_time(self.height - height, self.velocity[2]))
    }

    /// Returns the pose at which the first foot touches the ground, at the latest after `policy_dt` [s].
    fn touchdown(&self, policy_dt: f32) -> GroundPose {
        let times = self.foot_clearance.iter().zip(&self.foot_velocity_z);
        self.after(times.map(|(clearance, velocity)| fall_time(*clearance, *velocity)).fold(policy_dt, f32::min))
    }

    fn after(&self, time: f32) -> GroundPose {
        let [vx, vy, _] = self.velocity;
        let GroundPose { x, y, yaw } = self.pose;
        GroundPose { x: x + vx * time, y: y + vy * time, yaw: yaw + self.yaw_rate * time }
    }
}

/// Returns the time in which a body in flight falls by `distance` [m], 0 if it does not get there [s].
fn fall_time(distance: f32, velocity: f32) -> f32 {
    let discriminant = velocity * velocity + 2.0 * GRAVITY * distance;
    if discriminant < 0.0 { 0.0 } else { ((velocity + discriminant.sqrt()) / GRAVITY).max(0.0) }
}

/// The first flight of a robot in an episode.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    stage: Stage,
    /// True once a foot has touched the ground: the drop at the start is no jump.
    has_stood: bool,
    air_time: f32,
    /// Motion in the last step without contact.
    last: JumpMotion,
    landing: Option<GroundPose>,
}

impl Flight {
    /// Updates the stage after a policy step. Returns true if the robot has landed in this step.
    ///
    /// The landing is the pose of the base at the first contact of a foot after all feet were off the ground for at
    /// least 60 ms. Between two policy steps it follows from the motion before the contact.
    pub fn update(&mut self, motion: &JumpMotion, policy_dt: f32) -> bool {
        let touches = motion.foot_force.iter().any(|force| *force > CONTACT_FORCE_THRESHOLD);
        let lands = touches && self.stage == Stage::Flight;
        if lands {
            self.stage = Stage::Landed;
            self.landing = Some(self.last.touchdown(policy_dt));
        } else if touches {
            self.has_stood = true;
            self.air_time = 0.0;
        } else if self.has_stood {
            self.air_time += policy_dt;
            self.last = *motion;
            if self.stage == Stage::BeforeTakeOff && self.air_time >= MIN_AIR_TIME - 1e-4 {
                self.stage = Stage::Flight;
            }
        }
        lands
    }

    /// Returns the stage.
    pub fn stage(&self) -> Stage {
        self.stage
    }

    /// Returns the pose of the base at the landing, once the robot has landed.
    pub fn landing(&self) -> Option<GroundPose> {
        self.landing
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the motion of a rigid robot `time` after it has left the ground with 1.5 m/s forward and 2 m/s upward.
    fn motion(time: f32) -> JumpMotion {
        let rise = 2.0 * time - 0.5 * GRAVITY * time * time;
        let in_air = rise > 0.0;
        JumpMotion {
            pose: GroundPose { x: 1.5 * time, y: 0.0, yaw: 0.5 * time },
            height: 0.3 + rise,
            velocity: [1.5, 0.0, 2.0 - GRAVITY * time],
            yaw_rate: 0.5,
            foot_clearance: [rise.max(0.0); 4],
            foot_velocity_z: [2.0 - GRAVITY * time; 4],
            foot_force: if in_air { [0.0; 4] } else { [50.0; 4] },
        }
    }

    #[test]
    fn landing_of_a_rigid_robot_is_that_of_a_projectile() {
        let time = 2.0 * 2.0 / GRAVITY;
        let mut flight = Flight::default();
        let mut landed = 0;
        assert!(!flight.update(&motion(-0.01), 0.02), "it stands");
        for step in 0..60 {
            landed += u32::from(flight.update(&motion(0.02 * step as f32 + 0.007), 0.02));
        }
        let landing = flight.landing().expect("landed");
        assert_eq!((landed, flight.stage()), (1, Stage::Landed));
        assert!((landing.x - 1.5 * time).abs() < 1e-4 && (landing.yaw - 0.5 * time).abs() < 1e-4, "{landing:?}");
        let predicted = motion(0.1).landing_at(0.3);
        assert!((predicted.x - landing.x).abs() < 1e-4, "{predicted:?}");
    }

    #[test]
    fn legs_that_are_stretched_before_the_contact_do_not_move_the_landing_beyond_the_step() {
        let mut flight = Flight::default();
        flight.update(&motion(-0.01), 0.02);
        for step in 1..=5 {
            flight.update(&JumpMotion { foot_velocity_z: [0.0; 4], ..motion(0.02 * step as f32) }, 0.02);
        }
        flight.update(&JumpMotion { foot_force: [80.0; 4], ..motion(0.12) }, 0.02);
        let landing = flight.landing().expect("landed");
        assert!((landing.x - 1.5 * 0.12).abs() < 1e-4, "{landing:?}");
    }

    #[test]
    fn short_loss_of_contact_is_no_flight() {
        let mut flight = Flight { has_stood: true, ..Flight::default() };
        let in_air = JumpMotion { foot_force: [0.0; 4], ..motion(0.1) };
        let on_ground = JumpMotion { foot_force: [0.0, 0.0, 20.0, 0.0], ..motion(0.1) };
        for motion in [&in_air, &in_air, &on_ground, &in_air, &in_air] {
            assert!(!flight.update(motion, 0.02));
            assert_eq!(flight.stage(), Stage::BeforeTakeOff);
        }
        flight.update(&in_air, 0.02);
        assert_eq!((flight.stage(), flight.landing()), (Stage::Flight, None));
    }

    #[test]
    fn drop_at_the_start_is_no_flight() {
        let mut flight = Flight::default();
        for _ in 0..5 {
            flight.update(&JumpMotion { foot_force: [0.0; 4], ..motion(0.1) }, 0.02);
        }
        assert_eq!(flight.stage(), Stage::BeforeTakeOff);
    }

    #[test]
    fn base_that_cannot_reach_the_height_stays_where_it_is() {
        let crouched = JumpMotion { height: 0.2, velocity: [1.0, 0.0, 0.5], ..motion(0.0) };
        assert_eq!(crouched.landing_at(0.3), crouched.pose);
    }
}
