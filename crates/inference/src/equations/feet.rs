//! Which feet of a robot on the ground stand in a sample, and the force of each on the base per torque of its joints.

use glam::{DMat3, DVec3};
use twinstep_dynamics::Vec3;
use twinstep_dynamics::tree::{TreeMotion, TreeParameters, TreeStructure};

use super::measurements::{Measurements, Regime};
use super::robot::{Robot, Sphere};
use super::samples::{GRAVITY, Sample};
use super::touch::Contact;

/// Time before and after a sample in which a foot neither touches down nor lifts off [s].
const SETTLED_S: f64 = 0.02;
/// Height above the feet below which another part may touch the ground [m]: its roughness.
const CLEARANCE: f64 = 0.02;
/// Determinant of the Jacobian below which a leg is stretched [m³].
const LEAST_DETERMINANT: f64 = 1e-4;

/// Poses of the bodies of a sample, in the frame of the base.
struct Pose<'a> {
    places: TreeMotion<f64>,
    axes: &'a [DMat3],
    up: Vec3<f64>,
}

impl Pose<'_> {
    fn centre(&self, sphere: &Sphere) -> Vec3<f64> {
        let place = &self.places.bodies[sphere.body].place;
        place.origin + place.turned(Vec3((self.axes[sphere.body] * sphere.centre).to_array()))
    }

    /// Returns the height of the lowest point of a sphere above the origin of the base [m].
    fn bottom(&self, sphere: &Sphere) -> f64 {
        self.centre(sphere).dot(self.up) - sphere.radius
    }

    /// Returns the lowest point of a foot; `None` if its leg cannot push it in all directions.
    fn contact(&self, sphere: &Sphere, (foot, joints): (usize, [usize; 3])) -> Option<Contact> {
        let point = self.centre(sphere) + self.up.scaled(-sphere.radius);
        let columns = joints.map(|joint| {
            let axis = &self.places.bodies[joint + 1].axis;
            DVec3::from_array((axis.linear + axis.angular.cross(point)).0)
        });
        // Jᵀ f = τ.
        let jacobian = DMat3::from_cols(columns[0], columns[1], columns[2]);
        let force_per_torque = jacobian.transpose().inverse();
        let forces = [0, 1, 2].map(|index| force_per_torque.col(index));
        let point = DVec3::from_array(point.0);
        (jacobian.determinant().abs() >= LEAST_DETERMINANT).then_some(Contact { foot, point, joints, columns, forces })
    }
}

impl Sample {
    /// Finds the joints of the legs in the air, and the force at a base that stands per torque of a joint.
    ///
    /// Returns false if the robot may touch the ground with another part than its feet, if it stands and it is not known on which
    /// feet, or if they are not at the end of three joints.
    pub fn set_feet(
        &mut self,
        measured: &Measurements,
        robot: &Robot,
        structure: &TreeStructure,
        bodies: &TreeParameters<f64>,
    ) -> bool {
        let standing: Vec<Option<bool>> = (0..robot.feet.len()).map(|foot| self.stands(foot, measured)).collect();
        // The legs in the air need not know of the others if an accelerometer feels the impacts of their feet.
        let feels = measured.base.as_ref().is_some_and(|base| !base.acceleration.is_empty());
        if (self.regime == Regime::Stand || !feels) && standing.iter().any(Option::is_none) {
            return false;
        }
        let state = self.state(robot, &self.response, [0.0; 3]);
        let mut places = TreeMotion::empty(bodies);
        places.set(bodies, &state, GRAVITY);
        let axes = twinstep_dynamics::tree::batch_from_bodies(&robot.tree);
        let pose = Pose { places, axes: &axes, up: state.world_axes()[2] };
        let feet: Vec<Sphere> = robot.feet.iter().map(Sphere::from).collect();
        let lowest =
            |spheres: &[Sphere]| spheres.iter().map(|sphere| pose.bottom(sphere)).fold(f64::INFINITY, f64::min);
        if lowest(&robot.other_parts) < lowest(&feet) + CLEARANCE {
            return false;
        }
        self.base_per_torque = vec![[0.0; 6]; robot.joints.len()];
        for (index, foot) in feet.iter().enumerate().filter(|(index, _)| standing[*index] != Some(false)) {
            let Ok(joints) = <[usize; 3]>::try_from(structure.branches[foot.body].as_slice()) else { return false };
            for joint in joints {
                self.is_free[joint] = false;
            }
            let contact = pose.contact(foot, (index, joints));
            if self.regime == Regime::Stand {
                let Some(contact) = &contact else { return false };
                for (joint, force) in contact.joints.iter().zip(contact.forces) {
                    let moment = contact.point.cross(force);
                    self.base_per_torque[*joint] = [moment.x, moment.y, moment.z, force.x, force.y, force.z];
                }
            }
            if let (Some(contact), Some(true)) = (contact, standing[index]) {
                self.touch(measured, robot, &contact, DVec3::from_array(pose.up.0));
            }
        }
        true
    }

    /// Returns whether a foot stands in the whole sample, and shortly before and after it; `None` if that changes or is not known.
    fn stands(&self, foot: usize, measured: &Measurements) -> Option<bool> {
        let settled = (SETTLED_S / measured.dt).round() as usize;
        let rows = self.rows.start.saturating_sub(settled)..(self.rows.end + settled).min(measured.t.len());
        let is_measured = measured.contact.iter().any(|touches| touches[rows.clone()].iter().any(Option::is_some));
        match measured.contact.get(foot).filter(|_| is_measured) {
            Some(touches) => {
                let first = touches[rows.start]?;
                touches[rows].iter().all(|now| *now == Some(first)).then_some(first)
            }
            None => (self.regime == Regime::Stand).then_some(true),
        }
    }
}
