//! Residuals of a log: measured minus what a robot would have, and what changes of the robot change in them.

use super::block::{Block, Column};
use super::gaussian::{Cache, Group};
use super::law::{Law, Place};
use super::robot::Robot;
use super::site::Site;

/// State of a joint.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// Position [rad].
    pub q: f64,
    /// Velocity [rad/s].
    pub dq: f64,
    /// Torque of the drive [N·m].
    pub torque: f64,
}

/// A law at a site that changes a robot.
pub struct Change<'a> {
    /// The law.
    pub law: &'a Law,
    /// The site.
    pub site: Site,
    /// The changed robot.
    pub after: Robot,
}

/// Unknowns that are never reported, with narrow priors.
#[derive(Default)]
pub struct Small {
    /// Their columns.
    pub groups: Vec<Group>,
    /// Products of the columns.
    pub cache: Cache,
}

impl Small {
    /// Returns unknowns with these columns.
    pub fn new(groups: Vec<Group>) -> Self {
        Self { groups, cache: Cache::default() }
    }

    /// Returns the number of unknowns.
    pub fn len(&self) -> usize {
        self.groups.iter().map(|group| group.columns.len()).sum()
    }
}

/// What a joint has a little of.
pub struct Little {
    /// Index of the law.
    pub law: usize,
    /// Index of the joint.
    pub joint: usize,
    /// Unknowns of the law.
    pub unknowns: Vec<f64>,
    /// Their standard deviations.
    pub stds: Vec<f64>,
}

/// A function at a joint in physical units.
#[derive(Clone, Debug, PartialEq)]
pub struct Formula {
    /// Formula of position q [rad], velocity dq [rad/s], position error e [rad], torque tau [N·m], temperature T [°C] and time t [s].
    pub text: String,
    /// Factor of the formula for a torque of 1 N·m, root mean square; of an angle between encoder and link [rad] where the law is of one.
    pub per_torque: f64,
}

/// Residuals of a log.
pub trait Residuals: Sync {
    /// What a robot has, from which residuals and columns are computed.
    type Predicted: Send + Sync;

    /// Returns the effects of which every joint of a real robot has its own, if a search begins with them, and from where: their first
    /// parameter at each joint, if it is known.
    fn usual(&self) -> Vec<(&'static str, Option<Vec<f64>>)>;

    /// Returns true if each column is a simulation, so that few are computed.
    fn is_simulated(&self) -> bool;

    /// Returns the number of steps of a fit of a candidate.
    fn trial_steps(&self) -> usize;

    /// Returns the number of steps of a fit that is compared with another one of the same causes.
    fn fit_steps(&self) -> usize;

    /// Returns the blocks, with any residuals.
    fn blocks(&self) -> &[Block];

    /// Returns what each robot has.
    fn predicted(&self, robots: &[Robot]) -> Vec<Self::Predicted>;

    /// Returns the blocks with the residuals of a robot.
    fn residuals(&self, robot: &Robot, predicted: &Self::Predicted) -> Vec<Block>;

    /// Returns what each change changes of a robot, in the residuals.
    fn columns(&self, before: (&Robot, &Self::Predicted), changes: &[Change]) -> Vec<Column>;

    /// Returns a number that is equal for equal columns of laws with a place at a site; `None` if it is not known.
    fn fingerprint(&self, place: Place, site: Site, robot: &Robot, predicted: &Self::Predicted) -> Option<u64>;

    /// Returns the small unknowns around a robot.
    fn small(&self, laws: &[Law], robot: &Robot, predicted: &Self::Predicted) -> Small;

    /// Changes a robot by values of the small unknowns, and the values if they are not possible.
    ///
    /// Returns false if the residuals are linear in them: then they stay at zero.
    fn apply_small(&self, laws: &[Law], robot: &mut Robot, values: &mut [f64]) -> bool;

    /// Returns what each joint has a little of, given the values of the small unknowns and their standard deviations. Nothing if the
    /// residuals are linear in them.
    fn little(&self, values: &[f64], stds: &[f64]) -> Vec<Little>;

    /// Returns the equations that tell laws at a joint apart.
    fn places(&self) -> &[Place];

    /// Returns the columns of [`super::unknown::FUNCTIONS`] at a joint, in the equations of a law's place; none if there are none.
    fn functions(&self, predicted: &Self::Predicted, joint: usize, place: Place) -> Vec<Column>;

    /// Returns these functions in physical units.
    fn formulas(&self, predicted: &Self::Predicted, joint: usize, place: Place) -> Vec<Formula>;

    /// Returns the state of a joint at a time of the log [s].
    fn state(&self, predicted: &Self::Predicted, joint: usize, t: f64) -> State;
}
