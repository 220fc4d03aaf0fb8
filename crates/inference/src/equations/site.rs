//! Where laws act, and what they change of a robot.

use glam::{DMat3, DVec3};
use twinstep_effects::Apply;

use super::law::{Law, Place};
use super::robot::Robot;

/// Mass above which a payload changes the inertia of a body, too [kg], if it is no farther from the body's origin than this [m].
const LEAST_PAYLOAD: f64 = 0.05;
const LONGEST_ARM: f64 = 0.5;
/// Least factor on the second moment of a body along an axis.
const LEAST_MOMENT: f64 = 0.1;

/// Where a law acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Site {
    /// A joint, or its link.
    Joint(usize),
    /// The base.
    Base,
}

/// Changes a robot by a law at a site.
pub fn apply(robot: &mut Robot, law: &Law, site: Site, unknowns: &[f64], shape: f64) {
    if unknowns.iter().all(|unknown| *unknown == 0.0) {
        return;
    }
    let scale = if let Site::Joint(joint) = site { robot.scale[joint] } else { 1.0 };
    let values = law.parameters(unknowns, shape, scale);
    match law.form.place {
        Place::Slip => robot.ground_friction += unknowns[0],
        Place::Sink => robot.contact_time = robot.contact_time.hypot(values[0]),
        _ => {}
    }
    match (law.effect.name, site) {
        ("supply_sag", _) => robot.voltage_exponent = values[0],
        ("thermal_derating", Site::Joint(joint)) => robot.thermal[joint] = [values[0], values[1]],
        ("gyro_bias", _) => robot.gyro_bias += DVec3::new(values[0], values[1], values[2]),
        ("payload", site) => {
            // The unknowns are mass and first moment, in which forces are nearly linear.
            let body = &mut robot.tree.bodies[body_of(site)].inertia;
            let mass = unknowns[0];
            if body.mass + mass <= 0.0 {
                // There is no such body, and [`is_physical`] refuses the cause.
                return;
            }
            let moment = DVec3::new(unknowns[1], unknowns[2], unknowns[3]);
            if mass.abs() > LEAST_PAYLOAD && (moment / mass).length() < LONGEST_ARM {
                *body = body.with_point_mass(mass, moment / mass);
            } else {
                let total = body.mass + mass;
                body.com = (body.mass * body.com + moment) / total;
                body.mass = total;
            }
        }
        ("inertia", site) => {
            let body = &mut robot.tree.bodies[body_of(site)].inertia;
            let trace = |matrix: &DMat3| matrix.x_axis.x + matrix.y_axis.y + matrix.z_axis.z;
            let factor = |axis: usize| (1.0 + unknowns[axis]).max(LEAST_MOMENT).sqrt();
            let stretch = DMat3::from_diagonal(DVec3::new(factor(0), factor(1), factor(2)));
            let moments = DMat3::from_diagonal(DVec3::splat(0.5 * trace(&body.inertia))) - body.inertia;
            let moments = stretch * moments * stretch;
            body.inertia = DMat3::from_diagonal(DVec3::splat(trace(&moments))) - moments;
        }
        ("com_shift", site) => {
            robot.tree.bodies[body_of(site)].inertia.com += DVec3::new(values[0], values[1], values[2]);
        }
        (_, Site::Joint(joint)) => {
            if let Apply::Joint(change) = law.effect.apply {
                let _ = change(&mut robot.joints[joint], &values);
            }
        }
        (_, Site::Base) => {}
    }
}

/// Returns true if a law at a site leaves a body a positive mass and inertia, so that a model file may state it.
pub fn is_physical(robot: &Robot, law: &Law, site: Site, unknowns: &[f64]) -> bool {
    if law.effect.name != "payload" {
        return true;
    }
    let values = (law.form.values)(unknowns, 0.0);
    let position = DVec3::new(values[1], values[2], values[3]);
    robot.tree.bodies[body_of(site)].inertia.with_point_mass(values[0], position).is_physical()
}

/// Returns the least first unknown of a law at a site of a robot: what its file states may be too much.
pub fn least(law: &Law, robot: &Robot, site: Site) -> f64 {
    let amount = match site {
        Site::Joint(joint) if law.effect.is_of_sum() => law.effect.amount(&robot.joints[joint]) / robot.scale[joint],
        _ => 0.0,
    };
    if law.form.is_positive { -amount } else { f64::NEG_INFINITY }
}

/// Returns the index of the body at a site.
pub fn body_of(site: Site) -> usize {
    match site {
        Site::Joint(joint) => joint + 1,
        Site::Base => 0,
    }
}
