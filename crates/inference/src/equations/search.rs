//! The search for the set of causes of highest evidence.

use std::sync::Arc;

use super::causes::{Cause, Found, ScopeSites};
use super::fit::Fitted;
use super::nuisance;
use super::outcome::TWO_SIDED_95;
use super::problem::{EFFECT_PROBABILITY, Rivals, Search, power};
use super::residuals::Residuals;
use super::screening::{LARGE, PRESENT};
use super::site::Site;

/// Gain of the evidence above which a cause is added or kept [nat].
pub const LEAST_GAIN: f64 = 3.0;
/// Other scopes of a cause that are tried.
const OTHER_SCOPES: usize = 3;
/// Steps of the fit of what every joint has its own of.
const USUAL_STEPS: usize = 8;
/// Candidates whose fit is finished before one of them is added, where a fit is a simulation.
const FINISHED: usize = 3;
/// Candidates that are tried in the place of a cause.
const RIVALS: usize = 2;
/// Evidence by which another cause must be better to take the place of one [nat]: fits end so close to their best values.
const LEAST_BETTER: f64 = 10.0;
/// Most causes.
const MOST_CAUSES: usize = 6;
/// Causes that were added and removed again, after which the search ends.
const MOST_REMOVED: usize = 2;

impl<R: Residuals> Search<'_, R> {
    /// Searches. `go_on` gets a line of progress, and ends the search if it returns false.
    pub fn run(mut self, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Found> {
        let predicted = self.system.predicted(std::slice::from_ref(&self.base)).remove(0);
        let small = Arc::new(self.system.small(self.laws, &self.base, &predicted));
        let mut best = self.fit(Vec::new(), &small, 1, None);
        let given: Vec<f64> = best.posterior.noise.iter().map(power).collect();
        self.note(format!("no cause: {:.1} nat", best.evidence));
        best = self.with_usual(best, go_on)?;
        while best.causes.len() < MOST_CAUSES && self.removed.len() < MOST_REMOVED {
            if !go_on(&self.progress(&best)) {
                return None;
            }
            let candidates = self.screen(&best);
            let mut fits: Vec<(f64, Fitted<R>)> = Vec::new();
            for (screened, cause) in candidates {
                if !go_on(&format!("{}, trying {}", self.progress(&best), self.name(&cause))) {
                    return None;
                }
                let causes = [best.causes.as_slice(), &[cause]].concat();
                fits.push((screened, self.fit(causes, &best.small, self.system.trial_steps(), Some(&best))));
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
            let mut fits: Vec<Fitted<R>> = fits.into_iter().map(|(_, fit)| fit).filter(|fit| fit.is_possible).collect();
            fits.sort_by(|one, other| other.evidence.total_cmp(&one.evidence));
            if self.system.is_simulated() {
                // A few steps do not tell what comes out.
                for fit in fits.iter_mut().take(FINISHED).filter(|fit| fit.evidence > best.evidence + LEAST_GAIN) {
                    *fit = self.fit(fit.causes.clone(), &fit.small, self.system.fit_steps(), Some(fit));
                }
                fits.sort_by(|one, other| other.evidence.total_cmp(&one.evidence));
            }
            let mut fits = fits.into_iter();
            let Some(next) = fits.next() else { break };
            let rival = |fit: Fitted<R>| (fit.causes[fit.causes.len() - 1].clone(), fit.evidence - next.evidence);
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
            let small = Arc::new(self.system.small(self.laws, &best.robot, &best.predicted));
            best = self.fit(best.causes.clone(), &small, self.system.fit_steps(), Some(&best));
            let last = best.causes.len() - 1;
            best = self.with_best_scope(best, last);
            best = self.with_best_shape(best, last);
            if !best.is_possible {
                best = self.without_last(best);
            }
            best = self.without_surplus(best);
        }
        if !go_on(&self.progress(&best)) {
            return None;
        }
        if self.system.is_simulated() {
            best = self.with_rivals(best, go_on)?;
        }
        best = self.without_imitations(best);
        Some(self.found(best, &given))
    }

    pub fn note(&mut self, line: String) {
        self.decisions.push(line);
    }

    fn progress(&self, best: &Fitted<R>) -> String {
        let names: Vec<String> = best.causes.iter().map(|cause| self.name(cause)).collect();
        if names.is_empty() { "looking for causes".to_owned() } else { format!("found {}", names.join(", ")) }
    }

    pub fn name(&self, cause: &Cause) -> String {
        format!("{}@{}", self.laws[cause.law].effect.name, cause.scope.label())
    }

    /// Returns a fit of what every joint of a real robot has its own of, without what the log does not need.
    ///
    /// Beside each other they explain little of what each seems to explain alone, so that adding them one by one begins with the wrong one.
    fn with_usual(&mut self, mut best: Fitted<R>, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Fitted<R>> {
        let usual = self.system.usual();
        let scope = self.scopes.iter().filter(|scope| !scope.is_alike).max_by_key(|scope| scope.sites.len()).cloned();
        let (Some(scope), false) = (scope, usual.is_empty()) else { return Some(best) };
        let cause = |(name, start): &(&str, Option<Vec<f64>>)| {
            let law = self.laws.iter().position(|law| law.effect.name == *name).expect("a law of the catalogue");
            let strengths = self.laws[law].strengths.len().max(1) as f64;
            let log_prior = EFFECT_PROBABILITY.ln() + scope.probability.ln() + std::f64::consts::LN_2 - strengths.ln();
            let little = 0.1 * self.laws[law].units[0];
            let value = |site: &Site| match (site, start) {
                (Site::Joint(joint), Some(start)) => {
                    let one = self.laws[law].parameters(&[1.0], self.laws[law].shapes[0], self.base.scale[*joint])[0];
                    (start[*joint] / one).max(1e-3)
                }
                _ => little,
            };
            let values = scope.sites.iter().map(|site| vec![value(site)]).collect();
            Cause { law, scope: scope.clone(), shape: self.laws[law].shapes[0], values, log_prior }
        };
        let causes: Vec<Cause> = usual.iter().map(cause).collect();
        if !go_on("fitting the friction, the inertia and the delay of each joint") {
            return None;
        }
        let all = self.fit(causes, &best.small, USUAL_STEPS, Some(&best));
        let names: Vec<&str> = usual.iter().map(|(name, _)| *name).collect();
        self.note(format!("{} at each joint: {:.1} nat", names.join(", "), all.evidence - best.evidence));
        for cause in &all.causes {
            self.note(format!("  {}: {:.4?}", self.name(cause), cause.values));
        }
        best = self.without_surplus(all);
        for place in 0..best.causes.len() {
            if !go_on(&self.progress(&best)) {
                return None;
            }
            best = self.with_best_scope(best, place);
        }
        self.removed.clear();
        Some(best)
    }

    /// Tries other scopes of a cause: those that contain the sites where it is large, the narrowest first.
    fn with_best_scope(&mut self, mut best: Fitted<R>, last: usize) -> Fitted<R> {
        let cause = best.causes[last].clone();
        let law = &self.laws[cause.law];
        let sizes = cause.sizes(&law.units);
        let largest = sizes.iter().copied().fold(0.0, f64::max);
        // A little of an effect is at every joint.
        let usual = |values: &Vec<f64>| {
            let is_usual = |(unknown, value): (usize, &f64)| {
                value.abs() < TWO_SIDED_95 * nuisance::small_std(law.effect.name, unknown)
            };
            values.iter().enumerate().all(is_usual)
        };
        let is_large = |place: &usize| sizes[*place] > LARGE * largest && !usual(&cause.values[*place]);
        let large: Vec<Site> = (0..sizes.len()).filter(is_large).map(|place| cause.scope.sites[place]).collect();
        if large.is_empty() {
            return best;
        }
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
            let other = self.fit(causes, &best.small, self.system.fit_steps(), Some(&best));
            let is_scope = other.causes[last].scope.is_alike || other.causes[last].smallest_share(&law.units) > PRESENT;
            if is_scope && other.is_possible && other.evidence > best.evidence {
                let line =
                    format!("  scope {}: {:.1} nat", other.causes[last].scope.label(), other.evidence - best.evidence);
                self.note(line);
                best = other;
            }
        }
        best
    }

    /// Tries shapes between those of the screening, where it had only some of them.
    fn with_best_shape(&mut self, mut best: Fitted<R>, place: usize) -> Fitted<R> {
        let shapes = &self.laws[best.causes[place].law].shapes;
        if !self.system.is_simulated() || shapes.len() < 2 {
            return best;
        }
        let spacing = shapes[1] - shapes[0];
        for share in [0.5, 0.25] {
            for side in [-1.0, 1.0] {
                let mut causes = best.causes.clone();
                causes[place].shape += side * share * spacing;
                let other = self.fit(causes, &best.small, self.system.trial_steps(), Some(&best));
                if other.is_possible && other.evidence > best.evidence {
                    best = other;
                    break;
                }
            }
        }
        best
    }

    /// Compares each cause with others on its sites, and replaces it by one that is better.
    fn with_rivals(&mut self, mut best: Fitted<R>, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Fitted<R>> {
        for place in 0..best.causes.len() {
            let mut others = best.causes.clone();
            let cause = others.remove(place);
            let name = self.name(&cause);
            let without = self.fit(others, &best.small, self.system.trial_steps(), Some(&best));
            let candidates = self.screen_at(&without, Some(&cause.scope.sites));
            let mut fits: Vec<Fitted<R>> = Vec::new();
            for (_, rival) in candidates.into_iter().filter(|(_, one)| one.law != cause.law).take(RIVALS) {
                if !go_on(&format!("{}, trying {} in place of {name}", self.progress(&best), self.name(&rival))) {
                    return None;
                }
                let causes = [without.causes.as_slice(), &[rival]].concat();
                let fit = self.fit(causes, &without.small, self.system.fit_steps(), Some(&without));
                let line = format!(
                    "  {} in place of {name}: {:.1} nat",
                    self.name(&fit.causes[fit.causes.len() - 1]),
                    fit.evidence - best.evidence
                );
                self.note(line);
                fits.push(fit);
            }
            fits.retain(|fit| fit.is_possible);
            fits.sort_by(|one, other| other.evidence.total_cmp(&one.evidence));
            let mut replaced = cause;
            if fits.first().is_some_and(|fit| fit.evidence > best.evidence + LEAST_BETTER) {
                let mut better = fits.remove(0);
                // In the place of the other one.
                let added = better.causes.len() - 1;
                better.causes.swap(place, added);
                replaced = better.causes[place].clone();
                best = self.fit(better.causes.clone(), &better.small, self.system.trial_steps(), Some(&better));
            }
            let rival = |fit: &Fitted<R>| (fit.causes[fit.causes.len() - 1].clone(), fit.evidence - best.evidence);
            let others = fits.iter().map(rival).collect();
            self.rivals.push(Rivals { law: replaced.law, scope: replaced.scope.label(), others });
        }
        Some(best)
    }

    /// Removes the cause that was added last, because its best parameters are not possible.
    fn without_last(&mut self, best: Fitted<R>) -> Fitted<R> {
        let mut causes = best.causes.clone();
        let Some(cause) = causes.pop() else { return best };
        self.note(format!("- {}: its parameters are not possible", self.name(&cause)));
        self.removed.push((cause.law, cause.scope.label()));
        self.fit(causes, &best.small, 2, Some(&best))
    }

    /// Removes causes that no longer have evidence beside the others.
    fn without_surplus(&mut self, mut best: Fitted<R>) -> Fitted<R> {
        while !best.causes.is_empty() {
            let fits = (0..best.causes.len()).map(|removed| {
                let mut causes = best.causes.clone();
                causes.remove(removed);
                (removed, self.fit(causes, &best.small, 2, Some(&best)))
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
