//! Robot model of the flag `--model`, and its simulator.

use std::path::Path;

use twinstep_effects::ModelFile;
use twinstep_ensemble::ActuatorNetworkRobot;
use twinstep_logs::Log;
use twinstep_model::{RobotModel, go2};
use twinstep_sim::{BatchRollout, SimConfig};

use crate::failure::{Failure, input};

/// Returns a model file whose actuators are laws, not networks, or the ideal Go2 for `None`.
pub fn analytic_model(path: Option<&Path>) -> Result<ModelFile, Failure> {
    path.map_or(Ok(ModelFile::default()), ModelFile::load_without_actuator_network).map_err(input)
}

/// Returns the robot of a model file whose actuators are laws, or the ideal Go2 for `None`.
pub fn robot_model(path: Option<&Path>) -> Result<RobotModel, Failure> {
    path.map_or_else(|| Ok(go2()), |path| twinstep_effects::load_robot(path).map_err(input))
}

/// A robot and the simulator of its logs.
pub struct SimulatedRobot {
    /// The robot.
    pub robot: RobotModel,
    /// Contains the actuator network of the model file, if there is one.
    pub simulator: BatchRollout,
}

impl SimulatedRobot {
    /// Creates a robot without an actuator network.
    pub fn analytic(robot: RobotModel) -> Result<Self, Failure> {
        let simulator = simulator(&robot)?;
        Ok(Self { robot, simulator })
    }

    /// Reads a model file, or takes the ideal Go2 for `None`. Fails if its actuator network does not serve `log`, whose
    /// path is `log_path`.
    pub fn load(path: Option<&Path>, log: &Log, log_path: &Path) -> Result<Self, Failure> {
        let file = path.map_or(Ok(ModelFile::default()), ModelFile::load).map_err(input)?;
        let Some(learned) = ActuatorNetworkRobot::load(&file).map_err(input)? else {
            return Self::analytic(file.robot_model().map_err(input)?);
        };
        learned.check_log(&log_path.display().to_string(), log).map_err(input)?;
        Self::learned(learned)
    }

    /// Creates a robot with an actuator network, whose members' mean is applied.
    pub fn learned(learned: ActuatorNetworkRobot) -> Result<Self, Failure> {
        let robot = learned.robot.clone();
        let simulator = simulator(&robot)?
            .with_actuators(move |num_robots, robot| Box::new(learned.mean_actuators(num_robots, robot)));
        Ok(Self { robot, simulator })
    }
}

/// Returns the simulator in which models are evaluated, with analytic actuators.
pub fn simulator(robot: &RobotModel) -> Result<BatchRollout, Failure> {
    BatchRollout::new(robot, &SimConfig::default()).map_err(input)
}
