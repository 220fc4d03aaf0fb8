//! What a log needs of the robot's messages. It is kept for every row of a recording, and the messages are three times
//! as large.

use twinstep_model::NUM_JOINTS;

/// Measurements of the robot; motors and feet in the robot's order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LowState {
    /// Orientation world-from-base: w, x, y, z.
    pub quaternion: [f32; 4],
    /// Angular velocity [rad/s].
    pub gyroscope: [f32; 3],
    /// Specific force [m/s²].
    pub accelerometer: [f32; 3],
    pub motors: [MotorState; NUM_JOINTS],
    /// Raw counts of the force sensors, not newtons.
    pub foot_force: [i16; 4],
    /// Battery voltage [V].
    pub power_v: f32,
    /// Clock of the robot [ms].
    pub tick: u32,
}

/// Position and velocity of the base, in the world frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct BaseState {
    /// Position [m].
    pub position: [f32; 3],
    /// Velocity [m/s].
    pub velocity: [f32; 3],
}

impl BaseState {
    /// Returns position, then velocity.
    pub fn values(&self) -> [f64; 6] {
        let (position, velocity) = (self.position.map(f64::from), self.velocity.map(f64::from));
        [position[0], position[1], position[2], velocity[0], velocity[1], velocity[2]]
    }
}

/// Measurements of one motor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct MotorState {
    /// Joint position [rad].
    pub q: f32,
    /// Joint velocity [rad/s].
    pub dq: f32,
    /// Motor current × torque constant [N·m].
    pub tau_est: f32,
    /// Motor temperature [°C].
    pub temperature: u8,
}

/// Command of the robot; motors in the robot's order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct LowCmd {
    pub motors: [MotorCmd; NUM_JOINTS],
}

/// Command of one motor: torque = tau + kp·(q − q_measured) + kd·(dq − dq_measured).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct MotorCmd {
    pub mode: u8,
    /// Commanded position [rad].
    pub q: f32,
    /// Commanded velocity [rad/s].
    pub dq: f32,
    /// Feed-forward torque [N·m].
    pub tau: f32,
    /// Position gain [N·m/rad].
    pub kp: f32,
    /// Velocity gain [N·m·s/rad].
    pub kd: f32,
}

impl From<twinstep_unitree::LowState> for LowState {
    fn from(state: twinstep_unitree::LowState) -> Self {
        let imu = state.imu_state;
        let motor = |motor: usize| {
            let twinstep_unitree::MotorState { q, dq, tau_est, temperature, .. } = state.motor_state[motor];
            MotorState { q, dq, tau_est, temperature }
        };
        Self {
            quaternion: imu.quaternion,
            gyroscope: imu.gyroscope,
            accelerometer: imu.accelerometer,
            motors: std::array::from_fn(motor),
            foot_force: state.foot_force,
            power_v: state.power_v,
            tick: state.tick,
        }
    }
}

impl From<twinstep_unitree::LowCmd> for LowCmd {
    fn from(command: twinstep_unitree::LowCmd) -> Self {
        let motor = |motor: usize| {
            let twinstep_unitree::MotorCmd { mode, q, dq, tau, kp, kd, .. } = command.motor_cmd[motor];
            MotorCmd { mode, q, dq, tau, kp, kd }
        };
        Self { motors: std::array::from_fn(motor) }
    }
}
