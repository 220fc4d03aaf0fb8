//! Causes that only imitate another law: functions of what their joints measure explain more, or their own law explains more with a size
//! that depends on the state.

use std::sync::Arc;

use nalgebra::DVector;

use super::another_law::{AnotherLaw, Term};
use super::block::Column;
use super::causes::{Cause, UnknownLaw};
use super::fit::Fitted;
use super::gaussian::{Group, Posterior, Scores, posterior};
use super::law::Place;
use super::problem::{Search, UNKNOWN_PROBABILITY};
use super::residuals::{Residuals, Small, State};
use super::search::LEAST_GAIN;
use super::site::Site;
use super::unknown::{quantity, unknown_law};

/// Error of the form of a law of the catalogue, as the size of each function that it lacks, relative to its own.
const FORM_ERROR: f64 = 0.01;
/// Standard deviation of the relative change of a law's size with each of [`MODULATORS`]: of a law of the catalogue, and of another one.
const FORM_CHANGE: [f64; 2] = [0.03, 0.5];
/// Difference of what two laws explain, relative to it, below which they are one law.
const SAME: f64 = 0.1;
/// Least standard deviation of a function of the state; one that changes less is constant.
const LEAST_CHANGE: f64 = 0.05;

/// What takes the place of a cause.
pub struct Replacement {
    /// Its unknowns.
    groups: Vec<Group>,
    /// Its description, by joint.
    laws: Vec<UnknownLaw>,
    /// By how much it is better than the cause [nat].
    pub gain: f64,
    /// By how much what it explains differs from what the cause explains, relative to the latter.
    pub difference: f64,
}

impl<R: Residuals> Search<'_, R> {
    /// Removes causes whose law is another one. That law stays in the fit, so that no other cause explains it.
    ///
    /// Where no functions are known, the cause stays in the fit, and has no name.
    pub fn without_imitations(&mut self, mut best: Fitted<R>) -> Fitted<R> {
        let mut place = 0;
        while place < best.causes.len() {
            let name = self.name(&best.causes[place]);
            let mut others = best.causes.clone();
            let cause = others.remove(place);
            let without = self.fit(others, &best.small, 2, Some(&best));
            let changed = self.changed(&best, place);
            let functions = self.of_functions(&best, &without, place);
            for (what, found) in [("a size that changes", &changed), ("functions of the state", &functions)] {
                if let Some(found) = found {
                    let other = 100.0 * found.difference;
                    self.note(format!(
                        "  {what} in place of {name}: {:.1} nat, {other:.0} % of it differs",
                        found.gain
                    ));
                }
            }
            let changed = changed.filter(|found| found.gain > LEAST_GAIN);
            // The catalogue has most of the functions, too.
            let functions = functions.filter(|found| found.gain > 0.0 && found.difference > SAME);
            let Some(law) = functions.or(changed) else {
                place += 1;
                continue;
            };
            self.imitations.push((cause.law, cause.scope.name.clone()));
            if self.system.places().is_empty() {
                // Nothing can take its place: it stays, without a name.
                place += 1;
                continue;
            }
            self.other_laws.extend(law.laws);
            let small = Small::new(best.small.groups.iter().cloned().chain(law.groups).collect());
            best = self.fit(without.causes.clone(), &Arc::new(small), 2, Some(&without));
            // It may have had what another cause leaves.
            place = 0;
        }
        best
    }

    /// Returns functions of what the joints of a cause measure, in its place; `None` if they cannot take it.
    fn of_functions(&self, best: &Fitted<R>, without: &Fitted<R>, place: usize) -> Option<Replacement> {
        let cause = &best.causes[place];
        let law = &self.laws[cause.law];
        let joints: Vec<usize> = cause.scope.sites.iter().filter_map(joint_of).collect();
        if joints.is_empty() || self.system.places().is_empty() {
            return None;
        }
        // What a link has more of is seen in the torque of its joint.
        let of = if law.form.place == Place::Body { Place::Joint } else { law.form.place };
        let functions =
            |predicted: &R::Predicted, joint: usize| -> Vec<Column> { self.system.functions(predicted, joint, of) };
        let by_joint: Vec<Vec<Column>> = joints.iter().map(|joint| functions(&without.predicted, *joint)).collect();
        let (free, found) = likeliest(without, &by_joint);
        if found.terms.is_empty() {
            return None;
        }
        let with_functions = Self::posterior_with(without, best, free.clone());
        let imitated = with_functions.evidence
            + without.log_prior()
            + (UNKNOWN_PROBABILITY * cause.scope.probability).ln()
            + found.log_choices;
        let difference = difference(best, without, place, (&free, &with_functions));
        // A law of the catalogue has its form, or a slightly different one.
        let unknowns = law.form.units.len();
        let near = joints.iter().enumerate().flat_map(|(site, joint)| {
            let columns = &best.groups[place].columns[site * unknowns..(site + 1) * unknowns];
            let size = root_mean_square(&sum(columns, &cause.values[site]));
            let group = move |column: Column| {
                let std = FORM_ERROR * size / root_mean_square(&column).max(1e-9);
                Group::single(column, std.max(1e-4))
            };
            functions(&best.predicted, *joint).into_iter().map(group)
        });
        let named = [Vec::new(), near.collect()].map(|near| Self::evidence_with(best, best, near));
        let named = named[0].max(named[1]);
        let described = joints.iter().enumerate().map(|(index, joint)| UnknownLaw {
            gain: imitated - without.evidence,
            ..unknown_law(
                &found,
                index,
                &self.base.tree.joints[*joint].name,
                of,
                &self.system.formulas(&without.predicted, *joint, of),
            )
        });
        Some(Replacement { groups: free, laws: described.collect(), gain: imitated - named, difference })
    }

    /// Returns the law of a cause with a size that changes with the state: nothing of the catalogue does that.
    pub fn changed(&self, best: &Fitted<R>, place: usize) -> Option<Replacement> {
        let cause = &best.causes[place];
        let law = &self.laws[cause.law];
        let unknowns = law.form.units.len();
        let mut changes = vec![Column::default(); MODULATORS.len()];
        for (index, site) in cause.scope.sites.iter().enumerate() {
            let columns = &best.groups[place].columns[index * unknowns..(index + 1) * unknowns];
            let effect = sum(columns, &cause.values[index]);
            for ((_, modulator), change) in MODULATORS.iter().zip(&mut changes) {
                change.add(&self.modulated(&best.predicted, joint_of(site), &effect, *modulator));
            }
        }
        let (variables, changes): (Vec<&str>, Vec<Column>) = MODULATORS
            .iter()
            .map(|(variable, _)| *variable)
            .zip(changes)
            .filter(|(_, change)| !change.is_zero())
            .unzip();
        let count = changes.len();
        let found = Self::posterior_with(best, best, vec![Group::independent(changes.clone(), FORM_CHANGE[0])]);
        let first = found.mean.len() - count;
        let gain =
            |index: usize| gain_of_change(found.mean[first + index], found.covariance[(first + index, first + index)]);
        let (largest, gain) =
            (0..count).map(|index| (index, gain(index))).max_by(|one, other| one.1.total_cmp(&other.1))?;
        let own = best.groups[place].columns.iter().cloned().zip(cause.values.iter().flatten());
        let own = own.map(|(column, value)| Group::single(column, value.abs().max(law.form.units[0])));
        let changing = Group::independent(changes, FORM_CHANGE[1]);
        let name = |site: &Site| joint_of(site).map_or("base", |joint| &self.base.tree.joints[joint].name).to_owned();
        let described = cause.scope.sites.iter().map(|site| UnknownLaw {
            joint: name(site),
            quantity: quantity(law.form.place),
            variable: variables[largest],
            terms: Vec::new(),
            gain,
        });
        Some(Replacement {
            groups: own.chain([changing]).collect(),
            laws: described.collect(),
            gain: gain + UNKNOWN_PROBABILITY.ln(),
            difference: found.mean[first + largest].abs(),
        })
    }

    /// Returns an effect times a function of the state, which has no mean over the effect and a root mean square of one, or less.
    fn modulated(
        &self,
        predicted: &R::Predicted,
        joint: Option<usize>,
        effect: &Column,
        function: Modulator,
    ) -> Column {
        let size = root_mean_square(effect).max(1e-12);
        let part = |(block, rows): &(usize, Vec<f64>)| {
            let times = &self.system.blocks()[*block].t;
            let value = |(row, entry): (usize, &f64)| {
                let state = joint.map(|joint| self.system.state(predicted, joint, times[row]));
                function(entry / size, times[row], state)
            };
            (*block, rows.iter().enumerate().map(value).collect::<Vec<f64>>())
        };
        let factors: Vec<(usize, Vec<f64>)> = effect.parts.iter().map(part).collect();
        let weighted = |of: &dyn Fn(f64) -> f64| {
            let pairs =
                effect.parts.iter().zip(&factors).flat_map(|((_, rows), (_, factors))| rows.iter().zip(factors));
            let (sum, total) = pairs
                .fold((0.0, 0.0), |(sum, total), (row, factor)| (sum + row * row * of(*factor), total + row * row));
            sum / f64::max(total, 1e-12)
        };
        let mean = weighted(&|factor| factor);
        let std = weighted(&|factor| (factor - mean).powi(2)).sqrt().max(LEAST_CHANGE);
        let mut modulated = effect.clone();
        for ((_, rows), (_, factors)) in modulated.parts.iter_mut().zip(&factors) {
            rows.iter_mut().zip(factors).for_each(|(row, factor)| *row *= (factor - mean) / std);
        }
        modulated
    }

    /// Returns the evidence of a fit with further unknowns, with the noise of `best`.
    fn evidence_with(fit: &Fitted<R>, best: &Fitted<R>, further: Vec<Group>) -> f64 {
        Self::posterior_with(fit, best, further).evidence + fit.log_prior()
    }

    pub fn posterior_with(fit: &Fitted<R>, best: &Fitted<R>, further: Vec<Group>) -> Posterior {
        let groups: Vec<Group> = fit.groups.iter().cloned().chain(further).collect();
        posterior(&fit.blocks, [&fit.small.groups, &groups], Some(&best.posterior.noise), &fit.small.cache)
    }
}

/// Returns by how much what functions explain differs from what a cause explains, relative to the latter.
///
/// The other causes that act there are part of both: functions that take over from them are no other law.
fn difference<R: Residuals>(
    best: &Fitted<R>,
    without: &Fitted<R>,
    place: usize,
    (functions, found): (&[Group], &Posterior),
) -> f64 {
    let sites = &best.causes[place].scope.sites;
    let at_sites = |cause: &Cause, columns: &[Column], values: &[f64]| {
        let unknowns = cause.values[0].len();
        let is_there = |(index, _): &(usize, &Column)| sites.contains(&cause.scope.sites[index / unknowns]);
        let (columns, values): (Vec<Column>, Vec<f64>) =
            columns.iter().enumerate().filter(is_there).map(|(index, column)| (column.clone(), values[index])).unzip();
        sum(&columns, &values)
    };
    let (mut before, mut after) = (Column::default(), Column::default());
    for (cause, group) in best.causes.iter().zip(&best.groups) {
        before.add(&at_sites(cause, &group.columns, &cause.values.concat()));
    }
    let mut first = without.small.len();
    for (cause, group) in without.causes.iter().zip(&without.groups) {
        // A fit ends with a step from where its posterior is.
        let step =
            |(index, value): (usize, f64)| value + found.mean[first + index] - without.posterior.mean[first + index];
        let values: Vec<f64> = cause.values.concat().into_iter().enumerate().map(step).collect();
        after.add(&at_sites(cause, &group.columns, &values));
        first += values.len();
    }
    let columns: Vec<Column> = functions.iter().flat_map(|group| group.columns.iter().cloned()).collect();
    let means: Vec<f64> = found.mean.iter().copied().skip(first).collect();
    after.add(&sum(&columns, &means));
    after.add(&before.scaled(-1.0));
    root_mean_square(&after) / root_mean_square(&before).max(1e-12)
}

/// Returns the functions of joints that explain most together, and their unknowns.
fn likeliest<R: Residuals>(fit: &Fitted<R>, by_joint: &[Vec<Column>]) -> (Vec<Group>, AnotherLaw) {
    let (joints, count) = (by_joint.len(), by_joint[0].len());
    let columns: Vec<&Column> = (0..count).flat_map(|index| by_joint.iter().map(move |all| &all[index])).collect();
    let groups: Vec<&Group> = fit.small.groups.iter().chain(&fit.groups).collect();
    let scores = Scores::new(&fit.blocks, &groups, &fit.posterior, &columns);
    let candidates: Vec<Vec<usize>> =
        (0..count).map(|function| (function * joints..(function + 1) * joints).collect()).collect();
    let law = AnotherLaw::most_likely(&scores, &candidates);
    let group = |term: &Term| Group {
        columns: by_joint.iter().map(|all| all[term.function].clone()).collect(),
        mean: DVector::zeros(joints),
        covariance: term.covariance.clone(),
        gain: None,
    };
    (law.terms.iter().map(group).collect(), law)
}

/// Returns by how much another law explains a change better than a law of the catalogue [nat], given mean and variance of the change with the
/// prior of the latter.
fn gain_of_change(mean: f64, variance: f64) -> f64 {
    let [form, other] = FORM_CHANGE;
    // What the log says of the change, without its prior.
    let of_log = 1.0 / (1.0 / variance - 1.0 / (form * form)).max(1e-9);
    let change = of_log * mean / variance;
    let log_density = |std: f64| {
        let variance = std * std + of_log;
        -0.5 * change * change / variance - 0.5 * variance.ln()
    };
    log_density(other) - log_density(form)
}

/// Function of an effect in a row, relative to its root mean square, of time, and of the state of its joint.
type Modulator = fn(f64, f64, Option<State>) -> f64;

/// Functions with which the size of an effect may change: time, the effect's own size and direction, and the state of the joint; with what
/// each depends on, as the prefix of a channel of the log. What acts on the base changes readings of several units, whose sizes cannot be
/// compared: its effect may change with time.
const MODULATORS: [(&str, Modulator); 7] = [
    ("t", |_, t, _| t),
    ("tau_measured", |effect, _, state| state.map_or(0.0, |_| effect.abs())),
    ("tau_measured", |effect, _, state| state.map_or(0.0, |_| effect.signum())),
    ("q", |_, _, state| state.map_or(0.0, |state| state.q)),
    ("dq", |_, _, state| state.map_or(0.0, |state| state.dq.abs())),
    ("dq", |_, _, state| state.map_or(0.0, |state| (state.dq / 0.03).tanh())),
    ("tau_measured", |_, _, state| state.map_or(0.0, |state| state.torque.abs())),
];

fn joint_of(site: &Site) -> Option<usize> {
    if let Site::Joint(joint) = site { Some(*joint) } else { None }
}

/// Returns the sum of columns times their values.
fn sum(columns: &[Column], values: &[f64]) -> Column {
    let mut total = Column::default();
    columns.iter().zip(values).for_each(|(column, value)| total.add(&column.scaled(*value)));
    total
}

/// Returns the root mean square of the rows of a column.
fn root_mean_square(column: &Column) -> f64 {
    let rows = || column.parts.iter().flat_map(|(_, rows)| rows);
    (rows().map(|row| row * row).sum::<f64>() / rows().count().max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_large_change_that_the_log_shows_is_another_law_and_one_that_it_does_not_show_is_not() {
        let odds = |change: f64, std: f64| {
            let variance = 1.0 / (1.0 / (std * std) + 1.0 / FORM_CHANGE[0].powi(2));
            gain_of_change(variance * change / (std * std), variance) + UNKNOWN_PROBABILITY.ln()
        };
        assert!(odds(0.33, 0.01) > LEAST_GAIN);
        assert!(odds(0.05, 0.01) < 0.0);
        assert!(odds(0.33, 1.0) < 0.0);
    }
}
