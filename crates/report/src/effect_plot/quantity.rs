//! Quantities of a simulated motion in the plot of an effect.

use twinstep_identify::experiment::estimated_torque;
use twinstep_model::{
    Command, NUM_JOINTS, PerJoint, RobotModel, RobotStates,
    dynamics::{Acceleration, KinematicTree, State, Vec3, inverse_dynamics},
    go2,
};

/// Gravitational acceleration [m/s²].
const GRAVITY: f64 = 9.81;

/// Quantity of an actuator period, of the base or of the plotted joint.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum PlotQuantity {
    /// Time since the start of the motion [s].
    Time,
    /// Encoder reading of the position [rad].
    Position,
    /// Encoder reading of the velocity [rad/s].
    Velocity,
    /// Mean acceleration over the period [rad/s²].
    Acceleration,
    /// Torque of the ideal actuator for the command and the measured state [N·m].
    CommandedTorque,
    /// Measured motor torque [N·m].
    EstimatedTorque,
    /// Motor torque minus the torque that the ideal robot needs for the same motion [N·m].
    InverseDynamicsResidual,
    /// Height of the base [m].
    Height,
    /// Position of the base, to the left [m].
    Sideways,
    /// Pitch of the base, nose down [rad].
    Pitch,
    /// Roll rate measured by the gyroscope [rad/s].
    Gyro,
    /// True roll rate of the base [rad/s].
    RollRate,
    /// Contact force on all feet [N].
    Force,
    /// Fraction of the contact force that is on the front feet.
    FrontShare,
    /// Upward acceleration of the base plus gravity [m/s²].
    VerticalAcceleration,
    /// Acceleration of the base to the left [m/s²].
    LateralAcceleration,
    /// Battery voltage [V].
    Voltage,
    /// Motor temperature [°C].
    Temperature,
    /// Factor on the torque for supply voltage and motor temperature.
    DeratingFactor,
}

/// Simulated motion of a robot.
pub struct SimulatedRun {
    /// The robot.
    pub robot: RobotModel,
    /// Command of each actuator period.
    pub commands: Vec<Command>,
    /// Battery voltage [V] and motor temperature [°C] of each actuator period.
    pub supply: Vec<[f64; 2]>,
    /// Derating factor of each joint in each actuator period.
    pub derating: Vec<PerJoint>,
    /// Index of the plotted joint.
    pub joint: usize,
    /// Number of actuator periods before time 0.
    pub settle: usize,
    /// States at the start of each actuator period and after the last one.
    pub states: RobotStates,
}

impl PlotQuantity {
    /// Returns the label of an axis, with its unit.
    pub fn label(self) -> &'static str {
        match self {
            Self::Time => "time [s]",
            Self::Position => "joint position [rad]",
            Self::Velocity => "joint velocity [rad/s]",
            Self::Acceleration => "joint acceleration [rad/s²]",
            Self::CommandedTorque => "torque of the ideal actuator [N·m]",
            Self::EstimatedTorque => "measured torque [N·m]",
            Self::InverseDynamicsResidual => "inverse-dynamics residual [N·m]",
            Self::Height => "base height [m]",
            Self::Sideways => "base position to the left [m]",
            Self::Pitch => "base pitch [rad]",
            Self::Gyro => "measured roll rate [rad/s]",
            Self::RollRate => "true roll rate [rad/s]",
            Self::Force => "force on all feet [N]",
            Self::FrontShare => "fraction on the front feet",
            Self::VerticalAcceleration => "upward acceleration + g [m/s²]",
            Self::LateralAcceleration => "acceleration to the left [m/s²]",
            Self::Voltage => "battery voltage [V]",
            Self::Temperature => "motor temperature [°C]",
            Self::DeratingFactor => "derating factor",
        }
    }

    /// Returns the value in actuator period `period` of a run.
    pub fn of(self, run: &SimulatedRun, period: usize) -> f64 {
        let (states, joint, dt) = (&run.states, run.joint, run.robot.control.actuator_dt());
        let change = |of: &dyn Fn(usize) -> f32| f64::from(of(period + 1) - of(period)) / dt;
        let feet = states.truth.foot_force[period + 1].map(f64::from);
        match self {
            Self::Time => (period as f64 - run.settle as f64) * dt,
            Self::Position => f64::from(states.measured.q[period][joint]),
            Self::Velocity => f64::from(states.measured.dq[period][joint]),
            Self::Acceleration => change(&|row| states.measured.dq[row][joint]),
            Self::CommandedTorque => run.commanded_torque(period),
            Self::EstimatedTorque => run.measured_torque(period),
            Self::InverseDynamicsResidual => {
                f64::from(states.measured.tau[period + 1][joint]) - run.required_torque(period)
            }
            Self::Height => f64::from(states.truth.base_position[period][2]),
            Self::Sideways => f64::from(states.truth.base_position[period][1]),
            Self::Pitch => {
                let [w, x, y, z] = states.measured.orientation[period].map(f64::from);
                (2.0 * (w * y - z * x)).asin()
            }
            Self::Gyro => f64::from(states.measured.gyro[period][0]),
            Self::RollRate => Self::Gyro.of(run, period) - run.robot.gyro_bias.x,
            Self::Force => feet.iter().sum(),
            Self::FrontShare => (feet[0] + feet[1]) / feet.iter().sum::<f64>(),
            Self::VerticalAcceleration => change(&|row| states.truth.base_linear_velocity[row][2]) + GRAVITY,
            Self::LateralAcceleration => change(&|row| states.truth.base_linear_velocity[row][1]),
            Self::Voltage => run.supply[period][0],
            Self::Temperature => run.supply[period][1],
            Self::DeratingFactor => f64::from(run.derating[period][joint]),
        }
    }
}

impl SimulatedRun {
    /// Returns the torque of an actuator without effects in the measured state [N·m].
    fn commanded_torque(&self, period: usize) -> f64 {
        let (command, joint) = (&self.commands[period], self.joint);
        let [q, dq] = [self.states.measured.q[period][joint], self.states.measured.dq[period][joint]];
        f64::from(command.kp[joint] * (command.q[joint] - q) - command.kd[joint] * dq)
    }

    /// Returns the measured torque of a period, with the delay of the torque sensor [N·m].
    fn measured_torque(&self, period: usize) -> f64 {
        estimated_torque(&self.states, &self.robot, self.joint, period, period + 1)
    }

    /// Returns the torque that the ideal robot with a fixed base needs for the measured motion [N·m]: inverse dynamics.
    fn required_torque(&self, period: usize) -> f64 {
        let dt = self.robot.control.actuator_dt();
        let mean =
            |of: &[[f32; NUM_JOINTS]], joint: usize| f64::from(f32::midpoint(of[period][joint], of[period + 1][joint]));
        let mut state = State::<f64>::origin();
        state.q = std::array::from_fn(|joint| mean(&self.states.measured.q, joint));
        state.dq = std::array::from_fn(|joint| mean(&self.states.measured.dq, joint));
        let speed = &self.states.measured.dq;
        let ddq = std::array::from_fn(|joint| f64::from(speed[period + 1][joint] - speed[period][joint]) / dt);
        let acceleration = Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq };
        let (_, torques) = inverse_dynamics(&KinematicTree::splat(&go2()), &state, &acceleration, GRAVITY);
        torques[self.joint]
    }
}
