//! Places, joint axes, inertias and velocities of all bodies, in base axes at the base's origin.

use crate::{Inertia, Vec3};
use twinstep_model::TreeJointKind;
use twinstep_simd::SimdFloat;

use super::parameters::Place;
use super::structure::JointAxis;
use super::{TreeParameters, TreeState};

/// Angular and linear part of a motion, or moment and force of a wrench, at the base's origin.
#[derive(Clone, Copy, Debug)]
pub struct Spatial<T> {
    /// Angular velocity [rad/s], or moment [N·m].
    pub angular: Vec3<T>,
    /// Velocity [m/s], or force [N].
    pub linear: Vec3<T>,
}

impl<T: SimdFloat> Spatial<T> {
    /// Returns zero.
    #[inline(always)]
    pub fn zero() -> Self {
        Self { angular: Vec3::zero(), linear: Vec3::zero() }
    }

    /// Returns the sum.
    #[inline(always)]
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self { angular: self.angular + other.angular, linear: self.linear + other.linear }
    }

    /// Returns the product with a number.
    #[inline(always)]
    #[must_use]
    pub fn scaled(self, factor: T) -> Self {
        Self { angular: self.angular.scaled(factor), linear: self.linear.scaled(factor) }
    }

    /// Returns the power of a wrench in a motion.
    #[inline(always)]
    pub fn dot(self, other: Self) -> T {
        self.angular.dot(other.angular) + self.linear.dot(other.linear)
    }

    /// Returns the change of another motion that moves with this one.
    #[inline(always)]
    #[must_use]
    pub fn cross(self, other: Self) -> Self {
        Self {
            angular: self.angular.cross(other.angular),
            linear: self.angular.cross(other.linear) + self.linear.cross(other.angular),
        }
    }
}

/// Place, motion and inertia of a body.
#[derive(Clone, Debug)]
pub struct BodyMotion<T> {
    /// Place of the body.
    pub place: Place<T>,
    /// Motion of the joint of the body at unit velocity; zero for the base.
    pub axis: Spatial<T>,
    /// Velocity relative to a frame that moves with the base's origin without turning.
    pub velocity: Spatial<T>,
    /// Acceleration in that frame without those of base and joints. Gravity accelerates it upwards.
    pub acceleration: Spatial<T>,
    /// Force on the body for this acceleration.
    pub force: Spatial<T>,
    /// Inertia about the base's origin.
    pub inertia: Inertia<T>,
}

/// Motion of all bodies. The numbers of a body are together in memory, because those of all bodies leave the first cache.
#[derive(Clone, Debug)]
pub struct TreeMotion<T> {
    /// Bodies: the base, then that of each joint.
    pub bodies: Vec<BodyMotion<T>>,
}

impl<T: SimdFloat> TreeMotion<T> {
    /// Returns a placeholder for [`TreeMotion::set`], to be used in every step.
    pub fn empty(parameters: &TreeParameters<T>) -> Self {
        let zero = Spatial::zero();
        let body = |inertia: &Inertia<T>| BodyMotion {
            place: Place::identity(),
            axis: zero,
            velocity: zero,
            acceleration: zero,
            force: zero,
            inertia: *inertia,
        };
        Self { bodies: parameters.bodies.iter().map(body).collect() }
    }

    /// Computes everything for a state, with gravity [m/s²] along −z of the world.
    #[inline(always)]
    pub fn set(&mut self, parameters: &TreeParameters<T>, state: &TreeState<T>, gravity: T) {
        let structure = &*parameters.structure;
        let base = &mut self.bodies[0];
        base.velocity = Spatial { angular: state.angular_velocity, linear: Vec3::zero() };
        base.acceleration = Spatial { angular: Vec3::zero(), linear: state.world_axes()[2].scaled(gravity) };
        base.inertia = parameters.bodies[0];
        base.force = force(&base.inertia, base.velocity, base.acceleration);
        for joint in 0..structure.num_joints() {
            let (earlier, own) = self.bodies.split_at_mut(joint + 1);
            let (parent, body) = (&earlier[structure.parents[joint]], &mut own[0]);
            let mut place = if structure.is_parallel[joint] {
                parent.place.moved(parameters.places[joint].origin)
            } else {
                parent.place.after(&parameters.places[joint])
            };
            let (index, is_reversed) = match structure.axes[joint] {
                JointAxis::Along(index, sign) => (index, sign < 0.0),
                JointAxis::Turned => (2, false),
            };
            let direction = if is_reversed { -place.axes[index] } else { place.axes[index] };
            let axis = match structure.kinds[joint] {
                TreeJointKind::Revolute => {
                    let (sine, cosine) = state.q[joint].sin_cos();
                    place.turn(index, if is_reversed { -sine } else { sine }, cosine);
                    Spatial { angular: direction, linear: place.origin.cross(direction) }
                }
                TreeJointKind::Prismatic => {
                    place.origin = place.origin + direction.scaled(state.q[joint]);
                    Spatial { angular: Vec3::zero(), linear: direction }
                }
            };
            let own = axis.scaled(state.dq[joint]);
            body.velocity = parent.velocity.plus(own);
            body.acceleration = parent.acceleration.plus(parent.velocity.cross(own));
            body.inertia = turned(&parameters.bodies[joint + 1], &place).shifted(place.origin);
            body.force = force(&body.inertia, body.velocity, body.acceleration);
            (body.place, body.axis) = (place, axis);
        }
    }
}

/// Returns the force on a body for its acceleration: the change of its momentum.
#[inline(always)]
pub fn force<T: SimdFloat>(body: &Inertia<T>, velocity: Spatial<T>, acceleration: Spatial<T>) -> Spatial<T> {
    let momentum = times(body, velocity);
    let turning = Spatial {
        angular: velocity.angular.cross(momentum.angular) + velocity.linear.cross(momentum.linear),
        linear: velocity.angular.cross(momentum.linear),
    };
    times(body, acceleration).plus(turning)
}

/// Returns the inertia about the same point in the axes in which the body has this place.
#[inline(always)]
fn turned<T: SimdFloat>(body: &Inertia<T>, place: &Place<T>) -> Inertia<T> {
    let [xx, yy, zz, xy, xz, yz] = body.about_origin;
    // Columns of R I.
    let [a, b, c] =
        [place.turned(Vec3([xx, xy, xz])), place.turned(Vec3([xy, yy, yz])), place.turned(Vec3([xz, yz, zz]))];
    let [x, y, z] = place.axes;
    let entry = |i: usize, j: usize| a.0[i] * x.0[j] + b.0[i] * y.0[j] + c.0[i] * z.0[j];
    let about_origin = [entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)];
    Inertia { mass: body.mass, moment: place.turned(body.moment), about_origin }
}

/// Returns momentum for a velocity, or force for an acceleration: the product with the spatial inertia.
#[inline(always)]
pub fn times<T: SimdFloat>(body: &Inertia<T>, motion: Spatial<T>) -> Spatial<T> {
    let Spatial { angular, linear } = motion;
    Spatial {
        angular: body.times(angular) + body.moment.cross(linear),
        linear: linear.scaled(body.mass) + angular.cross(body.moment),
    }
}
