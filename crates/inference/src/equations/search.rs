//! The search for the set of causes of highest evidence.

use super::causes::{Cause, Found, ScopeSites};
use super::fit::Fitted;
use super::gaussian::Group;
use super::nuisance;
use super::problem::{Rivals, Search, power};
use super::robot::Robot;
use super::screening::LARGE;
use super::system::{Predicted, Site};

/// Gain of the evidence above which a cause is added or kept [nat].
pub const LEAST_GAIN: f64 = 3.0;
/// Other scopes of a cause that are tried.
const OTHER_SCOPES: usize = 3;
/// Iterations of a fit that is compared with another one of the same causes.
const CONVERGED: usize = 8;
/// Most causes.
const MOST_CAUSES: usize = 6;
/// Causes that were added and removed again, after which the search ends.
const MOST_REMOVED: usize = 2;

impl Search<'_> {
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
            let mut fits: Vec<Fitted> = fits.into_iter().map(|(_, fit)| fit).filter(|fit| fit.is_possible).collect();
            fits.sort_by(|one, other| other.evidence.total_cmp(&one.evidence));
            let mut fits = fits.into_iter();
            let Some(next) = fits.next() else { break };
            let rival = |fit: Fitted| (fit.causes[fit.causes.len() - 1].clone(), fit.evidence - next.evidence);
            let rivals: Vec<(Cause, f64)> = fits.map(rival).collect();
            if next.evidence - best.evidence < LEAST_GAIN {
                break;
            }
            let added = &next.causes[next.causes.len() - 1];
            self.rivals.push(Rivals { law: added.law, scope: added.scope.label(), others: rivals });
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
            if !best.is_possible {
                best = self.without_last(best, &small);
            }
            best = self.without_surplus(best, &small);
        }
        if !go_on(&self.progress(&best)) {
            return None;
        }
        best = self.without_imitations(best, &small);
        Some(self.found(best, &small, &given))
    }

    pub fn note(&mut self, line: String) {
        self.decisions.push(line);
    }

    fn progress(&self, best: &Fitted) -> String {
        let names: Vec<String> = best.causes.iter().map(|cause| self.name(cause)).collect();
        if names.is_empty() { "looking for causes".to_owned() } else { format!("found {}", names.join(", ")) }
    }

    pub fn name(&self, cause: &Cause) -> String {
        format!("{}@{}", self.laws[cause.law].effect.name, cause.scope.label())
    }

    /// Tries other scopes of the last cause: those that contain the sites where it is large, the narrowest first.
    fn with_best_scope(&mut self, mut best: Fitted, small: &[Group]) -> Fitted {
        let last = best.causes.len() - 1;
        let cause = best.causes[last].clone();
        let law = &self.laws[cause.law];
        let sizes = cause.sizes(&law.units);
        let largest = sizes.iter().copied().fold(0.0, f64::max);
        let sites = cause.scope.sites.iter().zip(&sizes);
        let large: Vec<Site> = sites.filter(|(_, size)| **size > LARGE * largest).map(|(site, _)| *site).collect();
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
            let is_scope = other.causes[last].scope.is_alike || other.causes[last].smallest_share(&law.units) > LARGE;
            if is_scope && other.is_possible && other.evidence > best.evidence {
                let line =
                    format!("  scope {}: {:.1} nat", other.causes[last].scope.label(), other.evidence - best.evidence);
                self.note(line);
                best = other;
            }
        }
        best
    }

    /// Removes the cause that was added last, because its best parameters are not possible.
    fn without_last(&mut self, best: Fitted, small: &[Group]) -> Fitted {
        let mut causes = best.causes.clone();
        let Some(cause) = causes.pop() else { return best };
        self.note(format!("- {}: its parameters are not possible", self.name(&cause)));
        self.removed.push((cause.law, cause.scope.label()));
        self.fit(causes, small, 2, Some(&best))
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
            self.removed.push((cause.law, cause.scope.label()));
            let line = format!("- {}: {:.1} nat", self.name(&best.causes[removed]), best.evidence - without.evidence);
            self.note(line);
            best = without;
        }
        best
    }
}
