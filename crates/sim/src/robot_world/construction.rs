//! Construction of a rapier world: ground, bodies, joints and collision shapes of the robot, in the initial state.

use std::f64::consts::TAU;

use glam::{DVec3, Quat, Vec3};
use rapier3d::prelude::*;
use twinstep_dynamics::{SimdActuators, link_armature};
use twinstep_model::{BaseMount, Contact, JointModel, RigidBody, TreeJointKind};

use super::world_robot::{WorldLink, WorldRobot};
use super::{PRISMATIC_AXIS, REVOLUTE_AXIS, RobotWorld};
use crate::ground_shapes::GroundShapes;
use crate::{Placement, SimConfig};

/// MuJoCo's default impedance of a deep contact.
const IMPEDANCE: f64 = 0.95;
/// The bodies of a robot collide only with the ground.
const ROBOT_GROUP: InteractionGroups = InteractionGroups::new(Group::GROUP_1, Group::GROUP_2, InteractionTestMode::And);
const GROUND_GROUP: InteractionGroups =
    InteractionGroups::new(Group::GROUP_2, Group::GROUP_1, InteractionTestMode::And);

impl RobotWorld {
    /// Builds a robot in its initial state.
    pub fn new(robot: &WorldRobot, config: &SimConfig, ground: &GroundShapes, initial_state: &Placement) -> Self {
        let mut world = PhysicsWorld { gravity: Vec3::new(0.0, 0.0, -9.81), ..PhysicsWorld::default() };
        world.integration_parameters = integration_parameters(&robot.contact, config);
        let friction = robot.contact.friction as f32;
        insert_ground(&mut world, ground, friction);

        let base_com = robot.base.com.as_vec3();
        let base = insert_base(&mut world, config.base, &robot.base, initial_state);
        let mut bodies = vec![base];
        let mut multibody = None;
        for (link, joint) in robot.links.iter().zip(&robot.joints) {
            let child = world.insert_body(moving_body(RigidBodyBuilder::dynamic(), &link.body, link.body.com));
            // The frame of the base's body is at its centre of mass.
            let shift = if link.parent == 0 { robot.base.com } else { DVec3::ZERO };
            multibody = world.insert_multibody_joint(bodies[link.parent], child, rapier_joint(link, joint, shift));
            bodies.push(child);
        }
        let shapes = robot.shapes.iter().map(|(body, shape)| {
            let shape = if *body == 0 { shifted(shape.clone(), -base_com) } else { shape.clone() };
            insert_shape(&mut world, bodies[*body], shape, friction)
        });
        let shapes = shapes.collect();
        let axis = |link: &WorldLink| match link.kind {
            TreeJointKind::Revolute => REVOLUTE_AXIS,
            TreeJointKind::Prismatic => PRISMATIC_AXIS,
        };
        let dt = 1.0 / f64::from(config.physics_hz());
        let mut this = Self {
            actuator: SimdActuators::new(&robot.joints, robot.actuator_dt, dt).with_sampled_positions(),
            gyro_bias: robot.gyro_bias.as_vec3(),
            axes: robot.links.iter().map(axis).collect(),
            world,
            base,
            multibody: multibody.expect("a robot has a joint, and its tree no loop"),
            base_com,
            root_dofs: if config.base == BaseMount::Floating { 6 } else { 0 },
            shapes,
        };
        this.reset_joints(robot, initial_state);
        this
    }

    fn reset_joints(&mut self, robot: &WorldRobot, initial_state: &Placement) {
        let (root_dofs, num_joints) = (self.root_dofs, robot.joints.len());
        // An initial state contains encoder readings.
        let readings = robot.joints.iter().zip(initial_state.q.iter().zip(&initial_state.dq));
        let q: Vec<f64> = readings.map(|(joint, (q, dq))| q - joint.actuator.encoder_error(*dq)).collect();
        self.actuator.set(0, &robot.joints, &q, &initial_state.dq);
        let (multibody, _) = self.world.multibody_joints.get_mut(self.multibody).expect("built with the world");
        // Sets the pose of the root, and removes its six degrees of freedom if the base is fixed.
        multibody.forward_kinematics(&self.world.bodies, true);
        multibody.damping_mut().fill(0.0);
        for (dof, joint) in robot.joints.iter().enumerate() {
            multibody.armature_mut()[root_dofs + dof] = link_armature(joint) as f32;
            multibody.damping_mut()[root_dofs + dof] = joint.viscous_friction as f32;
        }
        let mut displacement = vec![0.0; root_dofs + num_joints];
        write(&mut displacement[root_dofs..], &q);
        multibody.apply_displacements(&displacement);

        let mut velocity = vec![0.0; root_dofs + num_joints];
        write(&mut velocity[root_dofs..], &initial_state.dq);
        if root_dofs > 0 {
            let world_from_base = rotation(initial_state);
            let angular_world = world_from_base * vector(initial_state.base_angular_velocity);
            let linear_com =
                vector(initial_state.base_linear_velocity) + angular_world.cross(world_from_base * self.base_com);
            velocity[..3].copy_from_slice(&linear_com.to_array());
            velocity[3..6].copy_from_slice(&angular_world.to_array());
        }
        multibody.generalized_velocity_mut().as_mut_slice().copy_from_slice(&velocity);
        multibody.forward_kinematics(&self.world.bodies, false);
        multibody.update_rigid_bodies(&mut self.world.bodies, true);
    }
}

fn vector(values: [f64; 3]) -> Vec3 {
    DVec3::from(values).as_vec3()
}

fn rotation(state: &Placement) -> Quat {
    let [w, x, y, z] = state.base_orientation.map(|value| value as f32);
    Quat::from_xyzw(x, y, z, w)
}

fn write(values: &mut [f32], given: &[f64]) {
    values.iter_mut().zip(given).for_each(|(value, given)| *value = *given as f32);
}

fn integration_parameters(contact: &Contact, config: &SimConfig) -> IntegrationParameters {
    let softness = softness(contact);
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

fn insert_base(
    world: &mut PhysicsWorld,
    mount: BaseMount,
    base: &RigidBody,
    initial_state: &Placement,
) -> RigidBodyHandle {
    let world_from_base = rotation(initial_state);
    let centre = vector(initial_state.base_position) + world_from_base * base.com.as_vec3();
    let builder = match mount {
        BaseMount::Floating => RigidBodyBuilder::dynamic(),
        BaseMount::Fixed => RigidBodyBuilder::fixed(),
    };
    let pose = Pose::from_parts(centre, world_from_base);
    world.insert_body(moving_body(builder, base, DVec3::ZERO).pose(pose))
}

/// Returns a body with the mass and inertia of `body`, whose centre of mass is at `com` in its frame.
fn moving_body(builder: RigidBodyBuilder, body: &RigidBody, com: DVec3) -> RigidBodyBuilder {
    let inertia = body.inertia.as_mat3();
    builder
        .additional_mass_properties(MassProperties::with_inertia_matrix(com.as_vec3(), body.mass as f32, inertia))
        .can_sleep(false)
}

/// Returns the joint of a link. `shift` is the origin of the parent's body in the frame of the parent [m].
fn rapier_joint(link: &WorldLink, joint: &JointModel, shift: DVec3) -> GenericJoint {
    let range = joint.range.map(|limit| limit as f32);
    let has_limits = range[0].is_finite() && range[1].is_finite();
    let (axis, anchor) = (link.axis.as_vec3(), (link.origin - shift).as_vec3());
    match link.kind {
        TreeJointKind::Revolute => {
            let joint = RevoluteJointBuilder::new(axis).local_anchor1(anchor).contacts_enabled(false);
            if has_limits { joint.limits(range).build().into() } else { joint.build().into() }
        }
        TreeJointKind::Prismatic => {
            let joint = PrismaticJointBuilder::new(axis).local_anchor1(anchor).contacts_enabled(false);
            if has_limits { joint.limits(range).build().into() } else { joint.build().into() }
        }
    }
}

/// Returns a shape that is moved by `offset` [m].
fn shifted(shape: ColliderBuilder, offset: Vec3) -> ColliderBuilder {
    let mut pose = shape.position;
    pose.translation += offset;
    shape.position(pose)
}

fn insert_shape(
    world: &mut PhysicsWorld,
    body: RigidBodyHandle,
    shape: ColliderBuilder,
    friction: f32,
) -> ColliderHandle {
    world.insert_collider(shape.friction(friction).density(0.0).collision_groups(ROBOT_GROUP), Some(body))
}
