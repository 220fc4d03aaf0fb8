//! One Go2 in a rapier world of its own: construction, actuation and readout.
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

use std::f64::consts::TAU;

use glam::{DVec3, Quat, Vec3};
use rapier3d::prelude::*;
use twinstep_model::{
    BaseMount, Command, Contact, InitialState, Joint, JointKind, Leg, NUM_JOINTS, PerJoint, PerLeg, RigidBody,
    RobotModel,
    dynamics::{JointForces, SimdActuators, SimdCommands},
    frames,
};

use crate::SimConfig;
use crate::ground_shapes::GroundShapes;

/// MuJoCo's default impedance of a deep contact.
const IMPEDANCE: f64 = 0.95;
/// Stiffness of the spring that applies a joint torque [N·m/rad].
const TORQUE_SPRING: f32 = 1e-3;
/// Index of a revolute joint's axis in rapier's six-axis layout.
const REVOLUTE_AXIS: usize = 3;
/// The bodies of a robot collide only with the ground.
const ROBOT_GROUP: InteractionGroups = InteractionGroups::new(Group::GROUP_1, Group::GROUP_2, InteractionTestMode::And);
const GROUND_GROUP: InteractionGroups =
    InteractionGroups::new(Group::GROUP_2, Group::GROUP_1, InteractionTestMode::And);

/// World with one robot and the ground.
pub struct RobotWorld {
    world: PhysicsWorld,
    trunk: RigidBodyHandle,
    multibody: MultibodyJointHandle,
    /// Centre of mass of the trunk in the base frame [m].
    trunk_com: Vec3,
    /// Degrees of freedom of the root: 6, or 0 with a fixed base.
    root_dofs: usize,
    feet: [ColliderHandle; 4],
    upper_body: Vec<ColliderHandle>,
    actuator: SimdActuators<f64>,
    /// Gyroscope bias [rad/s].
    gyro_bias: Vec3,
}

/// Input of the actuators of one robot.
#[derive(Clone, Copy)]
pub enum ActuatorInputRef<'a> {
    /// A command to the actuators of the robot model.
    Command(&'a Command),
    /// Joint torques of an external actuator [N·m].
    Torques(&'a PerJoint),
}

/// State of a world on which a step depends.
#[derive(Clone)]
pub struct WorldSnapshot {
    islands: IslandManager,
    broad_phase: DefaultBroadPhase,
    narrow_phase: NarrowPhase,
    bodies: RigidBodySet,
    colliders: ColliderSet,
    multibody_joints: MultibodyJointSet,
    root: RootFrame,
}

/// State of a world outside rapier's sets. A reset with another robot model changes the trunk and the handles.
#[derive(Clone)]
struct RootFrame {
    trunk: RigidBodyHandle,
    multibody: MultibodyJointHandle,
    trunk_com: Vec3,
    feet: [ColliderHandle; 4],
    upper_body: Vec<ColliderHandle>,
    actuator: SimdActuators<f64>,
    gyro_bias: Vec3,
    /// Contains the contact compliance, which depends on the robot model.
    integration_parameters: IntegrationParameters,
}

impl RobotWorld {
    /// Builds a robot in its initial state.
    pub fn new(robot: &RobotModel, config: &SimConfig, ground: &GroundShapes, initial_state: &InitialState) -> Self {
        let mut world = PhysicsWorld { gravity: Vec3::new(0.0, 0.0, -9.81), ..PhysicsWorld::default() };
        world.integration_parameters = integration_parameters(robot, config);
        let friction = robot.contact.friction as f32;
        insert_ground(&mut world, ground, friction);

        let trunk_com = robot.trunk.com.as_vec3();
        let trunk = insert_trunk(&mut world, config.base, &robot.trunk, initial_state);
        let mut upper_body = vec![insert_shape(&mut world, trunk, trunk_box(robot).translation(-trunk_com), friction)];
        let mut feet = Vec::with_capacity(4);
        let mut multibody = None;
        for leg in Leg::ALL {
            let mut parent = (trunk, -robot.trunk.com);
            for kind in JointKind::ALL {
                let joint = Joint { leg, kind };
                let body = robot.legs[leg as usize].bodies[kind as usize];
                let child = world.insert_body(moving_body(RigidBodyBuilder::dynamic(), &body, body.com));
                let origin = robot.legs[leg as usize].origins[kind as usize] + parent.1;
                multibody = world.insert_multibody_joint(parent.0, child, revolute(robot, joint, origin));
                parent = (child, DVec3::ZERO);
                match kind {
                    JointKind::Hip => {}
                    JointKind::Thigh => upper_body.push(insert_shape(&mut world, child, thigh_box(robot), friction)),
                    JointKind::Calf => {
                        insert_shape(&mut world, child, calf_capsule(robot), friction);
                        feet.push(insert_shape(&mut world, child, foot_sphere(robot), friction));
                    }
                }
            }
        }
        let mut this = Self {
            actuator: SimdActuators::new(robot, 1.0 / f64::from(config.physics_hz())),
            gyro_bias: robot.gyro_bias.as_vec3(),
            world,
            trunk,
            multibody: multibody.expect("the joints of a leg form no loop"),
            trunk_com,
            root_dofs: if config.base == BaseMount::Floating { 6 } else { 0 },
            feet: feet.try_into().expect("each leg has one foot"),
            upper_body,
        };
        this.reset_joints(robot, initial_state);
        this
    }

    fn reset_joints(&mut self, robot: &RobotModel, initial_state: &InitialState) {
        let root_dofs = self.root_dofs;
        // An initial state contains encoder readings.
        let q: PerJoint =
            std::array::from_fn(|joint| initial_state.q[joint] - robot.joints[joint].actuator.encoder_offset as f32);
        let rotors = self.actuator.set(0, robot, &q, &initial_state.dq);
        let (multibody, _) = self.world.multibody_joints.get_mut(self.multibody).expect("built with the world");
        // Sets the pose of the root, and removes its six degrees of freedom if the base is fixed.
        multibody.forward_kinematics(&self.world.bodies, true);
        multibody.damping_mut().fill(0.0);
        for (dof, (joint, rotor)) in robot.joints.iter().zip(rotors).enumerate() {
            multibody.armature_mut()[root_dofs + dof] = rotor as f32;
            multibody.damping_mut()[root_dofs + dof] = joint.viscous_friction as f32;
        }
        let mut displacement = vec![0.0; root_dofs + NUM_JOINTS];
        displacement[root_dofs..].copy_from_slice(&q);
        multibody.apply_displacements(&displacement);

        let mut velocity = vec![0.0; root_dofs + NUM_JOINTS];
        velocity[root_dofs..].copy_from_slice(&initial_state.dq);
        if root_dofs > 0 {
            let world_from_base = frames::world_from_base(initial_state.base_orientation);
            let angular_world = world_from_base * Vec3::from(initial_state.base_angular_velocity);
            let linear_com =
                Vec3::from(initial_state.base_linear_velocity) + angular_world.cross(world_from_base * self.trunk_com);
            velocity[..3].copy_from_slice(&linear_com.to_array());
            velocity[3..6].copy_from_slice(&angular_world.to_array());
        }
        multibody.generalized_velocity_mut().as_mut_slice().copy_from_slice(&velocity);
        multibody.forward_kinematics(&self.world.bodies, false);
        multibody.update_rigid_bodies(&mut self.world.bodies, true);
    }

    /// Sets the factors on the torque for supply voltage and motor temperature.
    pub fn set_derating(&mut self, factors: &PerJoint) {
        self.actuator.set_derating(0, factors);
    }

    /// Advances by one actuator period of `steps` physics steps and returns the mean estimated torque [N·m].
    pub fn actuator_period(&mut self, input: ActuatorInputRef, steps: usize) -> PerJoint {
        let (mut q, mut dq) = self.joints();
        match input {
            ActuatorInputRef::Command(command) => {
                self.actuator.update_command(&SimdCommands::new(std::slice::from_ref(command)), &q, &dq);
            }
            ActuatorInputRef::Torques(tau) => self.actuator.set_torque(tau.map(f64::from)),
        }
        let mut estimated = [0.0; NUM_JOINTS];
        for index in 0..steps {
            let JointForces { tau, dry_friction: dry, .. } = self.actuator.step(index, &q, &dq);
            let (multibody, _) = self.world.multibody_joints.get_mut(self.multibody).expect("built with the world");
            for (joint, link) in multibody.links_mut().skip(1).enumerate() {
                let position = link.joint().coords()[REVOLUTE_AXIS];
                link.joint.set_spring(REVOLUTE_AXIS, TORQUE_SPRING, position + tau[joint] as f32 / TORQUE_SPRING);
            }
            for (joint, dry) in dry.into_iter().enumerate() {
                multibody.frictions_mut()[self.root_dofs + joint] = dry as f32;
            }
            self.world.step();
            (q, dq) = self.joints();
            for (estimated, current) in estimated.iter_mut().zip(self.actuator.estimated_torque()) {
                *estimated += current / steps as f64;
            }
        }
        estimated.map(|tau| tau as f32)
    }

    /// Returns the positions [rad] and velocities [rad/s] of the joints.
    fn joints(&self) -> ([f64; NUM_JOINTS], [f64; NUM_JOINTS]) {
        let (multibody, _) = self.world.multibody_joints.get(self.multibody).expect("built with the world");
        let (mut q, mut dq) = ([0.0; NUM_JOINTS], [0.0; NUM_JOINTS]);
        let velocities = multibody.generalized_velocity();
        for (joint, link) in multibody.links().skip(1).enumerate() {
            q[joint] = f64::from(link.joint().coords()[REVOLUTE_AXIS]);
            dq[joint] = f64::from(velocities[self.root_dofs + joint]);
        }
        (q, dq)
    }

    /// Returns true if a number became NaN or infinite in the last step. rapier then quarantines the body.
    pub fn diverged(&self) -> bool {
        !self.world.quarantine().bodies().is_empty() || !self.world.quarantine().colliders().is_empty()
    }

    /// Reads the encoders: positions [rad] and velocities [rad/s].
    pub fn read_joints(&self, q: &mut PerJoint, dq: &mut PerJoint) {
        let (positions, velocities) = self.joints();
        for joint in 0..NUM_JOINTS {
            let (encoder_q, encoder_dq) = self.actuator.encoder_reading(joint, positions[joint], velocities[joint]);
            (q[joint], dq[joint]) = (encoder_q as f32, encoder_dq as f32);
        }
    }

    /// Returns the pose and the velocity of the base frame.
    ///
    /// The velocity is that of the joint coordinates, because the trunk body's velocity is delayed by one physics step.
    pub fn read_base(&self) -> BaseState {
        let trunk = &self.world.bodies[self.trunk];
        let rotation = Quat::from_array(trunk.position().rotation.to_array());
        let offset_world = rotation * self.trunk_com;
        let (linear_com, angular_world) = self.root_velocity();
        BaseState {
            position: (trunk.translation() - offset_world).to_array(),
            orientation: frames::to_wxyz(rotation),
            linear_velocity: (linear_com - angular_world.cross(offset_world)).to_array(),
            angular_velocity: (rotation.inverse() * angular_world).to_array(),
            gyro: (rotation.inverse() * angular_world + self.gyro_bias).to_array(),
        }
    }

    /// Returns the velocity of the trunk's centre of mass [m/s] and its angular velocity [rad/s], in the world frame.
    fn root_velocity(&self) -> (Vec3, Vec3) {
        if self.root_dofs == 0 {
            return (Vec3::ZERO, Vec3::ZERO);
        }
        let (multibody, _) = self.world.multibody_joints.get(self.multibody).expect("built with the world");
        let velocity = multibody.generalized_velocity();
        (Vec3::new(velocity[0], velocity[1], velocity[2]), Vec3::new(velocity[3], velocity[4], velocity[5]))
    }

    /// Returns the normal force on each foot, mean over the last physics step [N].
    pub fn foot_forces(&self) -> PerLeg {
        self.feet.map(|foot| self.normal_impulse(foot) / self.world.integration_parameters.dt)
    }

    /// Returns true if the trunk or a thigh touches the ground.
    pub fn body_contact(&self) -> bool {
        self.upper_body.iter().any(|shape| self.normal_impulse(*shape) > 0.0)
    }

    fn normal_impulse(&self, shape: ColliderHandle) -> f32 {
        self.world.narrow_phase.contact_pairs_with(shape).map(ContactPair::total_impulse_magnitude).sum()
    }

    /// Returns the state on which the next step depends.
    pub fn snapshot(&self) -> WorldSnapshot {
        WorldSnapshot {
            islands: self.world.islands.clone(),
            broad_phase: self.world.broad_phase.clone(),
            narrow_phase: self.world.narrow_phase.clone(),
            bodies: self.world.bodies.clone(),
            colliders: self.world.colliders.clone(),
            multibody_joints: self.world.multibody_joints.clone(),
            root: RootFrame {
                trunk: self.trunk,
                multibody: self.multibody,
                trunk_com: self.trunk_com,
                feet: self.feet,
                upper_body: self.upper_body.clone(),
                actuator: self.actuator.clone(),
                gyro_bias: self.gyro_bias,
                integration_parameters: self.world.integration_parameters,
            },
        }
    }

    /// Restores the state of `snapshot`.
    pub fn restore(&mut self, snapshot: &WorldSnapshot) {
        let WorldSnapshot { islands, broad_phase, narrow_phase, bodies, colliders, multibody_joints, root } =
            snapshot.clone();
        self.world = PhysicsWorld {
            gravity: self.world.gravity,
            integration_parameters: root.integration_parameters,
            islands,
            broad_phase,
            narrow_phase,
            bodies,
            colliders,
            multibody_joints,
            ..PhysicsWorld::default()
        };
        let RootFrame { trunk, multibody, trunk_com, feet, upper_body, actuator, gyro_bias, .. } = root;
        (self.trunk, self.multibody, self.trunk_com, self.feet, self.upper_body, self.actuator, self.gyro_bias) =
            (trunk, multibody, trunk_com, feet, upper_body, actuator, gyro_bias);
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

fn integration_parameters(robot: &RobotModel, config: &SimConfig) -> IntegrationParameters {
    let softness = softness(&robot.contact);
    IntegrationParameters {
        dt: 1.0 / config.physics_hz() as f32,
        num_solver_iterations: config.solver_iterations() as usize,
        max_ccd_substeps: 0,
        contact_softness: softness,
        static_contact_softness: softness,
        ..IntegrationParameters::default()
    }
}

/// Returns the rapier contact spring that is as compliant as MuJoCo's contact.
///
/// MuJoCo's impedance d leaves the fraction 1 − d of the unconstrained acceleration. A load is therefore supported by
/// a spring and a damper that are d / (1 − d) times as stiff as those of the time constant.
fn softness(contact: &Contact) -> SpringCoefficients<f32> {
    let residual_scale = (1.0 - IMPEDANCE).sqrt();
    let frequency = 1.0 / (TAU * contact.time_constant * contact.damping_ratio * residual_scale);
    SpringCoefficients::new(frequency as f32, (contact.damping_ratio / residual_scale) as f32)
}

fn insert_ground(world: &mut PhysicsWorld, ground: &GroundShapes, friction: f32) {
    for collider in ground.colliders() {
        world.insert_collider(collider.friction(friction).collision_groups(GROUND_GROUP), None);
    }
}

fn insert_trunk(
    world: &mut PhysicsWorld,
    base: BaseMount,
    trunk: &RigidBody,
    initial_state: &InitialState,
) -> RigidBodyHandle {
    let world_from_base = frames::world_from_base(initial_state.base_orientation);
    let centre = Vec3::from(initial_state.base_position) + world_from_base * trunk.com.as_vec3();
    let builder = match base {
        BaseMount::Floating => RigidBodyBuilder::dynamic(),
        BaseMount::Fixed => RigidBodyBuilder::fixed(),
    };
    let pose = Pose::from_parts(centre, world_from_base);
    world.insert_body(moving_body(builder, trunk, DVec3::ZERO).pose(pose))
}

/// Returns a body with the mass and inertia of `body`, whose centre of mass is at `com` in its frame.
fn moving_body(builder: RigidBodyBuilder, body: &RigidBody, com: DVec3) -> RigidBodyBuilder {
    let inertia = body.inertia.as_mat3();
    builder
        .additional_mass_properties(MassProperties::with_inertia_matrix(com.as_vec3(), body.mass as f32, inertia))
        .can_sleep(false)
}

fn revolute(robot: &RobotModel, joint: Joint, origin: DVec3) -> GenericJoint {
    let range = robot.joints[joint.index()].range.map(|limit| limit as f32);
    RevoluteJointBuilder::new(RobotModel::axis(joint).as_vec3())
        .local_anchor1(origin.as_vec3())
        .limits(range)
        .contacts_enabled(false)
        .build()
        .into()
}

fn insert_shape(
    world: &mut PhysicsWorld,
    body: RigidBodyHandle,
    shape: ColliderBuilder,
    friction: f32,
) -> ColliderHandle {
    world.insert_collider(shape.friction(friction).density(0.0).collision_groups(ROBOT_GROUP), Some(body))
}

fn trunk_box(robot: &RobotModel) -> ColliderBuilder {
    let half = robot.shapes.trunk_half_size.as_vec3();
    ColliderBuilder::cuboid(half.x, half.y, half.z)
}

fn thigh_box(robot: &RobotModel) -> ColliderBuilder {
    let half = robot.shapes.thigh_half_size.as_vec3();
    ColliderBuilder::cuboid(half.x, half.y, half.z).translation(robot.shapes.thigh_centre.as_vec3())
}

fn calf_capsule(robot: &RobotModel) -> ColliderBuilder {
    let [knee, shin] = [robot.shapes.calf_ends[0].as_vec3(), robot.shapes.calf_ends[1].as_vec3()];
    ColliderBuilder::capsule_from_endpoints(knee, shin, robot.shapes.calf_radius as f32)
}

fn foot_sphere(robot: &RobotModel) -> ColliderBuilder {
    ColliderBuilder::ball(robot.shapes.foot_radius as f32).translation(robot.shapes.foot_centre.as_vec3())
}

#[cfg(test)]
mod tests {
    use std::f32::consts::TAU;

    use twinstep_model::{Ground, body_poses, go2};

    use super::*;

    /// Rendering uses the forward kinematics of the model, so they must agree with the engine.
    #[test]
    fn body_poses_agree_with_the_forward_kinematics() {
        let robot = go2();
        let q = std::array::from_fn(|j| robot.control.default_pose[j] as f32 + 0.2 * (j as f32).sin());
        let tilted = Quat::from_euler(glam::EulerRot::ZYX, 0.1 * TAU, 0.05 * TAU, -0.03 * TAU);
        let initial_state = InitialState { base_orientation: frames::to_wxyz(tilted), ..InitialState::at_rest(0.6, q) };
        let mut world =
            RobotWorld::new(&robot, &SimConfig::default(), &GroundShapes::new(&Ground::FLAT), &initial_state);
        for steps in [0, 40] {
            world.actuator_period(ActuatorInputRef::Torques(&std::array::from_fn(|j| (j as f32).cos())), steps);
            let (mut q, mut dq) = (PerJoint::default(), PerJoint::default());
            world.read_joints(&mut q, &mut dq);
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
