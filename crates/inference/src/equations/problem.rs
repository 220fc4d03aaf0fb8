//! What a search for causes works on, and what it remembers.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use super::block::{Column, SHAPES};
use super::causes::{Cause, ScopeSites, Screened, UnknownLaw};
use super::law::Law;
use super::residuals::Residuals;
use super::robot::Robot;
use super::site::Site;

/// Prior probability that an effect is a cause.
const EFFECT_PROBABILITY: f64 = 1.0 / 12.0;

/// Prior probability that every joint has its own of a usual effect. That they are alike is three times as probable.
const USUAL_PROBABILITY: f64 = 0.2;

/// Prior probability of a law that the catalogue does not have at a joint.
pub const UNKNOWN_PROBABILITY: f64 = 0.001;

/// Search for causes.
pub struct Search<'a, R> {
    pub system: &'a R,
    pub laws: &'a [Law],
    pub scopes: Vec<ScopeSites>,
    pub base: Robot,
    pub decisions: Vec<String>,
    /// Causes that were removed: law and scope. They are not tried again.
    pub removed: Vec<(usize, String)>,
    /// Candidates that were fitted when a cause was added.
    pub rivals: Vec<Rivals>,
    /// The best scope of each law in the last screening, with its gain [nat].
    pub screened: Vec<Screened>,
    /// Causes in whose place another law explains more: law and scope.
    pub imitations: Vec<(usize, String)>,
    /// The laws that explain more.
    pub other_laws: Vec<UnknownLaw>,
    /// Columns of the last screening.
    pub columns: KnownColumns,
}

/// Columns by what they are of, with the fingerprint of what they were computed from.
pub type KnownColumns = Mutex<HashMap<ColumnOf, (u64, Arc<Column>)>>;

/// Column of an unknown of a law at a site.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ColumnOf {
    /// Index of the law.
    pub law: usize,
    /// Index of the strength or of the shape.
    pub variant: usize,
    /// The site.
    pub site: Site,
    /// Index of the unknown.
    pub unknown: usize,
}

/// Candidates in the place of a cause.
pub struct Rivals {
    pub law: usize,
    pub scope: String,
    /// With their evidence minus that of the cause [nat].
    pub others: Vec<(Cause, f64)>,
}

impl<'a, R: Residuals> Search<'a, R> {
    /// Prepares a search for what `base` lacks.
    pub fn new(system: &'a R, laws: &'a [Law], scopes: Vec<ScopeSites>, base: Robot) -> Self {
        Self {
            system,
            laws,
            scopes,
            base,
            decisions: Vec::new(),
            removed: Vec::new(),
            rivals: Vec::new(),
            screened: Vec::new(),
            imitations: Vec::new(),
            other_laws: Vec::new(),
            columns: KnownColumns::default(),
        }
    }

    /// Returns the logarithm of the prior probability of a law on a scope.
    pub fn log_prior(&self, law: usize, scope: &ScopeSites) -> f64 {
        let name = self.laws[law].effect.name;
        let is_usual = self.system.usual().iter().any(|(usual, _)| *usual == name);
        if is_usual && scope.sites.len() == self.base.joints.len() {
            return (USUAL_PROBABILITY * if scope.is_alike { 3.0 } else { 1.0 }).ln();
        }
        EFFECT_PROBABILITY.ln() + scope.probability.ln()
    }
}

/// Returns the variance of noise, relative to that of the sensor.
pub fn power((shape, scale): &(usize, f64)) -> f64 {
    scale * (1.0 + SHAPES[*shape].ratio)
}
