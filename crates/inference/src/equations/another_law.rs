//! A law that the catalogue does not have: a sum of few functions of what joints measure.
//!
//! The functions are chosen one by one, the one that explains most next to the others first. The size of each has its own prior, and each
//! choice has its probability, so that a law with more functions must explain more.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::causes::SPREAD;
use super::gaussian::{Scores, gain};

/// Standard deviations of the torque of a function that are compared [N·m], root mean square over its rows.
const STDS: [f64; 4] = [0.05, 0.2, 0.8, 3.0];
/// Most functions of a law.
const MOST_TERMS: usize = 4;

/// A function at joints.
#[derive(Clone, Debug)]
pub struct Term {
    /// Index of the function.
    pub function: usize,
    /// Prior covariance of its torques at the joints.
    pub covariance: DMatrix<f64>,
    /// Its torque at each joint [N·m].
    pub mean: Vec<f64>,
    /// Standard deviation of each.
    pub std: Vec<f64>,
}

/// A sum of functions.
#[derive(Clone, Debug)]
pub struct AnotherLaw {
    /// The functions, in the order in which they were chosen.
    pub terms: Vec<Term>,
    /// Gain of the evidence, with the probability of the choices [nat].
    pub gain: f64,
    /// Logarithm of the probability of the choices.
    pub log_choices: f64,
}

impl AnotherLaw {
    /// Chooses functions of joints. `candidates` has the places of their columns in `scores`, by function and joint.
    ///
    /// A law that all joints have is one function for all of them, as an effect of the catalogue is.
    pub fn most_likely(scores: &Scores, candidates: &[Vec<usize>]) -> Self {
        let (count, joints) = (candidates.len(), candidates.first().map_or(0, Vec::len));
        let all: Vec<usize> = candidates.iter().flatten().copied().collect();
        let (with_residual, products) =
            (DVector::from_fn(all.len(), |row, _| scores.with_residual[all[row]]), scores.products(&all));
        let alike: &[bool] = if joints > 1 { &[true, false] } else { &[false] };
        let priors: Vec<DMatrix<f64>> = STDS
            .into_iter()
            .flat_map(|std| alike.iter().map(move |is_alike| covariance(joints, std, *is_alike)))
            .collect();
        let log_choice = -((count * priors.len()).max(1) as f64).ln();
        let fitted = |terms: &[(usize, usize)]| {
            let places: Vec<usize> =
                terms.iter().flat_map(|(function, _)| function * joints..(function + 1) * joints).collect();
            let size = places.len();
            let with_residual = DVector::from_fn(size, |row, _| with_residual[places[row]]);
            let products = DMatrix::from_fn(size, size, |row, other| products[(places[row], places[other])]);
            let prior = DMatrix::from_fn(size, size, |row, other| {
                let is_same = row / joints == other / joints;
                if is_same { priors[terms[row / joints].1][(row % joints, other % joints)] } else { 0.0 }
            });
            gain(&with_residual, &products, &DVector::zeros(size), &prior)
        };
        let log_choices = |terms: &[(usize, usize)]| terms.len() as f64 * log_choice;
        let (mut terms, mut best): (Vec<(usize, usize)>, f64) = (Vec::new(), 0.0);
        while terms.len() < MOST_TERMS {
            let free = (0..count).filter(|function| terms.iter().all(|(known, _)| known != function));
            let tried: Vec<Vec<(usize, usize)>> = free
                .flat_map(|function| (0..priors.len()).map(move |prior| (function, prior)))
                .map(|term| [terms.as_slice(), &[term]].concat())
                .collect();
            let tried = tried.into_par_iter().map(|terms| (fitted(&terms).0 + log_choices(&terms), terms));
            let Some((gain, next)) = tried.max_by(|one, other| one.0.total_cmp(&other.0)) else { break };
            if gain <= best {
                break;
            }
            (terms, best) = (next, gain);
        }
        let (_, mean, posterior) = fitted(&terms);
        let term = |(place, (function, prior)): (usize, &(usize, usize))| {
            let own = place * joints..(place + 1) * joints;
            Term {
                function: *function,
                covariance: priors[*prior].clone(),
                mean: own.clone().map(|row| mean[row]).collect(),
                std: own.map(|row| posterior[(row, row)].max(0.0).sqrt()).collect(),
            }
        };
        let log_choices = log_choices(&terms);
        Self { terms: terms.iter().enumerate().map(term).collect(), gain: best, log_choices }
    }
}

/// Returns the prior covariance of the torques of a function at joints.
fn covariance(joints: usize, std: f64, is_alike: bool) -> DMatrix<f64> {
    let [shared, own] = if is_alike { [1.0, SPREAD * SPREAD] } else { [0.0, 1.0] };
    DMatrix::from_fn(joints, joints, |row, other| std * std * (shared + if row == other { own } else { 0.0 }))
}

#[cfg(test)]
mod tests {
    use super::super::block::{Block, Column};
    use super::super::gaussian::{Cache, posterior};
    use super::*;

    #[test]
    fn a_law_of_two_functions_is_found_among_others_that_all_joints_share() {
        let t: Vec<f64> = (0..300).map(|row| 0.01 * f64::from(row)).collect();
        let functions: Vec<fn(f64) -> f64> =
            vec![|t| (7.0 * t).sin(), |t| (7.0 * t).sin().powi(3), |t| (11.0 * t).cos(), |t| t - 1.5];
        let noise = |row: usize, joint: usize| 0.07 * ((row * 7919 + 31 * joint) as f64).sin();
        let of_joint = |joint: usize| -> Vec<f64> {
            let law = |(row, t): (usize, &f64)| 0.5 * functions[0](*t) - 0.3 * functions[2](*t) + noise(row, joint);
            t.iter().enumerate().map(law).collect()
        };
        let block = |joint| Block { name: String::new(), t: t.clone(), y: of_joint(joint), sigma: 0.05 };
        let blocks = [block(0), block(1), block(2)];
        let column =
            |joint, function: fn(f64) -> f64| Column { parts: vec![(joint, t.iter().map(|t| function(*t)).collect())] };
        let columns: Vec<Column> =
            functions.iter().flat_map(|function| (0..3).map(|joint| column(joint, *function))).collect();
        let before = posterior(&blocks, [&[], &[]], None, &Cache::default());
        let scores = Scores::new(&blocks, &[], &before, &columns.iter().collect::<Vec<_>>());
        let candidates: Vec<Vec<usize>> = (0..4).map(|function| (3 * function..3 * function + 3).collect()).collect();
        let law = AnotherLaw::most_likely(&scores, &candidates);
        let mut found: Vec<(usize, f64)> = law.terms.iter().map(|term| (term.function, term.mean[0])).collect();
        found.sort_by_key(|(function, _)| *function);
        assert_eq!(found.iter().map(|(function, _)| *function).collect::<Vec<_>>(), [0, 2]);
        assert!((found[0].1 - 0.5).abs() < 0.03 && (found[1].1 + 0.3).abs() < 0.03, "{found:?}");
        // Alike: the off-diagonal entries of the prior are those of one function.
        assert!(law.terms.iter().all(|term| term.covariance[(0, 1)] > 0.0));
        assert!(law.gain > 3.0, "{}", law.gain);
    }
}
