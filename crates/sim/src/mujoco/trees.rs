//! Robots of any tree in MuJoCo: the PD loop and the bodies are in its process.

use std::path::Path;

use glam::{DAffine3, DQuat};
use twinstep_model::{ActuatorParams, BaseMount, MjcfActuator, RobotTree, TreeModel, TreeShapeKind};
use twinstep_robot_files::{TreeMjcf, geom_name, write_mjcf};

use super::frames::{self, Layout, PUSH, RESET, Reset, STATES, STEP, Settings, StateRow};
use super::process::Process;
use super::{default_python, effect_outside_mujoco};
use crate::tree_engine::{TreeCommand, TreeEngine, TreeReadings};
use crate::tree_error::TreeError;
use crate::{BackendBuildError, Placement, SimConfig, SimConfigError, Terrain};

/// Robots of one tree.
pub struct MujocoTrees {
    process: Process,
    layout: Layout,
    /// Model of the robots that the process was started with.
    nominal: String,
    /// Shape of each geom of the layout.
    shapes: Vec<usize>,
    config: SimConfig,
    robots: Vec<Robot>,
}

/// What the process does not know of a robot, and its last readings.
#[derive(Clone)]
struct Robot {
    kp_scale: Vec<f32>,
    kd_scale: Vec<f32>,
    encoder_offset: Vec<f32>,
    /// Position and orientation of a fixed base, which is part of its model.
    fixed: Option<([f64; 3], [f64; 4])>,
    readings: TreeReadings,
}

impl Robot {
    fn new(model: &TreeModel) -> Self {
        let of_joints = |value: fn(&ActuatorParams) -> f64| {
            model.joints.iter().map(|joint| value(&joint.actuator) as f32).collect()
        };
        Self {
            kp_scale: of_joints(|actuator| actuator.kp_scale),
            kd_scale: of_joints(|actuator| actuator.kd_scale),
            encoder_offset: of_joints(|actuator| actuator.encoder_offset),
            fixed: None,
            readings: TreeReadings::zero(model),
        }
    }

    /// Returns the command of a PD loop with ideal gains that reads true joint positions.
    fn adjusted(&self, command: &TreeCommand) -> TreeCommand {
        let product =
            |gains: &[f32], scales: &[f32]| gains.iter().zip(scales).map(|(gain, scale)| gain * scale).collect();
        TreeCommand {
            q: command.q.iter().zip(&self.encoder_offset).map(|(q, offset)| q - offset).collect(),
            kp: product(&command.kp, &self.kp_scale),
            kd: product(&command.kd, &self.kd_scale),
            ..command.clone()
        }
    }
}

impl MujocoTrees {
    /// Creates robots in a state, whose actuators have the rate `actuator_hz` [Hz], with the interpreter of `TWINSTEP_PYTHON`, or else
    /// `python3`.
    pub fn new(
        robot: &TreeModel,
        config: &SimConfig,
        actuator_hz: f64,
        num_robots: usize,
        initial_state: &Placement,
    ) -> Result<Self, BackendBuildError> {
        check(robot)?;
        if config.terrain != Terrain::Flat {
            let allowed = "`flat` in the engine `mujoco`, for a robot of any tree".to_owned();
            return Err(SimConfigError { field: "terrain", value: format!("{:?}", config.terrain), allowed }.into());
        }
        let python = default_python();
        let tree = exported(robot, config, initial_state);
        let (layout, shapes) = layout(&tree);
        let settings = Settings {
            robots: num_robots,
            threads: config.threads,
            iterations: config.solver_iterations(),
            steps: config.steps_per_actuator_period(actuator_hz),
        };
        let nominal = mjcf(robot, &tree, config);
        let hello = frames::hello(&settings, &layout, &nominal);
        let failed = |python: &Path, reason| BackendBuildError::Mujoco { python: python.to_owned(), reason };
        let process = Process::start(&python, &hello).map_err(|reason| failed(&python, reason))?;
        let robots = vec![Robot::new(robot); num_robots];
        let mut this = Self { process, layout, nominal, shapes, config: *config, robots };
        for index in 0..num_robots {
            this.place(index, robot, initial_state)?;
        }
        Ok(this)
    }

    /// Sends a request and reads the states of `robots` from its reply.
    fn request(&mut self, kind: u8, body: &[u8], robots: &[usize]) -> Result<(), TreeError> {
        let failed = |reason| TreeError::Process { reason };
        let reply = self.process.request(kind, body, STATES).map_err(failed)?;
        let Self { layout, shapes, robots: all, .. } = self;
        frames::read_states(&reply, layout, robots, |robot, row| read(&mut all[robot], shapes, &row)).map_err(
            |reason| {
                self.process.fail(reason.clone());
                failed(reason)
            },
        )
    }
}

impl TreeEngine for MujocoTrees {
    fn place(&mut self, robot: usize, model: &TreeModel, state: &Placement) -> Result<(), TreeError> {
        check(model)?;
        self.robots[robot] = Robot::new(model);
        if self.config.base.is_fixed() {
            self.robots[robot].fixed = Some((state.base_position, state.base_orientation));
        }
        let offsets = self.robots[robot].encoder_offset.clone();
        let q = state.q.iter().zip(offsets).map(|(q, offset)| *q as f32 - offset);
        let base = state.base_position.iter().chain(&state.base_orientation);
        let base = base.chain(&state.base_linear_velocity).chain(&state.base_angular_velocity);
        let row = base.map(|value| *value as f32).chain(q).chain(state.dq.iter().map(|dq| *dq as f32)).collect();
        let text = mjcf(model, &exported(model, &self.config, state), &self.config);
        // An empty text is the nominal model, which is compiled already.
        let text = if text == self.nominal { String::new() } else { text };
        self.request(RESET, &frames::reset(&[Reset { robot, state: row, mjcf: &text }]), &[robot])
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), TreeError> {
        self.request(PUSH, &frames::push(robot, velocity), &[robot])
    }

    fn read(&self, robot: usize, readings: &mut TreeReadings) {
        readings.clone_from(&self.robots[robot].readings);
    }

    fn advance(
        &mut self,
        commands: &[TreeCommand],
        [periods, _]: [usize; 2],
        states: &mut [TreeReadings],
        _parallel: bool,
    ) -> Result<(), TreeError> {
        let adjusted: Vec<_> =
            self.robots.iter().zip(commands).map(|(robot, command)| robot.adjusted(command)).collect();
        let rows =
            adjusted.iter().map(|TreeCommand { q, dq, tau_ff, kp, kd }| [q, dq, tau_ff, kp, kd].map(Vec::as_slice));
        let count = self.robots.len();
        let body = frames::step(rows, &vec![true; count], periods);
        self.request(STEP, &body, &(0..count).collect::<Vec<_>>())?;
        for (own, robot) in states.iter_mut().zip(&self.robots) {
            own.clone_from(&robot.readings);
        }
        Ok(())
    }
}

/// Checks that MuJoCo simulates every effect of a robot.
fn check(robot: &TreeModel) -> Result<(), TreeError> {
    let delayed = robot.joints.iter().any(|joint| joint.actuator.command_delay != 0.0);
    match effect_outside_mujoco(&robot.joints).or(delayed.then_some("command_delay")) {
        Some(effect) => Err(TreeError::UnsupportedEffect { name: robot.tree.name.clone(), effect }),
        None => Ok(()),
    }
}

/// Returns the tree with the numbers of all joints, with a base that is fixed where `state` has it if `config` says so.
fn exported(robot: &TreeModel, config: &SimConfig, state: &Placement) -> RobotTree {
    let mut tree = robot.plain_tree();
    if config.base.is_fixed() {
        tree.base = Some(BaseMount::Fixed);
        let [w, x, y, z] = state.base_orientation;
        let turn = DQuat::from_xyzw(x, y, z, w).normalize();
        tree.world_from_base = DAffine3::from_rotation_translation(turn, state.base_position.into());
    }
    tree
}

fn mjcf(robot: &TreeModel, tree: &RobotTree, config: &SimConfig) -> String {
    let timestep = 1.0 / f64::from(config.physics_hz());
    let actuator = MjcfActuator::Torque;
    write_mjcf(tree, &TreeMjcf { timestep, actuator, start: None, contact: robot.contact })
}

/// Returns joints and geoms, and the shape of each geom. A mesh has no geom.
fn layout(tree: &RobotTree) -> (Layout, Vec<usize>) {
    let shapes = tree.shapes.iter().enumerate();
    let shapes: Vec<_> = shapes.filter(|(_, shape)| !matches!(shape.kind, TreeShapeKind::Mesh(_))).collect();
    let shapes: Vec<_> = shapes.into_iter().map(|(index, _)| index).collect();
    let geoms = shapes.iter().map(|shape| geom_name(*shape)).collect();
    let joints = tree.joints.iter().map(|joint| joint.name.clone()).collect();
    // The model of each robot has its base where its state has it.
    (Layout { joints, geoms, base: 0 }, shapes)
}

fn read(robot: &mut Robot, shapes: &[usize], row: &StateRow) {
    let Robot { readings, encoder_offset, fixed, .. } = robot;
    let state = &mut readings.state;
    let double = |values: [f32; 3]| values.map(f64::from);
    state.base_position = double(row.base_position);
    state.base_orientation = row.orientation.map(f64::from);
    if let Some(place) = fixed {
        (state.base_position, state.base_orientation) = *place;
    }
    state.base_linear_velocity = double(row.base_linear_velocity);
    state.base_angular_velocity = double(row.base_angular_velocity);
    state.q = row.q.iter().zip(encoder_offset).map(|(q, offset)| f64::from(*q + *offset)).collect();
    state.dq = row.dq.iter().copied().map(f64::from).collect();
    readings.tau = row.tau.iter().copied().map(f64::from).collect();
    readings.shape_force.fill(0.0);
    for (shape, force) in shapes.iter().zip(row.geom_force) {
        readings.shape_force[*shape] = f64::from(*force);
    }
}
