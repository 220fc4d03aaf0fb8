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

/// Places and motion of all bodies.
#[derive(Clone, Debug)]
pub struct TreeMotion<T> {
    /// Place of each body.
    pub places: Vec<Place<T>>,
    /// Motion of each joint at unit velocity.
    pub axes: Vec<Spatial<T>>,
    /// Inertia of each body about the base's origin.
    pub inertias: Vec<Inertia<T>>,
    /// Velocity of each body relative to a frame that moves with the base's origin without turning.
    pub velocities: Vec<Spatial<T>>,
}

impl<T: SimdFloat> TreeMotion<T> {
    /// Returns a placeholder for [`TreeMotion::set`], to be used in every step.
    pub fn empty(parameters: &TreeParameters<T>) -> Self {
        let joints = parameters.structure.num_joints();
        Self {
            places: vec![Place::identity(); joints + 1],
            axes: vec![Spatial::zero(); joints],
            inertias: parameters.bodies.clone(),
            velocities: vec![Spatial::zero(); joints + 1],
        }
    }

    /// Computes everything for a state.
    #[inline(always)]
    pub fn set(&mut self, parameters: &TreeParameters<T>, state: &TreeState<T>) {
        let structure = &*parameters.structure;
        self.velocities[0] = Spatial { angular: state.angular_velocity, linear: Vec3::zero() };
        self.inertias[0] = parameters.bodies[0];
        for joint in 0..structure.num_joints() {
            let parent = structure.parents[joint];
            let mut place = if structure.is_parallel[joint] {
                self.places[parent].moved(parameters.places[joint].origin)
            } else {
                self.places[parent].after(&parameters.places[joint])
            };
            let (index, is_reversed) = match structure.axes[joint] {
                JointAxis::Along(index, sign) => (index, sign < 0.0),
                JointAxis::Turned => (2, false),
            };
            let axis = if is_reversed { -place.axes[index] } else { place.axes[index] };
            let unit = match structure.kinds[joint] {
                TreeJointKind::Revolute => {
                    let (sine, cosine) = state.q[joint].sin_cos();
                    place.turn(index, if is_reversed { -sine } else { sine }, cosine);
                    Spatial { angular: axis, linear: place.origin.cross(axis) }
                }
                TreeJointKind::Prismatic => {
                    place.origin = place.origin + axis.scaled(state.q[joint]);
                    Spatial { angular: Vec3::zero(), linear: axis }
                }
            };
            self.axes[joint] = unit;
            self.velocities[joint + 1] = self.velocities[parent].plus(unit.scaled(state.dq[joint]));
            self.inertias[joint + 1] = turned(&parameters.bodies[joint + 1], &place).shifted(place.origin);
            self.places[joint + 1] = place;
        }
    }
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
