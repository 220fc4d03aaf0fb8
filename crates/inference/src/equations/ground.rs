//! Feet on the ground: the force on a foot that slides, and the height of a foot that stands.
//!
//! The force on a foot is the one that balances its leg: `Jᵀ f` is what the motion needs minus the torques on the links. Along the
//! velocity of a foot that slides it is the friction coefficient times the normal force. A foot that is pressed down sinks into the
//! ground, by `(1 - d) / d² k⁻¹ A f` if it moves slowly: d and k are impedance and stiffness of the contact (MuJoCo's `solimp` and
//! `solref`), and A is the inverse mass that a force on the foot moves.

use glam::{DQuat, DVec3};
use nalgebra::{DMatrix, DVector};
use twinstep_dynamics::tree::{TreeMotion, TreeParameters, TreeStructure, mass_matrix};

use super::measurements::{Measurements, Regime};
use super::robot::Robot;
use super::samples::Sample;
use super::touch::{Contact, Touch};

/// Speed above which a foot slides [m/s]: several times the noise of usual estimates.
const SLIDING_SPEED: f64 = 0.15;
/// Cosine of the largest angle between the velocities of a foot at both ends of a sample in which it slides.
const ONE_DIRECTION: f64 = 0.95;
/// Impedance of a contact whose foot is in the ground by a millimetre or more.
const IMPEDANCE: f64 = 0.95;

impl Sample {
    /// Adds a foot that stands in the whole sample.
    pub fn touch(&mut self, measured: &Measurements, robot: &Robot, contact: &Contact, up: DVec3) {
        let base = measured.base.as_ref();
        let position = base.filter(|base| !base.position.is_empty()).map(|base| {
            let of = |axis: usize| {
                let mean = |row: usize| 0.5 * (base.position[row][axis] + base.position[row + 1][axis]);
                self.rows.clone().zip(self.weights.iter()).map(|(row, weight)| weight * mean(row)).sum()
            };
            DVec3::from_array([0, 1, 2].map(of))
        });
        let place = position.map(|position| position + turned(self.response.base.orientation, contact.point));
        // How deep a foot is after an impact depends on its motion, too.
        let place = place.filter(|place| place.is_finite() && self.regime == Regime::Stand);
        let along = self.direction(measured, contact, up);
        self.touches.push(Touch {
            foot: contact.foot,
            joints: contact.joints,
            normal: contact.forces.map(|force| force.dot(up)),
            along: along.map(|direction| contact.forces.map(|force| force.dot(direction))),
            height: place.map(|place| (place.z, contact.columns.map(|column| column.dot(up)))),
            depth: depth_per_force(robot, self, contact, up),
            place: place.unwrap_or_default(),
            up,
        });
    }

    /// Returns the direction of a foot that slides, in the frame of the base; `None` if it does not, or if that is not known.
    fn direction(&self, measured: &Measurements, contact: &Contact, up: DVec3) -> Option<DVec3> {
        let base = measured.base.as_ref().filter(|base| !base.velocity.is_empty())?;
        let inverse = conjugate(self.response.base.orientation);
        let half = self.rows.len() / 2;
        let velocity = |rows: std::ops::Range<usize>| {
            let mean = |value: &dyn Fn(usize) -> f64| rows.clone().map(value).sum::<f64>() / rows.len() as f64;
            let of_base = DVec3::from_array([0, 1, 2].map(|axis| mean(&|row| base.velocity[row][axis])));
            let turning = DVec3::from_array([0, 1, 2].map(|axis| mean(&|row| base.smooth_gyro[row][axis])));
            let of_joints = contact
                .joints
                .iter()
                .zip(contact.columns)
                .map(|(joint, column)| mean(&|row| measured.joints[*joint].smooth[1][row]) * column);
            let of_foot = turned(inverse, of_base) + turning.cross(contact.point) + of_joints.sum::<DVec3>();
            of_foot - up * up.dot(of_foot)
        };
        let [first, second] =
            [self.rows.start..self.rows.start + half, self.rows.start + half..self.rows.end].map(velocity);
        let slides = first.length() > SLIDING_SPEED && second.length() > SLIDING_SPEED;
        let is_straight = first.dot(second) > ONE_DIRECTION * first.length() * second.length();
        (slides && is_straight).then(|| (first + second).normalize())
    }
}

/// Returns the depth of a foot per force on it, for a contact with a time constant of 1 s [m/N].
fn depth_per_force(robot: &Robot, sample: &Sample, contact: &Contact, up: DVec3) -> f64 {
    let mut bodies = TreeParameters::<f64>::splat(&robot.tree);
    bodies.armature = robot.joints.iter().map(|joint| joint.armature).collect();
    let mut places = TreeMotion::empty(&bodies);
    places.set(&bodies, &sample.state(robot, &sample.response, [0.0; 3]), 0.0);
    let matrix = mass_matrix(&TreeStructure::new(&robot.tree), &bodies, &places);
    let size = matrix.len();
    let mass = DMatrix::from_fn(size, size, |row, column| matrix[row][column]);
    let mut direction = DVector::zeros(size);
    let angular = contact.point.cross(up);
    for axis in 0..3 {
        (direction[axis], direction[3 + axis]) = (angular[axis], up[axis]);
    }
    for (joint, column) in contact.joints.iter().zip(contact.columns) {
        direction[size - robot.joints.len() + joint] = column.dot(up);
    }
    let inverse_mass = mass.cholesky().map_or(0.0, |factor| direction.dot(&factor.solve(&direction)));
    // k is 1 / (d T)².
    (1.0 - IMPEDANCE) * inverse_mass
}

fn turned([w, x, y, z]: [f64; 4], vector: DVec3) -> DVec3 {
    DQuat::from_xyzw(x, y, z, w).normalize() * vector
}

fn conjugate([w, x, y, z]: [f64; 4]) -> [f64; 4] {
    [w, -x, -y, -z]
}
