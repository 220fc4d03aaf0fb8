//! Checks of the messages on `rt/lowcmd`, and the command that stays in force.

use std::collections::VecDeque;

use twinstep_model::{Command, Joint, RobotModel};
use twinstep_unitree::{
    CdrError, ChecksumError, HEAD, LOW_LEVEL, LowCmd, MotorCmd, NO_POSITION, NO_VELOCITY, SERVO, decode, motor_index,
};

/// Largest accepted position gain [N·m/rad]. The vendor's limit is not documented; its examples use up to 80.
const MAX_KP: f32 = 200.0;
/// Largest accepted velocity gain [N·m·s/rad]. The vendor's limit is not documented; its examples use up to 5.
const MAX_KD: f32 = 20.0;
/// Farthest accepted position outside a joint's range [rad].
const MAX_EXCESS: f32 = 0.2;
/// Interval in which messages are counted [ms].
const RATE_INTERVAL_MS: u64 = 100;
/// Largest accepted number of messages in this interval: 1 kHz, and a burst after a pause of the network.
const MAX_MESSAGES: usize = 120;
/// `BmsCmd::off` that switches the robot off.
const POWER_OFF: u8 = 0xa5;

/// A message on `rt/lowcmd` was not executed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Refused {
    /// It is no message of this type.
    #[error("the message cannot be decoded: {0}")]
    Encoding(#[from] CdrError),
    /// It was damaged, or its checksum was not computed.
    #[error("the message is damaged: {0}")]
    Checksum(#[from] ChecksumError),
    /// It does not begin with the two bytes of a command.
    #[error("`head` is {found:02x?}; a command begins with fe ef")]
    Head {
        /// First two bytes.
        found: [u8; 2],
    },
    /// It is not for the motors.
    #[error("`level_flag` is {found:#04x}; commands of the motors have 0xff")]
    Level {
        /// Value of the field.
        found: u8,
    },
    /// The mode of a motor does not exist.
    #[error("`mode` of {joint} is {mode}; it is 1 (servo) or 0 (stopped)")]
    Mode {
        /// Joint.
        joint: Joint,
        /// Value of the field.
        mode: u8,
    },
    /// A number is not finite.
    #[error("`{quantity}` of {joint} is {value}, which is not a finite number")]
    NotFinite {
        /// Joint.
        joint: Joint,
        /// Field of the message.
        quantity: &'static str,
        /// Value of the field.
        value: f32,
    },
    /// A number is outside its limits.
    #[error("`{quantity}` of {joint} is {value}, outside {low} to {high}")]
    OutOfRange {
        /// Joint.
        joint: Joint,
        /// Field of the message.
        quantity: &'static str,
        /// Value of the field.
        value: f32,
        /// Lowest accepted value.
        low: f32,
        /// Highest accepted value.
        high: f32,
    },
    /// Messages arrive too often.
    #[error("{count} messages arrived within 100 ms; send at most 1000 per second")]
    TooOften {
        /// Number of messages within 100 ms.
        count: usize,
    },
    /// The robot is switched off.
    #[error("the robot is switched off")]
    PowerOff,
}

/// What the robot received since it was switched on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FakeStatistics {
    /// Number of executed messages.
    pub accepted: u64,
    /// Number of messages without effect because the built-in controller was active.
    pub ignored: u64,
    /// Number of refused messages.
    pub refused: u64,
    /// Reason of the first refused message.
    pub first_refused: Option<Refused>,
    /// Longest time between two executed messages while the first of them moved or held a joint [ms].
    pub largest_gap_ms: u64,
    /// Farthest commanded position outside a joint's range [rad]; 0 if all were inside.
    pub largest_excess_rad: f32,
    /// Number of damping messages since the last one that moved or held a joint.
    pub dampings: u64,
    /// Time from the last message that moved or held a joint to the first damping message after it [ms].
    pub damping_delay_ms: u64,
}

/// Receiver of `rt/lowcmd`.
#[derive(Clone, Debug)]
pub(super) struct Firmware {
    /// Lowest and highest position [rad], highest speed [rad/s] and torque [N·m] of each joint.
    limits: [[f32; 4]; 12],
    /// Message in force. No watchdog of the motors is documented, so it stays in force.
    last: Option<LowCmd>,
    last_at_ms: u64,
    arrivals_ms: VecDeque<u64>,
    pub statistics: FakeStatistics,
}

impl Firmware {
    pub fn new(robot: &RobotModel) -> Self {
        let limits = robot.joints.map(|joint| [joint.range[0], joint.range[1], joint.speed_limit, joint.torque_limit]);
        Self {
            limits: limits.map(|limits| limits.map(|limit| limit as f32)),
            last: None,
            last_at_ms: 0,
            arrivals_ms: VecDeque::new(),
            statistics: FakeStatistics::default(),
        }
    }

    /// Executes a message, or ignores it while the built-in controller is active. Returns true if it switches the
    /// robot off.
    pub fn receive(&mut self, payload: &[u8], now_ms: u64, controller_active: bool) -> Result<bool, Refused> {
        let checked = self.check(payload, now_ms);
        match checked {
            Err(refused) => {
                self.statistics.refused += 1;
                self.statistics.first_refused.get_or_insert_with(|| refused.clone());
                Err(refused)
            }
            Ok(_) if controller_active => {
                self.statistics.ignored += 1;
                Ok(false)
            }
            Ok(message) => {
                self.count_gap(now_ms);
                self.statistics.accepted += 1;
                let excess = Joint::ALL.into_iter().map(|joint| self.excess(joint, &message)).fold(0.0, f32::max);
                self.statistics.largest_excess_rad = self.statistics.largest_excess_rad.max(excess);
                let is_off = message.bms_cmd.off == POWER_OFF;
                self.count_damping(&message, now_ms);
                (self.last, self.last_at_ms) = (Some(message), now_ms);
                Ok(is_off)
            }
        }
    }

    /// Refuses a message to a robot without power.
    pub fn refuse_without_power(&mut self) -> Refused {
        self.statistics.refused += 1;
        Refused::PowerOff
    }

    /// Forgets the message in force: the motors are stopped.
    pub fn stop(&mut self) {
        self.last = None;
    }

    /// Counts the time since the message in force, if it moves or holds a joint. In damping a pause is no danger.
    pub fn count_gap(&mut self, now_ms: u64) {
        let command = self.command();
        if command.kp.iter().chain(&command.tau_ff).any(|value| *value != 0.0) {
            let gap = now_ms - self.last_at_ms;
            self.statistics.largest_gap_ms = self.statistics.largest_gap_ms.max(gap);
        }
    }

    /// Counts a message that replaces the one in force.
    fn count_damping(&mut self, message: &LowCmd, now_ms: u64) {
        let moves = |motor: &MotorCmd| motor.kp != 0.0 || motor.tau != 0.0;
        let statistics = &mut self.statistics;
        if message.motor_cmd.iter().any(moves) {
            statistics.dampings = 0;
            return;
        }
        if statistics.dampings == 0 {
            statistics.damping_delay_ms = now_ms - self.last_at_ms;
        }
        statistics.dampings += 1;
    }

    /// Returns the command in force; without one the motors are limp.
    pub fn command(&self) -> Command {
        let mut command = Command::hold([0.0; 12], 0.0, 0.0);
        let Some(message) = &self.last else { return command };
        for (index, joint) in Joint::ALL.into_iter().enumerate() {
            let motor = message.motor_cmd[motor_index(joint)];
            if motor.mode != SERVO {
                continue;
            }
            command.tau_ff[index] = motor.tau;
            if motor.q != NO_POSITION {
                (command.q[index], command.kp[index]) = (motor.q, motor.kp);
            }
            if motor.dq != NO_VELOCITY {
                (command.dq[index], command.kd[index]) = (motor.dq, motor.kd);
            }
        }
        command
    }

    /// Returns the motor modes of the message in force, in the order of the joints.
    pub fn modes(&self) -> [u8; 12] {
        let mode = |joint| self.last.as_ref().map_or(0, |message| message.motor_cmd[motor_index(joint)].mode);
        Joint::ALL.map(mode)
    }

    fn check(&mut self, payload: &[u8], now_ms: u64) -> Result<LowCmd, Refused> {
        self.arrivals_ms.push_back(now_ms);
        self.arrivals_ms.retain(|at| at + RATE_INTERVAL_MS > now_ms);
        let count = self.arrivals_ms.len();
        if count > MAX_MESSAGES {
            return Err(Refused::TooOften { count });
        }
        let message: LowCmd = decode(payload)?;
        message.check_checksum()?;
        if message.head != HEAD {
            return Err(Refused::Head { found: message.head });
        }
        if message.level_flag != LOW_LEVEL {
            return Err(Refused::Level { found: message.level_flag });
        }
        for joint in Joint::ALL {
            self.check_motor(joint, &message)?;
        }
        Ok(message)
    }

    fn check_motor(&self, joint: Joint, message: &LowCmd) -> Result<(), Refused> {
        let motor = message.motor_cmd[motor_index(joint)];
        if motor.mode > SERVO {
            return Err(Refused::Mode { joint, mode: motor.mode });
        }
        let [lower, upper, speed, torque] = self.limits[joint.index()];
        let fields = [
            ("q", motor.q, lower - MAX_EXCESS, upper + MAX_EXCESS),
            ("dq", motor.dq, -speed, speed),
            ("tau", motor.tau, -torque, torque),
            ("kp", motor.kp, 0.0, MAX_KP),
            ("kd", motor.kd, 0.0, MAX_KD),
        ];
        for (quantity, value, low, high) in fields {
            if !value.is_finite() {
                return Err(Refused::NotFinite { joint, quantity, value });
            }
            let is_disabled = (quantity == "q" && value == NO_POSITION) || (quantity == "dq" && value == NO_VELOCITY);
            if !is_disabled && !(low..=high).contains(&value) {
                return Err(Refused::OutOfRange { joint, quantity, value, low, high });
            }
        }
        Ok(())
    }

    fn excess(&self, joint: Joint, message: &LowCmd) -> f32 {
        let motor = message.motor_cmd[motor_index(joint)];
        let [lower, upper, ..] = self.limits[joint.index()];
        if motor.q == NO_POSITION { 0.0 } else { (lower - motor.q).max(motor.q - upper) }
    }
}
