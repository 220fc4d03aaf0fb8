//! Robots of any tree, in one of the three engines.

use std::sync::Arc;

use twinstep_dynamics::tree::TreeStructure;
use twinstep_model::{FreeJoint, TreeModel};
use twinstep_simd::InstructionSet;

use crate::batch::{SimdPrecision, tree_batches};
use crate::mujoco::MujocoTrees;
use crate::rapier_trees::RapierTrees;
use crate::thread_pool::thread_pool;
use crate::tree_engine::{TreeCommand, TreeEngine, TreeReadings};
use crate::tree_error::TreeError;
use crate::{BackendBuildError, Engine, Placement, SimConfig, SimConfigError};

/// Simulation of robots of one tree; their numbers may differ.
pub struct TreeSimulation {
    engine: Box<dyn TreeEngine>,
    states: Vec<TreeReadings>,
    /// Robot of the first reset: the others have its tree.
    robot: TreeModel,
    pool: Option<Arc<rayon::ThreadPool>>,
    /// Physics steps per actuator period.
    steps: usize,
    has_fixed_base: bool,
}

impl TreeSimulation {
    /// Creates `num_robots` robots in a state, whose actuators have the rate `actuator_hz` [Hz], in single precision and the widest
    /// registers.
    ///
    /// The base of `robot` moves if `config` says floating and the robot's tree does not fix it. Fails if the engine of `config` does not
    /// simulate an effect of the robot, if the robot has no joint, and if a setting or the initial state is not allowed.
    pub fn new(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_hz: f64,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Result<Self, BackendBuildError> {
        let precision = SimdPrecision::Single(InstructionSet::best());
        Self::with_precision(robot, config, actuator_hz, precision, num_robots, initial_state)
    }

    /// Creates robots like [`TreeSimulation::new`], in the given precision. Only the batch engine has a choice.
    pub fn with_precision(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_hz: f64,
        precision: SimdPrecision,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Result<Self, BackendBuildError> {
        config.check(actuator_hz)?;
        initial_state.check(robot.joints.len())?;
        let mut config = config.at_actuator_rate(actuator_hz);
        if let Some(mount) = robot.tree.base.filter(|mount| mount.is_fixed()) {
            config.base = mount;
        }
        let engine: Box<dyn TreeEngine> = match config.engine {
            _ if robot.joints.is_empty() => {
                return Err(refused("robot", &robot.tree.name, "a robot with joints").into());
            }
            Engine::Rapier if robot.tree.free_joint != FreeJoint::default() => {
                let allowed = "`batch` for a robot whose free joint has armature, damping or friction";
                return Err(refused("engine", "rapier", allowed).into());
            }
            Engine::Batch => {
                // A base that is held has no equations, which a base without mass, as in many URDF files, does not solve.
                let mut robot = robot.clone();
                robot.tree.base = Some(config.base);
                tree_batches(precision, &robot, &config, 1.0 / actuator_hz, num_robots, initial_state)
            }
            Engine::Rapier => Box::new(RapierTrees::new(robot, &config, 1.0 / actuator_hz, num_robots, initial_state)),
            Engine::Mujoco => Box::new(MujocoTrees::new(robot, &config, actuator_hz, num_robots, initial_state)?),
        };
        let pool = if config.threads == 1 { None } else { Some(thread_pool(config.threads)?) };
        let mut states = vec![TreeReadings::zero(robot); num_robots];
        states.iter_mut().enumerate().for_each(|(robot, readings)| engine.read(robot, readings));
        let (steps, has_fixed_base) = (config.steps_per_actuator_period(actuator_hz), config.base.is_fixed());
        Ok(Self { engine, states, robot: robot.clone(), pool, steps, has_fixed_base })
    }

    /// Returns the number of robots.
    pub fn num_robots(&self) -> usize {
        self.states.len()
    }

    /// Resets a robot to a state, with the parameters of `model`, which has the same tree.
    pub fn reset(&mut self, robot: usize, model: &TreeModel, state: &Placement) -> Result<(), TreeError> {
        if robot >= self.num_robots() {
            return Err(TreeError::RobotOutOfRange { robot, num_robots: self.num_robots() });
        }
        check_tree(&self.robot, model)?;
        state.check(model.joints.len())?;
        self.engine.place(robot, model, state)?;
        self.engine.read(robot, &mut self.states[robot]);
        Ok(())
    }

    /// Adds a velocity [m/s] to that of a robot's base, in the world frame. Fails if the base is fixed.
    pub fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), TreeError> {
        if robot >= self.num_robots() {
            return Err(TreeError::RobotOutOfRange { robot, num_robots: self.num_robots() });
        }
        if self.has_fixed_base {
            return Err(TreeError::FixedBase { name: self.robot.tree.name.clone() });
        }
        self.engine.push(robot, velocity)?;
        self.engine.read(robot, &mut self.states[robot]);
        Ok(())
    }

    /// Advances every robot by `actuator_periods` under its command.
    pub fn step(&mut self, commands: &[TreeCommand], actuator_periods: usize) -> Result<(), TreeError> {
        let (given, expected) = (commands.len(), self.num_robots());
        if given != expected {
            return Err(TreeError::WrongLength { field: "commands", given, expected, per: "robot" });
        }
        commands.iter().try_for_each(|command| command.check(self.robot.joints.len()))?;
        let Self { engine, states, pool, steps, .. } = self;
        let count = [actuator_periods, *steps];
        match pool {
            Some(pool) => pool.install(|| engine.advance(commands, count, states, true)),
            None => engine.advance(commands, count, states, false),
        }
    }

    /// Returns the readings of every robot.
    pub fn states(&self) -> &[TreeReadings] {
        &self.states
    }
}

/// Checks that two robots have the same bodies, joint axes and shapes. Places and numbers may differ.
fn check_tree(first: &TreeModel, other: &TreeModel) -> Result<(), TreeError> {
    let differs = |what: &'static str| Err(TreeError::OtherTree { name: other.tree.name.clone(), what });
    let structure = |robot: &TreeModel| TreeStructure::new(&robot.tree);
    let points = |robot: &TreeModel| robot.points.iter().map(|point| (point.body, point.shape)).collect::<Vec<_>>();
    if structure(first) != structure(other) {
        return differs("its joints have other parents, kinds or axes");
    }
    if points(first) != points(other) || first.tree.shapes.len() != other.tree.shapes.len() {
        return differs("its shapes are others");
    }
    Ok(())
}

fn refused(field: &'static str, value: &str, allowed: &str) -> SimConfigError {
    SimConfigError { field, value: value.to_owned(), allowed: allowed.to_owned() }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use twinstep_model::{RobotTree, go2};

    use super::*;

    fn robot() -> TreeModel {
        TreeModel::new(RobotTree::from(&go2())).expect("equal limits")
    }

    fn start() -> Placement {
        Placement::at_rest(1.0, go2().control.default_pose.to_vec())
    }

    fn simulation(engine: Engine) -> TreeSimulation {
        let config = SimConfig { engine, threads: 1, ..SimConfig::default() };
        TreeSimulation::new(&robot(), &config, 200.0, 2, &start()).expect("two robots")
    }

    #[test]
    fn arguments_of_the_wrong_length_are_refused_and_nothing_changes() {
        let mut robots = simulation(Engine::Batch);
        let before = robots.states().to_vec();
        let error = robots.step(&[TreeCommand::hold(vec![0.0; 12], 1.0, 0.0)], 1).expect_err("one command");
        assert_eq!(error.to_string(), "`commands` has 1 entries; 2 are expected, one per robot");
        let short = TreeCommand { kd: vec![0.0; 3], ..TreeCommand::hold(vec![0.0; 12], 1.0, 0.0) };
        let error = robots.step(&[short.clone(), short], 1).expect_err("three gains");
        assert_eq!(error.to_string(), "`kd` has 3 entries; 12 are expected, one per joint");
        let nan = TreeCommand::hold(vec![f32::NAN; 12], 1.0, 0.0);
        let error = robots.step(&[nan.clone(), nan], 1).expect_err("NaN");
        assert_eq!(error.to_string(), "`q` of entry 0 is NaN; finite numbers are expected");
        let error = robots.push(2, [1.0, 0.0, 0.0]).expect_err("two robots");
        assert_eq!(error.to_string(), "robot 2 does not exist; the number of robots is 2");
        let error = robots.reset(2, &robot(), &start()).expect_err("two robots");
        assert_eq!(error.to_string(), "robot 2 does not exist; the number of robots is 2");
        assert_eq!(robots.states(), before);
    }

    /// URDF files often begin with a link without mass, and state neither damping nor rotor inertia.
    #[test]
    fn held_base_moves_the_robot_alike_with_any_mass() {
        let positions = |mass: f64| {
            let mut pendulum = robot();
            pendulum.tree.base = None;
            pendulum.tree.bodies[0].inertia = pendulum.tree.bodies[0].inertia.scaled(mass);
            pendulum.points.clear();
            for joint in &mut pendulum.joints {
                (joint.armature, joint.viscous_friction, joint.coulomb_friction) = (0.0, 0.0, 0.0);
            }
            let config = SimConfig { base: twinstep_model::BaseMount::Fixed, threads: 1, ..SimConfig::default() };
            let mut robots = TreeSimulation::new(&pendulum, &config, 200.0, 1, &start()).expect("a robot");
            let command = TreeCommand::hold(vec![0.1; 12], 5.0, 0.2);
            robots.step(&[command], 40).expect("one command");
            robots.states()[0].state.q.clone()
        };
        let [without, with] = [0.0, 1.0].map(positions);
        assert!(without.iter().all(|q| q.is_finite()), "{without:?}");
        assert_eq!(without, with);
    }

    #[test]
    fn robot_with_another_tree_is_refused() {
        let mut other = robot();
        other.tree.joints[1].axis = DVec3::Z;
        let error = simulation(Engine::Batch).reset(0, &other, &start()).expect_err("another axis");
        assert!(error.to_string().contains("its joints have other parents, kinds or axes"), "{error}");
    }

    #[test]
    fn effect_that_mujoco_does_not_simulate_is_refused_before_its_process_starts() {
        let config = SimConfig { engine: Engine::Mujoco, ..SimConfig::default() };
        let mut worn = robot();
        worn.joints[3].actuator.backlash = 0.01;
        let error = TreeSimulation::new(&worn, &config, 200.0, 1, &start()).err().expect("refused").to_string();
        assert!(error.contains("the engine `mujoco` does not simulate the effect `backlash`"), "{error}");
    }

    #[test]
    fn pushed_robot_moves_in_both_engines_and_one_on_a_stand_is_not_pushed() {
        for engine in [Engine::Batch, Engine::Rapier] {
            let mut robots = simulation(engine);
            robots.push(1, [0.5, -0.2, 0.0]).expect("it floats");
            let command = TreeCommand::hold(start().q.iter().map(|q| *q as f32).collect(), 20.0, 0.5);
            robots.step(&[command.clone(), command], 1).expect("two commands");
            let speeds = [0, 1].map(|robot| robots.states()[robot].state.base_linear_velocity);
            assert!(speeds[0][0].abs() < 0.02 && (speeds[1][0] - 0.5).abs() < 0.02, "{engine:?}: {speeds:?}");
        }
        let config = SimConfig { base: twinstep_model::BaseMount::Fixed, threads: 1, ..SimConfig::default() };
        let mut stand = TreeSimulation::new(&robot(), &config, 200.0, 1, &start()).expect("one robot");
        let error = stand.push(0, [0.5, 0.0, 0.0]).expect_err("on a stand").to_string();
        assert_eq!(error, "the base of robot `go2` is fixed; only a floating one can be pushed");
    }

    /// A heavier robot falls as fast, but turns its joints less. The neighbour in the next lane is the same as before.
    #[test]
    fn robots_of_one_batch_have_their_own_numbers() {
        let mut heavy = robot();
        heavy.joints.iter_mut().for_each(|joint| joint.armature = 1.0);
        let run = |second: &TreeModel| {
            let mut robots = simulation(Engine::Batch);
            robots.reset(1, second, &start()).expect("the same tree");
            let command = TreeCommand::hold(vec![0.0; 12], 20.0, 0.5);
            robots.step(&[command.clone(), command], 20).expect("two commands");
            robots.states().to_vec()
        };
        let (same, mixed) = (run(&robot()), run(&heavy));
        assert_eq!(same[0], mixed[0]);
        assert_eq!(same[0], same[1]);
        let moved = |readings: &TreeReadings| (readings.state.q[1] - start().q[1]).abs();
        assert!(moved(&mixed[1]) < 0.5 * moved(&mixed[0]), "{} rad, {} rad", moved(&mixed[1]), moved(&mixed[0]));
    }
}
