//! Quantities of a simulated motion in the plot of an effect.

use twinstep_dynamics::Vec3;
use twinstep_dynamics::quadruped::{Acceleration, KinematicTree, QuadrupedState, inverse_dynamics};
use twinstep_effects::PlotQuantity;
use twinstep_identify::experiment::estimated_torque;
use twinstep_model::{Command, NUM_JOINTS, PerJoint, RobotModel, RobotStates, go2};

/// Gravitational acceleration [m/s²].
const GRAVITY: f64 = 9.81;

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

/// Returns the value of a quantity in actuator period `period` of a run.
pub fn value(quantity: PlotQuantity, run: &SimulatedRun, period: usize) -> f64 {
    let (states, joint, dt) = (&run.states, run.joint, run.robot.control.actuator_dt());
    let change = |of: &dyn Fn(usize) -> f32| f64::from(of(period + 1) - of(period)) / dt;
    let feet = states.truth.foot_force[period + 1].map(f64::from);
    match quantity {
        PlotQuantity::Time => (period as f64 - run.settle as f64) * dt,
        PlotQuantity::Position => f64::from(states.measured.q[period][joint]),
        PlotQuantity::Velocity => f64::from(states.measured.dq[period][joint]),
        PlotQuantity::Acceleration => change(&|row| states.measured.dq[row][joint]),
        PlotQuantity::CommandedTorque => run.commanded_torque(period),
        PlotQuantity::EstimatedTorque => run.measured_torque(period),
        PlotQuantity::InverseDynamicsResidual => {
            f64::from(states.measured.tau[period + 1][joint]) - run.required_torque(period)
        }
        PlotQuantity::Height => f64::from(states.truth.base_position[period][2]),
        PlotQuantity::Sideways => f64::from(states.truth.base_position[period][1]),
        PlotQuantity::Pitch => {
            let [w, x, y, z] = states.measured.orientation[period].map(f64::from);
            (2.0 * (w * y - z * x)).asin()
        }
        PlotQuantity::Gyro => f64::from(states.measured.gyro[period][0]),
        PlotQuantity::RollRate => f64::from(states.truth.base_angular_velocity[period][0]),
        PlotQuantity::Force => feet.iter().sum(),
        PlotQuantity::FrontShare => (feet[0] + feet[1]) / feet.iter().sum::<f64>(),
        PlotQuantity::VerticalAcceleration => change(&|row| states.truth.base_linear_velocity[row][2]) + GRAVITY,
        PlotQuantity::LateralAcceleration => change(&|row| states.truth.base_linear_velocity[row][1]),
        PlotQuantity::Voltage => run.supply[period][0],
        PlotQuantity::Temperature => run.supply[period][1],
        PlotQuantity::DeratingFactor => f64::from(run.derating[period][joint]),
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
        let mut state = QuadrupedState::<f64>::origin(NUM_JOINTS);
        state.q = std::array::from_fn(|joint| mean(&self.states.measured.q, joint));
        state.dq = std::array::from_fn(|joint| mean(&self.states.measured.dq, joint));
        let speed = &self.states.measured.dq;
        let ddq = std::array::from_fn(|joint| f64::from(speed[period + 1][joint] - speed[period][joint]) / dt);
        let acceleration = Acceleration { angular: Vec3::zero(), linear: Vec3::zero(), ddq };
        let (_, torques) = inverse_dynamics(&KinematicTree::splat(&go2()), &state, &acceleration, GRAVITY);
        torques[self.joint]
    }
}
