//! `SportModeState_`: estimates of the robot's built-in controller, on `rt/sportmodestate`.

use crate::cdr::{FieldVisitor, Message};
use crate::imu_state::ImuState;

/// Estimates of the built-in controller. The robot sends none after that controller was released.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SportModeState {
    /// Time: seconds.
    pub sec: i32,
    /// Time: nanoseconds.
    pub nanosec: u32,
    /// Error code of the built-in controller.
    pub error_code: u32,
    /// Inertial measurement unit.
    pub imu_state: ImuState,
    /// Mode of the built-in controller.
    pub mode: u8,
    /// Progress of the present action.
    pub progress: f32,
    /// Gait of the built-in controller.
    pub gait_type: u8,
    /// Height of a lifted foot [m].
    pub foot_raise_height: f32,
    /// Position in the world frame [m].
    pub position: [f32; 3],
    /// Height of the body above the ground [m].
    pub body_height: f32,
    /// Linear velocity [m/s].
    pub velocity: [f32; 3],
    /// Yaw rate [rad/s].
    pub yaw_speed: f32,
    /// Distances to obstacles [m].
    pub range_obstacle: [f32; 4],
    /// Raw counts of the force sensors in the feet.
    pub foot_force: [i16; 4],
    /// Positions of the feet in the base frame [m].
    pub foot_position_body: [f32; 12],
    /// Velocities of the feet in the base frame [m/s].
    pub foot_speed_body: [f32; 12],
    /// Planned path.
    pub path_point: [PathPoint; 10],
}

/// Point of the planned path.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PathPoint {
    /// Time since the start [s].
    pub t_from_start: f32,
    /// Position, x [m].
    pub x: f32,
    /// Position, y [m].
    pub y: f32,
    /// Yaw [rad].
    pub yaw: f32,
    /// Velocity along x [m/s].
    pub vx: f32,
    /// Velocity along y [m/s].
    pub vy: f32,
    /// Yaw rate [rad/s].
    pub vyaw: f32,
}

impl Message for SportModeState {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.sec);
        fields.value(&mut self.nanosec);
        fields.value(&mut self.error_code);
        fields.structure(&mut self.imu_state);
        fields.value(&mut self.mode);
        fields.value(&mut self.progress);
        fields.value(&mut self.gait_type);
        fields.value(&mut self.foot_raise_height);
        fields.array(&mut self.position);
        fields.value(&mut self.body_height);
        fields.array(&mut self.velocity);
        fields.value(&mut self.yaw_speed);
        fields.array(&mut self.range_obstacle);
        fields.array(&mut self.foot_force);
        fields.array(&mut self.foot_position_body);
        fields.array(&mut self.foot_speed_body);
        for point in &mut self.path_point {
            fields.structure(point);
        }
    }
}

impl Message for PathPoint {
    fn visit_fields(&mut self, fields: &mut impl FieldVisitor) {
        fields.value(&mut self.t_from_start);
        fields.value(&mut self.x);
        fields.value(&mut self.y);
        fields.value(&mut self.yaw);
        fields.value(&mut self.vx);
        fields.value(&mut self.vy);
        fields.value(&mut self.vyaw);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_round_trips() {
        crate::cdr::round_trips::<SportModeState>(512);
    }
}
