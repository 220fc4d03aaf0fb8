//! What explains a log, in the terms of the catalogue: effects, scopes, values and intervals.

use twinstep_effects::{CATALOGUE, Composition, Effect};

use super::causes::{Cause, Found, FoundCause, Screened, UnknownLaw};
use super::law::{Law, Place};
use super::outcome::TWO_SIDED_95;
use super::residuals::Little;
use super::robot::Robot;
use super::search::LEAST_GAIN;
use super::site::{Site, apply, body_of};

/// Relative standard deviation of a value because no law is exact.
const LAW_ERROR: f64 = 0.015;
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
///
/// A model with [`Explained::all`] predicts best; the causes alone are what the log shows with certainty.
#[derive(Clone, Debug)]
pub struct Explained {
    /// Causes, the strongest first.
    pub causes: Vec<Explanation>,
    /// Effects that belong to the fit, but are too small or too uncertain to be called causes.
    pub unnamed: Vec<Explanation>,
    /// Correlation of the estimates of two causes, by their places.
    pub correlations: Vec<(usize, usize, f64)>,
    /// Variance above noise that is left, relative to that of the given robot.
    pub left: f64,
    /// Scales of position and velocity gain by joint, if they differ, beside the causes, by more than they are uncertain; else empty.
    pub gains: Vec<[f64; 2]>,
    /// Laws that the catalogue does not have, the strongest first.
    pub unknown: Vec<UnknownLaw>,
    /// True if the log has no torques, so that positions were compared.
    pub is_of_positions: bool,
    /// Decisions of the search, as sentences.
    pub decisions: Vec<String>,
    /// The effects of the catalogue that are no cause, the closest first.
    pub passed: Vec<Passed>,
}

/// An effect that is no cause.
#[derive(Clone, Debug)]
pub struct Passed {
    /// The effect.
    pub effect: &'static Effect,
    /// Its best scope, and by how much it would be better than what was found, by the screening [nat]; `None` if it explains nothing.
    pub best: Option<(String, f64)>,
    /// Why it is no cause, as a sentence.
    pub reason: &'static str,
}

impl Explained {
    /// Returns the causes, and the other effects of the fit.
    pub fn all(&self) -> impl Iterator<Item = &Explanation> {
        self.causes.iter().chain(&self.unnamed)
    }
}

/// Laws and the given robot, in which unknowns have a meaning.
pub struct Terms<'a> {
    /// The laws.
    pub laws: &'a [Law],
    /// The given robot.
    pub robot: &'a Robot,
}

impl Terms<'_> {
    /// Returns what a search has found.
    pub fn explained(&self, found: Found) -> Explained {
        let mut causes: Vec<Explanation> = found.causes.iter().map(|cause| self.explanation(cause)).collect();
        let named = found.causes.iter().filter(|cause| cause.is_large).count();
        let mut unnamed = causes.split_off(named);
        let exported = found.causes.iter().zip(causes.iter().chain(&unnamed));
        let alike: Vec<&Cause> =
            exported.filter(|(_, one)| one.by_joint.is_empty()).map(|(found, _)| &found.cause).collect();
        let little = found.little.into_iter().map(|one| beside(one, &alike)).collect::<Vec<_>>();
        unnamed.extend(self.little(&little));
        let passed = passed(&causes, &unnamed, self.laws, (&found.screened, &found.imitations));
        let is_named = |(one, other, _): &(usize, usize, f64)| *one < named && *other < named;
        let excess = |power: f64| (power - UNEXPLAINED).max(0.0);
        let sum = |side: usize| found.left.iter().map(|(_, powers)| excess(powers[side])).sum::<f64>();
        Explained {
            left: if sum(0) > 0.0 { sum(1) / sum(0) } else { 0.0 },
            gains: found.gains,
            is_of_positions: false,
            unknown: found.unknown,
            correlations: found.correlations.into_iter().filter(is_named).collect(),
            decisions: found.decisions,
            passed,
            causes,
            unnamed,
        }
    }

    fn explanation(&self, found: &FoundCause) -> Explanation {
        let cause = &found.cause;
        let (effect, scope, values) = self.in_terms(cause);
        let law = &self.laws[cause.law];
        let first = cause.scope.sites[0];
        let mean_scale =
            cause.scope.sites.iter().map(|site| self.scale(*site)).sum::<f64>() / cause.scope.sites.len() as f64;
        let intervals = self.intervals(law, first, (&cause.mean(), &found.stds), cause.shape, mean_scale);
        let sites = cause.scope.sites.iter().zip(cause.values.iter().zip(&found.site_stds));
        let differs = differ(cause, found)
            || law.form.is_of_torque && cause.scope.sites.iter().any(|site| self.scale(*site) != self.scale(first));
        let by_joint = sites.filter_map(|(site, (unknowns, stds))| match site {
            Site::Joint(joint) if differs => {
                Some(self.of_joint(law, *joint, (unknowns.as_slice(), stds.as_slice()), cause.shape))
            }
            _ => None,
        });
        let by_joint = by_joint.collect();
        let rivals = found.rivals.iter().map(|(cause, behind)| {
            let (effect, scope, values) = self.in_terms(cause);
            (effect, scope, values, *behind)
        });
        let mut others: Vec<(&'static Effect, String, Vec<f64>, f64)> = Vec::new();
        for rival in rivals {
            // Joints that are alike and joints of their own have one name.
            let is_named = |effect_of: &Effect, scope_of: &str| rival.0 == effect_of && rival.1 == scope_of;
            if !is_named(effect, &scope) && !others.iter().any(|(effect, scope, ..)| is_named(effect, scope)) {
                others.push(rival);
            }
        }
        let (gain, explained) = (found.gain, found.explained);
        Explanation { effect, scope, values, intervals, by_joint, gain, explained, rivals: others }
    }

    /// Returns what joints have a little of, where the log shows it.
    fn little(&self, all: &[Little]) -> Vec<Explanation> {
        let is_shown = |one: &&Little| one.unknowns.iter().zip(&one.stds).any(|(unknown, std)| unknown.abs() > *std);
        // An entry that replaces others would replace a cause.
        let is_added = |one: &&Little| self.laws[one.law].effect.composition != Composition::Replace;
        let explanation = |one: &Little| {
            let law = &self.laws[one.law];
            let own = self.of_joint(law, one.joint, (&one.unknowns, &one.stds), law.shapes[0]);
            Explanation {
                effect: law.effect,
                scope: self.robot.tree.joints[one.joint].name.clone(),
                values: own.values.clone(),
                intervals: own.intervals.clone(),
                by_joint: vec![own],
                gain: 0.0,
                explained: 0.0,
                rivals: Vec::new(),
            }
        };
        all.iter().filter(is_shown).filter(is_added).map(explanation).collect()
    }

    fn of_joint(&self, law: &Law, joint: usize, (unknowns, stds): (&[f64], &[f64]), shape: f64) -> OfJoint {
        let site = Site::Joint(joint);
        OfJoint {
            joint,
            values: self.values(law, site, unknowns, shape, self.scale(site)),
            intervals: self.intervals(law, site, (unknowns, stds), shape, self.scale(site)),
        }
    }

    fn scale(&self, site: Site) -> f64 {
        if let Site::Joint(joint) = site { self.robot.scale[joint] } else { 1.0 }
    }

    fn in_terms(&self, cause: &Cause) -> (&'static Effect, String, Vec<f64>) {
        let law = &self.laws[cause.law];
        let sites = &cause.scope.sites;
        let mean_scale = sites.iter().map(|site| self.scale(*site)).sum::<f64>() / sites.len() as f64;
        let values = self.values(law, sites[0], &cause.mean(), cause.shape, mean_scale);
        (law.effect, cause.scope.name.clone(), values)
    }

    /// Returns the parameters of an effect within their bounds.
    fn values(&self, law: &Law, site: Site, unknowns: &[f64], shape: f64, scale: f64) -> Vec<f64> {
        let of_ground: Option<fn(&Robot) -> f64> = match law.form.place {
            Place::Slip => Some(|robot| robot.ground_friction),
            Place::Sink => Some(|robot| robot.contact_time),
            _ => None,
        };
        if let Some(value) = of_ground {
            let mut changed = self.robot.clone();
            apply(&mut changed, law, site, unknowns, shape);
            return clamped(law.effect, vec![value(&changed)]);
        }
        if !law.effect.replaces_body() {
            return clamped(law.effect, law.parameters(unknowns, shape, scale));
        }
        let mut changed = self.robot.clone();
        apply(&mut changed, law, site, unknowns, shape);
        clamped(law.effect, changed.tree.bodies[body_of(site)].inertia.log_cholesky().to_vec())
    }

    /// Returns the 95 % interval of each parameter, given unknowns and their standard deviations.
    fn intervals(
        &self,
        law: &Law,
        site: Site,
        (unknowns, stds): (&[f64], &[f64]),
        shape: f64,
        scale: f64,
    ) -> Vec<[f64; 2]> {
        let values = |unknowns: &[f64]| self.values(law, site, unknowns, shape, scale);
        let mut intervals: Vec<[f64; 2]> = values(unknowns).into_iter().map(|value| [value; 2]).collect();
        for (unknown, std) in stds.iter().enumerate() {
            let half = TWO_SIDED_95 * std.hypot(LAW_ERROR * unknowns[unknown]);
            for side in [-half, half] {
                let mut moved = unknowns.to_vec();
                moved[unknown] += side;
                for (interval, value) in intervals.iter_mut().zip(values(&moved)) {
                    *interval = [interval[0].min(value), interval[1].max(value)];
                }
            }
        }
        intervals
    }
}

/// Returns why each effect that is no cause is none.
fn passed(
    causes: &[Explanation],
    unnamed: &[Explanation],
    laws: &[Law],
    (screened, imitations): (&[Screened], &[(usize, String)]),
) -> Vec<Passed> {
    let of_effect = |effect: &'static Effect| {
        let best = screened.iter().find(|one| laws[one.law].effect == effect);
        let best = best.map(|one| (one.scope.clone(), one.gain));
        let imitated = imitations.iter().find(|(law, _)| laws[*law].effect == effect);
        if let Some((_, scope)) = imitated {
            let best = Some((scope.clone(), best.map_or(0.0, |(_, gain)| gain)));
            return Passed {
                effect,
                best,
                reason: "It was found, but a law that the catalogue does not have explains more.",
            };
        }
        if let Some(small) = unnamed.iter().find(|one| one.effect == effect && one.gain != 0.0) {
            let best = Some((small.scope.clone(), small.gain));
            let reason = "It belongs to the fit, but it is too uncertain, or not larger than in 95 % of all robots.";
            return Passed { effect, best, reason };
        }
        let reason = match best {
            Some((_, gain)) if gain > LEAST_GAIN => "Fitted beside the causes, it gains less than the screening says.",
            Some(_) => "It gains too little: 3 nat are the least.",
            None => "No equation of this log shows it, or it has the wrong sign.",
        };
        Passed { effect, best, reason }
    };
    let others = CATALOGUE.into_iter().filter(|effect| causes.iter().all(|cause| cause.effect != *effect));
    let mut passed: Vec<Passed> = others.map(of_effect).collect();
    let gain = |one: &Passed| one.best.as_ref().map_or(f64::NEG_INFINITY, |(_, gain)| *gain);
    passed.sort_by(|one, other| gain(other).total_cmp(&gain(one)));
    passed
}

/// Returns a little with the difference between a joint's value and that of all sites, for causes of one value.
fn beside(mut little: Little, alike: &[&Cause]) -> Little {
    for cause in alike.iter().filter(|cause| cause.law == little.law) {
        if let Some(place) = cause.scope.sites.iter().position(|site| *site == Site::Joint(little.joint)) {
            let own = cause.values[place].iter().zip(cause.mean());
            little.unknowns.iter_mut().zip(own).for_each(|(unknown, (own, mean))| *unknown += own - mean);
        }
    }
    little
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
