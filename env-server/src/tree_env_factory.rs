//! Environments of robots of any tree.

use std::path::Path;

use twinstep_effects::{NominalGain, RobotSampler, TreeModelFile};
use twinstep_envs::{ControlledRobot, PoseTask, Randomisation, Task, TaskConfig, Walk};
use twinstep_model::{AutoresetMode, BaseMount, Feet, JOINT_NAMES, RobotTree, TreeModel, VecEnv, go2};
use twinstep_protocol::random_u64;
use twinstep_sim::{BackendBuildError, Engine, Placement, SimConfig, Terrain, TreeSimulation};

use crate::tree_env::{TreeEnv, TreeEnvConfig};
use crate::{Config, EnvFactory, EnvFactoryError};

/// Rate of actuators and policy [Hz] if the model file states none.
const ACTUATOR_HZ: f64 = 200.0;
const POLICY_HZ: f64 = 50.0;
/// Joint offset of an action of 1 [rad] if neither model file nor torque limits state one.
const ACTION_SCALE: f64 = 0.25;
/// Share of the torque limit that an action of 1 exerts at rest, if the model file states no action scale: that of the Go2.
const ACTION_TORQUE: f64 = 0.5;
/// Range of the action scale that follows from torque limits [rad].
const ACTION_SCALES: [f64; 2] = [0.1, 1.0];

/// Builds environments of the tasks `pose` and `walk` for the robot of a model file, of any tree.
pub struct TreeEnvFactory {
    task: TaskConfig,
    randomise: Randomisation,
    /// `None` unless the effects are sampled in each episode.
    sampler: Option<RobotSampler<TreeModelFile>>,
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
        if !matches!(config.task, TaskConfig::Pose(_) | TaskConfig::Walk(_)) {
            return Err(refused("task.name", "a robot of any tree has the tasks `pose` and `walk`"));
        }
        if config.task.epistemic_uncertainty_weight().1 != 0.0 {
            return Err(refused(
                "task.reward.epistemic_uncertainty",
                "a robot of any tree has no actuator networks; use 0",
            ));
        }
        if matches!((config.sim.terrain, &config.task), (Terrain::Course(_), TaskConfig::Pose(_))) {
            return Err(refused("sim.terrain", "a course is for the task `walk`; `pose` has another ground"));
        }
        let file = match &config.server.model {
            Some(path) => model(path)?,
            None => ideal_go2(),
        };
        let robot = file.tree_model().expect("the file was checked when it was read");
        let control = controlled_robot(&file, &robot, config.sim.base)?;
        let seed = config.server.seed.unwrap_or_else(random_u64);
        let (task, randomise, sim) = (config.task.clone(), config.randomise, config.sim);
        randomise.check()?;
        if control.standing_height.is_some() {
            randomise.check_base(robot.tree.bodies[0].inertia.mass)?;
        }
        if sim.engine == Engine::Mujoco && randomise.command_delay_ms != [0.0, 0.0] {
            let reason = "the engine `mujoco` has no delay for a robot of any tree; use [0, 0], or `batch`";
            return Err(refused("randomise.command_delay_ms", reason));
        }
        if randomise.has_pushes() && control.standing_height.is_none() {
            return Err(refused("randomise.push_m_s", "the base of the robot is fixed; use [0, 0]"));
        }
        let sampler = if randomise.effects { Some(RobotSampler::new(file)?) } else { None };
        let factory = Self { task, randomise, sampler, sim, robot, control, seed };
        factory.build(1, AutoresetMode::Disabled, None)?;
        Ok(factory)
    }

    /// Returns the name of the robot.
    pub fn robot_name(&self) -> &str {
        &self.control.name
    }

    /// Returns the robot as its task sees it.
    pub fn control(&self) -> &ControlledRobot {
        &self.control
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
        let simulation = self.simulation(num_envs)?;
        let (ground, randomise, seed) = (self.sim.terrain.ground(), self.randomise, self.seed);
        let sampler = self.sampler.clone();
        let settings = TreeEnvConfig { ground, randomise, sampler, autoreset, max_episode_steps, seed };
        let control = self.control.clone();
        match &self.task {
            TaskConfig::Walk(config) => Ok(self.env(Walk::of(config.clone(), control, true)?, simulation, settings)),
            TaskConfig::Pose(config) => Ok(self.env(PoseTask::new(config.clone(), control)?, simulation, settings)),
            _ => unreachable!("`new` has refused the others"),
        }
    }
}

impl TreeEnvFactory {
    fn env<T: Task + 'static>(&self, task: T, simulation: TreeSimulation, settings: TreeEnvConfig) -> Box<dyn VecEnv> {
        Box::new(TreeEnv::new(task, self.control.clone(), self.robot.clone(), simulation, settings))
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
    let of_robot_file = &file.of_robot_file.gains;
    let gain = |joint: usize, part: usize| {
        let (key, gains) = [("kp", &file.kp), ("kd", &file.kd)][part];
        let name = &joints[joint];
        let stated = gains.as_ref().and_then(|gains| gains.of(name));
        // Gains of a joint without actuator have no effect.
        let passive = (robot.joints[joint].torque_limit == 0.0).then_some(0.0);
        let missing = || EnvFactoryError::NoGain { key, joint: name.clone() };
        stated.or_else(|| Some(of_robot_file.get(name)?[part])).or(passive).ok_or_else(missing)
    };
    let gains = (0..joints.len()).map(|joint| Ok([gain(joint, 0)?, gain(joint, 1)?]));
    let gains = gains.collect::<Result<Vec<_>, EnvFactoryError>>()?;
    let (actuator_hz, policy_hz) = (file.actuator_hz.unwrap_or(ACTUATOR_HZ), file.policy_hz.unwrap_or(POLICY_HZ));
    let decimation = (actuator_hz / policy_hz).round().max(1.0);
    if (decimation * policy_hz - actuator_hz).abs() > 1e-6 * actuator_hz {
        return Err(refused("control.policy_hz", "`actuator_hz` must be a multiple of it"));
    }
    let action_scale = file.action_scale.unwrap_or_else(|| action_scale(robot, &gains));
    let default_pose = file.pose();
    let is_fixed = base.is_fixed() || robot.tree.base.is_some_and(BaseMount::is_fixed);
    let controlled = ControlledRobot {
        name: robot.tree.name.clone(),
        standing_height: (!is_fixed).then(|| robot.tree.standing_height(&default_pose)),
        joints,
        gains,
        default_pose,
        ranges: robot.joints.iter().map(|joint| joint.range).collect(),
        torque_limits: robot.joints.iter().map(|joint| joint.torque_limit).collect(),
        action_scale,
        actuator_dt: 1.0 / actuator_hz,
        decimation: decimation as usize,
        mass: robot.tree.total_mass(),
        feet: Feet::new(&robot.tree, Vec::new()),
        hips: Vec::new(),
    };
    Ok(controlled.with_feet(robot, &file.groups)?)
}

/// Returns the joint offset at which the median joint exerts [`ACTION_TORQUE`] of its torque limit [rad].
fn action_scale(robot: &TreeModel, gains: &[[f64; 2]]) -> f64 {
    let joints = robot.joints.iter().zip(gains);
    let mut offsets: Vec<_> = joints
        .map(|(joint, [kp, _])| ACTION_TORQUE * joint.torque_limit / kp)
        .filter(|offset| offset.is_finite() && *offset > 0.0)
        .collect();
    offsets.sort_by(f64::total_cmp);
    let median = offsets.get(offsets.len() / 2).copied();
    median.map_or(ACTION_SCALE, |offset| offset.clamp(ACTION_SCALES[0], ACTION_SCALES[1]))
}
