//! What the batch engine needs of a robot, beside its equations of motion.

use glam::{DVec3, dvec3};
use twinstep_model::{BaseMount, Contact, JointModel, RobotModel, TreeModel};

/// Number of contact points of a leg: the foot, the distal end of the calf, the knee.
const LEG_POINTS: usize = 3;
/// Index of the first corner of the trunk: its points follow those of the legs.
const FIRST_CORNER: usize = 4 * LEG_POINTS;

/// Sphere, or point, that touches the ground.
#[derive(Clone, Copy, Debug)]
pub struct SurfacePoint {
    /// Index of the body: 0 is the base, joint `i` moves body `i + 1`.
    pub body: usize,
    /// Centre in the frame of the body [m].
    pub centre: DVec3,
    /// Radius [m].
    pub radius: f64,
}

/// Robot of a batch.
pub trait BatchRobot: Sync {
    /// Returns the joints with their actuators.
    fn joints(&self) -> &[JointModel];
    /// Returns the contact with the ground.
    fn contact(&self) -> &Contact;
    /// Returns true if the base cannot move, however the simulation mounts it.
    fn is_fixed(&self) -> bool;
    /// Returns the dry friction of a free base [N and N·m].
    fn base_friction(&self) -> f64;
    /// Returns the reading of the gyroscope at rest [rad/s].
    fn gyro_bias(&self) -> DVec3;
    /// Returns the points that touch the ground. Those of a body follow each other.
    fn surface_points(&self) -> Vec<SurfacePoint>;
}

impl BatchRobot for RobotModel {
    fn joints(&self) -> &[JointModel] {
        &self.joints
    }

    fn contact(&self) -> &Contact {
        &self.contact
    }

    fn is_fixed(&self) -> bool {
        false
    }

    fn base_friction(&self) -> f64 {
        0.0
    }

    fn gyro_bias(&self) -> DVec3 {
        self.gyro_bias
    }

    /// Returns foot, distal end of the calf and knee of each leg, then the corners of the trunk, then the hips.
    fn surface_points(&self) -> Vec<SurfacePoint> {
        let shapes = &self.shapes;
        let [knee, shin] = shapes.calf_ends;
        let of_leg = [(shapes.foot_centre, shapes.foot_radius), (shin, shapes.calf_radius), (knee, shapes.calf_radius)];
        let legs =
            (0..4).flat_map(|leg| of_leg.map(|(centre, radius)| SurfacePoint { body: 3 * leg + 3, centre, radius }));
        let corners = (0..8).map(|corner| {
            let sign = |bit: usize| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
            let centre = shapes.trunk_half_size * dvec3(sign(0), sign(1), sign(2));
            SurfacePoint { body: 0, centre, radius: 0.0 }
        });
        let hips = (0..4).map(|leg| SurfacePoint {
            body: 3 * leg + 1,
            centre: self.hip_centre(leg),
            radius: shapes.hip_radius,
        });
        legs.chain(corners).chain(hips).collect()
    }
}

/// Returns the index of the foot of a leg among the surface points of a quadruped.
pub fn foot_point(leg: usize) -> usize {
    leg * LEG_POINTS
}

/// Returns true if a surface point of a quadruped is a knee, a hip or a corner of the trunk.
pub fn is_upper_body(point: usize) -> bool {
    point >= FIRST_CORNER || point % LEG_POINTS == LEG_POINTS - 1
}

impl BatchRobot for TreeModel {
    fn joints(&self) -> &[JointModel] {
        &self.joints
    }

    fn contact(&self) -> &Contact {
        &self.contact
    }

    fn is_fixed(&self) -> bool {
        self.tree.base == Some(BaseMount::Fixed)
    }

    fn base_friction(&self) -> f64 {
        self.tree.free_joint.friction
    }

    fn gyro_bias(&self) -> DVec3 {
        DVec3::ZERO
    }

    fn surface_points(&self) -> Vec<SurfacePoint> {
        let points = self.points.iter();
        points.map(|point| SurfacePoint { body: point.body, centre: point.centre, radius: point.radius }).collect()
    }
}
