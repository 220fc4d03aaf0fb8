//! The robot of a model file whose actuators an ensemble replaces or completes, with a check of the other effects.

use twinstep_effects::EffectEntry;
use twinstep_effects::{ActuatorNetworkConfig, ModelFile, NetworkMode};
use twinstep_logs::replay::at_log_rate;
use twinstep_logs::{Log, TorqueSensor};
use twinstep_model::{ActuatorMode, ActuatorTap, JOINT_NAMES, NUM_JOINTS, RobotModel};
use twinstep_simd::InstructionSet;

use crate::EnsembleError;
use crate::actuator_network::{ActuatorNetwork, Combination, NetworkUse};
use crate::ensemble::Ensemble;
use crate::metadata::JointEncoding;
use crate::network_input::NetworkInput;

/// Last stage of the actuator chain that an ensemble replaces, for a motor-current sensor and a joint-output sensor.
const LAST_REPLACED_STAGE: [u32; 2] = [9, 14];

/// A robot with actuator networks.
#[derive(Clone, Debug)]
pub struct ActuatorNetworkRobot {
    /// The robot without the replaced stages. Its gains are those of the training data, if the networks know only these.
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

    /// Replaces or completes the actuators of the robot of `file` by `ensemble`.
    ///
    /// # Panics
    /// If the effects of the file are not compatible, which reading a model file checks.
    pub fn new(file: &ModelFile, ensemble: Ensemble, settings: ActuatorNetworkConfig) -> Result<Self, EnsembleError> {
        let mut robot = file.robot_model().expect("the model file was checked when it was read");
        let model = &ensemble.description;
        ensemble.check_rate("the robot's actuator", robot.control.actuator_dt())?;
        model.check_mode(settings.mode)?;
        if model.input == NetworkInput::Errors {
            [robot.control.kp, robot.control.kd] = model.uniform_gains()?.map(|gain| [gain; NUM_JOINTS]);
        }
        let unknown = (0..JOINT_NAMES.len()).find(|joint| model.one_hot_index(*joint).is_none());
        if let Some(joint) = unknown.filter(|_| model.joint_input == JointEncoding::Identity) {
            return Err(EnsembleError::UnknownJoint { joint: JOINT_NAMES[joint] });
        }
        let replaces = settings.mode == NetworkMode::Replace;
        if replaces {
            check_effects(file, model.tau_sensor)?;
        }
        if replaces && model.tau_sensor == TorqueSensor::JointOutput {
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

    /// Returns actuators of `num_robots` robots that apply the mean of all members, the best prediction, at the actuator
    /// rate of `robot`.
    pub fn mean_actuators(&self, num_robots: usize, robot: &RobotModel) -> ActuatorNetwork {
        self.create(num_robots, Combination::Mean, robot.control.actuator_dt(), InstructionSet::best())
    }

    /// Returns the same robot with actuators at `actuator_hz` [Hz], not slower than the networks.
    pub fn at_rate(&self, actuator_hz: f64) -> Result<Self, EnsembleError> {
        let mut this = self.clone();
        this.robot.control.actuator_hz = actuator_hz;
        this.ensemble.check_rate("the robot's actuator", this.robot.control.actuator_dt())?;
        Ok(this)
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
        let combination = if run_all_members { Combination::OneMemberOfAll } else { Combination::OneMember };
        self.create(num_robots, combination, self.robot.control.actuator_dt(), instructions)
    }

    fn create(
        &self,
        num_robots: usize,
        combination: Combination,
        actuator_dt: f64,
        instructions: InstructionSet,
    ) -> ActuatorNetwork {
        let sensor = self.ensemble.description.tau_sensor;
        // The torque at the joint output can exceed that of the motor because of the rotor inertia.
        let limits = match sensor {
            TorqueSensor::JointOutput => [f32::INFINITY; 12],
            TorqueSensor::MotorCurrent | TorqueSensor::None => self.robot.torque_limits(),
        };
        let tap = match sensor {
            TorqueSensor::JointOutput => ActuatorTap::Output,
            TorqueSensor::MotorCurrent | TorqueSensor::None => ActuatorTap::Current,
        };
        let mode = match self.settings.mode {
            NetworkMode::Replace => ActuatorMode::Replace(tap),
            NetworkMode::Residual => ActuatorMode::AddAt(tap),
        };
        let used = NetworkUse { combination, mode, limits, actuator_dt };
        ActuatorNetwork::new(&self.ensemble, &self.settings, used, num_robots, instructions)
    }

    /// Returns whether the ensemble replaces the actuators or is added to them.
    pub fn mode(&self) -> NetworkMode {
        self.settings.mode
    }

    /// Returns true if the networks are valid for the gains of their training data only.
    pub fn has_fixed_gains(&self) -> bool {
        self.ensemble.description.input == NetworkInput::Errors
    }

    /// Returns true if the ensemble includes the rotor inertia. Every simulated robot must then have none.
    pub fn includes_rotor(&self) -> bool {
        self.settings.mode == NetworkMode::Replace && self.ensemble.description.tau_sensor == TorqueSensor::JointOutput
    }

    /// Checks that the networks can be evaluated on the rows of a log: its rate, and its gains if they know only some.
    ///
    /// `name` is the log's name in errors.
    pub fn check_log(&self, name: &str, log: &Log) -> Result<(), EnsembleError> {
        if let Ok(robot) = at_log_rate(log, &self.robot) {
            self.ensemble.check_rate(name, robot.control.actuator_dt())?;
        }
        if !self.has_fixed_gains() {
            return Ok(());
        }
        let [kp, kd] = self.ensemble.description.uniform_gains()?;
        for joint in log.joints() {
            if let Some(row) = log.tau_ff(joint).and_then(|torque| torque.iter().position(|torque| *torque != 0.0)) {
                return Err(EnsembleError::FeedForward { log: name.to_owned(), joint: joint.clone(), row });
            }
            let gains = |row| (log.kp(joint, row), log.kd(joint, row));
            if let Some(row) = (0..log.rows()).find(|row| gains(*row) != (Some(kp), Some(kd))) {
                let (kp, kd) = gains(row);
                let [kp, kd] = [kp, kd].map(|gain| gain.unwrap_or(f64::NAN));
                return Err(EnsembleError::GainsChange { log: name.to_owned(), joint: joint.clone(), row, kp, kd });
            }
        }
        Ok(())
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
