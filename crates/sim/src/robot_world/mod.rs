//! One robot in a rapier world of its own: actuation and readout.
//!
//! - [`construction`]: the world with the robot in its initial state.
//! - [`world_robot`]: what a world needs of a robot.
//! - [`snapshot`]: saves and restores the state.
//!
//! A legged robot in rapier 0.36 needs these corrections. Each is covered by a test in `tests/it/physics.rs`:
//!
//! - *Default damping.* A multibody joint damps its angular axes by 0.1 N·m·s, those of the floating root included.
//!   The damping is set to zero.
//! - *Root frame.* A floating root whose centre of mass is not at its origin drifts in flight, because rapier moves the
//!   origin with the velocity of the centre of mass. The frame of the root body is therefore at the trunk's centre of
//!   mass, and anchors and shapes are shifted.
//! - *Torque.* rapier has no generalised forces. A spring of low stiffness (k = 1 mN·m/rad) with the rest position
//!   `q + τ/k` applies the torque without world-frame sums, and keeps it over the physics steps.
//! - *Reset.* Contact caches and joint coordinates survive an in-place reset. A reset therefore builds a new world
//!   (31 µs), which cannot depend on the previous state.

mod construction;
mod snapshot;
mod world_robot;

use glam::{Quat, Vec3};
use rapier3d::prelude::*;
use twinstep_dynamics::SimdActuators;
use twinstep_model::frames;

use crate::actuator_input::ActuatorInput;

pub use snapshot::WorldSnapshot;
pub use world_robot::{WorldRobot, foot_shape, is_upper_body};

/// Stiffness of the spring that applies a joint torque [N·m/rad].
const TORQUE_SPRING: f32 = 1e-3;
/// Index of a revolute joint's axis in rapier's six-axis layout.
const REVOLUTE_AXIS: usize = 3;
/// Index of a sliding joint's axis.
const PRISMATIC_AXIS: usize = 0;

/// World with one robot and the ground.
pub struct RobotWorld {
    world: PhysicsWorld,
    base: RigidBodyHandle,
    multibody: MultibodyJointHandle,
    /// Centre of mass of the base in its frame [m].
    base_com: Vec3,
    /// Degrees of freedom of the root: 6, or 0 with a fixed base.
    root_dofs: usize,
    /// Index of each joint's axis in rapier's six-axis layout.
    axes: Vec<usize>,
    /// Collision shapes, in the order of [`WorldRobot::shapes`].
    shapes: Vec<ColliderHandle>,
    actuator: SimdActuators<f64, Vec<f64>>,
    /// Gyroscope bias [rad/s].
    gyro_bias: Vec3,
}

impl RobotWorld {
    /// Sets the factors on the torque for supply voltage and motor temperature.
    pub fn set_derating(&mut self, factors: &[f32]) {
        self.actuator.set_derating(0, factors);
    }

    /// Adds `velocity` to the linear velocity of the base, in the world frame [m/s]. The base is floating.
    pub fn push(&mut self, velocity: [f32; 3]) {
        let (multibody, _) = self.world.multibody_joints.get_mut(self.multibody).expect("built with the world");
        for (component, change) in multibody.generalized_velocity_mut().as_mut_slice().iter_mut().zip(velocity) {
            *component += change;
        }
    }

    /// Advances by one actuator period of `steps` physics steps and returns the mean estimated torque [N·m or N].
    pub fn actuator_period(&mut self, input: ActuatorInput<Vec<f64>>, steps: usize) -> Vec<f64> {
        let (mut q, mut dq) = self.joints();
        match input {
            ActuatorInput::Commands(commands) => self.actuator.update_command(&commands, &q, &dq),
            ActuatorInput::Torques(tau) => self.actuator.set_torque(&tau),
            ActuatorInput::Residual(commands, tap, tau) => {
                self.actuator.update_command(&commands, &q, &dq);
                self.actuator.set_residual(tap, tau);
            }
        }
        let mut estimated = vec![0.0; q.len()];
        for index in 0..steps {
            self.actuator.step(index, &q, &dq);
            let forces = self.actuator.forces();
            let (multibody, _) = self.world.multibody_joints.get_mut(self.multibody).expect("built with the world");
            for (joint, link) in multibody.links_mut().skip(1).enumerate() {
                let axis = self.axes[joint];
                let position = link.joint().coords()[axis];
                link.joint.set_spring(axis, TORQUE_SPRING, position + forces.tau[joint] as f32 / TORQUE_SPRING);
            }
            for (joint, dry) in forces.dry_friction.iter().enumerate() {
                multibody.frictions_mut()[self.root_dofs + joint] = *dry as f32;
            }
            self.world.step();
            (q, dq) = self.joints();
            for (estimated, current) in estimated.iter_mut().zip(self.actuator.estimated_torque()) {
                *estimated += current / steps as f64;
            }
        }
        estimated
    }

    /// Returns the positions [rad or m] and velocities [rad/s or m/s] of the joints.
    fn joints(&self) -> (Vec<f64>, Vec<f64>) {
        let (multibody, _) = self.world.multibody_joints.get(self.multibody).expect("built with the world");
        let velocities = multibody.generalized_velocity();
        let joints = multibody.links().skip(1).zip(&self.axes).enumerate();
        joints
            .map(|(joint, (link, axis))| {
                let velocity = velocities[self.root_dofs + joint];
                (f64::from(link.joint().coords()[*axis]), f64::from(velocity))
            })
            .unzip()
    }

    /// Returns true if a number became NaN or infinite in the last step. rapier then quarantines the body.
    pub fn diverged(&self) -> bool {
        !self.world.quarantine().bodies().is_empty() || !self.world.quarantine().colliders().is_empty()
    }

    /// Reads the encoders: positions [rad or m] and velocities [rad/s or m/s].
    pub fn read_joints(&self) -> (Vec<f64>, Vec<f64>) {
        let (q, dq) = self.joints();
        let readings = q.into_iter().zip(dq).enumerate();
        readings.map(|(joint, (q, dq))| self.actuator.encoder_reading(joint, q, dq)).unzip()
    }

    /// Returns the pose and the velocity of the base frame.
    ///
    /// The velocity is that of the joint coordinates, because the body's velocity is delayed by one physics step.
    pub fn read_base(&self) -> BaseState {
        let base = &self.world.bodies[self.base];
        let rotation = Quat::from_array(base.position().rotation.to_array());
        let offset_world = rotation * self.base_com;
        let (linear_com, angular_world) = self.root_velocity();
        BaseState {
            position: (base.translation() - offset_world).to_array(),
            orientation: frames::to_wxyz(rotation),
            linear_velocity: (linear_com - angular_world.cross(offset_world)).to_array(),
            angular_velocity: (rotation.inverse() * angular_world).to_array(),
            gyro: (rotation.inverse() * angular_world + self.gyro_bias).to_array(),
        }
    }

    /// Returns the velocity of the base's centre of mass [m/s] and its angular velocity [rad/s], in the world frame.
    fn root_velocity(&self) -> (Vec3, Vec3) {
        if self.root_dofs == 0 {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let (multibody, _) = self.world.multibody_joints.get(self.multibody).expect("built with the world");
        let velocity = multibody.generalized_velocity();
        (Vec3::new(velocity[0], velocity[1], velocity[2]), Vec3::new(velocity[3], velocity[4], velocity[5]))
    }

    /// Returns the normal force on each shape, mean over the last physics step [N].
    pub fn shape_forces(&self) -> impl Iterator<Item = f32> {
        self.shapes.iter().map(|shape| self.normal_impulse(*shape) / self.world.integration_parameters.dt)
    }

    fn normal_impulse(&self, shape: ColliderHandle) -> f32 {
        self.world.narrow_phase.contact_pairs_with(shape).map(ContactPair::total_impulse_magnitude).sum()
    }
}

/// Pose and velocity of the base frame, as in [`twinstep_model::RobotStates`].
pub struct BaseState {
    /// Position of the origin in the world frame [m].
    pub position: [f32; 3],
    /// World-from-base, `[w, x, y, z]`.
    pub orientation: [f32; 4],
    /// Velocity of the origin in the world frame [m/s].
    pub linear_velocity: [f32; 3],
    /// Angular velocity in the base frame [rad/s].
    pub angular_velocity: [f32; 3],
    /// Reading of the gyroscope: angular velocity with bias, in the base frame [rad/s].
    pub gyro: [f32; 3],
}

#[cfg(test)]
mod tests {
    use std::f32::consts::TAU;

    use twinstep_model::{Ground, InitialState, body_poses, go2};

    use super::*;
    use crate::ground_shapes::GroundShapes;
    use crate::{Placement, SimConfig};

    /// Rendering uses the forward kinematics of the model, so they must agree with the engine.
    #[test]
    fn body_poses_agree_with_the_forward_kinematics() {
        let robot = go2();
        let q = std::array::from_fn(|j| robot.control.default_pose[j] as f32 + 0.2 * (j as f32).sin());
        let tilted = Quat::from_euler(glam::EulerRot::ZYX, 0.1 * TAU, 0.05 * TAU, -0.03 * TAU);
        let initial_state = InitialState { base_orientation: frames::to_wxyz(tilted), ..InitialState::at_rest(0.6, q) };
        let mut world = RobotWorld::new(
            &WorldRobot::of_quadruped(&robot),
            &SimConfig::default(),
            &GroundShapes::new(&Ground::FLAT),
            &Placement::from(&initial_state),
        );
        for steps in [0, 40] {
            world.actuator_period(ActuatorInput::Torques((0..12).map(|joint| f64::from(joint).cos()).collect()), steps);
            let q = std::array::from_fn(|joint| world.read_joints().0[joint] as f32);
            let base = world.read_base();
            let world_from_base = twinstep_model::Pose {
                position: Vec3::from(base.position),
                rotation: frames::world_from_base(base.orientation),
            };
            let (multibody, _) = world.world.multibody_joints.get(world.multibody).expect("built with the world");
            let expected = body_poses(&robot, world_from_base, &q);
            for (link, expected) in multibody.links().skip(1).zip(&expected[1..]) {
                let body = &world.world.bodies[link.rigid_body_handle()];
                assert!((body.translation() - expected.position).length() < 1e-5, "after {steps} steps");
                let rotation = Quat::from_array(body.position().rotation.to_array());
                // Compares axes, because the arc cosine of nearly 1 loses half the digits.
                for axis in [Vec3::X, Vec3::Y, Vec3::Z] {
                    assert!((rotation * axis - expected.rotation * axis).length() < 1e-4, "after {steps} steps");
                }
            }
        }
    }
}
