//! Snapshot of a rapier world: saves and restores the state on which a step depends.

use glam::Vec3;
use rapier3d::prelude::*;
use twinstep_dynamics::SimdActuators;

use super::RobotWorld;

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

/// State of a world outside rapier's sets. A reset with another robot model changes the base and the handles.
#[derive(Clone)]
struct RootFrame {
    base: RigidBodyHandle,
    multibody: MultibodyJointHandle,
    base_com: Vec3,
    axes: Vec<usize>,
    shapes: Vec<ColliderHandle>,
    actuator: SimdActuators<f64, Vec<f64>>,
    gyro_bias: Vec3,
    /// Contains the contact compliance, which depends on the robot model.
    integration_parameters: IntegrationParameters,
}

impl RobotWorld {
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
                base: self.base,
                multibody: self.multibody,
                base_com: self.base_com,
                axes: self.axes.clone(),
                shapes: self.shapes.clone(),
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
        let RootFrame { base, multibody, base_com, axes, shapes, actuator, gyro_bias, .. } = root;
        (self.base, self.multibody, self.base_com, self.axes, self.shapes, self.actuator, self.gyro_bias) =
            (base, multibody, base_com, axes, shapes, actuator, gyro_bias);
    }
}
