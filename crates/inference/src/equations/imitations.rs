//! Causes that only imitate another law: functions of what their joints measure explain more, or their own law explains more with a size
//! that depends on the state.

use super::block::Column;
use super::fit::Fitted;
use super::gaussian::{Group, posterior};
use super::law::Place;
use super::problem::{EFFECT_PROBABILITY, Search, UNKNOWN_PROBABILITY};
use super::residuals::{Residuals, State};
use super::site::Site;
use super::unknown;

/// Error of the form of a law of the catalogue, as the size of each function that it lacks, relative to its own.
const FORM_ERROR: f64 = 0.01;
/// Standard deviation of the relative change of a law's size with each of [`MODULATORS`]: of a law of the catalogue, and of another one.
const FORM_CHANGE: [f64; 2] = [0.05, 0.5];
/// Least standard deviation of a function of the state; one that changes less is constant.
const LEAST_CHANGE: f64 = 1e-3;

impl<S: Residuals> Search<'_, S> {
    /// Removes causes whose law is another one.
    pub fn without_imitations(&mut self, mut best: Fitted<S::Predicted>, small: &[Group]) -> Fitted<S::Predicted> {
        let mut place = 0;
        while place < best.causes.len() {
            let name = self.name(&best.causes[place]);
            let changing = self.gain_of_changes(&best, small, place);
            self.note(format!("  {name} with a size that changes: {changing:.1} nat"));
            let (without, replaced) = self.replaced(&best, small, place);
            if let Some(gain) = replaced {
                self.note(format!("  another law in place of {name}: {gain:.1} nat"));
            }
            if changing > 0.0 || replaced.is_some_and(|gain| gain > 0.0) {
                best = without;
            } else {
                place += 1;
            }
        }
        best
    }

    /// Returns the fit without a cause, and by how much functions of what its joints measure are better in its place; `None` if they
    /// cannot take it.
    fn replaced(
        &self,
        best: &Fitted<S::Predicted>,
        small: &[Group],
        place: usize,
    ) -> (Fitted<S::Predicted>, Option<f64>) {
        let mut others = best.causes.clone();
        let cause = others.remove(place);
        let law = &self.laws[cause.law];
        let joint_of = |site: &Site| match site {
            Site::Joint(joint) => Some(*joint),
            Site::Base => None,
        };
        let joints: Vec<usize> = cause.scope.sites.iter().filter_map(joint_of).collect();
        let without = self.fit(others, small, 2, Some(best));
        if joints.is_empty() || law.place == Place::Body {
            return (without, None);
        }
        let functions = |predicted: &S::Predicted, joint: usize| -> Vec<Column> {
            self.system.functions(predicted, joint, law.place).into_iter().map(|(_, column)| column).collect()
        };
        let free = joints.iter().map(|joint| Group::independent(functions(&without.predicted, *joint), unknown::STD));
        let imitated = self.evidence_with(&without, small, best, free.collect())
            + (EFFECT_PROBABILITY * cause.scope.probability).ln();
        // A law of the catalogue may have a slightly different form.
        let unknowns = law.units.len();
        let near = joints.iter().enumerate().flat_map(|(site, joint)| {
            let columns = &best.groups[place].columns[site * unknowns..(site + 1) * unknowns];
            let size = root_mean_square(&sum(columns, &cause.values[site]));
            let group = move |column: Column| {
                let std = FORM_ERROR * size / root_mean_square(&column).max(1e-9);
                Group::single(column, std.max(1e-4))
            };
            functions(&best.predicted, *joint).into_iter().map(group)
        });
        let named = self.evidence_with(best, small, best, near.collect());
        (without, Some(imitated - named))
    }

    /// Returns by how much the law of a cause is better with a size that changes with the state: nothing of the catalogue does that.
    fn gain_of_changes(&self, best: &Fitted<S::Predicted>, small: &[Group], place: usize) -> f64 {
        let cause = &best.causes[place];
        let unknowns = self.laws[cause.law].units.len();
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
        let [form, other] = FORM_CHANGE
            .map(|std| self.evidence_with(best, small, best, vec![Group::independent(changes.clone(), std)]));
        other - form + UNKNOWN_PROBABILITY.ln()
    }

    /// Returns an effect times a function of the state, which has no mean over the effect and a root mean square of one.
    fn modulated(
        &self,
        predicted: &S::Predicted,
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
        let std = weighted(&|factor| (factor - mean).powi(2)).sqrt();
        let change = |((block, rows), (_, factors)): (&(usize, Vec<f64>), &(usize, Vec<f64>))| {
            let of = |(row, factor): (&f64, &f64)| if std > LEAST_CHANGE { row * (factor - mean) / std } else { 0.0 };
            (*block, rows.iter().zip(factors).map(of).collect())
        };
        Column { parts: effect.parts.iter().zip(&factors).map(change).collect() }
    }

    /// Returns the evidence of a fit with further unknowns, with the noise of `best`.
    fn evidence_with(
        &self,
        fit: &Fitted<S::Predicted>,
        small: &[Group],
        best: &Fitted<S::Predicted>,
        further: Vec<Group>,
    ) -> f64 {
        let groups: Vec<Group> = fit.groups.iter().cloned().chain(further).collect();
        let log_prior: f64 = fit.causes.iter().map(|cause| cause.log_prior).sum();
        posterior(&fit.blocks, [small, &groups], Some(&best.posterior.noise), &self.cache).evidence + log_prior
    }
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
