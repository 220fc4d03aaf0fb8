//! Screening: the gain of every effect on every scope, at the noise of the causes that were found.

use std::collections::HashMap;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use twinstep_effects::Target;

use super::block::Column;
use super::causes::{Cause, ScopeSites, Screened};
use super::fit::Fitted;
use super::gaussian::{Group, Scores, gain};
use super::law::{Law, Place};
use super::normal;
use super::problem::{ColumnOf, Search};
use super::residuals::{Change, Residuals};
use super::site::{Site, apply, least};

/// Standard deviation of a strength around one that is tried, relative to it.
const CELL: f64 = 0.3;
/// Size at a site above which a cause is large there, relative to its largest.
pub const LARGE: f64 = 0.3;
/// Size at a site, relative to the largest, above which a cause whose sites have their own values is present there.
pub const PRESENT: f64 = 0.1;
/// Candidates that are fitted in full after each screening, and at most of one effect.
const FITTED: [usize; 2] = [6, 3];

/// What may be added, with its column.
struct Candidate {
    of: ColumnOf,
    column: Arc<Column>,
}

impl<R: Residuals> Search<'_, R> {
    /// Returns the best candidates for a further cause, with their gains at the noise of the current fit.
    pub fn screen(&mut self, best: &Fitted<R>) -> Vec<(f64, Cause)> {
        let hypotheses = self.screened(best, None);
        self.screened.clear();
        for (gain, cause) in &hypotheses {
            if !self.screened.iter().any(|one| one.law == cause.law) {
                let scope = cause.scope.name.clone();
                self.screened.push(Screened { law: cause.law, scope, gain: *gain });
            }
        }
        self.chosen(hypotheses)
    }

    /// Returns the best candidates at some sites, or at all.
    pub fn screen_at(&self, best: &Fitted<R>, only: Option<&[Site]>) -> Vec<(f64, Cause)> {
        self.chosen(self.screened(best, only))
    }

    /// Returns every effect on every scope with its gain, the best first.
    fn screened(&self, best: &Fitted<R>, only: Option<&[Site]>) -> Vec<(f64, Cause)> {
        let candidates = self.candidates(best, only);
        let columns: Vec<&Column> = candidates.iter().map(|candidate| &*candidate.column).collect();
        let groups: Vec<&Group> = best.small.groups.iter().chain(&best.groups).collect();
        let scores = Scores::new(&best.blocks, &groups, &best.posterior, &columns);
        let mut hypotheses: Vec<(f64, Cause)> = Vec::new();
        for law in 0..self.laws.len() {
            for shape in 0..self.variants(law) {
                let own: Vec<usize> = (0..candidates.len())
                    .filter(|index| candidates[*index].of.law == law && candidates[*index].of.variant == shape)
                    .collect();
                if own.is_empty() {
                    continue;
                }
                hypotheses.extend(self.hypotheses(law, shape, &own, &candidates, &scores, best));
            }
        }
        let is_within =
            |cause: &Cause| only.is_none_or(|only| cause.scope.sites.iter().all(|site| only.contains(site)));
        hypotheses.retain(|(_, cause)| is_within(cause));
        hypotheses.sort_by(|one, other| other.0.total_cmp(&one.0));
        hypotheses
    }

    /// Returns the hypotheses that are fitted.
    fn chosen(&self, hypotheses: Vec<(f64, Cause)>) -> Vec<(f64, Cause)> {
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

    fn candidates(&self, best: &Fitted<R>, only: Option<&[Site]>) -> Vec<Candidate> {
        let mut all: Vec<ColumnOf> = Vec::new();
        for (index, law) in self.laws.iter().enumerate() {
            let mut sites: Vec<Site> = self.scopes_of(law).flat_map(|scope| scope.sites.iter().copied()).collect();
            sites.retain(|site| only.is_none_or(|only| only.contains(site)));
            sites.sort();
            sites.dedup();
            let variants = self.variants(index);
            let of = |(site, variant, unknown)| ColumnOf { law: index, variant, site, unknown };
            let unknowns = law.form.units.len();
            let pairs = sites.into_iter().flat_map(|site| (0..variants).map(move |variant| (site, variant)));
            all.extend(pairs.flat_map(|(site, variant)| (0..unknowns).map(move |one| (site, variant, one))).map(of));
        }
        let columns = self.columns_of(best, &all);
        let candidates = all.into_iter().zip(columns).map(|(of, column)| Candidate { of, column });
        candidates.filter(|candidate| !candidate.column.is_zero()).collect()
    }

    /// Returns columns around a fit, per unit of their unknown or per strength. Those that cannot have changed are not computed again.
    fn columns_of(&self, best: &Fitted<R>, all: &[ColumnOf]) -> Vec<Arc<Column>> {
        let mut prints: HashMap<(Place, Site), Option<u64>> = HashMap::new();
        let mut print = |of: &ColumnOf| {
            let place = self.laws[of.law].form.place;
            let print = || self.system.fingerprint(place, of.site, &best.robot, &best.predicted);
            *prints.entry((place, of.site)).or_insert_with(print)
        };
        let prints: Vec<Option<u64>> = all.iter().map(&mut print).collect();
        let mut known = self.columns.lock().expect("no panic");
        let is_known = |(of, print): &(&ColumnOf, &Option<u64>)| {
            known.get(of).is_some_and(|(earlier, _)| Some(*earlier) == **print)
        };
        let missing: Vec<ColumnOf> = all.iter().zip(&prints).filter(|one| !is_known(one)).map(|(of, _)| *of).collect();
        let changes: Vec<Change> = missing.iter().map(|of| self.change(best, of)).collect();
        let computed = self.system.columns((&best.robot, &best.predicted), &changes);
        let mut computed: HashMap<ColumnOf, Arc<Column>> = missing
            .iter()
            .zip(computed)
            .map(|(of, column)| (*of, Arc::new(column.scaled(1.0 / self.step(of)))))
            .collect();
        let column = |(of, print): (&ColumnOf, &Option<u64>)| match (computed.remove(of), print) {
            (None, _) => known[of].1.clone(),
            (Some(column), None) => column,
            (Some(column), Some(print)) => {
                known.insert(*of, (*print, column.clone()));
                column
            }
        };
        all.iter().zip(&prints).map(column).collect()
    }

    /// Returns the robot with some of an unknown.
    fn change(&self, best: &Fitted<R>, of: &ColumnOf) -> Change<'_> {
        let law = &self.laws[of.law];
        let shape = law.shapes.get(of.variant).copied().unwrap_or(law.shapes[0]);
        let mut after = best.robot.clone();
        apply(&mut after, law, of.site, &self.unknowns(of), shape);
        Change { law, site: of.site, after }
    }

    fn unknowns(&self, of: &ColumnOf) -> Vec<f64> {
        let law = &self.laws[of.law];
        let mut unknowns = vec![0.0; law.form.units.len()];
        unknowns[of.unknown] = law.strengths.get(of.variant).copied().unwrap_or(0.5 * law.form.units[of.unknown]);
        unknowns
    }

    /// Returns by what a column is divided: strengths are unknowns relative to those that are tried.
    fn step(&self, of: &ColumnOf) -> f64 {
        if self.laws[of.law].strengths.is_empty() { self.unknowns(of)[of.unknown] } else { 1.0 }
    }

    pub fn scopes_of<'b>(&'b self, law: &'b Law) -> impl Iterator<Item = &'b ScopeSites> {
        self.scopes.iter().filter(|_| law.is_cause).filter(move |scope| match law.effect.target {
            Target::Joints => scope.sites.iter().all(|site| *site != Site::Base),
            Target::Supply => scope.name == "all" && scope.sites == [Site::Base],
            Target::Bodies => scope.name != "all" && scope.name != "ground" && scope.sites.len() == 1,
            Target::Imu => scope.name == "base",
            Target::Ground => scope.name == "ground",
        })
    }

    fn hypotheses(
        &self,
        law_index: usize,
        variant: usize,
        own: &[usize],
        candidates: &[Candidate],
        scores: &Scores,
        best: &Fitted<R>,
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
            let removed = |(law, name): &(usize, String)| *law == law_index && *name == scope.label();
            if best.causes.iter().any(known) || self.removed.iter().any(removed) {
                continue;
            }
            let members: Vec<usize> =
                (0..own.len()).filter(|index| scope.sites.contains(&candidates[own[*index]].of.site)).collect();
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
                if one.of.unknown != other.of.unknown {
                    return 0.0;
                }
                let unit = if is_strength { CELL } else { law.form.units[one.of.unknown] };
                unit * unit * scope.covariance(one.of.site == other.of.site)
            });
            let (gain, posterior, spread) = gain(&with_residual, &inner, &mean, &covariance);
            let variants = self.variants(law_index) as f64;
            let log_prior = self.log_prior(law_index, scope);
            let mut log_grid = -variants.ln();
            let least = |site: Site| least(law, &self.base, site);
            if law.form.is_positive {
                // Posterior and prior are relative to a strength that is tried.
                let prior = if is_strength { 1.0 } else { law.form.units[0] };
                let bound = |row: usize| least(candidates[own[members[row]]].of.site);
                let first = (0..size).filter(|row| candidates[own[members[*row]]].of.unknown == 0);
                log_grid += if scope.is_alike {
                    let count = first.clone().count() as f64;
                    let mean = first.clone().map(|row| posterior[row]).sum::<f64>() / count;
                    let pairs = first.clone().flat_map(|one| first.clone().map(move |other| (one, other)));
                    let std = pairs.map(|(one, other)| spread[(one, other)]).sum::<f64>().sqrt() / count;
                    normal::log_above(first.map(bound).sum::<f64>() / count, mean, std, prior)
                } else {
                    first
                        .map(|row| normal::log_above(bound(row), posterior[row], spread[(row, row)].sqrt(), prior))
                        .sum()
                };
            }
            let mut values = vec![vec![0.0; law.form.units.len()]; scope.sites.len()];
            for (row, member) in members.iter().enumerate() {
                let candidate = &candidates[own[*member]];
                let site = scope.sites.iter().position(|site| *site == candidate.of.site).expect("a site of the scope");
                let strength = law.strengths.get(candidate.of.variant).copied().unwrap_or(1.0);
                let value = strength * posterior[row];
                values[site][candidate.of.unknown] =
                    if candidate.of.unknown == 0 { law.possible(value, least(candidate.of.site)) } else { value };
            }
            let shape = law.shapes.get(variant).copied().unwrap_or(law.shapes[0]);
            let log_shapes = -(law.shapes.len() as f64).ln();
            let cause =
                Cause { law: law_index, scope: scope.clone(), shape, values, log_prior: log_prior + log_shapes };
            // Joints of which some have nothing are another scope.
            let is_scope = cause.scope.is_alike || cause.smallest_share(law.form.units) > PRESENT;
            if is_scope && law.allows(&cause.mean(), shape) {
                found.push((gain + log_prior + log_grid, cause));
            }
        }
        found
    }
}
