//! A foot on the ground: the force on it, its height, and how they depend on its leg.

use glam::DVec3;

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

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

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
