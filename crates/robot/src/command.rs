//! Commands that are inside the robot's limits, the only ones that become a message.

use twinstep_model::{Command, Joint, PerJoint, RobotModel};
use twinstep_unitree::{LowCmd, MotorCmd, SERVO, motor_index};

use crate::SafetyConfig;
use crate::unsafe_command::UnsafeCommand;

/// Bounds of the numbers in a command.
#[derive(Clone, Debug, PartialEq)]
pub struct CommandLimits {
    lower: PerJoint,
    upper: PerJoint,
    max_speed: PerJoint,
    max_torque: PerJoint,
    max_kp: f32,
    max_kd: f32,
}

/// Command whose numbers are finite and inside the limits; joints in the order of [`Joint::ALL`].
///
/// Only [`CommandLimits::check`] makes one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SafeCommand(Command);

impl CommandLimits {
    /// Returns the limits of a robot.
    pub fn new(robot: &RobotModel, config: &SafetyConfig) -> Self {
        let bound =
            |side: usize| robot.joints.map(|joint| scaled_range(joint.range, config.soft_joint_limit_factor)[side]);
        Self {
            lower: bound(0),
            upper: bound(1),
            max_speed: robot.joints.map(|joint| joint.speed_limit as f32),
            max_torque: robot.torque_limits(),
            max_kp: config.max_kp,
            max_kd: config.max_kd,
        }
    }

    /// Returns the nearest positions inside the limits [rad].
    pub fn clamp(&self, q: PerJoint) -> PerJoint {
        std::array::from_fn(|joint| q[joint].clamp(self.lower[joint], self.upper[joint]))
    }

    /// Returns the lowest and highest position of a joint [rad].
    pub fn range(&self, joint: Joint) -> [f32; 2] {
        [self.lower[joint.index()], self.upper[joint.index()]]
    }

    /// Returns the command if every number is finite and inside its limits.
    pub fn check(&self, command: &Command) -> Result<SafeCommand, UnsafeCommand> {
        for (index, joint) in Joint::ALL.into_iter().enumerate() {
            let (speed, torque) = (self.max_speed[index], self.max_torque[index]);
            let fields = [
                ("q", command.q[index], self.lower[index], self.upper[index]),
                ("dq", command.dq[index], -speed, speed),
                ("tau_ff", command.tau_ff[index], -torque, torque),
                ("kp", command.kp[index], 0.0, self.max_kp),
                ("kd", command.kd[index], 0.0, self.max_kd),
            ];
            // NaN is in no range.
            if let Some((quantity, value, low, high)) =
                fields.into_iter().find(|(_, value, low, high)| !(low..=high).contains(&value))
            {
                return Err(UnsafeCommand { joint, quantity, value, low, high });
            }
        }
        Ok(SafeCommand(*command))
    }
}

/// Returns a range [rad] made wider or narrower by `factor`, about its middle.
pub(crate) fn scaled_range([low, high]: [f64; 2], factor: f32) -> [f32; 2] {
    let (middle, half) = (f64::midpoint(low, high), 0.5 * (high - low) * f64::from(factor));
    [(middle - half) as f32, (middle + half) as f32]
}

impl SafeCommand {
    /// Returns the numbers of the command.
    pub fn command(&self) -> &Command {
        &self.0
    }

    /// Returns the message to the motors, in their order and with its checksum.
    pub fn to_low_cmd(&self) -> LowCmd {
        let mut message = LowCmd::stopped();
        for (index, joint) in Joint::ALL.into_iter().enumerate() {
            message.motor_cmd[motor_index(joint)] = MotorCmd {
                mode: SERVO,
                q: self.0.q[index],
                dq: self.0.dq[index],
                tau: self.0.tau_ff[index],
                kp: self.0.kp[index],
                kd: self.0.kd[index],
                ..MotorCmd::default()
            };
        }
        message.with_checksum()
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{NUM_JOINTS, go2};

    use super::*;

    fn limits() -> CommandLimits {
        CommandLimits::new(&go2(), &SafetyConfig::default())
    }

    fn standing() -> Command {
        Command::hold(go2().control.default_pose_f32(), 30.0, 0.75)
    }

    #[test]
    fn number_that_is_not_finite_or_outside_its_limits_is_named() {
        type Field = fn(&mut Command) -> &mut PerJoint;
        let fields: [(&str, Field, f32); 5] = [
            ("q", |command| &mut command.q, 1.05),
            ("dq", |command| &mut command.dq, -31.0),
            ("tau_ff", |command| &mut command.tau_ff, 46.0),
            ("kp", |command| &mut command.kp, 101.0),
            ("kd", |command| &mut command.kd, -0.1),
        ];
        assert!(limits().check(&standing()).is_ok());
        for (name, field, outside) in fields {
            for value in [outside, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                for joint in Joint::ALL {
                    let mut command = standing();
                    // Thigh and calf have larger ranges than the hip.
                    let value = if name == "q" && joint.kind as usize > 0 { 5.0 * value } else { value };
                    field(&mut command)[joint.index()] = value;
                    let error = limits().check(&command).expect_err(name);
                    assert_eq!((error.joint, error.quantity), (joint, name));
                }
            }
        }
    }

    #[test]
    fn error_has_joint_value_and_range() {
        let mut command = standing();
        command.kp[3] = 500.0;
        let text = limits().check(&command).expect_err("too stiff").to_string();
        assert_eq!(text, "`kp` of FR_hip is 500, outside 0 to 100");
    }

    #[test]
    fn positions_are_kept_away_from_the_ends_of_the_joints() {
        let robot = go2();
        let [low, high] = [limits().clamp([-9.0; NUM_JOINTS]), limits().clamp([9.0; NUM_JOINTS])];
        for (joint, model) in robot.joints.iter().enumerate() {
            let range = (model.range[1] - model.range[0]) as f32;
            assert!((low[joint] - model.range[0] as f32 - 0.025 * range).abs() < 1e-5);
            assert!((model.range[1] as f32 - high[joint] - 0.025 * range).abs() < 1e-5);
        }
    }

    #[test]
    fn every_joint_commands_its_own_motor() {
        let mut command = standing();
        command.dq = std::array::from_fn(|joint| 0.1 * joint as f32);
        let message = limits().check(&command).expect("inside the limits").to_low_cmd();
        assert_eq!(message.check_checksum(), Ok(()));
        let dq = message.motor_cmd.map(|motor| (motor.dq * 10.0).round());
        assert_eq!(dq[..12], [3.0, 4.0, 5.0, 0.0, 1.0, 2.0, 9.0, 10.0, 11.0, 6.0, 7.0, 8.0]);
        for motor in &message.motor_cmd[12..] {
            assert_eq!((motor.kp, motor.kd, motor.tau), (0.0, 0.0, 0.0));
        }
        assert_eq!(message.bms_cmd.off, 0, "a battery that is switched off drops the robot");
    }
}
