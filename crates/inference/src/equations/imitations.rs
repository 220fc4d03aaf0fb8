//! Causes that only imitate another law: functions of what their joints measure explain more, or their own law explains more with a size
//! that depends on the state.

use super::block::Column;
use super::fit::Fitted;
use super::gaussian::{Group, Posterior, posterior};
use super::law::Place;
use super::problem::{EFFECT_PROBABILITY, Search, UNKNOWN_PROBABILITY};
use super::residuals::{Residuals, State};
use super::search::LEAST_GAIN;
use super::site::Site;
use super::unknown;

/// Error of the form of a law of the catalogue, as the size of each function that it lacks, relative to its own.
const FORM_ERROR: f64 = 0.01;
/// Standard deviation of the relative change of a law's size with each of [`MODULATORS`]: of a law of the catalogue, and of another one.
const FORM_CHANGE: [f64; 2] = [0.05, 0.5];
/// Least standard deviation of a function of the state; one that changes less is constant.
const LEAST_CHANGE: f64 = 0.05;

impl<R: Residuals> Search<'_, R> {
    /// Removes causes whose law is another one.
    pub fn without_imitations(&mut self, mut best: Fitted<R>) -> Fitted<R> {
        let mut place = 0;
        while place < best.causes.len() {
            let name = self.name(&best.causes[place]);
            let changing = self.gain_of_changes(&best, place);
            self.note(format!("  {name} with a size that changes: {changing:.1} nat"));
            let (without, replaced) = self.replaced(&best, place);
            if let Some(gain) = replaced {
                self.note(format!("  another law in place of {name}: {gain:.1} nat"));
            }
            if changing > LEAST_GAIN || replaced.is_some_and(|gain| gain > 0.0) {
                best = without;
            } else {
                place += 1;
            }
        }
        best
    }

    /// Returns the fit without a cause, and by how much functions of what its joints measure are better in its place; `None` if they
    /// cannot take it.
    fn replaced(&self, best: &Fitted<R>, place: usize) -> (Fitted<R>, Option<f64>) {
        let mut others = best.causes.clone();
        let cause = others.remove(place);
        let law = &self.laws[cause.law];
        let joint_of = |site: &Site| match site {
            Site::Joint(joint) => Some(*joint),
            Site::Base => None,
        };
        let joints: Vec<usize> = cause.scope.sites.iter().filter_map(joint_of).collect();
        let without = self.fit(others, &best.small, 2, Some(best));
        if joints.is_empty() || law.form.place == Place::Body {
            return (without, None);
        }
        let functions = |predicted: &R::Predicted, joint: usize| -> Vec<Column> {
            self.system.functions(predicted, joint, law.form.place).into_iter().map(|(_, column)| column).collect()
        };
        let free = joints.iter().map(|joint| Group::independent(functions(&without.predicted, *joint), unknown::STD));
        let imitated =
            Self::evidence_with(&without, best, free.collect()) + (EFFECT_PROBABILITY * cause.scope.probability).ln();
        // A law of the catalogue may have a slightly different form.
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
        let named = Self::evidence_with(best, best, near.collect());
        (without, Some(imitated - named))
    }

    /// Returns by how much the law of a cause is better with a size that changes with the state: nothing of the catalogue does that.
    pub fn gain_of_changes(&self, best: &Fitted<R>, place: usize) -> f64 {
        let cause = &best.causes[place];
        let unknowns = self.laws[cause.law].form.units.len();
        let mut changes = vec![Column::default(); MODULATORS.len()];
        for (index, site) in cause.scope.sites.iter().enumerate() {
            let columns = &best.groups[place].columns[index * unknowns..(index + 1) * unknowns];
            let effect = sum(columns, &cause.values[index]);
            let joint = match site {
                Site::Joint(joint) => Some(*joint),
                Site::Base => None,
            };
            for (modulator, change) in MODULATORS.iter().zip(&mut changes) {
                change.add(&self.modulated(&best.predicted, joint, &effect, *modulator));
            }
        }
        changes.retain(|change| !change.is_zero());
        if changes.is_empty() {
            return f64::NEG_INFINITY;
        }
        let count = changes.len();
        let found = Self::posterior_with(best, best, vec![Group::independent(changes, FORM_CHANGE[0])]);
        let first = found.mean.len() - count;
        let gain = |index: usize| gain_of_change(found.mean[index], found.covariance[(index, index)]);
        (first..first + count).map(gain).fold(f64::NEG_INFINITY, f64::max) + UNKNOWN_PROBABILITY.ln()
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
        let log_prior: f64 = fit.causes.iter().map(|cause| cause.log_prior).sum();
        Self::posterior_with(fit, best, further).evidence + log_prior
    }

    pub fn posterior_with(fit: &Fitted<R>, best: &Fitted<R>, further: Vec<Group>) -> Posterior {
        let groups: Vec<Group> = fit.groups.iter().cloned().chain(further).collect();
        posterior(&fit.blocks, [&fit.small.groups, &groups], Some(&best.posterior.noise), &fit.small.cache)
    }
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

/// Functions with which the size of an effect may change: time, the effect's own size and direction, and the state of the joint.
const MODULATORS: [Modulator; 7] = [
    |_, t, _| t,
    |effect, _, _| effect.abs(),
    |effect, _, _| effect.signum(),
    |_, _, state| state.map_or(0.0, |state| state.q),
    |_, _, state| state.map_or(0.0, |state| state.dq.abs()),
    |_, _, state| state.map_or(0.0, |state| (state.dq / 0.03).tanh()),
    |_, _, state| state.map_or(0.0, |state| state.torque.abs()),
];

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
