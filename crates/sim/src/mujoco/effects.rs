//! Effects of a robot model that MuJoCo simulates, and those that it does not.

use twinstep_model::{ActuatorParams, Command, InitialState, JointModel, PerJoint, RobotModel};

/// Returns the name of an effect of joints that MuJoCo does not simulate. Returns `None` if it simulates all.
///
/// Its model (MJCF) has bodies, armature, viscous and Coulomb friction, springs, torque gains and the ground. Gains of the
/// PD loop, offsets of the sensors and derating are added by [`Adjustments`], delays of commands by
/// [`CommandDelay`](super::delay::CommandDelay).
pub fn effect_outside_mujoco(joints: &[JointModel]) -> Option<&'static str> {
    joints.iter().find_map(|joint| {
        let ActuatorParams {
            saturation,
            torque_delay,
            no_load_speed,
            dead_zone,
            torque_time_constant,
            ripple,
            backlash,
            gear_stiffness,
            // In the model, in `CommandDelay` or in `Adjustments`. The delay of the logged torque acts where a log is replayed.
            command_delay: _,
            encoder_offset: _,
            encoder_lead,
            kp_scale: _,
            kd_scale: _,
            gain: _,
            sensor_delay: _,
        } = joint.actuator;
        let present = [
            ("torque_saturation", saturation.is_finite()),
            ("torque_delay", torque_delay != 0.0),
            ("torque_speed_limit", no_load_speed.is_finite()),
            ("torque_dead_zone", dead_zone != 0.0),
            ("drive_lag", torque_time_constant != 0.0),
            ("torque_ripple", ripple.amplitude != 0.0),
            ("backlash", backlash != 0.0),
            ("encoder_lead", encoder_lead != 0.0),
            ("joint_elasticity", gear_stiffness.is_finite()),
            ("stribeck_friction", joint.stribeck_friction.breakaway_torque != 0.0),
            ("load_friction", joint.load_friction != 0.0),
            // A torque without stiffness has no rest position.
            ("joint_spring", joint.spring.stiffness == 0.0 && joint.spring.torque_offset != 0.0),
        ];
        present.into_iter().find(|(_, present)| *present).map(|(effect, _)| effect)
    })
}

/// Effects of one robot on its commands and readings, which are not in its MuJoCo model.
#[derive(Clone, Copy)]
pub struct Adjustments {
    kp_scale: PerJoint,
    kd_scale: PerJoint,
    encoder_offset: PerJoint,
    gyro_bias: [f32; 3],
    /// Factor on the torque of each joint, for supply voltage and motor temperature.
    pub derating: PerJoint,
}

impl Adjustments {
    /// Returns the effects of `robot`.
    pub fn new(robot: &RobotModel) -> Self {
        Self {
            kp_scale: robot.joints.map(|joint| joint.actuator.kp_scale as f32),
            kd_scale: robot.joints.map(|joint| joint.actuator.kd_scale as f32),
            encoder_offset: robot.joints.map(|joint| joint.actuator.encoder_offset as f32),
            gyro_bias: robot.gyro_bias.as_vec3().to_array(),
            derating: PerJoint::default().map(|_| 1.0),
        }
    }

    /// Returns the command of a PD loop with ideal gains that reads true joint positions.
    ///
    /// The factors are exact, because the torque is clipped to its limit after them.
    pub fn command(&self, command: &Command) -> Command {
        let mut adjusted = *command;
        for joint in 0..self.derating.len() {
            let derating = self.derating[joint];
            adjusted.q[joint] -= self.encoder_offset[joint];
            adjusted.kp[joint] *= self.kp_scale[joint] * derating;
            adjusted.kd[joint] *= self.kd_scale[joint] * derating;
            adjusted.tau_ff[joint] *= derating;
        }
        adjusted
    }

    /// Returns the initial state with true joint positions instead of encoder readings.
    pub fn initial_state(&self, initial_state: &InitialState) -> InitialState {
        let mut adjusted = *initial_state;
        adjusted.q.iter_mut().zip(self.encoder_offset).for_each(|(q, offset)| *q -= offset);
        adjusted
    }

    /// Turns joint positions [rad] and angular velocity of the base [rad/s] into readings of the sensors.
    pub fn readings(&self, q: &mut PerJoint, gyro: &mut [f32; 3]) {
        q.iter_mut().zip(self.encoder_offset).for_each(|(q, offset)| *q += offset);
        gyro.iter_mut().zip(self.gyro_bias).for_each(|(rate, bias)| *rate += bias);
    }
}
