//! Causes, and what a search finds.

use super::residuals::Little;
use super::site::Site;

/// Standard deviation of a joint's value around that of its scope, where they are alike, relative to the prior's.
pub const SPREAD: f64 = 0.15;

/// Joints, or a part of a robot, on which an effect may act.
#[derive(Clone, Debug, PartialEq)]
pub struct ScopeSites {
    /// Name, as in the model file.
    pub name: String,
    /// Sites.
    pub sites: Vec<Site>,
    /// Prior probability.
    pub probability: f64,
    /// True if the values at the sites are alike, false if each is its own.
    pub is_alike: bool,
}

impl ScopeSites {
    /// Returns the name, with that each joint has its own value.
    pub fn label(&self) -> String {
        if self.is_alike { self.name.clone() } else { format!("each of {}", self.name) }
    }

    /// Returns the prior covariance of the values of an unknown at two sites, relative to the variance at one.
    pub fn covariance(&self, is_same_site: bool) -> f64 {
        let shared = if self.is_alike { 1.0 } else { 0.0 };
        let own = if self.is_alike { SPREAD * SPREAD } else { 1.0 };
        shared + if is_same_site { own } else { 0.0 }
    }
}

/// An effect on a scope, with values.
#[derive(Clone, Debug)]
pub struct Cause {
    /// Index of the law.
    pub law: usize,
    /// Where it acts.
    pub scope: ScopeSites,
    /// Shape of the law.
    pub shape: f64,
    /// Unknowns at each site.
    pub values: Vec<Vec<f64>>,
    /// Logarithm of the prior probability.
    pub log_prior: f64,
}

impl Cause {
    /// Returns the size at each site: the largest of its unknowns, each relative to a unit.
    pub fn sizes(&self, units: &[f64]) -> Vec<f64> {
        let largest =
            |values: &Vec<f64>| values.iter().zip(units).map(|(value, unit)| (value / unit).abs()).fold(0.0, f64::max);
        self.values.iter().map(largest).collect()
    }

    /// Returns the smallest size of a site, relative to the largest.
    pub fn smallest_share(&self, units: &[f64]) -> f64 {
        let sizes = self.sizes(units);
        let [least, most] = [f64::min, f64::max].map(|which| sizes.iter().copied().reduce(which).unwrap_or(0.0));
        least / most
    }

    /// Returns the mean of each unknown over the sites.
    pub fn mean(&self) -> Vec<f64> {
        let sites = self.values.len() as f64;
        let of = |unknown: usize| self.values.iter().map(|values| values[unknown]).sum::<f64>() / sites;
        (0..self.values[0].len()).map(of).collect()
    }
}

/// A cause with its evidence.
#[derive(Clone, Debug)]
pub struct FoundCause {
    /// The cause.
    pub cause: Cause,
    /// Evidence of the set with it minus that without it [nat].
    pub gain: f64,
    /// Standard deviation of the mean of each unknown over the sites.
    pub stds: Vec<f64>,
    /// Standard deviation of each unknown at each site.
    pub site_stds: Vec<Vec<f64>>,
    /// Share of the root mean square of the residuals that it explains, in the equations that it changes.
    pub explained: f64,
    /// Causes in its place, with their evidence minus that of the cause [nat], the best first.
    pub rivals: Vec<(Cause, f64)>,
    /// True if it is large enough to be reported. Else it only belongs to the fit.
    pub is_large: bool,
}

/// A function of a law.
#[derive(Clone, Debug)]
pub struct LawTerm {
    /// Formula of position q [rad], velocity dq [rad/s], position error e [rad], torque tau [N·m], temperature T [°C] and time t [s].
    pub formula: String,
    /// Factor of the formula: a torque [N·m], or an angle between encoder and link [rad].
    pub coefficient: f64,
    /// Torque, root mean square over the rows, with the sign of the factor [N·m].
    pub torque: f64,
    /// Standard deviation of the torque [N·m].
    pub std: f64,
}

/// A law that the catalogue does not have.
#[derive(Clone, Debug)]
pub struct UnknownLaw {
    /// Name of the joint.
    pub joint: String,
    /// What it is a law of: `torque of the drive`, `torque on the link` or `angle between encoder and link`.
    pub quantity: &'static str,
    /// What it depends on most, as the prefix of a channel of the log.
    pub variable: &'static str,
    /// Its functions, the largest first.
    pub terms: Vec<LawTerm>,
    /// Gain of the evidence [nat].
    pub gain: f64,
}

/// The best scope of a law in a screening.
#[derive(Clone, Debug)]
pub struct Screened {
    /// Index of the law.
    pub law: usize,
    /// Name of the scope.
    pub scope: String,
    /// Gain at the noise of the fit [nat].
    pub gain: f64,
}

/// Result of a search.
pub struct Found {
    /// Causes, those that are large first, each of them the strongest first.
    pub causes: Vec<FoundCause>,
    /// What each joint has a little of.
    pub little: Vec<Little>,
    /// Names of the equations, with the variance of what is left, relative to that of the sensors' noise: without and with the causes.
    pub left: Vec<(String, [f64; 2])>,
    /// Decisions, in order.
    pub decisions: Vec<String>,
    /// The best scope of each law at the end, with its gain [nat].
    pub screened: Vec<Screened>,
    /// Causes in whose place another law explains more: law and scope.
    pub imitations: Vec<(usize, String)>,
    /// Laws that the catalogue does not have, the strongest first.
    pub unknown: Vec<UnknownLaw>,
    /// Scales of position and velocity gain by joint, if they differ, beside the causes, by more than they are uncertain; else empty.
    pub gains: Vec<[f64; 2]>,
    /// Correlation of the first unknowns of each pair of causes, by their places.
    pub correlations: Vec<(usize, usize, f64)>,
}
