//! The robot of a model file whose actuators are replaced by an ensemble, with a check of the remaining effects.

use twinstep_effects::EffectEntry;
use twinstep_effects::{ActuatorNetworkConfig, ModelFile};
use twinstep_logs::TorqueSensor;
use twinstep_model::{JOINT_NAMES, RobotModel};
use twinstep_simd::InstructionSet;

use crate::EnsembleError;
use crate::actuator_network::ActuatorNetwork;
use crate::ensemble::Ensemble;
use crate::metadata::JointEncoding;

/// Last stage of the actuator chain that an ensemble replaces, for a motor-current sensor and a joint-output sensor.
const LAST_REPLACED_STAGE: [u32; 2] = [9, 14];

/// A robot with actuator networks.
#[derive(Clone, Debug)]
pub struct ActuatorNetworkRobot {
    /// The robot without the replaced stages. Its gains are those of the training data.
    pub robot: RobotModel,
    ensemble: Ensemble,
    settings: ActuatorNetworkConfig,
}

impl ActuatorNetworkRobot {
    /// Loads the ensemble that `file` names. Returns `None` if it names none.
    pub fn load(file: &ModelFile) -> Result<Option<Self>, EnsembleError> {
        let Some(settings) = &file.actuator else { return Ok(None) };
        Self::new(file, Ensemble::read(&settings.ensemble)?, settings.clone()).map(Some)
    }

    /// Replaces the actuators of the robot of `file` by `ensemble`.
    ///
    /// # Panics
    /// If the effects of the file are not compatible, which reading a model file checks.
    pub fn new(file: &ModelFile, ensemble: Ensemble, settings: ActuatorNetworkConfig) -> Result<Self, EnsembleError> {
        let mut robot = file.robot_model().expect("the model file was checked when it was read");
        let model = &ensemble.description;
        ensemble.check_step("the robot's actuator", robot.control.actuator_dt())?;
        [robot.control.kp, robot.control.kd] = model.uniform_gains()?;
        let unknown = (0..JOINT_NAMES.len()).find(|joint| model.one_hot_index(*joint).is_none());
        if let Some(joint) = unknown.filter(|_| model.joint_input == JointEncoding::Identity) {
            return Err(EnsembleError::UnknownJoint { joint: JOINT_NAMES[joint] });
        }
        check_effects(file, model.tau_sensor)?;
        if model.tau_sensor == TorqueSensor::JointOutput {
            // The training data contain the torque of the rotor inertia.
            robot.joints.iter_mut().for_each(|joint| joint.armature = 0.0);
        }
        Ok(Self { robot, ensemble, settings })
    }

    /// Returns the actuators of `num_robots` robots.
    ///
    /// With `run_all_members` they also compute the epistemic uncertainty.
    pub fn actuators(&self, num_robots: usize, run_all_members: bool) -> ActuatorNetwork {
        self.actuators_with(num_robots, run_all_members, InstructionSet::best())
    }

    /// Returns actuators like [`ActuatorNetworkRobot::actuators`] on a given instruction set.
    ///
    /// # Panics
    /// If the processor does not support the instruction set.
    pub fn actuators_with(
        &self,
        num_robots: usize,
        run_all_members: bool,
        instructions: InstructionSet,
    ) -> ActuatorNetwork {
        // The torque at the joint output can exceed that of the motor because of the rotor inertia.
        let limits = match self.ensemble.description.tau_sensor {
            TorqueSensor::JointOutput => [f32::INFINITY; 12],
            TorqueSensor::MotorCurrent | TorqueSensor::None => self.robot.torque_limits(),
        };
        ActuatorNetwork::new(&self.ensemble, &self.settings, run_all_members, limits, num_robots, instructions)
    }

    /// Returns true if the ensemble includes the rotor inertia. Every simulated robot must then have none.
    pub fn includes_rotor(&self) -> bool {
        self.ensemble.description.tau_sensor == TorqueSensor::JointOutput
    }
}

/// Checks that no effect of `file` belongs to a stage that an ensemble with this torque sensor replaces.
pub fn check_effects(file: &ModelFile, sensor: TorqueSensor) -> Result<(), EnsembleError> {
    file.effects.iter().try_for_each(|entry| check_compatible(entry, sensor))
}

/// Checks that an effect does not belong to a stage that an ensemble with this torque sensor replaces.
fn check_compatible(entry: &EffectEntry, sensor: TorqueSensor) -> Result<(), EnsembleError> {
    let (tap, last) = match sensor {
        TorqueSensor::JointOutput => ("output", LAST_REPLACED_STAGE[1]),
        TorqueSensor::MotorCurrent | TorqueSensor::None => ("current", LAST_REPLACED_STAGE[0]),
    };
    let (effect, place) = (entry.effect.name, entry.effect.chain_stage);
    let step: Option<u32> =
        place.split(',').next().and_then(|step| step.trim_end_matches(char::is_alphabetic).parse().ok());
    // The training data contain the delay of the torque sensor as well.
    if step.map_or(place.starts_with("tap"), |step| step <= last) {
        return Err(EnsembleError::StandsFor { effect, scope: entry.scope.to_string(), tap, last, place });
    }
    Ok(())
}
