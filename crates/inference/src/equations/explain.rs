//! The causes of a log, in the terms of the catalogue.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use twinstep_effects::Scope;
use twinstep_logs::Log;
use twinstep_model::{Joint, RobotModel, RobotTree, TreeJoint, TreeModel};

use super::causes::ScopeSites;
use super::explanation::{Explained, Terms};
use super::law::{Law, Place, laws};
use super::measurements::Measurements;
use super::positions::{Drives, Positions, is_simulated};
use super::problem::Search;
use super::robot::Robot;
use super::site::Site;
use super::system::System;
use crate::{Candidate, InferenceError};

/// Prior probability that each joint of all, or of a type, has its own value.
const EACH: f64 = 0.1;
/// Strengths and shapes of a law that are tried where each is a simulation.
const MOST_STRENGTHS: usize = 6;
const MOST_SHAPES: usize = 24;

/// Finds what a quadruped lacks, from the rows of `log` that are used. `go_on` gets a line of progress.
///
/// Simulations end soon after `stop` is true; `go_on` must return false then.
///
/// Returns `None` if `go_on` returned false. Fails if the log has neither torques nor a fixed base, or if
/// the base moves, and the robot does not both hang and stand on all feet in some rows.
pub fn explain(
    log: &Log,
    robot: &RobotModel,
    stop: &Arc<AtomicBool>,
    is_used: impl Fn(usize) -> bool,
    go_on: &mut dyn FnMut(&str) -> bool,
) -> Result<Option<Explained>, InferenceError> {
    let zeros = vec![0.0; robot.joints.len()];
    let drives = Drives {
        kp: zeros.clone(),
        kd: zeros,
        actuator_hz: robot.control.actuator_hz,
        estimates: None,
        stop: stop.clone(),
    };
    explain_robot(log, Robot::from(robot), &drives, scopes(), is_used, go_on)
}

/// Finds what a robot of any tree lacks, as [`explain`] does. Of its bodies nothing is a cause: model files of trees have effects at joints.
///
/// Simulations end soon after `stop` is true; `go_on` must return false then. `estimates` is a robot with first estimates of friction, inertia and delay, from which a search in simulations begins.
pub fn explain_tree(
    log: &Log,
    robot: &Candidate,
    estimates: Option<&TreeModel>,
    (actuator_hz, stop): (f64, &Arc<AtomicBool>),
    is_used: impl Fn(usize) -> bool,
    go_on: &mut dyn FnMut(&str) -> bool,
) -> Result<Option<Explained>, InferenceError> {
    let (kp, kd) = (robot.kp.clone(), robot.kd.clone());
    let drives =
        Drives { kp, kd, actuator_hz, estimates: estimates.map(|robot| robot.joints.clone()), stop: stop.clone() };
    explain_robot(log, Robot::from(&robot.robot), &drives, scopes_of(&robot.robot.tree), is_used, go_on)
}

fn explain_robot(
    log: &Log,
    robot: Robot,
    drives: &Drives,
    scopes: Vec<ScopeSites>,
    is_used: impl Fn(usize) -> bool,
    go_on: &mut dyn FnMut(&str) -> bool,
) -> Result<Option<Explained>, InferenceError> {
    let mut laws = laws();
    for law in &mut laws {
        law.is_cause = !log.is_too_slow_for(law.effect);
    }
    let measured = Measurements::new(log, &robot, &is_used);
    let is_of_positions = measured.is_none();
    let found = if let Some(measured) = measured {
        let system = System::new(measured, &robot);
        let is_balanced = !system.balance.samples.is_empty();
        if !system.measured.has_torque {
            if !is_balanced {
                return Err(InferenceError::NothingToSimulate);
            }
            for law in laws.iter_mut().filter(|law| law.form.place == Place::Sensor) {
                law.is_cause = false;
            }
        }
        for law in laws.iter_mut().filter(|_| !is_balanced) {
            let is_of_joint = law.form.place == Place::Joint && system.measured.is_at_output;
            law.is_cause &= matches!(law.form.place, Place::Drive | Place::Supply) || is_of_joint;
        }
        Search::new(&system, &laws, scopes, robot.clone()).run(go_on)
    } else {
        if !robot.has_bodies() {
            return Err(missing(log));
        }
        for law in &mut laws {
            law.is_cause &= is_simulated(law);
            few_variants(law);
        }
        let positions = Positions::new(log, &robot, &laws, &is_used, drives)?;
        Search::new(&positions, &laws, scopes, robot.clone()).run(go_on)
    };
    let terms = Terms { laws: &laws, robot: &robot };
    Ok(found.map(|found| Explained { is_of_positions, ..terms.explained(found) }))
}

/// Returns what the equations of drives alone lack in a log.
fn missing(log: &Log) -> InferenceError {
    let lacks = |joint: &String| match (log.dq(joint), log.tau_measured(joint)) {
        (None, _) => Some((joint.clone(), "dq")),
        (_, None) => Some((joint.clone(), "tau_measured")),
        _ => None,
    };
    let found = log.joints().iter().find_map(lacks);
    found.map_or(InferenceError::NothingToSimulate, |(joint, quantity)| InferenceError::Missing { joint, quantity })
}

/// Returns the root mean square error of the torques of a robot's drives, on measured states, in the rows that are used [N·m].
///
/// `None` if the log has no motor currents, or lacks what [`explain`] needs beside them.
pub fn torque_error(log: &Log, robot: &TreeModel, is_used: impl Fn(usize) -> bool) -> Option<f64> {
    let robot = Robot::from(robot);
    let system = System::new(Measurements::new(log, &robot, is_used)?, &robot);
    let blocks = system.residuals(&robot, &system.predicted(&robot));
    let torques = blocks.iter().filter(|block| block.name.starts_with("torque")).flat_map(|block| &block.y);
    let (sum, count) = torques.fold((0.0, 0.0), |(sum, count), error| (sum + error * error, count + 1.0));
    (count > 0.0).then(|| (sum / count).sqrt())
}

/// Leaves some of the variants of a law: each is a simulation.
fn few_variants(law: &mut Law) {
    for (variants, most) in [(&mut law.strengths, MOST_STRENGTHS), (&mut law.shapes, MOST_SHAPES)] {
        if variants.len() > most {
            *variants = variants.iter().copied().skip(1).step_by(variants.len() / most).collect();
        }
    }
}

/// Returns the scopes with their prior probabilities: joints of one type are alike, and what one has, all may have.
fn scopes() -> Vec<ScopeSites> {
    let of_joints = Scope::of_joints().into_iter().map(|scope| {
        let contained = Joint::ALL.into_iter().enumerate().filter(|(_, joint)| scope.contains(*joint));
        let probability = match scope {
            Scope::All | Scope::Base => 0.3,
            Scope::Kind(_) => 0.1,
            Scope::Joint(_) => 0.3 / 12.0,
            Scope::Leg(_) | Scope::Left | Scope::Right | Scope::Ground => 0.1 / 6.0,
        };
        ScopeSites {
            name: scope.to_string(),
            sites: contained.map(|(index, _)| Site::Joint(index)).collect(),
            probability,
            is_alike: true,
        }
    });
    let of_joints: Vec<ScopeSites> = of_joints.collect();
    let types = of_joints.iter().filter(|scope| scope.probability >= EACH && scope.sites.len() > 1);
    let each: Vec<ScopeSites> =
        types.map(|scope| ScopeSites { probability: EACH, is_alike: false, ..scope.clone() }).collect();
    let of_base =
        |name: &str| ScopeSites { name: name.to_owned(), sites: vec![Site::Base], probability: 0.5, is_alike: true };
    of_joints.into_iter().chain(each).chain([of_base("base"), of_base("all"), of_base("ground")]).collect()
}

/// Returns the scopes of the joints of a tree.
fn scopes_of(tree: &RobotTree) -> Vec<ScopeSites> {
    let count = tree.joints.len();
    let scope = |name: &str, joints: Range<usize>, probability: f64, is_alike: bool| ScopeSites {
        name: name.to_owned(),
        sites: joints.map(Site::Joint).collect(),
        probability,
        is_alike,
    };
    let of_joint = |(index, joint): (usize, &TreeJoint)| scope(&joint.name, index..index + 1, 0.3 / count as f64, true);
    let all = [scope("all", 0..count, 0.3, true), scope("all", 0..count, EACH, false)];
    all.into_iter().chain(tree.joints.iter().enumerate().map(of_joint)).collect()
}
