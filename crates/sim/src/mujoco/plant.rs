//! Robots whose bodies and contacts are MuJoCo's and whose actuators are each a [`PlantActuator`].

use std::path::Path;

use twinstep_model::{
    Actuator, ActuatorParams, Backend, BackendError, Command, CompliantStand, Ground, GroundTruth, InitialState,
    JointSpring, Measured, NUM_JOINTS, PerJoint, RobotModel, RobotStates, Simulator, Stribeck,
};

use super::MujocoBackend;
use super::plant_actuator::{Joints, PlantActuator};
use crate::checks::check_lengths;
use crate::{BackendBuildError, Engine, SimConfig};

/// Lowest rate of actuators and physics [Hz].
const STEP_HZ: f64 = 2000.0;
/// Torque limit of a joint behind its gear [N·m]: more than any gear transmits.
const NO_TORQUE_LIMIT: f64 = 1e5;

/// Robots in MuJoCo with every effect of the catalogue, by equations that share no code with the model's.
pub struct MujocoPlant {
    robot: RobotModel,
    /// The robots without what [`PlantActuator`] computes.
    bodies: MujocoBackend,
    actuators: Vec<PlantActuator>,
    /// External actuator. `None`: [`PlantActuator`] only.
    external: Option<Box<dyn Actuator>>,
    /// Steps per actuator period.
    steps: usize,
    /// States as the sensors measure them.
    states: RobotStates,
}

impl MujocoPlant {
    /// Creates `num_robots` robots, with the base as in `config`. The interpreter is that of [`MujocoBackend::new`].
    pub fn new(robot: RobotModel, config: SimConfig, num_robots: usize) -> Result<Self, BackendBuildError> {
        Self::with_bodies(robot, config, num_robots, MujocoBackend::new)
    }

    /// Creates robots like [`MujocoPlant::new`], with a `stand` that gives way if their base is fixed.
    pub fn on_stand(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        stand: Option<CompliantStand>,
    ) -> Result<Self, BackendBuildError> {
        Self::with_bodies(robot, config, num_robots, |robot, config, count| {
            MujocoBackend::on_stand(robot, config, count, &super::default_python(), stand)
        })
    }

    /// Creates robots like [`MujocoPlant::new`], with the interpreter `python`.
    pub fn with_python(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        python: &Path,
    ) -> Result<Self, BackendBuildError> {
        Self::with_bodies(robot, config, num_robots, |robot, config, count| {
            MujocoBackend::with_python(robot, config, count, python)
        })
    }

    fn with_bodies(
        robot: RobotModel,
        config: SimConfig,
        num_robots: usize,
        create: impl FnOnce(RobotModel, SimConfig, usize) -> Result<MujocoBackend, BackendBuildError>,
    ) -> Result<Self, BackendBuildError> {
        let steps = (STEP_HZ / robot.control.actuator_hz).ceil() as usize;
        let bodies = bodies(&robot, steps);
        let physics_hz = Some(bodies.control.actuator_hz as u32);
        let config = SimConfig { engine: Engine::Mujoco, physics_hz, ..config };
        let bodies = create(bodies, config, num_robots)?;
        let states = bodies.states().clone();
        let actuators = states.measured.q.iter().map(|q| PlantActuator::new(&robot, steps, &widened(q))).collect();
        Ok(Self { robot, bodies, actuators, external: None, steps, states })
    }

    /// Adds an external actuator to all robots, which replaces theirs or adds to them. Reset every robot afterwards.
    #[must_use]
    pub fn with_actuator(self, actuator: Box<dyn Actuator>) -> Self {
        Self { external: Some(actuator), ..self }
    }

    /// Returns positions [rad] and velocities [rad/s] of the links of a robot.
    fn links(&self, robot: usize) -> (Joints, Joints) {
        let measured = self.bodies.measured();
        (widened(&measured.q[robot]), widened(&measured.dq[robot]))
    }

    /// Reads the states of all robots, with the readings of their encoders.
    fn update_states(&mut self) {
        let tau = std::mem::take(&mut self.states.measured.tau);
        let uncertainty = std::mem::take(&mut self.states.truth.epistemic_uncertainty);
        self.states.clone_from(self.bodies.states());
        (self.states.measured.tau, self.states.truth.epistemic_uncertainty) = (tau, uncertainty);
        for robot in 0..self.actuators.len() {
            let (q, dq) = self.links(robot);
            for joint in 0..NUM_JOINTS {
                let (q, dq) = self.actuators[robot].reading(joint, q[joint], dq[joint]);
                self.states.measured.q[robot][joint] = q as f32;
                self.states.measured.dq[robot][joint] = dq as f32;
            }
        }
    }

    /// Replaces the actuators of a robot after its reset.
    fn rest(&mut self, robot: usize, model: &RobotModel, seed: u64) {
        if let Some(external) = &mut self.external {
            external.reset(robot, seed);
        }
        self.states.truth.epistemic_uncertainty[robot] = 0.0;
        self.actuators[robot] = PlantActuator::new(model, self.steps, &self.links(robot).0);
        self.states.measured.tau[robot] = PerJoint::default();
    }

    /// Advances the active robots by an actuator period, and adds the sensed torques to `sums` [N·m]. Robots that diverge
    /// become inactive.
    fn period(
        &mut self,
        commands: &[Command],
        active: &mut [bool],
        sums: &mut [Joints],
        diverged: &mut Vec<(usize, &'static str)>,
    ) -> Result<(), BackendError> {
        for robot in (0..active.len()).filter(|robot| active[*robot]) {
            let (q, dq) = self.links(robot);
            self.actuators[robot].sample(&commands[robot], &q, &dq);
        }
        if let Some(external) = &mut self.external {
            let mut tau = self.states.measured.tau.clone();
            external.torques(commands, active, &self.states.measured, &mut tau)?;
            for robot in (0..active.len()).filter(|robot| active[*robot]) {
                self.actuators[robot].set_external(external.mode(), widened(&tau[robot]));
            }
        }
        let mut torques = vec![Command::hold([0.0; NUM_JOINTS], 0.0, 0.0); active.len()];
        for _ in 0..self.steps {
            for robot in (0..active.len()).filter(|robot| active[*robot]) {
                let (q, dq) = self.links(robot);
                let plant = self.actuators[robot].step(&q, &dq);
                torques[robot].tau_ff = plant.applied.map(|tau| tau as f32);
                sums[robot].iter_mut().zip(plant.sensed).for_each(|(sum, tau)| *sum += tau);
            }
            match self.bodies.step(&torques, active, 1) {
                Err(BackendError::Diverged { robots }) => {
                    for (robot, _) in &robots {
                        active[*robot] = false;
                    }
                    diverged.extend(robots);
                }
                stepped => stepped?,
            }
        }
        Ok(())
    }
}

/// Returns the robot without what [`PlantActuator`] computes, with `steps` actuator periods in one of the robot's.
///
/// That includes the torque limit, which is the motor's: where backlash closes, a gear transmits more.
fn bodies(robot: &RobotModel, steps: usize) -> RobotModel {
    let mut bodies = robot.clone();
    bodies.control.actuator_hz *= steps as f64;
    for joint in &mut bodies.joints {
        if PlantActuator::has_rotor(joint) {
            // The rotor is not part of the link.
            joint.armature = 0.0;
        }
        joint.torque_limit = NO_TORQUE_LIMIT;
        (joint.stribeck_friction, joint.load_friction) = (Stribeck::NONE, 0.0);
        (joint.spring, joint.actuator) = (JointSpring::NONE, ActuatorParams::IDEAL);
    }
    bodies
}

fn widened(values: &PerJoint) -> Joints {
    values.map(f64::from)
}

impl Backend for MujocoPlant {
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
        self.bodies.ground()
    }

    fn reset(&mut self, initial_states: &[(usize, InitialState)]) -> Result<(), BackendError> {
        self.bodies.reset(initial_states)?;
        let nominal = self.robot.clone();
        for (robot, initial_state) in initial_states {
            self.rest(*robot, &nominal, initial_state.actuator_seed);
        }
        self.update_states();
        Ok(())
    }

    fn reset_with_model(
        &mut self,
        robot: usize,
        model: &RobotModel,
        initial_state: &InitialState,
    ) -> Result<(), BackendError> {
        self.bodies.reset_with_model(robot, &bodies(model, self.steps), initial_state)?;
        self.rest(robot, model, initial_state.actuator_seed);
        self.update_states();
        Ok(())
    }

    fn push(&mut self, robot: usize, velocity: [f32; 3]) -> Result<(), BackendError> {
        self.bodies.push(robot, velocity)?;
        self.update_states();
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        check_lengths(commands, active, self.num_robots())?;
        let mut running = active.to_vec();
        let (mut sums, mut diverged) = (vec![[0.0; NUM_JOINTS]; active.len()], Vec::new());
        for _ in 0..actuator_periods {
            // The sensor has the mean of the last actuator period.
            sums.fill([0.0; NUM_JOINTS]);
            self.period(commands, &mut running, &mut sums, &mut diverged)?;
            if self.external.is_some() {
                // The next period samples the readings.
                self.update_states();
            }
        }
        for robot in (0..active.len()).filter(|robot| active[*robot]) {
            self.states.measured.tau[robot] = sums[robot].map(|sum| (sum / self.steps as f64) as f32);
        }
        self.update_states();
        if let Some(evaluator) = self.external.as_deref_mut().and_then(Actuator::uncertainty) {
            evaluator.evaluate(active, &mut self.states.truth.epistemic_uncertainty);
        }
        if diverged.is_empty() { Ok(()) } else { Err(BackendError::Diverged { robots: diverged }) }
    }
}

impl Simulator for MujocoPlant {
    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn set_derating(&mut self, robot: usize, factors: &PerJoint) {
        self.actuators[robot].derating = widened(factors);
    }
}
