//! What every robot has a little of: unknowns that are never reported, with narrow priors.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use twinstep_model::RigidBody;

use super::block::Column;
use super::gaussian::Group;
use super::law::{Law, Place, Presence};
use super::robot::Robot;
use super::site::{Site, apply};
use super::system::{Predicted, System};
use super::touch::Touch;

/// Standard deviation of the friction at low speed [N·m], for two speeds [rad/s].
const LOW_SPEED: [(f64, f64); 2] = [(0.04, 0.2), (0.03, 0.8)];
/// Standard deviation of the time by which the positions of an encoder are ahead of its velocities [s]: drives filter the velocity, and
/// simulators update positions with the new one.
const LEAD: f64 = 4e-4;
/// Standard deviation of the tilt of a fixed base [rad].
pub const TILT: f64 = 0.005;
/// Standard deviation of an offset of the accelerometer, by its bias and its mounting [m/s²].
const ACCELERATION: f64 = 0.1;
/// Standard deviation of the position of the accelerometer in the base, along each axis [m].
const LEVER: f64 = 0.05;
/// Standard deviation of an offset of a torque sensor [N·m].
const TORQUE_OFFSET: f64 = 0.02;
/// Standard deviation of a constant torque at a joint: cables, a preload, friction at rest [N·m].
pub const STICK: f64 = 0.1;
/// Standard deviations of a link's mass, and of its inertia relative to the trace; that of its centre of mass [m].
pub const BODY: [f64; 3] = [0.03, 0.04, 0.003];

/// Standard deviation of the height of each foot's lowest point on its link [m].
const FOOT: f64 = 0.002;
/// Standard deviation of the height of the ground [m], and of its slope in each direction.
const FLOOR: [f64; 2] = [0.01, 0.03];
/// Standard deviation of the place in the base whose position was measured, along each axis [m].
const MARKER: f64 = 0.005;

/// Norm of what a small unknown changes in an equation, relative to the noise of a row, below which the equation does not show it.
const LEAST_SEEN: f64 = 0.1;

/// Returns the small unknowns whose columns depend on the causes that were found: those of drives and joints.
pub fn of_joints(system: &System, laws: &[Law], robot: &Robot, predicted: &Predicted) -> Vec<Group> {
    let (mut small, mut gains) = (Vec::new(), Vec::new());
    for law in present(laws, &[Place::Drive, Place::Supply, Place::Sensor, Place::Joint]) {
        for (unknown, std) in law.form.small.iter().enumerate() {
            if law.form.is_gain {
                let columns = by_joint(system, law, robot, predicted, unknown, law.shapes[0], *std);
                let group = |(column, std)| Group { gain: Some(unknown), ..Group::single(column, std) };
                gains.extend(columns.into_iter().map(group));
                continue;
            }
            small.extend(by_joint(system, law, robot, predicted, unknown, law.shapes[0], *std));
        }
    }
    for (std, speed) in LOW_SPEED {
        small.extend(by_joint(system, named(laws, "stribeck_friction"), robot, predicted, 0, speed, std));
    }
    let ones = vec![1.0; system.balance.samples.len()];
    for joint in 0..robot.joints.len() {
        small.push((system.torque_offset(joint), TORQUE_OFFSET * robot.scale[joint]));
        small.push((system.balance.joint_column(joint, &ones), STICK * robot.scale[joint]));
    }
    [gains, grouped(system, small)].concat()
}

/// Returns the small unknowns whose columns do not depend on the causes: those of bodies and their motion.
pub fn of_bodies(system: &System, laws: &[Law], robot: &Robot, predicted: &Predicted) -> Vec<Group> {
    let mut small = bodies(system, robot);
    for law in present(laws, &[Place::Link]) {
        small.extend(by_joint(system, law, robot, predicted, 0, 0.0, law.small_std(0)));
    }
    small.extend((0..robot.joints.len()).map(|joint| (system.balance.lead_column(joint), LEAD)));
    small.extend([0, 1].map(|axis| (system.balance.tilt_column(axis), TILT)));
    small.extend([0, 1, 2].map(|axis| (system.balance.acceleration_column(axis), ACCELERATION)));
    small.extend([0, 1, 2].map(|axis| (system.balance.lever_column(axis), LEVER)));
    small.extend(ground(system, laws, robot, predicted));
    grouped(system, small)
}

/// Returns the laws at these places of which every joint has a little.
fn present<'a>(laws: &'a [Law], places: &'a [Place]) -> impl Iterator<Item = &'a Law> {
    laws.iter().filter(|law| law.form.little != Presence::Nowhere && places.contains(&law.form.place))
}

fn named<'a>(laws: &'a [Law], name: &str) -> &'a Law {
    let own = laws.iter().filter(|law| law.effect.name == name);
    own.max_by_key(|law| law.form.units.len()).expect("a law of each effect")
}

/// Returns unknowns of their own, without the equations in which they are much smaller than the noise.
fn grouped(system: &System, small: Vec<(Column, f64)>) -> Vec<Group> {
    let seen = |(mut column, std): (Column, f64)| {
        column.parts.retain(|(block, rows)| {
            let size = rows.iter().map(|row| row * row).sum::<f64>().sqrt();
            std * size > LEAST_SEEN * system.blocks[*block].sigma
        });
        (column, std)
    };
    let kept = small.into_iter().map(seen).filter(|(column, _)| !column.is_zero());
    kept.map(|(column, std)| Group::single(column, std)).collect()
}

/// Returns the column of a small change of an unknown at each joint, per unit.
fn by_joint(
    system: &System,
    law: &Law,
    robot: &Robot,
    predicted: &Predicted,
    unknown: usize,
    shape: f64,
    std: f64,
) -> Vec<(Column, f64)> {
    let column = |joint: usize| {
        let mut unknowns = vec![0.0; law.form.units.len()];
        unknowns[unknown] = 2.0 * std;
        let mut before = robot.clone();
        if law.effect.name == "stribeck_friction" {
            // Two frictions of different speeds cannot be combined, but their columns are independent.
            before.joints[joint].stribeck_friction.breakaway_torque = 0.0;
        }
        let mut after = before.clone();
        add(&mut after, law, joint, &unknowns, shape);
        let site = Site::Joint(joint);
        (system.column(law, site, (&before, predicted), &after).scaled(1.0 / (2.0 * std)), std)
    };
    (0..robot.joints.len()).into_par_iter().map(column).collect()
}

/// Adds a small effect to what a joint has of it already.
pub fn add(robot: &mut Robot, law: &Law, joint: usize, unknowns: &[f64], shape: f64) {
    let scale = robot.scale[joint];
    match (law.form.add, law.form.place) {
        (Some(add), _) => add(&mut robot.joints[joint], unknowns[0], scale),
        (None, Place::Supply) => robot.voltage_exponent += law.parameters(unknowns, shape, scale)[0],
        (None, _) => apply(robot, law, Site::Joint(joint), unknowns, shape),
    }
}

/// Returns the unknowns of feet, floor and the measured place of the base.
fn ground(system: &System, laws: &[Law], robot: &Robot, predicted: &Predicted) -> Vec<(Column, f64)> {
    let height = |change: &dyn Fn(&Touch) -> f64| system.balance.height_column(change);
    let mut small = vec![(height(&|_| 1.0), FLOOR[0])];
    for foot in 0..robot.feet.len() {
        small.push((height(&|touch| if touch.foot == foot { 1.0 } else { 0.0 }), FOOT));
    }
    let touches = || system.balance.samples.iter().flat_map(|sample| &sample.touches);
    let middle = touches().map(|touch| touch.place).sum::<DVec3>() / touches().count().max(1) as f64;
    small.extend([0, 1].map(|axis| (height(&|touch| touch.place[axis] - middle[axis]), FLOOR[1])));
    small.extend([0, 1, 2].map(|axis| (height(&|touch| touch.up[axis]), MARKER)));
    for law in present(laws, &[Place::Slip, Place::Sink]) {
        let mut after = robot.clone();
        apply(&mut after, law, Site::Base, &law.form.small[..1], law.shapes[0]);
        let std = law.small_std(0);
        small.push((system.column(law, Site::Base, (robot, predicted), &after).scaled(1.0 / std), std));
    }
    small
}

/// Returns the ten inertial unknowns of each body.
fn bodies(system: &System, robot: &Robot) -> Vec<(Column, f64)> {
    let unit = |index: usize| {
        let mut inertia = DMat3::ZERO;
        let (row, column) = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)][index];
        inertia.col_mut(column)[row] = 1.0;
        inertia.col_mut(row)[column] = 1.0;
        inertia
    };
    let of_body = |body: usize| {
        let RigidBody { mass, com, inertia } = robot.tree.bodies[body].inertia;
        let trace = inertia.x_axis.x + inertia.y_axis.y + inertia.z_axis.z;
        let column = |added: RigidBody| system.balance.inertia_column(&robot.tree, robot, body, added);
        let mut columns = vec![(column(RigidBody { mass: 1.0, com, inertia: DMat3::ZERO }), BODY[0] * mass)];
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            // Moving the centre of mass by d changes the first moment by m d, which a pair of opposite masses has.
            let one = column(RigidBody { mass, com: com + 1e-3 * axis, inertia: DMat3::ZERO });
            let other = column(RigidBody { mass, com, inertia: DMat3::ZERO });
            columns.push((difference(&one, &other).scaled(1e3), BODY[2]));
        }
        for index in 0..6 {
            let added = RigidBody { mass: 0.0, com: DVec3::ZERO, inertia: unit(index) };
            columns.push((column(added), BODY[1] * trace));
        }
        columns
    };
    (0..robot.tree.bodies.len()).into_par_iter().flat_map_iter(of_body).collect()
}

fn difference(one: &Column, other: &Column) -> Column {
    let part = |(block, rows): &(usize, Vec<f64>)| {
        let second = other.parts.iter().find(|(index, _)| index == block).map(|(_, rows)| rows);
        let rows = rows.iter().enumerate().map(|(row, value)| value - second.map_or(0.0, |rows| rows[row])).collect();
        (*block, rows)
    };
    Column { parts: one.parts.iter().map(part).collect() }
}
