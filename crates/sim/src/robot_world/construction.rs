//! Construction of a rapier world: ground, bodies, joints and collision shapes of the robot, in the initial state.

use std::f64::consts::TAU;

use glam::{DVec3, Vec3};
use rapier3d::prelude::*;
use twinstep_dynamics::{SimdActuators, link_armature};
use twinstep_model::{
    BaseMount, Contact, InitialState, Joint, JointKind, Leg, NUM_JOINTS, PerJoint, RigidBody, RobotModel, frames,
};

use super::RobotWorld;
use crate::SimConfig;
use crate::ground_shapes::GroundShapes;

/// MuJoCo's default impedance of a deep contact.
const IMPEDANCE: f64 = 0.95;
/// The bodies of a robot collide only with the ground.
const ROBOT_GROUP: InteractionGroups = InteractionGroups::new(Group::GROUP_1, Group::GROUP_2, InteractionTestMode::And);
const GROUND_GROUP: InteractionGroups =
    InteractionGroups::new(Group::GROUP_2, Group::GROUP_1, InteractionTestMode::And);

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
            actuator: SimdActuators::new(
                &robot.joints,
                robot.control.actuator_dt(),
                1.0 / f64::from(config.physics_hz()),
            )
            .with_sampled_positions(),
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
        let q: PerJoint = std::array::from_fn(|joint| {
            let dq = f64::from(initial_state.dq[joint]);
            initial_state.q[joint] - robot.joints[joint].actuator.encoder_error(dq) as f32
        });
        self.actuator.set(0, &robot.joints, &q.map(f64::from), &initial_state.dq.map(f64::from));
        let (multibody, _) = self.world.multibody_joints.get_mut(self.multibody).expect("built with the world");
        // Sets the pose of the root, and removes its six degrees of freedom if the base is fixed.
        multibody.forward_kinematics(&self.world.bodies, true);
        multibody.damping_mut().fill(0.0);
        for (dof, joint) in robot.joints.iter().enumerate() {
            multibody.armature_mut()[root_dofs + dof] = link_armature(joint) as f32;
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
    let revolute = RevoluteJointBuilder::new(RobotModel::axis(joint).as_vec3())
        .local_anchor1(origin.as_vec3())
        .contacts_enabled(false);
    let has_limits = range[0].is_finite() && range[1].is_finite();
    if has_limits { revolute.limits(range).build().into() } else { revolute.build().into() }
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
