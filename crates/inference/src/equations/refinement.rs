//! Refinement of the causes that were found: other scopes, shapes between those of the screening, and other laws in their place.

use super::causes::{Cause, ScopeSites};
use super::fit::Fitted;
use super::outcome::TWO_SIDED_95;
use super::problem::{Rivals, Search};
use super::residuals::Residuals;
use super::screening::{LARGE, PRESENT};
use super::site::Site;

/// Other scopes of a cause that are tried.
const OTHER_SCOPES: usize = 3;
/// Candidates that are tried in the place of a cause.
const RIVALS: usize = 2;
/// Evidence by which another cause must be better to take the place of one [nat]: fits end so close to their best values.
const LEAST_BETTER: f64 = 10.0;

impl<R: Residuals> Search<'_, R> {
    /// Tries other scopes of a cause: those that contain the sites where it is large, the narrowest first.
    pub fn with_best_scope(&mut self, mut best: Fitted<R>, last: usize) -> Fitted<R> {
        let cause = best.causes[last].clone();
        let law = &self.laws[cause.law];
        let sizes = cause.sizes(law.form.units);
        let largest = sizes.iter().copied().fold(0.0, f64::max);
        // A little of an effect is at every joint.
        let usual = |values: &Vec<f64>| {
            let is_usual = |(unknown, value): (usize, &f64)| value.abs() < TWO_SIDED_95 * law.small_std(unknown);
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
        let mean: Vec<f64> = (0..law.form.units.len())
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
            let log_prior =
                cause.log_prior - self.log_prior(cause.law, &cause.scope) + self.log_prior(cause.law, &scope);
            let mut causes = best.causes.clone();
            causes[last] = Cause { scope, values, log_prior, ..cause.clone() };
            let other = self.fit(causes, &best.small, self.system.fit_steps(), Some(&best));
            let is_scope =
                other.causes[last].scope.is_alike || other.causes[last].smallest_share(law.form.units) > PRESENT;
            if is_scope && other.is_possible && other.evidence > best.evidence {
                let line =
                    format!("  scope {}: {:.1} nat", other.causes[last].scope.label(), other.evidence - best.evidence);
                self.note(line);
                best = other;
            }
        }
        best
    }

    /// Tries the median of all sites at those that are far from it: a law that is not linear in its parameter, such as a delay, has
    /// several best values, of which a fit finds the next one. Fits of simulations are too long, and too uncertain, for a trial.
    pub fn with_alike_sites(&mut self, best: Fitted<R>, place: usize) -> Fitted<R> {
        let cause = &best.causes[place];
        let law = &self.laws[cause.law];
        let median = |unknown: usize| {
            let mut values: Vec<f64> = cause.values.iter().map(|values| values[unknown]).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let medians: Vec<f64> = (0..law.form.units.len()).map(median).collect();
        let is_far = |values: &[f64]| {
            let pairs = values.iter().zip(&medians).enumerate();
            pairs.into_iter().any(|(unknown, (value, median))| (value - median).abs() > law.small_std(unknown))
        };
        let alike = |values: &Vec<f64>| if is_far(values) { medians.clone() } else { values.clone() };
        let values: Vec<Vec<f64>> = cause.values.iter().map(alike).collect();
        let is_linear = law.strengths.len() < 2;
        if self.system.is_simulated() || is_linear || cause.values.len() < 3 || values == cause.values {
            return best;
        }
        let mut causes = best.causes.clone();
        causes[place].values = values;
        let other = self.fit(causes, &best.small, self.system.fit_steps(), Some(&best));
        if !other.is_possible || other.evidence < best.evidence + LEAST_BETTER {
            return best;
        }
        self.note(format!("  sites alike: {:.1} nat", other.evidence - best.evidence));
        other
    }

    /// Tries shapes between those of the screening, where it had only some of them.
    pub fn with_best_shape(&mut self, mut best: Fitted<R>, place: usize) -> Fitted<R> {
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
    pub fn with_rivals(&mut self, mut best: Fitted<R>, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Fitted<R>> {
        let mut is_replaced = false;
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
                is_replaced = true;
                best = self.fit(better.causes.clone(), &better.small, self.system.trial_steps(), Some(&better));
            }
            let rival = |fit: &Fitted<R>| (fit.causes[fit.causes.len() - 1].clone(), fit.evidence - best.evidence);
            let mut others: Vec<(Cause, f64)> = fits.iter().map(rival).collect();
            // Those of when it was added are other ones.
            let known = |rivals: &&Rivals| rivals.law == replaced.law && rivals.scope == replaced.scope.label();
            let earlier = self.rivals.iter().rfind(known).map_or(Vec::new(), |rivals| rivals.others.clone());
            let is_new =
                |one: &Cause| !others.iter().any(|(other, _)| one.law == other.law && one.scope == other.scope);
            let added: Vec<(Cause, f64)> = earlier.into_iter().filter(|(one, _)| is_new(one)).collect();
            others.extend(added);
            others.sort_by(|one, other| other.1.total_cmp(&one.1));
            self.rivals.push(Rivals { law: replaced.law, scope: replaced.scope.label(), others });
        }
        // What took the place of a cause may explain another one, too.
        Some(if is_replaced { self.without_surplus(best) } else { best })
    }
}
