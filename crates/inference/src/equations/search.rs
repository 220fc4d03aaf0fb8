//! The search for the set of causes of highest evidence.

use std::sync::Arc;

use rayon::prelude::*;

use super::causes::{Cause, Found};
use super::fit::Fitted;
use super::problem::{Rivals, Search, power};
use super::residuals::Residuals;
use super::site::{Site, least};

/// Gain of the evidence above which a cause is added or kept [nat].
pub const LEAST_GAIN: f64 = 3.0;
/// Steps of the fit of what every joint has its own of.
const USUAL_STEPS: usize = 8;
/// Candidates whose fit is finished before one of them is added, where a fit is a simulation.
const FINISHED: usize = 3;
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
        best = self.better_end(best, go_on)?;
        let mut is_larger = true;
        while is_larger && best.causes.len() < MOST_CAUSES && self.removed.len() < MOST_REMOVED {
            (best, is_larger) = self.with_another(best, go_on)?;
        }
        if !go_on(&self.progress(&best)) {
            return None;
        }
        if self.system.is_simulated() {
            best = self.with_rivals(best, go_on)?;
        }
        best = self.without_imitations(best);
        // What is left may explain what another cause seemed to.
        best = self.without_surplus(best);
        Some(self.found(best, &given))
    }

    /// Returns the better one of two sets from which a search can begin: what every joint has its own of, and the best cause alone.
    ///
    /// The first explains what the second needs many causes for; the second explains with one what the first spreads over many joints.
    fn better_end(&mut self, none: Fitted<R>, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Fitted<R>> {
        if self.system.usual().is_empty() {
            return Some(none);
        }
        let usual = self.with_usual(&none, go_on)?;
        self.removed.clear();
        let (one, _) = self.with_another(none, go_on)?;
        self.removed.clear();
        let [first, second] = [&usual, &one].map(|fit| self.names(fit));
        self.note(format!(
            "beginning with the better one of {first}: {:.1}, {second}: {:.1} nat",
            usual.evidence, one.evidence
        ));
        Some(if usual.evidence > one.evidence { usual } else { one })
    }

    /// Adds the cause that explains most, if one does, and returns true then.
    fn with_another(&mut self, mut best: Fitted<R>, go_on: &mut dyn FnMut(&str) -> bool) -> Option<(Fitted<R>, bool)> {
        if !go_on(&self.progress(&best)) {
            return None;
        }
        let candidates = self.screen(&best);
        let mut fits: Vec<(f64, Fitted<R>)> = Vec::new();
        for some in candidates.chunks(rayon::current_num_threads()) {
            let names = some.iter().map(|(_, cause)| self.name(cause)).collect::<Vec<_>>().join(", ");
            if !go_on(&format!("{}, trying {names}", self.progress(&best))) {
                return None;
            }
            let fit = |(screened, cause): &(f64, Cause)| {
                let causes = [best.causes.as_slice(), std::slice::from_ref(cause)].concat();
                (*screened, self.fit(causes, &best.small, self.system.trial_steps(), Some(&best)))
            };
            fits.extend(some.par_iter().map(fit).collect::<Vec<_>>());
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
        let Some(next) = fits.next() else { return Some((best, false)) };
        let rival = |fit: Fitted<R>| (fit.causes[fit.causes.len() - 1].clone(), fit.evidence - next.evidence);
        let rivals: Vec<(Cause, f64)> = fits.map(rival).collect();
        if next.evidence - best.evidence < LEAST_GAIN {
            return Some((best, false));
        }
        let added = &next.causes[next.causes.len() - 1];
        self.rivals.push(Rivals { law: added.law, scope: added.scope.label(), others: rivals });
        let line =
            format!("+ {}: {:.1} nat", self.name(&next.causes[next.causes.len() - 1]), next.evidence - best.evidence);
        self.note(line);
        best = next;
        // The columns change with the causes.
        if !go_on(&self.progress(&best)) {
            return None;
        }
        let small = Arc::new(self.system.small(self.laws, &best.robot, &best.predicted));
        best = self.fit(best.causes.clone(), &small, self.system.fit_steps(), Some(&best));
        let last = best.causes.len() - 1;
        best = self.with_alike_sites(best, last);
        best = self.with_best_scope(best, last);
        best = self.with_best_shape(best, last);
        if !best.is_possible {
            best = self.without_last(best);
        }
        Some((self.without_surplus(best), true))
    }

    pub fn note(&mut self, line: String) {
        self.decisions.push(line);
    }

    pub fn progress(&self, best: &Fitted<R>) -> String {
        if best.causes.is_empty() { "looking for causes".to_owned() } else { format!("found {}", self.names(best)) }
    }

    fn names(&self, fit: &Fitted<R>) -> String {
        if fit.causes.is_empty() {
            return "no cause".to_owned();
        }
        fit.causes.iter().map(|cause| self.name(cause)).collect::<Vec<_>>().join(", ")
    }

    pub fn name(&self, cause: &Cause) -> String {
        format!("{}@{}", self.laws[cause.law].effect.name, cause.scope.label())
    }

    /// Returns a fit of what every joint of a real robot has its own of, without what the log does not need.
    ///
    /// Beside each other they explain little of what each seems to explain alone, so that adding them one by one begins with the wrong one.
    fn with_usual(&mut self, none: &Fitted<R>, go_on: &mut dyn FnMut(&str) -> bool) -> Option<Fitted<R>> {
        let usual = self.system.usual();
        let scope = self.scopes.iter().filter(|scope| !scope.is_alike).max_by_key(|scope| scope.sites.len()).cloned();
        let scope = scope.expect("joints have values of their own on a scope");
        let cause = |(name, start): &(&str, Option<Vec<f64>>)| {
            let index = self.laws.iter().position(|law| law.effect.name == *name).expect("a law of the catalogue");
            let law = &self.laws[index];
            let shape = law.shapes[0];
            let least = |site: &Site| least(law, &self.base, *site);
            let value = |site: &Site| match (site, start) {
                (Site::Joint(joint), Some(start)) => {
                    let one = law.parameters(&[1.0], shape, self.base.scale[*joint])[0];
                    law.possible(start[*joint] / one, least(site))
                }
                _ => 0.1 * law.form.units[0],
            };
            let values = scope.sites.iter().map(|site| vec![value(site)]).collect();
            let log_prior = self.log_prior(index, &scope) - (law.strengths.len().max(1) as f64).ln();
            Cause { law: index, scope: scope.clone(), shape, values, log_prior }
        };
        let causes: Vec<Cause> = usual.iter().map(cause).collect();
        if !go_on("fitting the friction, the inertia and the delay of each joint") {
            return None;
        }
        let all = self.fit(causes, &none.small, USUAL_STEPS, Some(none));
        let names: Vec<&str> = usual.iter().map(|(name, _)| *name).collect();
        self.note(format!("{} at each joint: {:.1} nat", names.join(", "), all.evidence - none.evidence));
        for cause in &all.causes {
            self.note(format!("  {}: {:.4?}", self.name(cause), cause.values));
        }
        let mut best = self.without_surplus(all);
        for place in 0..best.causes.len() {
            if !go_on(&self.progress(&best)) {
                return None;
            }
            best = self.with_best_scope(best, place);
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
    pub fn without_surplus(&mut self, mut best: Fitted<R>) -> Fitted<R> {
        while !best.causes.is_empty() {
            let fits = (0..best.causes.len()).into_par_iter().map(|removed| {
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
