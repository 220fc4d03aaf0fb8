//! The causes of a log, in the terms of the catalogue.

use twinstep_effects::{Effect, Scope};
use twinstep_logs::Log;
use twinstep_model::{Joint, RobotModel};

use super::causes::{Cause, Found, ScopeSites, UnknownLaw};
use super::law::{Law, laws};
use super::measurements::{Measurements, Regime};
use super::outcome::TWO_SIDED_95;
use super::problem::Search;
use super::robot::Robot;
use super::system::{Site, System, apply, body_of};

/// Relative standard deviation of a value because no law is exact.
const LAW_ERROR: f64 = 0.015;
/// Prior probability that each joint of all, or of a type, has its own value.
const EACH: f64 = 0.1;
/// Variance that is left in an equation, relative to that of its noise, which wrong statements about the noise allow.
const UNEXPLAINED: f64 = 2.0;

/// Values of an effect at a joint.
#[derive(Clone, Debug, PartialEq)]
pub struct OfJoint {
    /// The joint.
    pub joint: Joint,
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
    /// The scope.
    pub scope: Scope,
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
    pub rivals: Vec<(&'static Effect, Scope, Vec<f64>, f64)>,
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
    /// Decisions of the search, as sentences.
    pub decisions: Vec<String>,
}

/// Finds what `robot` lacks, from the rows of `log` that are used.
///
/// Returns `None` if the log has no motor currents, no velocities or unknown gains at a joint, or not all joints of the robot, and if the
/// base moves but the log has no rows in which it is fixed, or stands on all feet with its orientation, angular velocity and acceleration. `go_on`
/// gets a line of progress; the search ends with `None` if it returns false.
pub fn explain(
    log: &Log,
    robot: &RobotModel,
    is_used: impl Fn(usize) -> bool,
    go_on: &mut dyn FnMut(&str) -> bool,
) -> Option<Explained> {
    let robot = Robot::from(robot);
    let measured = Measurements::new(log, &robot, is_used)?;
    let system = System::new(measured, &robot);
    let is_free = system.measured.regime.iter().any(|regime| *regime != Regime::Hang);
    let hangs = system.measured.regime.contains(&Regime::Hang);
    if is_free && !(hangs && system.balance.stands()) {
        return None;
    }
    let mut laws = laws();
    for law in &mut laws {
        law.is_cause = !log.is_too_slow_for(law.effect);
    }
    let found = Search::new(&system, &laws, scopes(), robot.clone()).run(go_on)?;
    Some(explained(found, &laws, &robot))
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

/// Returns parameters of an effect within their bounds.
fn clamped(effect: &Effect, values: Vec<f64>) -> Vec<f64> {
    let bounds = effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter.bounds, parameter.count));
    values.into_iter().zip(bounds).map(|(value, [low, high])| value.clamp(low, high)).collect()
}

fn explained(found: Found, laws: &[Law], robot: &Robot) -> Explained {
    let values_of = |cause: &Cause, unknowns: &[f64]| -> Vec<f64> {
        let law = &laws[cause.law];
        if law.effect.name != "inertia" {
            return (law.values)(unknowns, cause.shape);
        }
        let (mut changed, site) = (robot.clone(), cause.scope.sites[0]);
        apply(&mut changed, law, site, unknowns, cause.shape);
        changed.tree.bodies[body_of(site)].inertia.log_cholesky().to_vec()
    };
    let in_terms = |cause: &Cause| {
        let law = &laws[cause.law];
        let scope: Scope = cause.scope.name.parse().expect("the name of a scope");
        let values = clamped(law.effect, values_of(cause, &cause.mean()));
        (law.effect, scope, values)
    };
    let intervals_of = |cause: &Cause, unknowns: &[f64], stds: &[f64]| {
        let effect = laws[cause.law].effect;
        let middle = clamped(effect, values_of(cause, unknowns));
        let mut intervals: Vec<[f64; 2]> = middle.into_iter().map(|value| [value; 2]).collect();
        for (unknown, std) in stds.iter().enumerate() {
            let half = TWO_SIDED_95 * std.hypot(LAW_ERROR * unknowns[unknown]);
            for side in [-half, half] {
                let mut moved = unknowns.to_vec();
                moved[unknown] += side;
                let ends = clamped(effect, values_of(cause, &moved));
                for (interval, value) in intervals.iter_mut().zip(ends) {
                    *interval = [interval[0].min(value), interval[1].max(value)];
                }
            }
        }
        intervals
    };
    let causes = found.causes.iter().map(|found| {
        let (effect, scope, values) = in_terms(&found.cause);
        let intervals = intervals_of(&found.cause, &found.cause.mean(), &found.stds);
        let sites = found.cause.scope.sites.iter().zip(found.cause.values.iter().zip(&found.site_stds));
        let by_joint = sites.filter_map(|(site, (unknowns, stds))| match site {
            Site::Joint(joint) if !found.cause.scope.is_alike => Some(OfJoint {
                joint: Joint::ALL[*joint],
                values: clamped(effect, values_of(&found.cause, unknowns)),
                intervals: intervals_of(&found.cause, unknowns, stds),
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
        unknown: found.unknown,
        correlations: found.correlations,
        decisions: found.decisions,
        causes,
    }
}
