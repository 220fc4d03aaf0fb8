//! Properties of the equations on a robot that hangs, sways and trots, whose signals are sines.

use std::collections::BTreeMap;

use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, go2};

use super::block::{Block, Column};
use super::law::{Law, Place, laws};
use super::measurements::Measurements;
use super::robot::Robot;
use super::system::{Site, System, apply};

const ROWS: usize = 1200;
const LEGS: [&str; 4] = ["FL", "FR", "RL", "RR"];

/// Returns a log of 6 s: 2 s each of hanging, standing, and moving with two feet in the air.
fn log() -> Log {
    let mut columns = BTreeMap::<String, Vec<f64>>::new();
    let mut push = |name: String, value: f64| columns.entry(name).or_default().push(value);
    for row in 0..ROWS {
        let (t, part) = (0.005 * row as f64, 3 * row / ROWS);
        push("t".to_owned(), t);
        push("segment".to_owned(), part as f64);
        push("battery_V".to_owned(), 30.0 - t);
        let amplitude = if part == 1 { 0.03 } else { 0.3 };
        for leg in LEGS {
            let is_in_air = part == 2 && ["FR", "RL"].contains(&leg);
            push(format!("contact_{leg}"), if is_in_air { 0.0 } else { 1.0 });
        }
        for (joint, name) in JOINT_NAMES.iter().enumerate() {
            let rate = 6.0 + joint as f64;
            let pose = go2().control.default_pose[joint];
            push(format!("q_{name}"), pose + amplitude * (rate * t).sin());
            push(format!("dq_{name}"), amplitude * rate * (rate * t).cos());
            push(format!("q_cmd_{name}"), pose + 1.1 * amplitude * (rate * (t + 0.01)).sin() + 0.1);
            push(format!("tau_measured_{name}"), 3.0 * (rate * t + 1.0).sin());
            push(format!("temp_{name}"), 40.0 + t);
        }
        for (axis, value) in ["w", "x", "y", "z"].into_iter().zip([1.0, 0.0, 0.0, 0.0]) {
            push(format!("quat_{axis}"), value);
        }
        for (axis, up) in ["x", "y", "z"].into_iter().zip([0.0, 0.0, 9.81]) {
            push(format!("gyro_{axis}"), 0.0);
            push(format!("acc_{axis}"), up);
            push(format!("vel_{axis}"), 0.0);
        }
    }
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let on_ground = ["sway", "trot"].map(|name| segment(name, BaseMount::Floating));
    let segments = [vec![segment("air", BaseMount::Fixed)], on_ground.to_vec()].concat();
    let mut meta = Meta::new(200.0, TorqueSensor::MotorCurrent, segments);
    (meta.kp, meta.kd) = (Some(Gain::Uniform(30.0)), Some(Gain::Uniform(0.8)));
    Log::new(meta, columns).expect("a log")
}

fn system() -> (System, Robot) {
    let robot = Robot::from(&go2());
    let measured = Measurements::new(&log(), &robot, |_| true).expect("motor currents");
    (System::new(measured, &robot), robot)
}

fn residuals(system: &System, robot: &Robot) -> Vec<Block> {
    system.residuals(robot, &system.predicted(robot))
}

/// Returns the largest difference between what residuals lose and a column, and the largest entry of the column.
fn difference(before: &[Block], after: &[Block], column: &Column) -> [f64; 2] {
    let mut largest = [0.0_f64; 2];
    for (index, (before, after)) in before.iter().zip(after).enumerate() {
        let part = column.parts.iter().find(|(block, _)| *block == index).map(|(_, rows)| rows);
        for row in 0..before.y.len() {
            let entry = part.map_or(0.0, |rows| rows[row]);
            largest[0] = largest[0].max((before.y[row] - after.y[row] - entry).abs());
            largest[1] = largest[1].max(entry.abs());
        }
    }
    largest
}

fn site_of(law: &Law) -> Site {
    if matches!(law.place, Place::Body | Place::Gyro | Place::Supply) { Site::Base } else { Site::Joint(4) }
}

#[test]
fn joints_of_legs_in_the_air_have_equations_while_the_base_moves_and_those_of_standing_legs_have_none() {
    let (system, _) = system();
    let rows = |leg: &str| {
        let name = format!("joint {leg}_thigh swing");
        system.blocks.iter().find(|block| block.name == name).map_or(0, |block| block.y.len())
    };
    assert!(rows("FR") > 20 && rows("RL") > 20);
    assert_eq!([rows("FL"), rows("RR")], [0, 0]);
}

#[test]
fn gain_below_its_bound_is_not_allowed() {
    let all = laws();
    let both =
        all.iter().find(|law| law.effect.name == "pd_gain" && law.units.len() == 2).expect("a law of both gains");
    assert!(both.allows(&[-0.5, 0.0], 0.0));
    assert!(!both.allows(&[-1.5, 0.0], 0.0));
}

#[test]
fn column_of_every_law_is_what_a_small_effect_takes_from_the_residuals() {
    let (system, robot) = system();
    let (predicted, before) = (system.predicted(&robot), residuals(&system, &robot));
    for law in laws() {
        for unknown in 0..law.units.len() {
            let mut unknowns = vec![0.0; law.units.len()];
            unknowns[unknown] = 0.02 * law.units[unknown];
            let mut after = robot.clone();
            apply(&mut after, &law, site_of(&law), &unknowns, law.shapes[0]);
            let column = system.column(&law, site_of(&law), (&robot, &predicted), &after);
            let [difference, size] = difference(&before, &residuals(&system, &after), &column);
            // Saturations and limits far above the torques of the log change nothing.
            assert!(difference <= 0.05 * size + 1e-9, "{} {unknown}: {difference} of {size}", law.effect.name);
        }
    }
}

/// A robot with a hundredth less torque and less of all masses lacks exactly as much.
#[test]
fn torque_and_mass_together_change_no_residual_of_a_hanging_joint() {
    let (system, mut robot) = system();
    robot.joints.iter_mut().for_each(|joint| joint.armature = 0.0);
    let before = residuals(&system, &robot);
    let mut scaled = robot.clone();
    scaled.joints.iter_mut().for_each(|joint| joint.actuator.gain = 0.99);
    for body in &mut scaled.tree.bodies {
        body.inertia.mass *= 0.99;
        body.inertia.inertia *= 0.99;
    }
    let hanging = |blocks: &[Block]| -> Vec<f64> {
        blocks.iter().filter(|block| block.name.starts_with("joint")).flat_map(|block| block.y.clone()).collect()
    };
    let (before, after) = (hanging(&before), hanging(&residuals(&system, &scaled)));
    assert!(!before.is_empty());
    for (before, after) in before.iter().zip(after) {
        assert!((before - after).abs() < 1e-9, "{before} {after}");
    }
}
