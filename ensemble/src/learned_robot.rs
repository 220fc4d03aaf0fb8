//! A model file's robot with an ensemble in place of its drives: what goes together, and what is left to simulate.

use twinstep_logs::TorqueSensor;
use twinstep_model::effects::EffectEntry;
use twinstep_model::lanes::InstructionSet;
use twinstep_model::{JOINT_NAMES, ActuatorNetworkConfig, ModelFile, RobotModel};

use crate::EnsembleError;
use crate::drives::ActuatorNetwork;
use crate::ensemble::{Ensemble, JointEncoding};

/// The last step of the chain up to the motor's current, and up to the joint's output.
const LAST_REPLACED_STAGE: [u32; 2] = [9, 14];

/// A robot whose drives are learned.
#[derive(Clone, Debug)]
pub struct ActuatorNetworkRobot {
    /// The robot without what the ensemble stands for; its gains are those that the ensemble learnt with.
    pub robot: RobotModel,
    ensemble: Ensemble,
    settings: ActuatorNetworkConfig,
}

impl ActuatorNetworkRobot {
    /// The robot of `file` with the ensemble that it names; none if it names none.
    pub fn load(file: &ModelFile) -> Result<Option<Self>, EnsembleError> {
        let Some(settings) = &file.actuator else { return Ok(None) };
        Self::new(file, Ensemble::read(&settings.ensemble)?, settings.clone()).map(Some)
    }

    /// The robot of `file` with `ensemble`.
    ///
    /// # Panics
    /// If the file's effects do not go together, which reading it has ruled out.
    pub fn new(file: &ModelFile, ensemble: Ensemble, settings: ActuatorNetworkConfig) -> Result<Self, EnsembleError> {
        let mut robot = file.robot_model().expect("a file that was read is of a robot");
        let model = &ensemble.description;
        ensemble.check_step("the robot's drive", robot.control.actuator_dt())?;
        [robot.control.kp, robot.control.kd] = model.uniform_gains()?;
        let unknown = (0..JOINT_NAMES.len()).find(|joint| model.one_hot_index(*joint).is_none());
        if let Some(joint) = unknown.filter(|_| model.joint_input == JointEncoding::Identity) {
            return Err(EnsembleError::UnknownJoint { joint: JOINT_NAMES[joint] });
        }
        file.effects.iter().try_for_each(|entry| check_compatible(entry, model.tau_sensor))?;
        if model.tau_sensor == TorqueSensor::JointOutput {
            // The rotor turned while they learnt, and is in what they learnt.
            robot.joints.iter_mut().for_each(|joint| joint.armature = 0.0);
        }
        Ok(Self { robot, ensemble, settings })
    }

    /// The drives of `num_robots` robots. With `uncertain` all members run, so that what they do not know is known.
    pub fn actuators(&self, num_robots: usize, run_all_members: bool) -> ActuatorNetwork {
        self.drives_with(num_robots, run_all_members, InstructionSet::best())
    }

    /// As [`LearnedRobot::drives`], with these instructions.
    ///
    /// # Panics
    /// If the processor lacks them.
    pub fn drives_with(&self, num_robots: usize, uncertain: bool, instructions: InstructionSet) -> ActuatorNetwork {
        // Behind the rotor a torque may be larger than the motor's.
        let limits = match self.ensemble.description.tau_sensor {
            TorqueSensor::JointOutput => [f32::INFINITY; 12],
            TorqueSensor::MotorCurrent | TorqueSensor::None => self.robot.torque_limits(),
        };
        ActuatorNetwork::new(&self.ensemble, &self.settings, uncertain, limits, num_robots, instructions)
    }

    /// Whether the ensemble stands for the rotor, which every robot that is simulated with it must then lack.
    pub fn includes_rotor(&self) -> bool {
        self.ensemble.description.tau_sensor == TorqueSensor::JointOutput
    }
}

/// Fails if an effect is one of the steps that an ensemble with such a sensor stands for.
fn check_compatible(entry: &EffectEntry, sensor: TorqueSensor) -> Result<(), EnsembleError> {
    let (tap, last) = match sensor {
        TorqueSensor::JointOutput => ("output", LAST_REPLACED_STAGE[1]),
        TorqueSensor::MotorCurrent | TorqueSensor::None => ("current", LAST_REPLACED_STAGE[0]),
    };
    let (effect, place) = (entry.effect.name, entry.effect.chain_stage);
    let step: Option<u32> = place.split(',').next().and_then(|step| step.parse().ok());
    // The tap's own delay is in what the networks learnt too.
    if step.map_or(place.starts_with("tap"), |step| step <= last) {
        return Err(EnsembleError::StandsFor { effect, scope: entry.scope.to_string(), tap, last, place });
    }
    Ok(())
}
