//! Robot whose bodies and contacts are MuJoCo's and whose actuators are a [`PlantActuator`].

use std::path::Path;

use twinstep_model::{
    ActuatorParams, Backend, BackendError, Command, Ground, GroundTruth, InitialState, JointSpring, Measured,
    NUM_JOINTS, PerJoint, RobotModel, RobotStates, Simulator, Stribeck,
};
use twinstep_sim::{BackendBuildError, Engine, MujocoBackend, SimConfig};

use crate::plant_actuator::{Joints, PlantActuator};

/// Lowest rate of actuators and physics [Hz].
const STEP_HZ: f64 = 2000.0;

/// One robot in MuJoCo.
pub struct MujocoPlant {
    robot: RobotModel,
    /// The robot without what [`PlantActuator`] computes.
    bodies: MujocoBackend,
    actuator: PlantActuator,
    /// Steps per actuator period.
    steps: usize,
    /// States as the sensors measure them.
    states: RobotStates,
}

impl MujocoPlant {
    /// Creates the robot, with the base as in `config`. The interpreter is that of [`MujocoBackend::new`].
    pub fn new(robot: RobotModel, config: SimConfig) -> Result<Self, BackendBuildError> {
        Self::with_bodies(robot, config, MujocoBackend::new)
    }

    /// Creates the robot, with the interpreter `python`.
    pub fn with_python(robot: RobotModel, config: SimConfig, python: &Path) -> Result<Self, BackendBuildError> {
        Self::with_bodies(robot, config, |robot, config, count| {
            MujocoBackend::with_python(robot, config, count, python)
        })
    }

    fn with_bodies(
        robot: RobotModel,
        config: SimConfig,
        create: impl FnOnce(RobotModel, SimConfig, usize) -> Result<MujocoBackend, BackendBuildError>,
    ) -> Result<Self, BackendBuildError> {
        let steps = (STEP_HZ / robot.control.actuator_hz).ceil() as usize;
        let mut bodies = robot.clone();
        bodies.control.actuator_hz *= steps as f64;
        for joint in &mut bodies.joints {
            if PlantActuator::has_rotor(joint) {
                // The rotor is not part of the link.
                joint.armature = 0.0;
            }
            (joint.stribeck_friction, joint.load_friction) = (Stribeck::NONE, 0.0);
            (joint.spring, joint.actuator) = (JointSpring::NONE, ActuatorParams::IDEAL);
        }
        let physics_hz = Some(bodies.control.actuator_hz as u32);
        let config = SimConfig { engine: Engine::Mujoco, physics_hz, ..config };
        let bodies = create(bodies, config, 1)?;
        let actuator = PlantActuator::new(&robot, steps, &widened(&bodies.states().measured.q[0]));
        let states = bodies.states().clone();
        Ok(Self { robot, bodies, actuator, steps, states })
    }

    /// Returns positions [rad] and velocities [rad/s] of the links.
    fn links(&self) -> (Joints, Joints) {
        let measured = self.bodies.measured();
        (widened(&measured.q[0]), widened(&measured.dq[0]))
    }

    /// Sets the states after actuator periods in which the current sensors measured `tau` on average [N·m].
    fn update_states(&mut self, tau: Joints) {
        self.states = self.bodies.states().clone();
        let (q, dq) = self.links();
        let measured = &mut self.states.measured;
        for joint in 0..NUM_JOINTS {
            let (q, dq) = self.actuator.reading(joint, q[joint], dq[joint]);
            (measured.q[0][joint], measured.dq[0][joint]) = (q as f32, dq as f32);
        }
        measured.tau[0] = tau.map(|tau| tau as f32);
    }
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
        self.actuator = PlantActuator::new(&self.robot, self.steps, &self.links().0);
        self.update_states([0.0; NUM_JOINTS]);
        Ok(())
    }

    fn step(&mut self, commands: &[Command], active: &[bool], actuator_periods: usize) -> Result<(), BackendError> {
        let mut sum = [0.0; NUM_JOINTS];
        for _ in 0..actuator_periods {
            let (q, dq) = self.links();
            self.actuator.sample(&commands[0], &q, &dq);
            for _ in 0..self.steps {
                let (q, dq) = self.links();
                let torques = self.actuator.step(&q, &dq);
                let mut command = Command::hold([0.0; NUM_JOINTS], 0.0, 0.0);
                command.tau_ff = torques.applied.map(|tau| tau as f32);
                self.bodies.step(&[command], active, 1)?;
                sum.iter_mut().zip(torques.sensed).for_each(|(sum, tau)| *sum += tau);
            }
        }
        let count = (actuator_periods * self.steps) as f64;
        self.update_states(sum.map(|sum| sum / count));
        Ok(())
    }
}

impl Simulator for MujocoPlant {
    fn states(&self) -> &RobotStates {
        &self.states
    }

    fn set_derating(&mut self, _robot: usize, factors: &PerJoint) {
        self.actuator.derating = widened(factors);
    }
}
