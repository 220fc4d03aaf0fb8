//! What an engine needs of the equations of one time step, of whatever tree.

use glam::DVec3;
use twinstep_simd::SimdFloat;

use crate::{JointForces, JointValues, State, Vec3};

/// Equations of motion of one time step, factored so that constraint rows are short.
///
/// Unknowns are the velocity changes of the base (angular, then linear of its origin, in base axes) and of the joints. They are found in
/// whitened coordinates, in which the mass matrix is the identity. A row `J Δ` that acts on one body has six whitened coefficients for the
/// base and one for each joint of the branch, the joints between base and body; the others are zero.
pub trait StepEquations<T: SimdFloat>: Send {
    /// Robots that have these equations.
    type Robot: Sync;
    /// Masses, inertias and places of a batch of robots.
    type Parameters: Clone + Send + Sync;
    /// One number for each joint.
    type Joints: JointValues<T>;
    /// One number for each joint of a branch.
    type Branch: JointValues<T>;

    /// Returns the parameters of `robot` in every lane.
    fn parameters(robot: &Self::Robot) -> Self::Parameters;
    /// Sets the robot of one lane.
    fn set_robot(parameters: &mut Self::Parameters, lane: usize, robot: &Self::Robot);
    /// Returns the rotor inertia reflected to each joint [kg·m² or kg].
    fn armature(parameters: &mut Self::Parameters) -> &mut Self::Joints;
    /// Visits every number that differs between robots, always in the same order.
    fn visit(parameters: &mut Self::Parameters, visit: impl FnMut(&mut T));
    /// Returns the coordinates in which [`StepEquations::point`] expects a point of `body` that is at `point` in the frame of the robot.
    fn point_of_body(robot: &Self::Robot, body: usize, point: DVec3) -> DVec3;

    /// Returns a placeholder for [`StepEquations::set_up`]. Reuse it in every step, because it is large.
    fn empty(parameters: &Self::Parameters) -> Self;

    /// Sets up a step of `dt` [s] under gravity [m/s²]. The whitened velocity changes are then those without constraints.
    ///
    /// Viscous friction is integrated implicitly, so any value is stable; dry friction is a constraint and has no effect here.
    /// `is_floating` is 1 for a free base and 0 for a fixed base.
    fn set_up(
        &mut self,
        parameters: &Self::Parameters,
        state: &State<T, Self::Joints>,
        forces: &JointForces<Self::Joints>,
        dt: T,
        gravity: T,
        is_floating: T,
    );

    /// Returns the velocity changes of the base and writes those of the joints.
    fn solution(&self, joints: &mut Self::Joints) -> [T; 6];

    /// Returns the position in the base frame of a point of a body [m].
    fn point(&self, body: usize, point: Vec3<T>) -> Vec3<T>;

    /// Returns the number of joints of the branch of a body.
    fn branch_len(&self, body: usize) -> usize;

    /// Returns zero for each joint of the branch of a body.
    fn zero_branch(&self, body: usize) -> Self::Branch;

    /// Returns the joint at `index` of the branch of a body.
    fn branch_joint(&self, body: usize, index: usize) -> usize;

    /// Returns the body whose branch is used for rows of a joint, and the index of the joint in it.
    fn row_of_joint(&self, joint: usize) -> (usize, usize);

    /// Writes the velocity of a point of `body` at `place` [m, base frame] along `direction` for a unit velocity of each joint of the branch.
    fn write_jacobian(&self, body: usize, place: Vec3<T>, direction: Vec3<T>, branch: &mut Self::Branch);

    /// Whitens the coefficients of a row that acts on `body`: writes those of the branch, returns those of the base.
    fn whiten(&self, body: usize, base: [T; 6], branch: &mut Self::Branch) -> [T; 6];

    /// Returns the product of a row that acts on `body` with the whitened velocity changes.
    fn velocity_change(&self, body: usize, base: &[T; 6], branch: &Self::Branch) -> T;

    /// Returns the products of the three rows of a contact point with the whitened velocity changes.
    fn velocity_changes(&self, body: usize, base: [&[T; 6]; 3], branch: [&Self::Branch; 3]) -> [T; 3];

    /// Adds an impulse along a row that acts on `body`.
    fn add_impulse(&mut self, body: usize, base: &[T; 6], branch: &Self::Branch, impulse: T);

    /// Adds impulses along the three rows of a contact point.
    fn add_impulses(&mut self, body: usize, base: [&[T; 6]; 3], branch: [&Self::Branch; 3], impulses: [T; 3]);
}
