//! The causes of a log, in the terms of the catalogue.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use twinstep_effects::{Effect, Scope};
use twinstep_logs::Log;
use twinstep_model::{Joint, RobotModel, RobotTree, TreeJoint, TreeModel};

use super::causes::{Cause, Found, FoundCause, ScopeSites, UnknownLaw};
use super::law::{Law, Place, laws};
use super::measurements::{Measurements, Regime};
use super::outcome::TWO_SIDED_95;
use super::positions::{Drives, Positions, is_simulated};
use super::problem::Search;
use super::robot::Robot;
use super::site::{Site, apply, body_of};
use super::system::System;
use crate::{Candidate, InferenceError};

/// Relative standard deviation of a value because no law is exact.
const LAW_ERROR: f64 = 0.015;
/// Prior probability that each joint of all, or of a type, has its own value.
const EACH: f64 = 0.1;
/// Strengths and shapes of a law that are tried where each is a simulation.
const MOST_STRENGTHS: usize = 6;
const MOST_SHAPES: usize = 24;
/// Variance that is left in an equation, relative to that of its noise, which wrong statements about the noise allow.
const UNEXPLAINED: f64 = 2.0;

/// Values of an effect at a joint.
#[derive(Clone, Debug, PartialEq)]
pub struct OfJoint {
    /// Index of the joint in the robot.
    pub joint: usize,
    /// Values of all parameters.
    pub values: Vec<f64>,
    /// 95 % interval of each value.
    pub intervals: Vec<[f64; 2]>,
}

/// An effect on a scope, with values.
#[derive(Clone, Debug, PartialEq)]
pub struct Explanation {
    /// The effect.
    pub effect: &'static Effect,
    /// Name of the scope, as in a model file.
    pub scope: String,
    /// Values of all parameters: means over the scope.
    pub values: Vec<f64>,
    /// 95 % interval of each value.
    pub intervals: Vec<[f64; 2]>,
    /// Values of each joint, where they are not alike; else empty.
    pub by_joint: Vec<OfJoint>,
    /// Evidence of all causes minus that without this one [nat].
    pub gain: f64,
    /// Share of the root mean square of the residuals that it explains, in the equations that it changes.
    pub explained: f64,
    /// Effects in its place, with their evidence minus that of the cause [nat].
    pub rivals: Vec<(&'static Effect, String, Vec<f64>, f64)>,
}

/// What explains a log.
#[derive(Clone, Debug)]
pub struct Explained {
    /// Causes, the strongest first.
    pub causes: Vec<Explanation>,
    /// Correlation of the estimates of two causes, by their places.
    pub correlations: Vec<(usize, usize, f64)>,
    /// Variance above noise that is left, relative to that of the given robot.
    pub left: f64,
    /// True if the gains of the joints differ, beside the causes, by more than they are uncertain.
    pub gains_differ: bool,
    /// Laws that the catalogue does not have, the strongest first.
    pub unknown: Vec<UnknownLaw>,
    /// True if the log has no torques, so that positions were compared.
    pub is_of_positions: bool,
    /// Decisions of the search, as sentences.
    pub decisions: Vec<String>,
}

/// Finds what a quadruped lacks, from the rows of `log` that are used. `go_on` gets a line of progress.
///
/// Returns `None` if `go_on` returned false. Fails if the log has neither torques nor a fixed base, or if
/// the base moves, and the robot does not both hang and stand on all feet in some rows.
pub fn explain(
    log: &Log,
    robot: &RobotModel,
    is_used: impl Fn(usize) -> bool,
    go_on: &mut dyn FnMut(&str) -> bool,
) -> Result<Option<Explained>, InferenceError> {
    let zeros = vec![0.0; robot.joints.len()];
    let drives = Drives {
        kp: zeros.clone(),
        kd: zeros,
        actuator_hz: robot.control.actuator_hz,
        estimates: None,
        stop: Arc::default(),
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
        let hangs = system.measured.regime.contains(&Regime::Hang);
        let is_free = system.measured.regime.iter().any(|regime| *regime != Regime::Hang);
        if is_free && !(hangs && system.balance.stands()) && !robot.feet.is_empty() {
            return Err(InferenceError::NothingToSimulate);
        }
        let is_balanced = hangs && !system.balance.samples.is_empty();
        for law in laws.iter_mut().filter(|_| !is_balanced) {
            let is_of_joint = law.place == Place::Joint && system.measured.is_at_output;
            law.is_cause &= matches!(law.place, Place::Drive | Place::Supply) || is_of_joint;
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
    Ok(found.map(|found| Explained { is_of_positions, ..explained(found, &laws, &robot) }))
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
    of_joints.into_iter().chain(each).chain([of_base("base"), of_base("all")]).collect()
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

/// Returns parameters of an effect within their bounds.
fn clamped(effect: &Effect, values: Vec<f64>) -> Vec<f64> {
    let bounds = effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter.bounds, parameter.count));
    values.into_iter().zip(bounds).map(|(value, [low, high])| value.clamp(low, high)).collect()
}

/// Returns true if the values of the joints differ from their mean by more than they are uncertain.
fn differ(cause: &Cause, found: &FoundCause) -> bool {
    let mean = cause.mean();
    let is_far = |(value, (std, mean)): (&f64, (&f64, &f64))| (value - mean).abs() > TWO_SIDED_95 * std;
    let of_site = |(values, stds): (&Vec<f64>, &Vec<f64>)| values.iter().zip(stds.iter().zip(&mean)).any(is_far);
    !cause.scope.is_alike || cause.values.iter().zip(&found.site_stds).any(of_site)
}

fn explained(found: Found, laws: &[Law], robot: &Robot) -> Explained {
    let scale_of = |site: &Site| if let Site::Joint(joint) = site { robot.scale[*joint] } else { 1.0 };
    let values_at = |cause: &Cause, unknowns: &[f64], scale: f64| -> Vec<f64> {
        let law = &laws[cause.law];
        if law.effect.name != "inertia" {
            return clamped(law.effect, law.parameters(unknowns, cause.shape, scale));
        }
        let (mut changed, site) = (robot.clone(), cause.scope.sites[0]);
        apply(&mut changed, law, site, unknowns, cause.shape);
        clamped(law.effect, changed.tree.bodies[body_of(site)].inertia.log_cholesky().to_vec())
    };
    let mean_scale =
        |cause: &Cause| cause.scope.sites.iter().map(scale_of).sum::<f64>() / cause.scope.sites.len() as f64;
    let in_terms = |cause: &Cause| {
        (laws[cause.law].effect, cause.scope.name.clone(), values_at(cause, &cause.mean(), mean_scale(cause)))
    };
    let intervals_of = |cause: &Cause, unknowns: &[f64], stds: &[f64], scale: f64| {
        let middle = values_at(cause, unknowns, scale);
        let mut intervals: Vec<[f64; 2]> = middle.into_iter().map(|value| [value; 2]).collect();
        for (unknown, std) in stds.iter().enumerate() {
            let half = TWO_SIDED_95 * std.hypot(LAW_ERROR * unknowns[unknown]);
            for side in [-half, half] {
                let mut moved = unknowns.to_vec();
                moved[unknown] += side;
                let ends = values_at(cause, &moved, scale);
                for (interval, value) in intervals.iter_mut().zip(ends) {
                    *interval = [interval[0].min(value), interval[1].max(value)];
                }
            }
        }
        intervals
    };
    let causes = found.causes.iter().map(|found| {
        let cause = &found.cause;
        let (effect, scope, values) = in_terms(cause);
        let intervals = intervals_of(cause, &cause.mean(), &found.stds, mean_scale(cause));
        let sites = cause.scope.sites.iter().zip(cause.values.iter().zip(&found.site_stds));
        let differs = differ(cause, found) || {
            let first = scale_of(&cause.scope.sites[0]);
            laws[cause.law].is_of_torque && cause.scope.sites.iter().any(|site| scale_of(site) != first)
        };
        let by_joint = sites.filter_map(|(site, (unknowns, stds))| match site {
            Site::Joint(joint) if differs => Some(OfJoint {
                joint: *joint,
                values: values_at(cause, unknowns, scale_of(site)),
                intervals: intervals_of(cause, unknowns, stds, scale_of(site)),
            }),
            _ => None,
        });
        let by_joint = by_joint.collect();
        let rivals = found.rivals.iter().map(|(cause, behind)| {
            let (effect, scope, values) = in_terms(cause);
            (effect, scope, values, *behind)
        });
        let rivals = rivals.collect();
        Explanation { effect, scope, values, intervals, by_joint, gain: found.gain, explained: found.explained, rivals }
    });
    let causes: Vec<Explanation> = causes.collect();
    let excess = |power: f64| (power - UNEXPLAINED).max(0.0);
    let sum = |side: usize| found.left.iter().map(|(_, powers)| excess(powers[side])).sum::<f64>();
    Explained {
        left: if sum(0) > 0.0 { sum(1) / sum(0) } else { 0.0 },
        gains_differ: found.gains_differ,
        is_of_positions: false,
        unknown: found.unknown,
        correlations: found.correlations,
        decisions: found.decisions,
        causes,
    }
}
