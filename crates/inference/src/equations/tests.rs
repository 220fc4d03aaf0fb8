//! Properties of the equations on a robot that hangs, sways and trots, whose signals are sines.

use std::collections::BTreeMap;
use std::sync::Arc;

use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, JOINT_NAMES, go2};

use super::block::{Block, Column};
use super::causes::{Cause, ScopeSites};
use super::law::{Law, Place, laws};
use super::measurements::Measurements;
use super::problem::Search;
use super::residuals::Small;
use super::robot::Robot;
use super::search::LEAST_GAIN;
use super::site::{Site, apply, body_of, is_physical};
use super::system::System;

pub(super) const ROWS: usize = 1200;
const LEGS: [&str; 4] = ["FL", "FR", "RL", "RR"];

/// Returns a log of 6 s: 2 s each of hanging, standing, and moving with two feet in the air.
fn log() -> Log {
    log_of(columns())
}

pub(super) fn columns() -> BTreeMap<String, Vec<f64>> {
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
    columns
}

pub(super) fn log_of(columns: BTreeMap<String, Vec<f64>>) -> Log {
    log_with(columns, TorqueSensor::MotorCurrent)
}

fn log_with(columns: BTreeMap<String, Vec<f64>>, sensor: TorqueSensor) -> Log {
    let segment = |name: &str, base| Segment { name: name.to_owned(), base };
    let on_ground = ["sway", "trot"].map(|name| segment(name, BaseMount::Floating));
    let segments = [vec![segment("air", BaseMount::Fixed)], on_ground.to_vec()].concat();
    let mut meta = Meta::new(200.0, sensor, segments);
    (meta.kp, meta.kd) = (Some(Gain::Uniform(30.0)), Some(Gain::Uniform(0.8)));
    Log::new(meta, columns).expect("a log")
}

pub(super) fn system() -> (System, Robot) {
    system_of(&log())
}

pub(super) fn system_of(log: &Log) -> (System, Robot) {
    let robot = Robot::from(&go2());
    let measured = Measurements::new(log, &robot, |_| true).expect("motor currents");
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
    if matches!(law.form.place, Place::Body | Place::Gyro | Place::Supply) { Site::Base } else { Site::Joint(4) }
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
        all.iter().find(|law| law.effect.name == "pd_gain" && law.form.units.len() == 2).expect("a law of both gains");
    assert!(both.allows(&[-0.5, 0.0], 0.0));
    assert!(!both.allows(&[-1.5, 0.0], 0.0));
}

#[test]
fn column_of_every_law_is_what_a_small_effect_takes_from_the_residuals() {
    for sensor in [TorqueSensor::MotorCurrent, TorqueSensor::JointOutput] {
        check_columns(&log_with(columns(), sensor));
    }
    let mut without_torques = columns();
    without_torques.retain(|name, _| !name.starts_with("tau_measured"));
    check_columns(&log_with(without_torques, TorqueSensor::None));
}

fn check_columns(log: &Log) {
    let (system, robot) = system_of(log);
    let (predicted, before) = (system.predicted(&robot), residuals(&system, &robot));
    // Without torque sensors, columns of joints have other torques than their residuals: those that balance the motion.
    let is_of_drive = |law: &Law| matches!(law.form.place, Place::Drive | Place::Supply);
    for law in laws().into_iter().filter(|law| system.measured.has_torque || is_of_drive(law)) {
        for unknown in 0..law.form.units.len() {
            let mut unknowns = vec![0.0; law.form.units.len()];
            unknowns[unknown] = 0.02 * law.form.units[unknown];
            let mut after = robot.clone();
            apply(&mut after, &law, site_of(&law), &unknowns, law.shapes[0]);
            let column = system.column(&law, site_of(&law), (&robot, &predicted), &after);
            let [difference, size] = difference(&before, &residuals(&system, &after), &column);
            // Saturations and limits far above the torques of the log change nothing.
            assert!(difference <= 0.05 * size + 1e-9, "{} {unknown}: {difference} of {size}", law.effect.name);
        }
    }
}

/// Columns that were computed for another robot are used again.
#[test]
fn columns_with_equal_fingerprints_are_equal() {
    let (system, robot) = system();
    let all = laws();
    let with = |robot: &Robot, law: &Law, site: Site| {
        let mut after = robot.clone();
        let unknowns: Vec<f64> = law.form.units.iter().map(|unit| 0.3 * unit).collect();
        apply(&mut after, law, site, &unknowns, law.shapes[0]);
        after
    };
    let predicted = system.predicted(&robot);
    let mut equal = 0;
    for cause in &all {
        let other = with(&robot, cause, site_of(cause));
        let of_other = system.predicted(&other);
        for law in &all {
            let site = if site_of(law) == Site::Base { Site::Base } else { Site::Joint(4 + equal % 2) };
            let print = |robot, predicted| super::system::fingerprint(law.form.place, site, robot, predicted);
            let prints = [print(&robot, &predicted), print(&other, &of_other)];
            if prints[0].is_none() || prints[0] != prints[1] {
                continue;
            }
            let [column, same] = [(&robot, &predicted), (&other, &of_other)]
                .map(|before| system.column(law, site, before, &with(before.0, law, site)));
            let rows = |column: &Column| column.parts.iter().flat_map(|(_, rows)| rows.clone()).collect::<Vec<f64>>();
            let largest = rows(&column).iter().zip(rows(&same)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(
                column.parts.len() == same.parts.len() && largest < 1e-9,
                "{} beside {}",
                law.effect.name,
                cause.effect.name
            );
            equal += 1;
        }
    }
    assert!(equal > 100, "{equal}");
}

/// Friction between motor and sensor changes what the sensor reads, and no balance of the link.
#[test]
fn friction_is_seen_by_a_sensor_at_the_output_and_by_the_balance_if_the_current_is_measured() {
    let seen = |sensor: TorqueSensor| {
        let (system, robot) = system_of(&log_with(columns(), sensor));
        let all = laws();
        let law = all.iter().find(|law| law.effect.name == "coulomb_friction").expect("a law");
        let mut after = robot.clone();
        apply(&mut after, law, Site::Joint(4), &[0.5], 0.0);
        let column = system.column(law, Site::Joint(4), (&robot, &system.predicted(&robot)), &after);
        let names = column.parts.iter().filter(|(_, rows)| rows.iter().any(|row| *row != 0.0));
        let names: Vec<String> = names.map(|(block, _)| system.blocks[*block].name.clone()).collect();
        names
    };
    assert!(seen(TorqueSensor::MotorCurrent).iter().all(|name| !name.starts_with("torque")));
    let at_output = seen(TorqueSensor::JointOutput);
    assert!(!at_output.is_empty() && at_output.iter().all(|name| name.starts_with("torque")), "{at_output:?}");
}

#[test]
fn payload_that_takes_away_more_than_a_body_has_is_not_possible() {
    let (_, robot) = system();
    let all = laws();
    let law = all.iter().find(|law| law.effect.name == "payload").expect("a law");
    for site in [Site::Base, Site::Joint(0), Site::Joint(2)] {
        let mass = robot.tree.bodies[body_of(site)].inertia.mass;
        let is_possible = |mass: f64, away: f64| is_physical(&robot, law, site, &[mass, 0.0, 0.0, mass * away]);
        assert!(is_possible(0.5, 0.1) && is_possible(-0.01 * mass, 0.0), "{site:?}");
        assert!(!is_possible(-1.01 * mass, 0.0), "{site:?}: more than the mass");
        assert!(!is_possible(-0.5 * mass, 1.0), "{site:?}: half of the mass, from a metre away");
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

/// Returns by how much the delay of all commands is better with a size that changes, in a log whose commands have a delay that is given by
/// time [s].
fn gain_of_a_changing_delay(delay: impl Fn(f64) -> f64) -> f64 {
    let mut columns = columns();
    for (joint, name) in JOINT_NAMES.iter().enumerate() {
        let rate = 6.0 + joint as f64;
        let command = |row: usize, t: f64| {
            let amplitude = if 3 * row / ROWS == 1 { 0.03 } else { 0.3 };
            go2().control.default_pose[joint] + 1.1 * amplitude * (rate * (t + 0.01)).sin() + 0.1
        };
        let torque = |row: usize| {
            let t = columns["t"][row];
            let error = command(row, t - delay(t)) - columns[&format!("q_{name}")][row];
            30.0 * error - 0.8 * columns[&format!("dq_{name}")][row]
        };
        let torques = (0..ROWS).map(torque).collect();
        columns.insert(format!("tau_measured_{name}"), torques);
    }
    let (system, robot) = system_of(&log_of(columns));
    let all = laws();
    let law = all.iter().position(|law| law.effect.name == "command_delay").expect("a law");
    let sites = (0..12).map(Site::Joint).collect();
    let scope = ScopeSites { name: "all".to_owned(), sites, probability: 0.3, is_alike: true };
    let cause = Cause { law, scope, shape: 0.0, values: vec![vec![0.25]; 12], log_prior: 0.0 };
    let search = Search::new(&system, &all, Vec::new(), robot);
    let fit = search.fit(vec![cause], &Arc::new(Small::default()), 8, None);
    search.changed(&fit, 0).expect("a delay that acts").gain
}

#[test]
fn delay_that_grows_with_time_is_another_law_and_a_constant_one_is_not() {
    let [constant, growing] = [gain_of_a_changing_delay(|_| 0.005), gain_of_a_changing_delay(|t| 0.01 * t / 6.0)];
    assert!(constant < 0.0, "{constant}");
    assert!(growing > LEAST_GAIN, "{growing}");
}

/// Slow sensors are read in few rows, and any sensor loses some.
#[test]
fn readings_that_are_missing_leave_all_columns_finite() {
    for name in
        ["battery_V", "temp_FL_thigh", "vel_x", "acc_y", "gyro_z", "quat_w", "contact_FR", "tau_measured_RL_hip"]
    {
        let mut columns = columns();
        let cells = columns.get_mut(name).expect("a channel");
        cells.iter_mut().enumerate().filter(|(row, _)| row % 50 != 7).for_each(|(_, cell)| *cell = f64::NAN);
        let (system, robot) = system_of(&log_of(columns));
        let predicted = system.predicted(&robot);
        for law in laws() {
            let mut after = robot.clone();
            apply(&mut after, &law, site_of(&law), law.form.units, law.shapes[0]);
            let column = system.column(&law, site_of(&law), (&robot, &predicted), &after);
            let finite = column.parts.iter().flat_map(|(_, rows)| rows).all(|row| row.is_finite());
            assert!(finite, "{name} missing, {}", law.effect.name);
        }
        let residuals = residuals(&system, &robot);
        assert!(residuals.iter().flat_map(|block| &block.y).all(|residual| residual.is_finite()), "{name}");
    }
}

#[test]
fn temperature_of_a_slow_sensor_is_held_until_its_next_reading() {
    let mut columns = columns();
    let cells = columns.get_mut("temp_FL_thigh").expect("a channel");
    cells.iter_mut().enumerate().filter(|(row, _)| row % 50 != 7).for_each(|(_, cell)| *cell = f64::NAN);
    let expected = [cells[7], cells[7], cells[57]];
    let (system, _) = system_of(&log_of(columns));
    let held = &system.measured.joints[1].temperature;
    assert_eq!([held[0], held[56], held[58]], expected);
}
