//! The search for the set of causes of highest evidence.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::block::{Block, Column, SHAPES};
use super::gaussian::{Cache, Group, Posterior, Scores, gain, posterior};
use super::law::{Law, Place};
use super::robot::Robot;
use super::system::{Predicted, Site, System, apply};
use super::{nuisance, unknown};

/// Gain of the evidence above which a cause is added or kept [nat].
pub const LEAST_GAIN: f64 = 3.0;
/// Standard deviation of a joint's value around that of its scope, relative to the prior's.
const SPREAD: f64 = 0.15;
/// Standard deviation of a strength around one that is tried, relative to it.
const CELL: f64 = 0.3;
/// Prior probability that an effect is a cause.
const EFFECT_PROBABILITY: f64 = 1.0 / 12.0;
/// Prior probability of a law that the catalogue does not have at a joint, and the gain from which it is reported [nat].
const UNKNOWN_PROBABILITY: f64 = 0.001;
const LEAST_UNKNOWN: f64 = 10.0;
/// Candidates that are fitted in full after each screening, and at most of one effect.
const FITTED: [usize; 2] = [6, 3];
/// Size at a site above which a cause is large there, relative to its largest.
const LARGE: f64 = 0.3;
/// Other scopes of a cause that are tried.
const OTHER_SCOPES: usize = 3;
/// Iterations of a fit that is compared with another one of the same causes.
const CONVERGED: usize = 8;
/// Standard deviations of a normal distribution within which 95 % are, on both sides and below.
pub const TWO_SIDED_95: f64 = 1.96;
const ONE_SIDED_95: f64 = 1.645;
/// Most causes.
const MOST_CAUSES: usize = 6;
/// Causes that were added and removed again, after which the search ends.
const MOST_REMOVED: usize = 2;

/// Joints, or a part of a robot, on which an effect may act.
#[derive(Clone, Debug, PartialEq)]
pub struct ScopeSites {
    /// Name, as in the model file.
    pub name: String,
    /// Sites.
    pub sites: Vec<Site>,
    /// Prior probability.
    pub probability: f64,
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
    log_prior: f64,
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
    /// Share of the root mean square of the residuals that it explains, in the equations that it changes.
    pub explained: f64,
    /// Causes in its place, with their evidence minus that of the cause [nat], the best first.
    pub rivals: Vec<(Cause, f64)>,
}

/// A law that the catalogue does not have.
#[derive(Clone, Debug)]
pub struct UnknownLaw {
    /// Name of the joint.
    pub joint: String,
    /// True if the torque at the sensor shows it, false if only the torque on the link does.
    pub of_drive: bool,
    /// What it depends on most, as the prefix of a channel of the log.
    pub variable: &'static str,
    /// Gain of the evidence [nat].
    pub gain: f64,
}

/// Result of a search.
pub struct Found {
    /// Causes, the strongest first.
    pub causes: Vec<FoundCause>,
    /// Names of the equations, with the variance of what is left, relative to that of the sensors' noise: without and with the causes.
    pub left: Vec<(String, [f64; 2])>,
    /// Decisions, in order.
    pub decisions: Vec<String>,
    /// Laws that the catalogue does not have, the strongest first.
    pub unknown: Vec<UnknownLaw>,
    /// True if the gains of the joints differ, beside the causes, by more than they are uncertain.
    pub gains_differ: bool,
    /// Correlation of the first unknowns of each pair of causes, by their places.
    pub correlations: Vec<(usize, usize, f64)>,
}

/// Search for causes.
pub struct Search<'a> {
    system: &'a System,
    laws: &'a [Law],
    scopes: Vec<ScopeSites>,
    base: Robot,
    decisions: Vec<String>,
    cache: Cache,
    /// Causes that were removed: law and scope. They are not tried again.
    removed: Vec<(usize, String)>,
    /// Candidates that were fitted when a cause was added.
    rivals: Vec<Rivals>,
}

/// Candidates in the place of a cause.
struct Rivals {
    law: usize,
    scope: String,
    /// With their evidence minus that of the cause [nat].
    others: Vec<(Cause, f64)>,
}

/// A set of causes, fitted.
struct Fitted {
    causes: Vec<Cause>,
    evidence: f64,
    posterior: Posterior,
    robot: Robot,
    predicted: Predicted,
    blocks: Vec<Block>,
    groups: Vec<Group>,
}

impl<'a> Search<'a> {
    /// Prepares a search for what `base` lacks.
    pub fn new(system: &'a System, laws: &'a [Law], scopes: Vec<ScopeSites>, base: Robot) -> Self {
        Self {
            system,
            laws,
            scopes,
            base,
            decisions: Vec::new(),
            cache: Cache::default(),
            removed: Vec::new(),
            rivals: Vec::new(),
        }
    }

    /// Searches. `go_on` gets a line of progress, and ends the search if it returns false.
    pub fn run(mut self, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Found> {
        let predicted = self.system.predicted(&self.base);
        let of_bodies = nuisance::of_bodies(self.system, self.laws, &self.base, &predicted);
        let small_of = |this: &Self, robot: &Robot, predicted: &Predicted| {
            this.cache.clear();
            let of_joints = nuisance::of_joints(this.system, this.laws, robot, predicted);
            [of_bodies.as_slice(), &of_joints].concat()
        };
        let mut small = small_of(&self, &self.base, &predicted);
        let mut best = self.fit(Vec::new(), &small, 1, None);
        let given: Vec<f64> = best.posterior.noise.iter().map(power).collect();
        self.note(format!("no cause: {:.1} nat", best.evidence));
        while best.causes.len() < MOST_CAUSES && self.removed.len() < MOST_REMOVED {
            if !go_on(&self.progress(&best)) {
                return None;
            }
            let candidates = self.screen(&best, &small);
            let mut fits: Vec<(f64, Fitted)> = Vec::new();
            for (screened, cause) in candidates {
                if !go_on(&format!("{}, trying {}", self.progress(&best), self.name(&cause))) {
                    return None;
                }
                let causes = [best.causes.as_slice(), &[cause]].concat();
                fits.push((screened, self.fit(causes, &small, 3, Some(&best))));
            }
            for (screened, fit) in &fits {
                let cause = &fit.causes[fit.causes.len() - 1];
                let line = format!(
                    "  {}: screened {screened:.1}, fitted {:.1}, values {:.4?}",
                    self.name(cause),
                    fit.evidence - best.evidence,
                    cause.values
                );
                self.note(line);
            }
            let mut fits: Vec<Fitted> = fits.into_iter().map(|(_, fit)| fit).collect();
            fits.sort_by(|one, other| other.evidence.total_cmp(&one.evidence));
            let mut fits = fits.into_iter();
            let Some(next) = fits.next() else { break };
            let rival = |fit: Fitted| (fit.causes[fit.causes.len() - 1].clone(), fit.evidence - next.evidence);
            let rivals: Vec<(Cause, f64)> = fits.map(rival).collect();
            if next.evidence - best.evidence < LEAST_GAIN {
                break;
            }
            let added = &next.causes[next.causes.len() - 1];
            self.rivals.push(Rivals { law: added.law, scope: added.scope.name.clone(), others: rivals });
            let line = format!(
                "+ {}: {:.1} nat",
                self.name(&next.causes[next.causes.len() - 1]),
                next.evidence - best.evidence
            );
            self.note(line);
            best = next;
            // The columns change with the causes.
            if !go_on(&self.progress(&best)) {
                return None;
            }
            small = small_of(&self, &best.robot, &best.predicted);
            best = self.fit(best.causes.clone(), &small, CONVERGED, Some(&best));
            best = self.with_best_scope(best, &small);
            best = self.without_surplus(best, &small);
        }
        if !go_on(&self.progress(&best)) {
            return None;
        }
        best = self.without_imitations(best, &small);
        Some(self.found(best, &small, &given))
    }

    fn note(&mut self, line: String) {
        self.decisions.push(line);
    }

    fn progress(&self, best: &Fitted) -> String {
        let names: Vec<String> = best.causes.iter().map(|cause| self.name(cause)).collect();
        if names.is_empty() { "looking for causes".to_owned() } else { format!("found {}", names.join(", ")) }
    }

    fn name(&self, cause: &Cause) -> String {
        format!("{}@{}", self.laws[cause.law].effect.name, cause.scope.name)
    }

    /// Tries other scopes of the last cause: those that contain the sites where it is large, the narrowest first.
    fn with_best_scope(&mut self, mut best: Fitted, small: &[Group]) -> Fitted {
        let last = best.causes.len() - 1;
        let cause = best.causes[last].clone();
        let law = &self.laws[cause.law];
        let size = |values: &Vec<f64>| {
            values.iter().zip(&law.units).map(|(value, unit)| (value / unit).abs()).fold(0.0, f64::max)
        };
        let largest = cause.values.iter().map(size).fold(0.0, f64::max);
        let values = cause.scope.sites.iter().zip(&cause.values);
        let large: Vec<Site> =
            values.filter(|(_, values)| size(values) > LARGE * largest).map(|(site, _)| *site).collect();
        let mut scopes: Vec<ScopeSites> = self
            .scopes_of(law)
            .filter(|scope| *scope != &cause.scope && large.iter().all(|site| scope.sites.contains(site)))
            .cloned()
            .collect();
        scopes.sort_by_key(|scope| scope.sites.len());
        let mean: Vec<f64> = (0..law.units.len())
            .map(|unknown| {
                let of = |site: &Site| {
                    cause.values[cause.scope.sites.iter().position(|own| own == site).expect("a site")][unknown]
                };
                large.iter().map(of).sum::<f64>() / large.len() as f64
            })
            .collect();
        for scope in scopes.into_iter().take(OTHER_SCOPES) {
            let of_site = |site: &Site| {
                let own = cause.scope.sites.iter().position(|one| one == site);
                own.filter(|_| large.contains(site)).map_or_else(|| mean.clone(), |place| cause.values[place].clone())
            };
            let values = scope.sites.iter().map(of_site).collect();
            let log_prior = cause.log_prior - cause.scope.probability.ln() + scope.probability.ln();
            let mut causes = best.causes.clone();
            causes[last] = Cause { scope, values, log_prior, ..cause.clone() };
            let other = self.fit(causes, small, CONVERGED, Some(&best));
            if other.evidence > best.evidence {
                let line =
                    format!("  scope {}: {:.1} nat", other.causes[last].scope.name, other.evidence - best.evidence);
                self.note(line);
                best = other;
            }
        }
        best
    }

    /// Removes causes that no longer have evidence beside the others.
    fn without_surplus(&mut self, mut best: Fitted, small: &[Group]) -> Fitted {
        while !best.causes.is_empty() {
            let fits = (0..best.causes.len()).map(|removed| {
                let mut causes = best.causes.clone();
                causes.remove(removed);
                (removed, self.fit(causes, small, 2, Some(&best)))
            });
            let (removed, without) =
                fits.max_by(|one, other| one.1.evidence.total_cmp(&other.1.evidence)).expect("causes");
            if best.evidence - without.evidence > LEAST_GAIN {
                break;
            }
            let cause = &best.causes[removed];
            self.removed.push((cause.law, cause.scope.name.clone()));
            let line = format!("- {}: {:.1} nat", self.name(&best.causes[removed]), best.evidence - without.evidence);
            self.note(line);
            best = without;
        }
        best
    }

    /// Removes causes in whose place functions of what their joints measure have more evidence: their law is another one.
    fn without_imitations(&mut self, mut best: Fitted, small: &[Group]) -> Fitted {
        let mut place = 0;
        while place < best.causes.len() {
            let mut others = best.causes.clone();
            let cause = others.remove(place);
            let law = &self.laws[cause.law];
            let joints: Vec<usize> = cause
                .scope
                .sites
                .iter()
                .filter_map(|site| match site {
                    Site::Joint(joint) => Some(*joint),
                    Site::Base => None,
                })
                .collect();
            if joints.is_empty() || matches!(law.place, Place::Body | Place::Gyro) {
                place += 1;
                continue;
            }
            let without = self.fit(others, small, 2, Some(&best));
            let place_of_functions =
                if matches!(law.place, Place::Drive | Place::Sensor) { Place::Drive } else { Place::Joint };
            let functions = joints.iter().map(|joint| {
                let columns = unknown::columns(self.system, &without.predicted, *joint, place_of_functions);
                Group::independent(columns.into_iter().map(|(_, column)| column).collect(), unknown::STD)
            });
            let groups: Vec<Group> = without.groups.iter().cloned().chain(functions).collect();
            let noise = Some(best.posterior.noise.as_slice());
            let imitated = posterior(&without.blocks, [small, &groups], noise, &self.cache);
            let log_prior: f64 = without.causes.iter().map(|cause| cause.log_prior).sum();
            let evidence = imitated.evidence + log_prior + (EFFECT_PROBABILITY * cause.scope.probability).ln();
            let line = format!("  another law in place of {}: {:.1} nat", self.name(&cause), evidence - best.evidence);
            self.note(line);
            if evidence > best.evidence + LEAST_GAIN {
                best = without;
            } else {
                place += 1;
            }
        }
        best
    }

    fn found(&mut self, best: Fitted, small: &[Group], given: &[f64]) -> Found {
        let first: usize = small.iter().map(|group| group.columns.len()).sum();
        let starts: Vec<usize> = best
            .causes
            .iter()
            .scan(first, |next, cause| {
                let start = *next;
                *next += cause.values.len() * cause.values[0].len();
                Some(start)
            })
            .collect();
        let (covariance, causes_of_fit, starts) = (&best.posterior.covariance, &best.causes, &starts);
        // Covariance of the means over the sites of two unknowns.
        let of_means = &|[one, other]: [usize; 2], [first, second]: [usize; 2]| {
            let places = |cause: usize, unknown: usize| {
                let size = causes_of_fit[cause].values[0].len();
                (0..causes_of_fit[cause].values.len()).map(move |site| starts[cause] + site * size + unknown)
            };
            let count = (causes_of_fit[one].values.len() * causes_of_fit[other].values.len()) as f64;
            let mut sum = 0.0;
            for row in places(one, first) {
                sum += places(other, second).map(|column| covariance[(row, column)]).sum::<f64>();
            }
            sum / count
        };
        let mut causes = Vec::new();
        for (index, cause) in best.causes.iter().enumerate() {
            let mut others = best.causes.clone();
            others.remove(index);
            let without = self.fit(others, small, 2, Some(&best));
            let stds = (0..cause.values[0].len()).map(|unknown| of_means([index; 2], [unknown; 2]).sqrt()).collect();
            let known = |rivals: &&Rivals| rivals.law == cause.law && rivals.scope == cause.scope.name;
            let rivals = self.rivals.iter().rfind(known).map_or(Vec::new(), |rivals| rivals.others.clone());
            let parts = best.groups[index].columns.iter().flat_map(|column| &column.parts);
            let changed: BTreeSet<usize> = parts.map(|(block, _)| *block).collect();
            let sum = |fit: &Fitted| -> f64 {
                let of = |block: &usize| fit.blocks[*block].y.len() as f64 * power(&fit.posterior.noise[*block]);
                changed.iter().map(of).sum()
            };
            let explained = 1.0 - (sum(&best) / sum(&without)).sqrt();
            let gain = best.evidence - without.evidence;
            causes.push(FoundCause { cause: cause.clone(), gain, stds, explained, rivals });
        }
        // Places in the fit of the causes that are large, the strongest first.
        let mut order: Vec<usize> = (0..causes.len()).filter(|index| self.is_large(&causes[*index])).collect();
        order.sort_by(|one, other| causes[*other].gain.total_cmp(&causes[*one].gain));
        let pairs = (0..order.len()).flat_map(|one| (0..one).map(move |other| (other, one)));
        let correlation = |(one, other): (usize, usize)| {
            let [first, second] = [order[one], order[other]];
            let together = of_means([first, second], [0, 0]);
            (one, other, together / (of_means([first; 2], [0; 2]) * of_means([second; 2], [0; 2])).sqrt())
        };
        let correlations = pairs.map(correlation).collect();
        let causes = order.iter().map(|index| causes[*index].clone()).collect();
        let left = best.blocks.iter().zip(&best.posterior.noise).zip(given);
        let left = left.map(|((block, noise), given)| (block.name.clone(), [*given, power(noise)])).collect();
        let unknown = self.unknown_laws(&best, small);
        Found {
            gains_differ: gains_differ(&best, small),
            causes,
            left,
            decisions: std::mem::take(&mut self.decisions),
            unknown,
            correlations,
        }
    }

    /// Returns true if an unknown of a cause is larger than in 95 % of all robots, with a probability of 95 %.
    ///
    /// Everything is a little present in every robot, so evidence alone does not make a cause.
    fn is_large(&self, found: &FoundCause) -> bool {
        let sites = found.cause.values.len() as f64;
        let mean = |unknown: usize| found.cause.values.iter().map(|values| values[unknown]).sum::<f64>() / sites;
        let effect = self.laws[found.cause.law].effect.name;
        let exceeds = |(unknown, std): (usize, &f64)| {
            mean(unknown).abs() - TWO_SIDED_95 * nuisance::small_std(effect, unknown) > ONE_SIDED_95 * std
        };
        found.stds.iter().enumerate().any(exceeds)
    }

    /// Returns the joints at which functions of what they measure explain what the causes leave.
    ///
    /// They come after the catalogue: together, they imitate any of its laws.
    fn unknown_laws(&self, best: &Fitted, small: &[Group]) -> Vec<UnknownLaw> {
        let groups: Vec<&Group> = small.iter().chain(&best.groups).collect();
        let mut found = Vec::new();
        for joint in 0..self.base.joints.len() {
            for place in [Place::Drive, Place::Joint] {
                let (variables, columns): (Vec<_>, Vec<Column>) =
                    unknown::columns(self.system, &best.predicted, joint, place).into_iter().unzip();
                let size = columns.len();
                let scores = Scores::new(&best.blocks, &groups, &best.posterior, &columns.iter().collect::<Vec<_>>());
                let with_residual = DVector::from_fn(size, |row, _| scores.with_residual[row]);
                let products = DMatrix::from_fn(size, size, |row, column| scores.product(row, column));
                let covariance = DMatrix::identity(size, size) * (unknown::STD * unknown::STD);
                let (gain, mean, _) = gain(&with_residual, &products, &DVector::zeros(size), &covariance);
                let gain = gain + UNKNOWN_PROBABILITY.ln();
                if gain > LEAST_UNKNOWN {
                    let joint = self.base.tree.joints[joint].name.clone();
                    let variable = variables[mean.icamax()];
                    found.push(UnknownLaw { joint, of_drive: place == Place::Drive, variable, gain });
                }
            }
        }
        found.sort_by(|one, other| other.gain.total_cmp(&one.gain));
        found
    }

    /// Fits the values of causes: their columns are computed again at each estimate.
    fn fit(&self, mut causes: Vec<Cause>, small: &[Group], iterations: usize, earlier: Option<&Fitted>) -> Fitted {
        let mut iteration = 0;
        loop {
            let mut robot = self.base.clone();
            for cause in &causes {
                self.apply(&mut robot, cause);
            }
            let predicted = self.system.predicted(&robot);
            let blocks = self.system.residuals(&robot, &predicted);
            let groups: Vec<Group> = causes
                .iter()
                .enumerate()
                .map(|(index, cause)| self.group(&causes, index, cause, &robot, &predicted))
                .collect();
            let mut noise = earlier.map(|fit| fit.posterior.noise.clone());
            if let (Some(noise), Some(last)) = (&mut noise, groups.last()) {
                // The noise of before has what the last cause explains.
                let parts = last.columns.iter().flat_map(|column| &column.parts);
                parts.for_each(|(block, _)| noise[*block] = (0, 1.0));
            }
            let posterior = posterior(&blocks, [small, &groups], noise.as_deref(), &self.cache);
            let mut first: usize = small.iter().map(|group| group.columns.len()).sum();
            let mut largest: f64 = 0.0;
            let mut moved = causes.clone();
            let mut log_allowed = 0.0;
            for cause in &mut moved {
                let law = &self.laws[cause.law];
                if law.is_positive {
                    log_allowed += log_allowed_of(cause, first, &posterior);
                }
                for values in &mut cause.values {
                    for (unknown, value) in values.iter_mut().enumerate() {
                        let shift = posterior.mean[first];
                        first += 1;
                        largest = largest.max(shift.abs() / law.units[unknown]);
                        *value += shift;
                        if law.is_positive && unknown == 0 {
                            *value = value.max(if law.strengths.is_empty() { 0.0 } else { 1e-3 });
                        }
                    }
                }
            }
            iteration += 1;
            let log_prior: f64 = causes.iter().map(|cause| cause.log_prior).sum();
            if iteration >= iterations.max(1) || largest < 0.02 {
                let evidence = posterior.evidence + log_prior + log_allowed;
                return Fitted { causes: moved, evidence, posterior, robot, predicted, blocks, groups };
            }
            causes = moved;
        }
    }

    fn apply(&self, robot: &mut Robot, cause: &Cause) {
        for (site, values) in cause.scope.sites.iter().zip(&cause.values) {
            apply(robot, &self.laws[cause.law], *site, values, cause.shape);
        }
    }

    /// Returns the unknowns of a cause: how its values differ from those of the robot.
    fn group(&self, causes: &[Cause], index: usize, cause: &Cause, robot: &Robot, predicted: &Predicted) -> Group {
        let law = &self.laws[cause.law];
        let (sites, size) = (cause.scope.sites.len(), law.units.len());
        let steps: Vec<(usize, usize)> =
            (0..sites).flat_map(|site| (0..size).map(move |unknown| (site, unknown))).collect();
        let columns: Vec<Column> = steps
            .par_iter()
            .map(|(site, unknown)| {
                // Relative to the robot with all causes, so that they compose.
                let mut changed = causes.to_vec();
                let step = 0.04 * law.units[*unknown];
                changed[index].values[*site][*unknown] += step;
                let mut after = self.base.clone();
                for cause in &changed {
                    self.apply(&mut after, cause);
                }
                self.system.column(law, cause.scope.sites[*site], (robot, predicted), &after).scaled(1.0 / step)
            })
            .collect();
        let mean = DVector::from_iterator(sites * size, cause.values.iter().flatten().map(|value| -value));
        let covariance = DMatrix::from_fn(sites * size, sites * size, |row, column| {
            let ((site, unknown), (other_site, other)) = (steps[row], steps[column]);
            if unknown != other {
                return 0.0;
            }
            let unit = law.units[unknown] * law.units[unknown];
            unit * (1.0 + if site == other_site { SPREAD * SPREAD } else { 0.0 })
        });
        Group { columns, mean, covariance, gain: None }
    }

    /// Returns the best candidates for a further cause, with their gains at the noise of the current fit.
    fn screen(&self, best: &Fitted, small: &[Group]) -> Vec<(f64, Cause)> {
        let candidates = self.candidates(best);
        let columns: Vec<&Column> = candidates.iter().map(|candidate| &candidate.column).collect();
        let groups: Vec<&Group> = small.iter().chain(&best.groups).collect();
        let scores = Scores::new(&best.blocks, &groups, &best.posterior, &columns);
        let mut hypotheses: Vec<(f64, Cause)> = Vec::new();
        for law in 0..self.laws.len() {
            for shape in 0..self.variants(law) {
                let own: Vec<usize> = (0..candidates.len())
                    .filter(|index| candidates[*index].law == law && candidates[*index].variant == shape)
                    .collect();
                if own.is_empty() {
                    continue;
                }
                hypotheses.extend(self.hypotheses(law, shape, &own, &candidates, &scores, best));
            }
        }
        hypotheses.sort_by(|one, other| other.0.total_cmp(&one.0));
        let mut chosen: Vec<(f64, Cause)> = Vec::new();
        for (gain, cause) in hypotheses {
            let effect = self.laws[cause.law].effect.name;
            let same = chosen.iter().filter(|(_, other)| self.laws[other.law].effect.name == effect).count();
            let twice =
                |(_, other): &(f64, Cause)| self.laws[other.law].effect.name == effect && other.scope == cause.scope;
            if chosen.iter().any(twice) {
                continue;
            }
            if same < FITTED[1] && chosen.len() < FITTED[0] && gain > 0.0 {
                chosen.push((gain, cause));
            }
        }
        // The noise of the current fit makes large effects smaller, so that the order below the best is not that of the fits.
        let most = chosen.first().map_or(0.0, |(gain, _)| *gain);
        chosen.retain(|(gain, _)| *gain > (0.1 * most).max(1.0));
        chosen
    }

    fn variants(&self, law: usize) -> usize {
        self.laws[law].strengths.len().max(self.laws[law].shapes.len())
    }

    fn candidates(&self, best: &Fitted) -> Vec<Candidate> {
        let mut all: Vec<(usize, usize, Site, usize)> = Vec::new();
        for (index, law) in self.laws.iter().enumerate() {
            let mut sites: Vec<Site> = self.scopes_of(law).flat_map(|scope| scope.sites.iter().copied()).collect();
            sites.sort();
            sites.dedup();
            for site in sites {
                for variant in 0..self.variants(index) {
                    all.extend((0..law.units.len()).map(|unknown| (index, variant, site, unknown)));
                }
            }
        }
        all.par_iter()
            .map(|(index, variant, site, unknown)| {
                let law = &self.laws[*index];
                let mut unknowns = vec![0.0; law.units.len()];
                unknowns[*unknown] = law.strengths.get(*variant).copied().unwrap_or(0.5 * law.units[*unknown]);
                let shape = law.shapes.get(*variant).copied().unwrap_or(law.shapes[0]);
                let mut after = best.robot.clone();
                apply(&mut after, law, *site, &unknowns, shape);
                let step = if law.strengths.is_empty() { unknowns[*unknown] } else { 1.0 };
                let column = self.system.column(law, *site, (&best.robot, &best.predicted), &after).scaled(1.0 / step);
                Candidate { law: *index, variant: *variant, site: *site, unknown: *unknown, column }
            })
            .filter(|candidate| !candidate.column.is_zero())
            .collect()
    }

    fn scopes_of<'b>(&'b self, law: &'b Law) -> impl Iterator<Item = &'b ScopeSites> {
        use twinstep_effects::Target;
        self.scopes.iter().filter(move |scope| match law.effect.target {
            Target::Joints => scope.sites.iter().all(|site| *site != Site::Base),
            Target::Supply => scope.name == "all",
            Target::Bodies => scope.sites.len() == 1,
            Target::Imu => scope.name == "base",
            Target::Ground => false,
        })
    }

    fn hypotheses(
        &self,
        law_index: usize,
        variant: usize,
        own: &[usize],
        candidates: &[Candidate],
        scores: &Scores,
        best: &Fitted,
    ) -> Vec<(f64, Cause)> {
        let law = &self.laws[law_index];
        let products = DMatrix::from_fn(own.len(), own.len(), |row, column| {
            if row <= column { scores.product(own[row], own[column]) } else { 0.0 }
        });
        let is_strength = !law.strengths.is_empty();
        let mut found = Vec::new();
        for scope in self.scopes_of(law) {
            let known = |cause: &Cause| {
                self.laws[cause.law].effect == law.effect
                    && cause.scope.sites.iter().any(|site| scope.sites.contains(site))
            };
            let removed = |(law, name): &(usize, String)| *law == law_index && *name == scope.name;
            if best.causes.iter().any(known) || self.removed.iter().any(removed) {
                continue;
            }
            let members: Vec<usize> =
                (0..own.len()).filter(|index| scope.sites.contains(&candidates[own[*index]].site)).collect();
            if members.is_empty() {
                continue;
            }
            let size = members.len();
            let with_residual = DVector::from_fn(size, |row, _| scores.with_residual[own[members[row]]]);
            let inner = DMatrix::from_fn(size, size, |row, column| {
                let (one, other) = (members[row].min(members[column]), members[row].max(members[column]));
                products[(one, other)]
            });
            let mean = DVector::from_element(size, if is_strength { 1.0 } else { 0.0 });
            let covariance = DMatrix::from_fn(size, size, |row, column| {
                let (one, other) = (&candidates[own[members[row]]], &candidates[own[members[column]]]);
                if one.unknown != other.unknown {
                    return 0.0;
                }
                let unit = if is_strength { CELL } else { law.units[one.unknown] };
                unit * unit * (1.0 + if one.site == other.site { SPREAD * SPREAD } else { 0.0 })
            });
            let (gain, posterior, spread) = gain(&with_residual, &inner, &mean, &covariance);
            let variants = self.variants(law_index) as f64;
            let mut log_prior = EFFECT_PROBABILITY.ln() + scope.probability.ln();
            let mut log_grid = -variants.ln();
            if law.is_positive && !is_strength {
                // The half of the prior that is allowed has twice the density.
                let deviation = posterior.mean() / (spread[(0, 0)].sqrt() + 1e-12);
                log_prior += std::f64::consts::LN_2;
                log_grid += if deviation < 0.0 { -0.5 * deviation * deviation } else { 0.0 };
            }
            if is_strength {
                log_prior += std::f64::consts::LN_2;
            }
            let mut values = vec![vec![0.0; law.units.len()]; scope.sites.len()];
            for (row, member) in members.iter().enumerate() {
                let candidate = &candidates[own[*member]];
                let site = scope.sites.iter().position(|site| *site == candidate.site).expect("a site of the scope");
                let strength = law.strengths.get(candidate.variant).copied().unwrap_or(1.0);
                let value = strength * posterior[row];
                values[site][candidate.unknown] =
                    if law.is_positive && candidate.unknown == 0 { value.max(1e-3 * strength) } else { value };
            }
            let shape = law.shapes.get(variant).copied().unwrap_or(law.shapes[0]);
            let log_shapes = -(law.shapes.len() as f64).ln();
            let cause =
                Cause { law: law_index, scope: scope.clone(), shape, values, log_prior: log_prior + log_shapes };
            found.push((gain + log_prior + log_grid, cause));
        }
        found
    }
}

/// Returns true if the errors of either gain are twice as large as they are uncertain, root mean square over the joints.
fn gains_differ(best: &Fitted, small: &[Group]) -> bool {
    // Squares of the estimates and of their standard deviations.
    let mut squares = [[0.0; 2]; 2];
    let mut place = 0;
    for group in small {
        if let Some(gain) = group.gain {
            squares[gain][0] += best.posterior.mean[place].powi(2);
            squares[gain][1] += best.posterior.covariance[(place, place)];
        }
        place += group.columns.len();
    }
    squares.iter().any(|[estimates, variances]| *estimates > 4.0 * variances)
}

/// Returns the logarithm of the probability that the mean of a cause's first unknown is allowed.
fn log_allowed_of(cause: &Cause, first: usize, posterior: &Posterior) -> f64 {
    let (sites, size) = (cause.values.len(), cause.values[0].len());
    let index = |site: usize| first + site * size;
    let mean = (0..sites).map(|site| cause.values[site][0] + posterior.mean[index(site)]).sum::<f64>() / sites as f64;
    let pairs = (0..sites).flat_map(|one| (0..sites).map(move |other| (one, other)));
    let variance = pairs.map(|(one, other)| posterior.covariance[(index(one), index(other))]).sum::<f64>()
        / (sites * sites) as f64;
    let deviation = mean / variance.sqrt();
    // The tail of the normal distribution: a bound that is exact far out.
    if deviation > 0.0 { 0.0 } else { -0.5 * deviation * deviation - (1.0 - deviation).ln() }
}

/// Returns the variance of noise, relative to that of the sensor.
fn power((shape, scale): &(usize, f64)) -> f64 {
    scale * (1.0 + SHAPES[*shape].ratio)
}

/// Column of one unknown of a law at one site.
struct Candidate {
    law: usize,
    /// Index of the strength or of the shape.
    variant: usize,
    site: Site,
    unknown: usize,
    column: Column,
}
