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

/// Speed above which a foot slides [m/s]: several times the noise of usual estimates.
const SLIDING_SPEED: f64 = 0.15;
/// Cosine of the largest angle between the velocities of a foot at both ends of a sample in which it slides.
const ONE_DIRECTION: f64 = 0.95;
/// Impedance of a contact whose foot is in the ground by a millimetre or more.
const IMPEDANCE: f64 = 0.95;

/// A foot on the ground in a sample.
#[derive(Clone, Debug)]
pub struct Touch {
    /// Index of the foot.
    pub foot: usize,
    /// Joints of its leg.
    pub joints: [usize; 3],
    /// Force on the foot along the ground's normal, per torque that a joint lacks [1/m].
    pub normal: [f64; 3],
    /// Force along the velocity of a foot that slides, per torque that a joint lacks [1/m].
    pub along: Option<[f64; 3]>,
    /// Height of the lowest point of a foot that moves slowly [m], and by how much it changes with the positions of the joints [m/rad].
    pub height: Option<(f64, [f64; 3])>,
    /// Depth of the foot in the ground per force on it, for a contact with a time constant of 1 s [m/N].
    pub depth: f64,
    /// Position of the lowest point of the foot in the world [m]; zero if it moves fast, or if it is not known.
    pub place: DVec3,
    /// Height of a point of the base per coordinate of the base.
    pub up: DVec3,
}

impl Touch {
    /// Returns the force of the ground along its normal, given moment and force at the base and torques of the joints that are lacking [N].
    pub fn normal_force(&self, lacking: &[f64]) -> f64 {
        -self.sum(self.normal, &lacking[6..])
    }

    /// Returns the force along the velocity of a foot that slides, plus what friction with a coefficient has [N]; zero if it sticks.
    pub fn slip(&self, coefficient: f64, lacking: &[f64]) -> f64 {
        self.along.map_or(0.0, |along| coefficient * self.normal_force(lacking) - self.sum(along, &lacking[6..]))
    }

    /// Returns by how much the height of the foot changes with the position of a joint [m/rad].
    pub fn lever(&self, joint: usize) -> f64 {
        let place = self.joints.iter().position(|own| *own == joint);
        self.height.zip(place).map_or(0.0, |((_, levers), place)| levers[place])
    }

    fn sum(&self, per: [f64; 3], of_joints: &[f64]) -> f64 {
        per.iter().zip(self.joints).map(|(per, joint)| per * of_joints[joint]).sum()
    }
}

/// Point of a foot that touches the ground, in the frame of the base, and how a leg moves it.
pub struct Contact {
    /// Index of the foot.
    pub foot: usize,
    /// The point [m].
    pub point: DVec3,
    /// Joints of the leg.
    pub joints: [usize; 3],
    /// Velocity of the point per velocity of each joint [m/rad].
    pub columns: [DVec3; 3],
    /// Force on the base per torque of each joint [1/m].
    pub forces: [DVec3; 3],
}

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

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DMat3;

    #[test]
    fn force_of_a_sliding_foot_is_that_which_its_leg_lacks() {
        let (up, along) = (DVec3::Z, DVec3::new(0.6, -0.8, 0.0));
        // Velocities of the foot per velocity of three joints.
        let columns = [DVec3::new(0.0, 0.3, 0.1), DVec3::new(-0.25, 0.02, 0.05), DVec3::new(-0.2, 0.0, -0.12)];
        let force_per_torque = DMat3::from_cols(columns[0], columns[1], columns[2]).transpose().inverse();
        let forces = [0, 1, 2].map(|index| force_per_torque.col(index));
        let touch = Touch {
            foot: 0,
            joints: [1, 3, 5],
            normal: forces.map(|force| force.dot(up)),
            along: Some(forces.map(|force| force.dot(along))),
            height: Some((0.0, columns.map(|column| column.dot(up)))),
            depth: 0.1,
            place: DVec3::ZERO,
            up,
        };
        // A normal force of 40 N, and friction with a coefficient of 0.3 against the motion.
        let of_ground = 40.0 * up - 0.3 * 40.0 * along;
        let mut lacking = vec![0.0; 12];
        for (joint, column) in touch.joints.iter().zip(columns) {
            lacking[6 + joint] = -column.dot(of_ground);
        }
        assert!((touch.normal_force(&lacking) - 40.0).abs() < 1e-9);
        assert!(touch.slip(0.3, &lacking).abs() < 1e-9);
        assert!((touch.slip(0.8, &lacking) - 0.5 * 40.0).abs() < 1e-9);
        assert!((touch.lever(5) + 0.12).abs() < 1e-12 && touch.lever(0) == 0.0);
    }
}
