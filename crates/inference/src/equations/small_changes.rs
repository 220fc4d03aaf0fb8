//! What every robot has a little of, as far as simulated positions show it.

use glam::{DAffine3, DVec3};

use super::law::{Law, Presence};
use super::nuisance;
use super::robot::Robot;
use crate::JointLog;

/// An unknown that is never reported.
#[derive(Clone, Copy, Debug)]
pub struct SmallUnknown {
    /// What it changes.
    pub change: SmallChange,
    /// Standard deviation.
    pub std: f64,
}

/// Change of a robot by an unknown.
#[derive(Clone, Copy, Debug)]
pub enum SmallChange {
    /// Unknown of a law at a joint.
    OfLaw { law: usize, joint: usize, unknown: usize },
    /// Constant torque at a joint [N·m].
    Torque { joint: usize },
    /// Mass of a body, relative to its own.
    Mass { body: usize },
    /// Centre of mass of a body along an axis [m].
    Centre { body: usize, axis: usize },
    /// Inertia of a body about an axis, relative to the trace.
    Inertia { body: usize, axis: usize },
    /// Tilt of the base about an axis [rad].
    Tilt { axis: usize },
}

impl SmallChange {
    /// Changes a robot by a value.
    pub fn apply(self, laws: &[Law], robot: &mut Robot, value: f64) {
        if value == 0.0 {
            return;
        }
        match self {
            Self::OfLaw { law, joint, unknown } => {
                let mut unknowns = vec![0.0; laws[law].form.units.len()];
                unknowns[unknown] = value;
                nuisance::add(robot, &laws[law], joint, &unknowns, laws[law].shapes[0]);
            }
            Self::Torque { joint } => robot.joints[joint].spring.torque_offset += value,
            Self::Mass { body } => robot.tree.bodies[body].inertia.mass *= (1.0 + value).max(0.1),
            Self::Centre { body, axis } => robot.tree.bodies[body].inertia.com[axis] += value,
            Self::Inertia { body, axis } => {
                let inertia = &mut robot.tree.bodies[body].inertia.inertia;
                let trace = inertia.x_axis.x + inertia.y_axis.y + inertia.z_axis.z;
                inertia.col_mut(axis)[axis] = (inertia.col(axis)[axis] + value * trace).max(1e-9);
            }
            Self::Tilt { axis } => {
                let turn = DAffine3::from_axis_angle([DVec3::X, DVec3::Y, DVec3::Z][axis], value);
                for joint in robot.tree.joints.iter_mut().filter(|joint| joint.parent == 0) {
                    joint.parent_from_child = turn * joint.parent_from_child;
                }
            }
        }
    }

    /// Returns the least value that is possible on top of what a robot has.
    pub fn least(self, laws: &[Law], robot: &Robot) -> f64 {
        let Self::OfLaw { law, joint, .. } = self else { return f64::NEG_INFINITY };
        let law = &laws[law];
        if !law.form.is_positive {
            return f64::NEG_INFINITY;
        }
        let scale = if law.form.is_of_torque { robot.scale[joint] } else { 1.0 };
        // What a strength adds cannot be taken away.
        if law.form.is_strength { 0.0 } else { -law.effect.amount(&robot.joints[joint]) / scale }
    }
}

/// Returns the small unknowns of a robot whose positions a log has.
pub fn small_unknowns(robot: &Robot, laws: &[Law], log: &JointLog) -> Vec<SmallUnknown> {
    let mut small = Vec::new();
    for channels in &log.joints {
        for (law, found) in laws.iter().enumerate().filter(|(_, law)| law.form.little == Presence::Everywhere) {
            small.extend(found.form.small.iter().enumerate().map(|(unknown, std)| SmallUnknown {
                change: SmallChange::OfLaw { law, joint: channels.joint, unknown },
                std: *std,
            }));
        }
        let joint = channels.joint;
        small.push(SmallUnknown { change: SmallChange::Torque { joint }, std: nuisance::STICK * robot.scale[joint] });
    }
    let [mass, inertia, centre] = nuisance::BODY;
    for body in 1..robot.tree.bodies.len() {
        small.push(SmallUnknown { change: SmallChange::Mass { body }, std: mass });
        for axis in 0..3 {
            small.push(SmallUnknown { change: SmallChange::Centre { body, axis }, std: centre });
            small.push(SmallUnknown { change: SmallChange::Inertia { body, axis }, std: inertia });
        }
    }
    small.extend([0, 1].map(|axis| SmallUnknown { change: SmallChange::Tilt { axis }, std: nuisance::TILT }));
    small
}
