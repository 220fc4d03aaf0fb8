//! The engine `mujoco`: MuJoCo itself, in a Python process of its own.
//!
//! The process has this robot as a MuJoCo model ([`twinstep_model::mjcf()`]), and its own integrator, contacts, joint
//! limits and friction. It computes the torque of the PD loop once per actuator period. A step of all robots is one
//! request with the commands and one reply with the states ([`frames`]).

mod delay;
mod effects;
mod frames;
mod plant;
mod plant_actuator;
mod process;
mod trees;

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use twinstep_model::{
    Backend, BackendError, Command, CompliantStand, Ground, GroundTruth, InitialState, JOINT_NAMES, Leg, Measured,
    MjcfActuator, MjcfOptions, NUM_LEGS, PerJoint, RobotModel, RobotStates, Simulator, mjcf,
};

use crate::checks::check_lengths;
use crate::{BackendBuildError, SimConfig};
use delay::CommandDelay;
use effects::Adjustments;
pub use effects::effect_outside_mujoco;
pub use plant::MujocoPlant;
pub use trees::MujocoTrees;

use frames::{Layout, PUSH, RESET, Reset, STATES, STEP, Settings, StateRow};
use process::Process;

/// Environment variable with the Python interpreter that has the packages `twinstep` and `mujoco`.
const PYTHON: &str = "TWINSTEP_PYTHON";
/// Name of the engine in errors.
const ENGINE: &str = "mujoco";

/// Backend that simulates its robots in MuJoCo, in a child process.
pub struct MujocoBackend {
    robot: RobotModel,
    options: MjcfOptions,
    process: Process,
    states: RobotStates,
    /// Effects of each robot that are not in its MuJoCo model.
    adjustments: Vec<Adjustments>,
    /// Delay of the commands of each robot, if there is one.
    delays: Vec<Option<CommandDelay>>,
}

impl MujocoBackend {
    /// Creates `num_robots` robots that stand in their default pose.
    ///
    /// The interpreter is that of the environment variable `TWINSTEP_PYTHON`, or else `python3`.
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BackendBuildError> {
        Self::with_python(robot, config, num_robots, &default_python())
    }

    /// Creates robots like [`MujocoBackend::new`], with the Python interpreter `python`.
    pub fn with_python(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        python: &Path,
    ) -> Result<Self, BackendBuildError> {
        Self::on_stand(robot, config, num_robots, python, None)
    }

    /// Creates robots like [`MujocoBackend::with_python`], with a `stand` that gives way if their base is fixed.
    fn on_stand(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        python: &Path,
        stand: Option<CompliantStand>,
    ) -> Result<Self, BackendBuildError> {
        config.check(robot.control.actuator_hz)?;
        let config = config.at_actuator_rate(robot.control.actuator_hz);
        if let Some(effect) = effect_outside_mujoco(&robot.joints) {
            return Err(BackendBuildError::Effect { engine: ENGINE, effect });
        }
        let timestep = 1.0 / f64::from(config.physics_hz());
        let ground = config.terrain.ground();
        let initial_state = InitialState::standing_on(&ground, &robot, robot.control.default_pose_f32(), 0.0);
        let options = MjcfOptions { base: config.base, stand, timestep, actuator: MjcfActuator::Torque, ground };
        let settings = Settings {
            robots: num_robots,
            threads: config.threads,
            iterations: config.solver_iterations(),
            steps: config.steps_per_actuator_period(robot.control.actuator_hz),
        };
        let process = Process::start(python, &frames::hello(&settings, &layout(), &mjcf(&robot, &options)))
            .map_err(|reason| BackendBuildError::Mujoco { python: PathBuf::from(python), reason })?;
        let (states, adjustments) = (RobotStates::new(num_robots), vec![Adjustments::new(&robot); num_robots]);
        let delays = vec![None; num_robots];
        let mut this = Self { robot, options, process, states, adjustments, delays };
        let standing: Vec<_> = (0..num_robots).map(|robot| (robot, initial_state)).collect();
        this.reset(&standing)
            .map_err(|error| BackendBuildError::Mujoco { python: PathBuf::from(python), reason: error.to_string() })?;
        Ok(this)
    }

    /// Returns true if MuJoCo simulates every effect of `robot` without a [`MujocoPlant`].
    pub fn simulates(robot: &RobotModel) -> bool {
        effect_outside_mujoco(&robot.joints).is_none()
    }

    /// Returns the id of the process.
    pub fn process_id(&self) -> u32 {
        self.process.id()
    }

    fn check_index(&self, robot: usize) -> Result<(), BackendError> {
        let num_robots = self.num_robots();
        if robot < num_robots { Ok(()) } else { Err(BackendError::RobotOutOfRange { robot, num_robots }) }
    }

    /// Sends a request and reads the states of `robots` from its reply.
    fn request(&mut self, kind: u8, body: &[u8], robots: &[usize]) -> Result<(), BackendError> {
        let failed = |reason| BackendError::EngineProcess { engine: ENGINE, reason };
        let reply = self.process.request(kind, body, STATES).map_err(failed)?;
        let states = &mut self.states;
        frames::read_states(&reply, &layout(), robots, |robot, row| set_state(states, robot, &row)).map_err(
            |reason| {
                self.process.fail(reason.clone());
                failed(reason)
            },
        )?;
        let measured = &mut self.states.measured;
        for robot in robots {
            self.adjustments[*robot].readings(&mut measured.q[*robot], &mut measured.gyro[*robot]);
        }
        Ok(())
    }

    /// Advances the active robots by some actuator periods with constant commands.
    fn advance(&mut self, commands: &[Command], active: &[bool], periods: usize) -> Result<(), BackendError> {
        let adjusted =
            commands.iter().zip(&self.adjustments).map(|(command, adjustments)| adjustments.command(command));
        let adjusted: Vec<_> = adjusted.collect();
        let rows = adjusted.iter().map(|Command { q, dq, tau_ff, kp, kd }| [q, dq, tau_ff, kp, kd].map(|row| &row[..]));
        let body = frames::step(rows, active, periods);
        self.request(STEP, &body, &(0..self.num_robots()).collect::<Vec<_>>())
    }

    /// Resets robots to initial states. An empty model is the nominal one.
    fn reset_robots(&mut self, robots: &[(usize, InitialState)], mjcf: &str) -> Result<(), BackendError> {
        let true_states: Vec<_> =
            robots.iter().map(|(robot, state)| (*robot, self.adjustments[*robot].initial_state(state))).collect();
        let reset = |(robot, state): &(usize, InitialState)| Reset { robot: *robot, state: state_row(state), mjcf };
        let resets: Vec<_> = true_states.iter().map(reset).collect();
        let indices: Vec<_> = robots.iter().map(|(robot, _)| *robot).collect();
        self.request(RESET, &frames::reset(&resets), &indices)?;
        for robot in indices {
            self.states.measured.stamp[robot] = 0.0;
        }
        Ok(())
    }
}

impl Backend for MujocoBackend {
    fn robot(&self) -> &RobotModel {
        &self.robot
    }

    fn measured(&self) -> &Measured {
        &self.states.measured
    }

    fn ground_truth(&self) -> Option<&GroundTruth> {
        Some(&self.states.truth)
    }

    fn ground(&self) -> Ground {
        self.options.ground.clone()
    }

    fn reset(&mut self, initial_states: &[(usize, InitialState)]) -> Result<(), BackendError> {
        for (robot, _) in initial_states {
            self.check_index(*robot)?;
        }
        let nominal = Adjustments::new(&self.robot);
        for (robot, initial_state) in initial_states {
            self.adjustments[*robot] = nominal;
            self.delays[*robot] = CommandDelay::new(&self.robot, &initial_state.q);
        }
        self.reset_robots(initial_states, "")
    }

    fn reset_with_model(
        &mut self,
        robot: usize,
        model: &RobotModel,
        initial_state: &InitialState,
    ) -> Result<(), BackendError> {
        self.check_index(robot)?;
        if let Some(effect) = effect_outside_mujoco(&model.joints) {
            return Err(BackendError::UnsupportedEffect { robot, engine: ENGINE, effect });
        }
        self.adjustments[robot] = Adjustments::new(model);
        self.delays[robot] = CommandDelay::new(model, &initial_state.q);
        self.reset_robots(&[(robot, *initial_state)], &mjcf(model, &self.options))
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), BackendError> {
        self.check_index(robot)?;
        if self.options.base.is_fixed() {
            return Err(BackendError::CannotPush { robot, reason: "its base is fixed" });
        }
        self.request(PUSH, &frames::push(robot, velocity), &[robot])
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        let num_robots = self.num_robots();
        check_lengths(commands, active, num_robots)?;
        if self.delays.iter().all(Option::is_none) {
            self.advance(commands, active, actuator_periods)?;
        } else {
            let mut arrived = commands.to_vec();
            for _ in 0..actuator_periods {
                for (robot, delay) in self.delays.iter_mut().enumerate().filter(|(robot, _)| active[*robot]) {
                    if let Some(delay) = delay {
                        arrived[robot] = delay.next(&commands[robot]);
                    }
                }
                self.advance(&arrived, active, 1)?;
            }
        }
        let elapsed = actuator_periods as f64 * self.robot.control.actuator_dt();
        let stepped: Vec<_> = (0..num_robots).filter(|robot| active[*robot]).collect();
        for robot in &stepped {
            self.states.measured.stamp[*robot] += elapsed;
        }
        let diverged = |robot| Some((robot, self.states.first_not_finite(robot)?));
        let robots: Vec<_> = stepped.into_iter().filter_map(diverged).collect();
        if robots.is_empty() { Ok(()) } else { Err(BackendError::Diverged { robots }) }
    }
}

impl Simulator for MujocoBackend {
    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn set_derating(&mut self, robot: usize, factors: &PerJoint) {
        self.adjustments[robot].derating = *factors;
    }
}

/// Returns joints and geoms of a quadruped: its feet, then what is not to touch the ground. A knee is the lower end of a thigh.
fn layout() -> Layout {
    let names = |end: &str| Leg::ALL.map(|leg| format!("{}_{end}", leg.name()));
    let geoms = names("foot").into_iter().chain(["trunk".to_owned()]).chain(names("knee")).chain(names("motors"));
    Layout { joints: JOINT_NAMES.map(str::to_owned).to_vec(), geoms: geoms.collect(), base: 1 }
}

fn set_state(states: &mut RobotStates, robot: usize, row: &StateRow) {
    let RobotStates { measured, truth } = states;
    for (own, values) in [(&mut measured.q, row.q), (&mut measured.dq, row.dq), (&mut measured.tau, row.tau)] {
        own[robot].copy_from_slice(values);
    }
    (measured.orientation[robot], measured.gyro[robot]) = (row.orientation, row.gyro);
    truth.base_position[robot] = row.base_position;
    truth.base_linear_velocity[robot] = row.base_linear_velocity;
    truth.base_angular_velocity[robot] = row.base_angular_velocity;
    let (feet, body) = row.geom_force.split_at(NUM_LEGS);
    truth.foot_force[robot].copy_from_slice(feet);
    truth.body_contact[robot] = body.iter().any(|force| *force > 0.0);
}

/// Returns the numbers of a reset.
fn state_row(state: &InitialState) -> Vec<f32> {
    let InitialState { base_position, base_orientation, base_linear_velocity, base_angular_velocity, q, dq, .. } =
        state;
    let values: [&[f32]; 6] = [base_position, base_orientation, base_linear_velocity, base_angular_velocity, q, dq];
    values.concat()
}

/// Returns the interpreter of the environment variable [`PYTHON`], or else `python3`.
fn default_python() -> PathBuf {
    let python = std::env::var_os(PYTHON).filter(|python| !python.is_empty());
    PathBuf::from(python.unwrap_or(OsString::from("python3")))
}
