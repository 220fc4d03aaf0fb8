//! What a search has found: causes that are large, with their evidence, and what they leave.

use std::collections::BTreeSet;

use super::another_law::AnotherLaw;
use super::block::Column;
use super::causes::{Found, FoundCause, UnknownLaw};
use super::fit::Fitted;
use super::gaussian::{Group, Scores};
use super::law::Place;
use super::problem::{Rivals, Search, UNKNOWN_PROBABILITY, power};
use super::residuals::Residuals;
use super::unknown::unknown_law;

/// Gain from which a law that the catalogue does not have is reported [nat].
const LEAST_UNKNOWN: f64 = 10.0;
/// Spreads of the gains of the joints of a robot, beside the usual one.
const GAIN_SPREADS: [f64; 3] = [0.001, 0.03, 0.1];
/// Standard deviations of a normal distribution within which 95 % are, on both sides and below.
pub const TWO_SIDED_95: f64 = 1.96;
const ONE_SIDED_95: f64 = 1.645;

impl<R: Residuals> Search<'_, R> {
    pub fn found(&mut self, best: Fitted<R>, given: &[f64]) -> Found {
        let first = best.small.len();
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
            let without = self.fit(others, &best.small, 2, Some(&best));
            let unknowns = cause.values[0].len();
            let own = |site: usize, unknown: usize| {
                let place = starts[index] + site * unknowns + unknown;
                covariance[(place, place)].sqrt()
            };
            let site_stds =
                (0..cause.values.len()).map(|site| (0..unknowns).map(|unknown| own(site, unknown)).collect());
            let site_stds = site_stds.collect();
            let stds = (0..cause.values[0].len()).map(|unknown| of_means([index; 2], [unknown; 2]).sqrt()).collect();
            let known = |rivals: &&Rivals| rivals.law == cause.law && rivals.scope == cause.scope.label();
            let rivals = self.rivals.iter().rfind(known).map_or(Vec::new(), |rivals| rivals.others.clone());
            let parts = best.groups[index].columns.iter().flat_map(|column| &column.parts);
            let changed: BTreeSet<usize> = parts.map(|(block, _)| *block).collect();
            let sum = |fit: &Fitted<R>| -> f64 {
                let of = |block: &usize| fit.blocks[*block].y.len() as f64 * power(&fit.posterior.noise[*block]);
                changed.iter().map(of).sum()
            };
            let explained = 1.0 - (sum(&best) / sum(&without)).sqrt();
            let gain = best.evidence - without.evidence;
            let mut found =
                FoundCause { cause: cause.clone(), gain, stds, site_stds, explained, rivals, is_large: false };
            let is_imitation = self.imitations.contains(&(cause.law, cause.scope.name.clone()));
            found.is_large = !is_imitation && self.is_large(&found);
            causes.push(found);
        }
        // Places in the fit.
        let mut order: Vec<usize> = (0..causes.len()).collect();
        order.sort_by(|one, other| {
            let [one, other] = [&causes[*one], &causes[*other]];
            other.is_large.cmp(&one.is_large).then(other.gain.total_cmp(&one.gain))
        });
        let pairs = (0..order.len()).flat_map(|one| (0..one).map(move |other| (other, one)));
        let correlation = |(one, other): (usize, usize)| {
            let [first, second] = [order[one], order[other]];
            let together = of_means([first, second], [0, 0]);
            (one, other, together / (of_means([first; 2], [0; 2]) * of_means([second; 2], [0; 2])).sqrt())
        };
        let correlations = pairs.map(correlation).collect();
        let causes = order.iter().map(|index| causes[*index].clone()).collect();
        let stds: Vec<f64> = (0..first).map(|place| covariance[(place, place)].sqrt()).collect();
        let little = self.system.little(&best.at, &stds);
        let left = best.blocks.iter().zip(&best.posterior.noise).zip(given);
        let left = left.map(|((block, noise), given)| (block.name.clone(), [*given, power(noise)])).collect();
        let unknown = self.unknown_laws(&best);
        Found {
            // What joints have a little of has their gains.
            gains: if little.is_empty() { Self::gains(&best) } else { Vec::new() },
            causes,
            little,
            left,
            decisions: std::mem::take(&mut self.decisions),
            screened: std::mem::take(&mut self.screened),
            imitations: std::mem::take(&mut self.imitations),
            unknown,
            correlations,
        }
    }

    /// Returns the scales of position and velocity gain by joint, if joints that differ are more likely than equal ones; else none.
    ///
    /// By how much the gains of a robot differ is not known before: it is what is most likely, from the usual to all that is no cause.
    fn gains(best: &Fitted<R>) -> Vec<[f64; 2]> {
        let of_gains = || best.small.groups.iter().filter(|group| group.gain.is_some());
        if of_gains().next().is_none() {
            return Vec::new();
        }
        let with_spread = |spread: f64| {
            let wider = of_gains().map(|group| Group::independent(group.columns.clone(), spread)).collect();
            Self::posterior_with(best, best, wider)
        };
        let likeliest =
            GAIN_SPREADS.into_iter().map(with_spread).max_by(|one, other| one.evidence.total_cmp(&other.evidence));
        let posterior = likeliest.expect("some spreads");
        let (mut scales, mut variances, mut place) = ([Vec::new(), Vec::new()], [0.0; 2], 0);
        let mut wider = posterior.mean.len() - of_gains().count();
        for group in &best.small.groups {
            if let Some(gain) = group.gain {
                scales[gain].push(1.0 + posterior.mean[place] + posterior.mean[wider]);
                let of = |one: usize, other: usize| posterior.covariance[(one, other)];
                variances[gain] += of(place, place) + of(wider, wider) + 2.0 * of(place, wider);
                wider += 1;
            }
            place += group.columns.len();
        }
        let differ = |gain: usize| {
            scales[gain].iter().map(|scale: &f64| (scale - 1.0).powi(2)).sum::<f64>() > 4.0 * variances[gain]
        };
        if !differ(0) && !differ(1) {
            return Vec::new();
        }
        scales[0].iter().zip(&scales[1]).map(|(kp, kd)| [*kp, *kd]).collect()
    }

    /// Returns true if an unknown of a cause is larger than in 95 % of all robots, with a probability of 95 %.
    ///
    /// Everything is a little present in every robot, so evidence alone does not make a cause.
    fn is_large(&self, found: &FoundCause) -> bool {
        let FoundCause { cause, stds, site_stds, .. } = found;
        let law = &self.laws[cause.law];
        let root_mean_square = |of: &dyn Fn(usize) -> f64| {
            ((0..cause.values.len()).map(|site| of(site).powi(2)).sum::<f64>() / cause.values.len() as f64).sqrt()
        };
        let exceeds = |(unknown, mean): (usize, &f64)| {
            // Values of their own cancel out in a mean.
            let [size, std] = if cause.scope.is_alike {
                [mean.abs(), stds[unknown]]
            } else {
                let size = root_mean_square(&|site| cause.values[site][unknown]);
                [size, root_mean_square(&|site| site_stds[site][unknown])]
            };
            size - TWO_SIDED_95 * law.small_std(unknown) > ONE_SIDED_95 * std
        };
        cause.mean().iter().enumerate().any(exceeds)
    }

    /// Returns the joints at which functions of what they measure explain what the causes leave.
    ///
    /// They come after the catalogue: together, they imitate any of its laws.
    fn unknown_laws(&self, best: &Fitted<R>) -> Vec<UnknownLaw> {
        let groups: Vec<&Group> = best.small.groups.iter().chain(&best.groups).collect();
        let sites =
            (0..self.base.joints.len()).flat_map(|joint| self.system.places().iter().map(move |place| (joint, *place)));
        let sites: Vec<(usize, Place)> = sites.collect();
        let columns = sites.iter().map(|(joint, place)| self.system.functions(&best.predicted, *joint, *place));
        let columns: Vec<Vec<Column>> = columns.collect();
        let scores = Scores::new(&best.blocks, &groups, &best.posterior, &columns.iter().flatten().collect::<Vec<_>>());
        let mut first = 0;
        let mut found = Vec::new();
        for ((joint, place), columns) in sites.iter().zip(&columns) {
            let candidates: Vec<Vec<usize>> = (first..first + columns.len()).map(|index| vec![index]).collect();
            first += columns.len();
            let law = AnotherLaw::most_likely(&scores, &candidates);
            let gain = law.gain + UNKNOWN_PROBABILITY.ln();
            if gain > LEAST_UNKNOWN {
                let name = &self.base.tree.joints[*joint].name;
                let formulas = self.system.formulas(&best.predicted, *joint, *place);
                found.push(UnknownLaw { gain, ..unknown_law(&law, 0, name, *place, &formulas) });
            }
        }
        found.extend(self.other_laws.iter().cloned());
        found.sort_by(|one, other| other.gain.total_cmp(&one.gain));
        found
    }
}
