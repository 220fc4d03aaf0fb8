//! What a picture of an effect shows of a simulated motion.

use twinstep_model::lanes::{Acceleration, State, Tree, Vec3, inverse_dynamics};
use twinstep_model::{Command, NUM_JOINTS, RobotModel, RobotStates, go2};

/// [m/s²]
const GRAVITY: f64 = 9.81;

/// A number of each drive period, of the trunk or of the joint that is shown.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// Since the motion began.
    Time,
    /// As the encoder shows it.
    Position,
    /// As the encoder shows it.
    Velocity,
    /// Mean over the period.
    Acceleration,
    /// What the ideal drive would give, from command and measurement.
    Wanted,
    /// What the motor gives, as its sensor shows it.
    Given,
    /// What the motor gives less what the ideal robot needs for the same motion.
    Unexplained,
    /// Of the trunk.
    Height,
    /// Of the trunk, to the left.
    Sideways,
    /// Of the trunk, nose down.
    Pitch,
    /// Roll rate as the gyroscope shows it.
    Gyro,
    /// Roll rate of the trunk.
    Turn,
    /// On all feet.
    Force,
    /// Share of the force that is on the front feet.
    FrontShare,
    /// Acceleration of the trunk upwards, and gravity.
    Lift,
    /// Acceleration of the trunk to the left.
    Push,
    /// Of the battery.
    Voltage,
    /// Of the motors.
    Temperature,
    /// Share of the torque that supply and heat leave.
    Strength,
}

/// A robot's motion under commands.
pub struct Run {
    /// The robot.
    pub robot: RobotModel,
    /// One a drive period.
    pub commands: Vec<Command>,
    /// Battery voltage [V] and motor temperature [°C] of each drive period.
    pub supply: Vec<[f64; 2]>,
    /// The joint that is shown.
    pub joint: usize,
    /// Drive periods before time 0.
    pub settle: usize,
    /// One more than commands.
    pub states: RobotStates,
}

impl Quantity {
    /// For an axis, with its unit.
    pub fn label(self) -> &'static str {
        match self {
            Self::Time => "time [s]",
            Self::Position => "joint position [rad]",
            Self::Velocity => "joint velocity [rad/s]",
            Self::Acceleration => "joint acceleration [rad/s²]",
            Self::Wanted => "torque of the ideal drive [N·m]",
            Self::Given => "measured torque [N·m]",
            Self::Unexplained => "unexplained torque [N·m]",
            Self::Height => "trunk height [m]",
            Self::Sideways => "trunk to the left [m]",
            Self::Pitch => "trunk pitch [rad]",
            Self::Gyro => "measured roll rate [rad/s]",
            Self::Turn => "true roll rate [rad/s]",
            Self::Force => "force on all feet [N]",
            Self::FrontShare => "share on the front feet",
            Self::Lift => "upward acceleration + g [m/s²]",
            Self::Push => "acceleration to the left [m/s²]",
            Self::Voltage => "battery voltage [V]",
            Self::Temperature => "motor temperature [°C]",
            Self::Strength => "share of the torque",
        }
    }

    /// In drive period `period` of a run.
    pub fn of(self, run: &Run, period: usize) -> f64 {
        let (states, joint, dt) = (&run.states, run.joint, run.robot.control.drive_dt());
        let change = |of: &dyn Fn(usize) -> f32| f64::from(of(period + 1) - of(period)) / dt;
        let feet = states.foot_force[period + 1].map(f64::from);
        match self {
            Self::Time => (period as f64 - run.settle as f64) * dt,
            Self::Position => f64::from(states.q[period][joint]),
            Self::Velocity => f64::from(states.dq[period][joint]),
            Self::Acceleration => change(&|row| states.dq[row][joint]),
            Self::Wanted => run.wanted(period),
            Self::Given => run.shown_torque(period),
            Self::Unexplained => f64::from(states.tau[period + 1][joint]) - run.needed(period),
            Self::Height => f64::from(states.base_position[period][2]),
            Self::Sideways => f64::from(states.base_position[period][1]),
            Self::Pitch => {
                let [w, x, y, z] = states.base_orientation[period].map(f64::from);
                (2.0 * (w * y - z * x)).asin()
            }
            Self::Gyro => f64::from(states.base_angular_velocity[period][0]),
            Self::Turn => Self::Gyro.of(run, period) - run.robot.gyro_bias.x,
            Self::Force => feet.iter().sum(),
            Self::FrontShare => (feet[0] + feet[1]) / feet.iter().sum::<f64>(),
            Self::Lift => change(&|row| states.base_linear_velocity[row][2]) + GRAVITY,
            Self::Push => change(&|row| states.base_linear_velocity[row][1]),
            Self::Voltage => run.supply[period][0],
            Self::Temperature => run.supply[period][1],
            Self::Strength => f64::from(run.commands[period].strength[joint]),
        }
    }
}

impl Run {
    /// Torque of a drive without effects on the measured state [N·m].
    fn wanted(&self, period: usize) -> f64 {
        let (command, joint) = (&self.commands[period], self.joint);
        let [q, dq] = [self.states.q[period][joint], self.states.dq[period][joint]];
        f64::from(command.kp[joint] * (command.q[joint] - q) - command.kd[joint] * dq)
    }

    /// What the sensor of the motor's current shows at the end of a period, late as it is [N·m].
    fn shown_torque(&self, period: usize) -> f64 {
        let late = self.robot.joints[self.joint].drive.sensor_delay / self.robot.control.drive_dt();
        let at = (period as f64 + 1.0 - late).max(0.0);
        let of = |entry: usize| f64::from(self.states.tau[entry][self.joint]);
        let whole = at as usize;
        of(whole) + at.fract() * (of((whole + 1).min(self.states.tau.len() - 1)) - of(whole))
    }

    /// What the ideal robot, held in the air, needs for the measured motion [N·m], by inverse dynamics.
    fn needed(&self, period: usize) -> f64 {
        let dt = self.robot.control.drive_dt();
        let mean =
            |of: &[[f32; NUM_JOINTS]], joint: usize| f64::from(f32::midpoint(of[period][joint], of[period + 1][joint]));
        let mut state = State::<f64>::origin();
        state.q = std::array::from_fn(|joint| mean(&self.states.q, joint));
        state.dq = std::array::from_fn(|joint| mean(&self.states.dq, joint));
        let speed = &self.states.dq;
        let ddq = std::array::from_fn(|joint| f64::from(speed[period + 1][joint] - speed[period][joint]) / dt);
        let acceleration = Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq };
        let (_, torques) = inverse_dynamics(&Tree::splat(&go2()), &state, &acceleration, GRAVITY);
        torques[self.joint]
    }
}
