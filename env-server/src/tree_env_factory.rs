//! Environments of robots of any tree.

use std::path::Path;

use twinstep_effects::{NominalGain, TreeModelFile};
use twinstep_envs::{ControlledRobot, PoseConfig, PoseTask, Randomisation, TaskConfig};
use twinstep_model::{AutoresetMode, BaseMount, JOINT_NAMES, RobotTree, TreeModel, VecEnv, go2};
use twinstep_protocol::random_u64;
use twinstep_sim::{BackendBuildError, Placement, SimConfig, Terrain, TreeSimulation};

use crate::tree_env::TreeEnv;
use crate::{Config, EnvFactory, EnvFactoryError};

/// Rate of actuators and policy [Hz] and joint offset of an action of 1 [rad] if the model file states none.
const ACTUATOR_HZ: f64 = 200.0;
const POLICY_HZ: f64 = 50.0;
const ACTION_SCALE: f64 = 0.25;

/// Builds environments of the task `pose` for the robot of a model file, of any tree.
pub struct TreeEnvFactory {
    task: PoseConfig,
    sim: SimConfig,
    robot: TreeModel,
    control: ControlledRobot,
    seed: u64,
}

impl TreeEnvFactory {
    /// Reads the model file and checks the settings. Default: the ideal Go2.
    pub fn new(config: &Config) -> Result<Self, EnvFactoryError> {
        if config.control.is_some() {
            return Err(EnvFactoryError::ContractOfQuadrupeds);
        }
        let TaskConfig::Pose(task) = &config.task else {
            return Err(refused("task.name", "a robot of any tree has the task `pose`"));
        };
        if config.randomise != Randomisation::default() {
            return Err(refused("randomise", "robots of the task `pose` are not randomised yet; leave it out"));
        }
        if config.sim.terrain != Terrain::Flat {
            return Err(refused("sim.terrain", "the task `pose` is on flat ground; use \"flat\""));
        }
        let file = match &config.server.model {
            Some(path) => model(path)?,
            None => ideal_go2(),
        };
        let robot = file.tree_model().expect("the file was checked when it was read");
        let control = controlled_robot(&file, &robot, config.sim.base)?;
        let seed = config.server.seed.unwrap_or_else(random_u64);
        let factory = Self { task: task.clone(), sim: config.sim, robot, control, seed };
        factory.simulation(1)?;
        Ok(factory)
    }

    /// Returns the name of the robot.
    pub fn robot_name(&self) -> &str {
        &self.control.name
    }

    /// Returns the tree of the robot.
    pub fn tree(&self) -> &RobotTree {
        &self.robot.tree
    }

    fn simulation(&self, num_envs: usize) -> Result<TreeSimulation, BackendBuildError> {
        let start = Placement::of(&self.robot.tree, self.control.default_pose.clone());
        TreeSimulation::new(&self.robot, &self.sim, 1.0 / self.control.actuator_dt, num_envs, &start)
    }
}

impl EnvFactory for TreeEnvFactory {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        max_episode_steps: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        let task = PoseTask::new(self.task.clone(), self.control.clone(), max_episode_steps)?;
        let simulation = self.simulation(num_envs)?;
        Ok(Box::new(TreeEnv::new(task, self.robot.clone(), simulation, autoreset, self.seed)))
    }
}

fn refused(field: &'static str, reason: &'static str) -> EnvFactoryError {
    EnvFactoryError::NotOfAnyTree { field, reason }
}

fn model(path: &Path) -> Result<TreeModelFile, EnvFactoryError> {
    let file = TreeModelFile::load(path)?;
    if file.robot != "go2" {
        return Ok(file);
    }
    // What a file leaves out is that of the policies of the Go2.
    let default = ideal_go2();
    let default_pose = if file.default_pose.is_empty() { default.default_pose } else { file.default_pose };
    Ok(TreeModelFile {
        kp: file.kp.or(default.kp),
        kd: file.kd.or(default.kd),
        action_scale: file.action_scale.or(default.action_scale),
        default_pose,
        ..file
    })
}

/// Returns the ideal Go2 with the gains and the pose of its policies.
fn ideal_go2() -> TreeModelFile {
    let control = go2().control;
    let pose = JOINT_NAMES.iter().map(|name| (*name).to_owned()).zip(control.default_pose).collect();
    TreeModelFile {
        kp: Some(NominalGain::All(control.kp[0])),
        kd: Some(NominalGain::All(control.kd[0])),
        default_pose: pose,
        action_scale: Some(control.action_scale),
        ..TreeModelFile::go2()
    }
}

fn controlled_robot(
    file: &TreeModelFile,
    robot: &TreeModel,
    base: BaseMount,
) -> Result<ControlledRobot, EnvFactoryError> {
    let joints: Vec<String> = robot.tree.joints.iter().map(|joint| joint.name.clone()).collect();
    let gain = |key: &'static str, gains: &Option<NominalGain>, joint: &str| {
        let missing = || EnvFactoryError::NoGain { key, joint: joint.to_owned() };
        gains.as_ref().and_then(|gains| gains.of(joint)).ok_or_else(missing)
    };
    let gains = joints.iter().map(|joint| Ok([gain("kp", &file.kp, joint)?, gain("kd", &file.kd, joint)?]));
    let gains = gains.collect::<Result<Vec<_>, EnvFactoryError>>()?;
    let (actuator_hz, policy_hz) = (file.actuator_hz.unwrap_or(ACTUATOR_HZ), file.policy_hz.unwrap_or(POLICY_HZ));
    let decimation = (actuator_hz / policy_hz).round().max(1.0);
    if (decimation * policy_hz - actuator_hz).abs() > 1e-6 * actuator_hz {
        return Err(refused("control.policy_hz", "`actuator_hz` must be a multiple of it"));
    }
    let default_pose = file.pose();
    let is_fixed = base.is_fixed() || robot.tree.base.is_some_and(BaseMount::is_fixed);
    Ok(ControlledRobot {
        name: robot.tree.name.clone(),
        standing_height: (!is_fixed).then(|| robot.tree.standing_height(&default_pose)),
        joints,
        gains,
        default_pose,
        ranges: robot.joints.iter().map(|joint| joint.range).collect(),
        torque_limits: robot.joints.iter().map(|joint| joint.torque_limit).collect(),
        action_scale: file.action_scale.unwrap_or(ACTION_SCALE),
        actuator_dt: 1.0 / actuator_hz,
        decimation: decimation as usize,
    })
}
