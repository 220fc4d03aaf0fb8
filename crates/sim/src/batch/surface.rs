//! What of a batch of robots touches the ground, and how.

use glam::DVec3;
use twinstep_dynamics::{StepEquations, Vec3};
use twinstep_model::Ground;
use twinstep_simd::SimdFloat;

use super::batch_robot::{BatchRobot, SurfacePoint};
use super::ground::SimdTerrain;
use crate::SimConfig;

/// Parameters of contacts and joint limits.
#[derive(Clone, Debug)]
pub struct ContactParams<T> {
    /// Contact points.
    pub points: Vec<SimdPoint<T>>,
    /// Contact points by body.
    pub bodies: Vec<PointsOfBody<T>>,
    /// The ground.
    pub ground: SimdTerrain<T>,
    /// Friction coefficient of the ground.
    pub friction: T,
    /// Time constant of a contact [s]; at least two steps.
    pub time_constant: T,
    /// Lower and upper joint limits [rad or m].
    pub limits: Vec<[T; 2]>,
    /// Time constant of a joint limit [s]; at least two steps.
    pub limit_time_constant: T,
    /// Dry friction of a free base [N and N·m].
    pub base_friction: T,
    /// 1 with a free base, 0 with a fixed base.
    pub is_floating: T,
}

/// Sphere that touches the ground.
#[derive(Clone, Copy, Debug)]
pub struct SimdPoint<T> {
    /// Centre in the frame of its body [m].
    pub centre: Vec3<T>,
    /// Radius [m].
    pub radius: T,
}

/// Contact points of a body, and a sphere that contains them.
#[derive(Clone, Debug)]
pub struct PointsOfBody<T> {
    /// Index of the body.
    pub body: usize,
    /// Indices of the points.
    pub points: std::ops::Range<usize>,
    /// Centre of the sphere in the frame of the body [m].
    pub centre: Vec3<T>,
    /// Radius of the sphere [m].
    pub radius: T,
}

impl<T: SimdFloat> ContactParams<T> {
    /// Returns how many contacts there are at most.
    pub fn num_contacts(&self) -> usize {
        self.points.len() * self.ground.contacts_of_point()
    }

    /// Returns the contact points and limits of `robot` in every lane, on `ground`. Friction and time constant of the ground are still
    /// zero: they differ by robot.
    pub fn new<E: StepEquations<T, Robot: BatchRobot>>(
        robot: &E::Robot,
        config: &SimConfig,
        ground: &Ground,
        dt: f64,
    ) -> Self {
        let given = robot.surface_points();
        let centres: Vec<DVec3> =
            given.iter().map(|SurfacePoint { body, centre, .. }| E::point_of_body(robot, *body, *centre)).collect();
        let points = given.iter().zip(&centres).map(|(SurfacePoint { radius, .. }, centre)| SimdPoint {
            centre: Vec3::splat(*centre),
            radius: T::splat(*radius),
        });
        let mut bodies = Vec::new();
        let mut start = 0;
        for of_body in given.chunk_by(|a, b| a.body == b.body) {
            let range = start..start + of_body.len();
            let centre = centres[range.clone()].iter().sum::<DVec3>() / of_body.len() as f64;
            let reach = of_body.iter().zip(&centres[range.clone()]);
            let radius = reach.map(|(point, at)| at.distance(centre) + point.radius).fold(0.0, f64::max);
            start = range.end;
            bodies.push(PointsOfBody {
                body: of_body[0].body,
                points: range,
                centre: Vec3::splat(centre),
                radius: T::splat(radius),
            });
        }
        let zero = T::splat(0.0);
        Self {
            points: points.collect(),
            bodies,
            ground: SimdTerrain::new(ground),
            friction: zero,
            time_constant: zero,
            limits: robot.joints().iter().map(|joint| joint.range.map(T::splat)).collect(),
            base_friction: zero,
            limit_time_constant: T::splat(2.0 * dt),
            is_floating: T::splat(if config.base.is_fixed() || robot.is_fixed() { 0.0 } else { 1.0 }),
        }
    }
}
