//! What a picture of an effect shows of a simulated motion.

use twinstep_identify::experiment::estimated_torque;
use twinstep_model::{
    Command, NUM_JOINTS, RobotModel, RobotStates,
    dynamics::{Acceleration, KinematicTree, State, Vec3, inverse_dynamics},
    go2,
};

/// [m/s²]
const GRAVITY: f64 = 9.81;

/// A number of each actuator period, of the trunk or of the joint that is shown.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum PlotQuantity {
    /// Since the motion began.
    Time,
    /// As the encoder shows it.
    Position,
    /// As the encoder shows it.
    Velocity,
    /// Mean over the period.
    Acceleration,
    /// What the ideal actuator would give, from command and measurement.
    CommandedTorque,
    /// What the motor gives, as its sensor shows it.
    EstimatedTorque,
    /// What the motor gives less what the ideal robot needs for the same motion.
    InverseDynamicsResidual,
    /// Of the trunk.
    Height,
    /// Of the trunk, to the left.
    Sideways,
    /// Of the trunk, nose down.
    Pitch,
    /// Roll rate as the gyroscope shows it.
    Gyro,
    /// Roll rate of the trunk.
    RollRate,
    /// On all feet.
    Force,
    /// Share of the force that is on the front feet.
    FrontShare,
    /// Acceleration of the trunk upwards, and gravity.
    VerticalAcceleration,
    /// Acceleration of the trunk to the left.
    LateralAcceleration,
    /// Of the battery.
    Voltage,
    /// Of the motors.
    Temperature,
    /// Share of the torque that supply and heat leave.
    DeratingFactor,
}

/// A robot's motion under commands.
pub struct SimulatedRun {
    /// The robot.
    pub robot: RobotModel,
    /// One an actuator period.
    pub commands: Vec<Command>,
    /// Battery voltage [V] and motor temperature [°C] of each actuator period.
    pub supply: Vec<[f64; 2]>,
    /// The joint that is shown.
    pub joint: usize,
    /// Actuator periods before time 0.
    pub settle: usize,
    /// One more than commands.
    pub states: RobotStates,
}

impl PlotQuantity {
    /// For an axis, with its unit.
    pub fn label(self) -> &'static str {
        match self {
            Self::Time => "time [s]",
            Self::Position => "joint position [rad]",
            Self::Velocity => "joint velocity [rad/s]",
            Self::Acceleration => "joint acceleration [rad/s²]",
            Self::CommandedTorque => "torque of the ideal actuator [N·m]",
            Self::EstimatedTorque => "measured torque [N·m]",
            Self::InverseDynamicsResidual => "unexplained torque [N·m]",
            Self::Height => "trunk height [m]",
            Self::Sideways => "trunk to the left [m]",
            Self::Pitch => "trunk pitch [rad]",
            Self::Gyro => "measured roll rate [rad/s]",
            Self::RollRate => "true roll rate [rad/s]",
            Self::Force => "force on all feet [N]",
            Self::FrontShare => "share on the front feet",
            Self::VerticalAcceleration => "upward acceleration + g [m/s²]",
            Self::LateralAcceleration => "acceleration to the left [m/s²]",
            Self::Voltage => "battery voltage [V]",
            Self::Temperature => "motor temperature [°C]",
            Self::DeratingFactor => "share of the torque",
        }
    }

    /// In actuator period `period` of a run.
    pub fn of(self, run: &SimulatedRun, period: usize) -> f64 {
        let (states, joint, dt) = (&run.states, run.joint, run.robot.control.actuator_dt());
        let change = |of: &dyn Fn(usize) -> f32| f64::from(of(period + 1) - of(period)) / dt;
        let feet = states.foot_force[period + 1].map(f64::from);
        match self {
            Self::Time => (period as f64 - run.settle as f64) * dt,
            Self::Position => f64::from(states.q[period][joint]),
            Self::Velocity => f64::from(states.dq[period][joint]),
            Self::Acceleration => change(&|row| states.dq[row][joint]),
            Self::CommandedTorque => run.wanted(period),
            Self::EstimatedTorque => run.measured_torque(period),
            Self::InverseDynamicsResidual => f64::from(states.tau[period + 1][joint]) - run.needed(period),
            Self::Height => f64::from(states.base_position[period][2]),
            Self::Sideways => f64::from(states.base_position[period][1]),
            Self::Pitch => {
                let [w, x, y, z] = states.base_orientation[period].map(f64::from);
                (2.0 * (w * y - z * x)).asin()
            }
            Self::Gyro => f64::from(states.base_angular_velocity[period][0]),
            Self::RollRate => Self::Gyro.of(run, period) - run.robot.gyro_bias.x,
            Self::Force => feet.iter().sum(),
            Self::FrontShare => (feet[0] + feet[1]) / feet.iter().sum::<f64>(),
            Self::VerticalAcceleration => change(&|row| states.base_linear_velocity[row][2]) + GRAVITY,
            Self::LateralAcceleration => change(&|row| states.base_linear_velocity[row][1]),
            Self::Voltage => run.supply[period][0],
            Self::Temperature => run.supply[period][1],
            Self::DeratingFactor => f64::from(run.commands[period].derating_factor[joint]),
        }
    }
}

impl SimulatedRun {
    /// Torque of an actuator without effects on the measured state [N·m].
    fn wanted(&self, period: usize) -> f64 {
        let (command, joint) = (&self.commands[period], self.joint);
        let [q, dq] = [self.states.q[period][joint], self.states.dq[period][joint]];
        f64::from(command.kp[joint] * (command.q[joint] - q) - command.kd[joint] * dq)
    }

    /// Returns the measured torque of a period, with the delay of the torque sensor [N·m].
    fn measured_torque(&self, period: usize) -> f64 {
        estimated_torque(&self.states, &self.robot, self.joint, period, period + 1)
    }

    /// What the ideal robot, held in the air, needs for the measured motion [N·m], by inverse dynamics.
    fn needed(&self, period: usize) -> f64 {
        let dt = self.robot.control.actuator_dt();
        let mean =
            |of: &[[f32; NUM_JOINTS]], joint: usize| f64::from(f32::midpoint(of[period][joint], of[period + 1][joint]));
        let mut state = State::<f64>::origin();
        state.q = std::array::from_fn(|joint| mean(&self.states.q, joint));
        state.dq = std::array::from_fn(|joint| mean(&self.states.dq, joint));
        let speed = &self.states.dq;
        let ddq = std::array::from_fn(|joint| f64::from(speed[period + 1][joint] - speed[period][joint]) / dt);
        let acceleration = Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq };
        let (_, torques) = inverse_dynamics(&KinematicTree::splat(&go2()), &state, &acceleration, GRAVITY);
        torques[self.joint]
    }
}
