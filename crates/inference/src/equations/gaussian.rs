//! The likelihood of the residuals of all blocks, with the unknowns integrated out.
//!
//! Residuals are `y = X β + δ + ε`: columns times unknowns with a normal prior, what no column explains, and noise. The prior is
//! `β ~ N(mean, K)`; K has a block for each [`Group`] of unknowns. Shape and scale of `δ + ε` are those of highest likelihood in each
//! block.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use rayon::prelude::*;

use super::block::{Block, Column, SHAPES, Shape, Whitener};
use super::triangular::{inverse, inverse_of_lower};

/// Smallest variance of a block, relative to the stated noise.
const LEAST_SCALE: f64 = 0.25;
/// Rows that the stated noise counts for. A block with few rows has the stated noise.
const PRIOR_ROWS: f64 = 20.0;
/// Most alternating estimates of unknowns, shapes and scales.
const ITERATIONS: usize = 5;

/// Products of the columns of stable unknowns that were computed before, by block.
#[derive(Default)]
pub struct Cache(Mutex<HashMap<u64, Arc<Vec<Stable>>>>);

/// What does not change of a block while the columns of the first unknowns stay the same, for one shape.
struct Stable {
    whitener: Whitener,
    gram: DMatrix<f64>,
}

impl Cache {
    /// Returns the products of the columns of stable unknowns.
    ///
    /// They stay at their place in memory as long as the cache lives.
    fn stable(&self, block: &Block, members: &[(usize, &[f64])]) -> Arc<Vec<Stable>> {
        let start = block.name.bytes().fold(members.len() as u64, |hash, byte| mixed(hash, u64::from(byte)));
        let hash = members.iter().fold(start, |hash, (_, part)| mixed(hash, part.as_ptr() as u64));
        if let Some(known) = self.0.lock().expect("no panic").get(&hash) {
            return known.clone();
        }
        let of_shape = |shape: &Shape| {
            let whitener = Whitener::new(block, *shape);
            let mut white = DMatrix::zeros(block.y.len(), members.len());
            for (index, (_, part)) in members.iter().enumerate() {
                white.column_mut(index).copy_from_slice(&whitener.whiten(part));
            }
            // Faster than `tr_mul`, which multiplies without blocks.
            Stable { whitener, gram: white.transpose() * &white }
        };
        let computed = Arc::new(SHAPES.iter().map(of_shape).collect::<Vec<_>>());
        self.0.lock().expect("no panic").insert(hash, computed.clone());
        computed
    }
}

fn mixed(hash: u64, number: u64) -> u64 {
    (hash ^ number).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
}

/// Unknowns with their columns and their prior.
#[derive(Clone, Debug)]
pub struct Group {
    /// Columns.
    pub columns: Vec<Column>,
    /// Prior mean.
    pub mean: DVector<f64>,
    /// Prior covariance.
    pub covariance: DMatrix<f64>,
    /// 0 for the position gain, 1 for the velocity gain, if the unknown is the relative error of the gain of a joint.
    pub gain: Option<usize>,
}

impl Group {
    /// Returns one unknown with prior mean zero.
    pub fn single(column: Column, std: f64) -> Self {
        Self::independent(vec![column], std)
    }

    /// Returns independent unknowns with prior mean zero and the same standard deviation.
    pub fn independent(columns: Vec<Column>, std: f64) -> Self {
        let size = columns.len();
        Self {
            columns,
            mean: DVector::zeros(size),
            covariance: DMatrix::identity(size, size) * (std * std),
            gain: None,
        }
    }
}

/// Sums of products of the white columns of one block with one shape.
struct Products {
    gram: DMatrix<f64>,
    with_y: DVector<f64>,
    square: f64,
    log_determinant: f64,
}

/// Posterior of the unknowns, given shapes and scales.
pub struct Posterior {
    /// Logarithm of the marginal likelihood [nat].
    pub evidence: f64,
    /// Mean of all unknowns, group after group.
    pub mean: DVector<f64>,
    /// Covariance.
    pub covariance: DMatrix<f64>,
    /// Shape and variance of each block.
    pub noise: Vec<(usize, f64)>,
    factor: Cholesky<f64, Dyn>,
    /// Products of the columns with the residuals of the prior mean.
    with_residual: DVector<f64>,
    prior_mean: DVector<f64>,
}

/// Estimates shapes and scales, beginning with those of an earlier estimate, and integrates the unknowns out.
///
/// The first groups are those of the cache.
pub fn posterior(
    blocks: &[Block],
    groups: [&[Group]; 2],
    earlier: Option<&[(usize, f64)]>,
    cache: &Cache,
) -> Posterior {
    let stable = groups[0].iter().map(|group| group.columns.len()).sum();
    let groups: Vec<&Group> = groups.into_iter().flatten().collect();
    let groups = groups.as_slice();
    let size: usize = groups.iter().map(|group| group.columns.len()).sum();
    let (precision, prior_mean, prior_log_determinant) = prior(groups, size);
    let members = members(blocks.len(), groups);
    let products: Vec<Vec<Products>> =
        blocks.par_iter().zip(&members).map(|(block, members)| products(block, members, stable, cache)).collect();
    let mut noise: Vec<(usize, f64)> = earlier.map_or_else(|| vec![(0, 1.0); blocks.len()], <[(usize, f64)]>::to_vec);
    let mut solution = solve(&products, &members, &noise, &precision, &prior_mean);
    for _ in 0..ITERATIONS {
        let covariance = inverse(&solution.factor);
        let better: Vec<(usize, f64)> = blocks
            .par_iter()
            .enumerate()
            .map(|(index, block)| {
                best_noise(block.y.len(), &products[index], &members[index], &solution.mean, &covariance)
            })
            .collect();
        let is_same = |((shape, scale), (other, now)): (&(usize, f64), &(usize, f64))| {
            shape == other && (now / scale - 1.0).abs() < 0.02
        };
        let converged = noise.iter().zip(&better).all(is_same);
        noise = better;
        solution = solve(&products, &members, &noise, &precision, &prior_mean);
        if converged {
            break;
        }
    }
    let of_blocks: f64 = noise
        .iter()
        .zip(&products)
        .zip(blocks)
        .map(|(((shape, variance), products), block)| {
            let rows = block.y.len() as f64;
            // The stated noise is a prior on the scale.
            -0.5 * (rows + PRIOR_ROWS) * variance.ln()
                - 0.5 * PRIOR_ROWS / variance
                - 0.5 * products[*shape].log_determinant
        })
        .sum();
    let log_determinant =
        2.0 * solution.factor.l_dirty().diagonal().iter().take(size).map(|entry| entry.ln()).sum::<f64>();
    let shift = &solution.mean - &prior_mean;
    let evidence = of_blocks - 0.5 * solution.square + 0.5 * solution.with_residual.dot(&shift)
        - 0.5 * log_determinant
        - 0.5 * prior_log_determinant;
    Posterior {
        evidence,
        covariance: inverse(&solution.factor),
        mean: solution.mean,
        noise,
        factor: solution.factor,
        with_residual: solution.with_residual,
        prior_mean,
    }
}

/// Indices of the unknowns that have a part in a block, with the part.
type Members<'a> = Vec<(usize, &'a [f64])>;

fn members<'a>(blocks: usize, groups: &[&'a Group]) -> Vec<Members<'a>> {
    let mut members: Vec<Members> = vec![Vec::new(); blocks];
    for (index, column) in groups.iter().flat_map(|group| &group.columns).enumerate() {
        for (block, rows) in &column.parts {
            members[*block].push((index, rows));
        }
    }
    members
}

/// Returns precision matrix, mean and logarithm of the determinant of the covariance of the prior.
fn prior(groups: &[&Group], size: usize) -> (DMatrix<f64>, DVector<f64>, f64) {
    let (mut precision, mut mean, mut log_determinant) = (DMatrix::zeros(size, size), DVector::zeros(size), 0.0);
    let mut first = 0;
    for group in groups {
        let len = group.columns.len();
        let factor = group.covariance.clone().cholesky().expect("a covariance is positive definite");
        log_determinant += 2.0 * factor.l_dirty().diagonal().iter().map(|entry| entry.ln()).sum::<f64>();
        precision.view_mut((first, first), (len, len)).copy_from(&factor.inverse());
        mean.rows_mut(first, len).copy_from(&group.mean);
        first += len;
    }
    (precision, mean, log_determinant)
}

/// Returns the products of a block by shape. The columns of the first `stable` unknowns are those of the cache.
fn products(block: &Block, members: &Members, stable: usize, cache: &Cache) -> Vec<Products> {
    let split = members.partition_point(|(unknown, _)| *unknown < stable);
    let known = cache.stable(block, &members[..split]);
    let of_shape = |Stable { whitener, gram }: &Stable| {
        let size = members.len();
        let mut gram = gram.clone().resize(size, size, 0.0);
        for (index, (_, part)) in members.iter().enumerate().skip(split) {
            let weighted = whitener.weighted(part);
            for (other, (_, part)) in members.iter().enumerate().take(index + 1) {
                let product = dot(part, &weighted);
                (gram[(other, index)], gram[(index, other)]) = (product, product);
            }
        }
        let weighted = whitener.weighted(&block.y);
        Products {
            gram,
            with_y: DVector::from_iterator(size, members.iter().map(|(_, part)| dot(part, &weighted))),
            square: dot(&block.y, &weighted),
            log_determinant: whitener.log_determinant,
        }
    };
    known.iter().map(of_shape).collect()
}

/// Returns the scalar product of two series, summed in lanes.
fn dot(one: &[f64], other: &[f64]) -> f64 {
    let mut lanes = [0.0; 8];
    let (of_one, of_other) = (one.chunks_exact(8), other.chunks_exact(8));
    let rest: f64 = of_one.remainder().iter().zip(of_other.remainder()).map(|(one, other)| one * other).sum();
    for (one, other) in of_one.zip(of_other) {
        for lane in 0..8 {
            lanes[lane] += one[lane] * other[lane];
        }
    }
    lanes.iter().sum::<f64>() + rest
}

struct Solution {
    mean: DVector<f64>,
    factor: Cholesky<f64, Dyn>,
    with_residual: DVector<f64>,
    /// Square of the residuals of the prior mean, divided by their variance.
    square: f64,
}

fn solve(
    products: &[Vec<Products>],
    members: &[Members],
    noise: &[(usize, f64)],
    precision: &DMatrix<f64>,
    prior_mean: &DVector<f64>,
) -> Solution {
    let mut matrix = precision.clone();
    let mut with_residual = DVector::zeros(prior_mean.len());
    let mut square = 0.0;
    for ((products, members), (shape, variance)) in products.iter().zip(members).zip(noise) {
        let (products, weight) = (&products[*shape], 1.0 / variance);
        let local = DVector::from_iterator(members.len(), members.iter().map(|(index, _)| prior_mean[*index]));
        let explained = &products.gram * &local;
        square += weight * (products.square - 2.0 * local.dot(&products.with_y) + local.dot(&explained));
        for (column, (one, _)) in members.iter().enumerate() {
            with_residual[*one] += weight * (products.with_y[column] - explained[column]);
            for (row, (other, _)) in members.iter().enumerate() {
                matrix[(*other, *one)] += weight * products.gram[(row, column)];
            }
        }
    }
    let factor = factored(matrix);
    let mean = prior_mean + factor.solve(&with_residual);
    Solution { mean, factor, with_residual, square }
}

/// Returns the Cholesky factor of a precision matrix. Rounding may leave it slightly indefinite: then its diagonal grows a little.
fn factored(matrix: DMatrix<f64>) -> Cholesky<f64, Dyn> {
    let grown = |share: &f64| {
        let mut matrix = matrix.clone();
        for index in 0..matrix.nrows() {
            matrix[(index, index)] *= 1.0 + share;
        }
        matrix.cholesky()
    };
    [0.0, 1e-12, 1e-9, 1e-6].iter().find_map(grown).expect("the prior makes it positive definite")
}

/// Returns shape and variance of highest likelihood, given the posterior of the unknowns.
fn best_noise(
    rows: usize,
    products: &[Products],
    members: &Members,
    mean: &DVector<f64>,
    covariance: &DMatrix<f64>,
) -> (usize, f64) {
    if rows == 0 {
        return (0, 1.0);
    }
    let local = DVector::from_iterator(members.len(), members.iter().map(|(index, _)| mean[*index]));
    let spread =
        DMatrix::from_fn(members.len(), members.len(), |row, column| covariance[(members[row].0, members[column].0)]);
    let rows = rows as f64;
    let mut best = (0, 1.0, f64::NEG_INFINITY);
    for (shape, products) in products.iter().enumerate() {
        let square = products.square - 2.0 * local.dot(&products.with_y)
            + local.dot(&(&products.gram * &local))
            + products.gram.component_mul(&spread).sum();
        let variance = ((square + PRIOR_ROWS) / (rows + PRIOR_ROWS)).max(LEAST_SCALE);
        let likelihood = -0.5 * (rows + PRIOR_ROWS) * variance.ln()
            - 0.5 * products.log_determinant
            - 0.5 * (square + PRIOR_ROWS) / variance;
        if likelihood > best.2 {
            best = (shape, variance, likelihood);
        }
    }
    (best.0, best.1)
}

/// Products of candidate columns with the residuals and with each other, after the unknowns of a posterior have explained what they can.
pub struct Scores {
    /// Products with the residual, by candidate.
    pub with_residual: Vec<f64>,
    /// White candidates by block, for products with each other.
    white: Vec<Vec<(usize, Vec<f64>)>>,
    /// What the unknowns explain of each candidate.
    explained: Vec<DVector<f64>>,
}

impl Scores {
    /// Computes the products of candidates.
    pub fn new(blocks: &[Block], groups: &[&Group], posterior: &Posterior, candidates: &[&Column]) -> Self {
        let members = members(blocks.len(), groups);
        let mut parts: Vec<Vec<(usize, &[f64])>> = vec![Vec::new(); blocks.len()];
        for (candidate, column) in candidates.iter().enumerate() {
            for (block, part) in &column.parts {
                parts[*block].push((candidate, part));
            }
        }
        // White candidates of each block, with their products with its unknowns and with its residuals.
        let of_blocks: Vec<(DMatrix<f64>, DMatrix<f64>, DVector<f64>)> = (0..blocks.len())
            .into_par_iter()
            .map(|index| {
                let (shape, variance) = posterior.noise[index];
                let whitener = Whitener::new(&blocks[index], SHAPES[shape]);
                let root = 1.0 / variance.sqrt();
                let white = |parts: &[(usize, &[f64])]| {
                    let mut white = DMatrix::zeros(blocks[index].y.len(), parts.len());
                    for (place, (_, part)) in parts.iter().enumerate() {
                        white.column_mut(place).copy_from_slice(&whitener.whiten(part));
                    }
                    white * root
                };
                let [of_unknowns, of_candidates] = [white(&members[index]), white(&parts[index])];
                let known = members[index].iter().map(|(unknown, _)| posterior.prior_mean[*unknown]);
                let y = root * DVector::from_vec(whitener.whiten(&blocks[index].y))
                    - &of_unknowns * DVector::from_iterator(members[index].len(), known);
                let transposed = of_candidates.transpose();
                (of_unknowns.transpose() * &of_candidates, of_candidates, transposed * y)
            })
            .map(|(with_unknowns, white, with_y)| (white, with_unknowns, with_y))
            .collect();
        let mut with_unknowns = DMatrix::zeros(posterior.mean.len(), candidates.len());
        let mut with_residual = DVector::zeros(candidates.len());
        let mut white: Vec<Vec<(usize, Vec<f64>)>> = vec![Vec::new(); candidates.len()];
        for (index, (own, of_unknowns, of_y)) in of_blocks.iter().enumerate() {
            for (place, (candidate, _)) in parts[index].iter().enumerate() {
                for (row, (unknown, _)) in members[index].iter().enumerate() {
                    with_unknowns[(*unknown, *candidate)] += of_unknowns[(row, place)];
                }
                with_residual[*candidate] += of_y[place];
                white[*candidate].push((index, own.column(place).iter().copied().collect()));
            }
        }
        let inverse = inverse_of_lower(&posterior.factor.l());
        let explained = &inverse * with_unknowns;
        let residual = inverse * &posterior.with_residual;
        with_residual -= explained.transpose() * residual;
        let explained = explained.column_iter().map(nalgebra::Matrix::into_owned).collect();
        Self { with_residual: with_residual.iter().copied().collect(), white, explained }
    }

    /// Returns the products of some candidates with each other that the unknowns do not explain.
    pub fn products(&self, places: &[usize]) -> DMatrix<f64> {
        let size = places.len();
        let row = |one: usize| (0..=one).map(|other| self.product(places[one], places[other])).collect::<Vec<f64>>();
        let rows: Vec<Vec<f64>> = (0..size).into_par_iter().map(row).collect();
        DMatrix::from_fn(size, size, |one, other| rows[one.max(other)][one.min(other)])
    }

    /// Returns the product of two candidates that the unknowns do not explain.
    pub fn product(&self, one: usize, other: usize) -> f64 {
        let mut sum = -self.explained[one].dot(&self.explained[other]);
        for (block, part) in &self.white[one] {
            if let Some((_, second)) = self.white[other].iter().find(|(index, _)| index == block) {
                sum += part.iter().zip(second).map(|(one, other)| one * other).sum::<f64>();
            }
        }
        sum
    }
}

/// Gain of the evidence by a group of candidates with a normal prior [nat], and their posterior mean and covariance, given products with
/// the residual and with each other.
pub fn gain(
    with_residual: &DVector<f64>,
    products: &DMatrix<f64>,
    mean: &DVector<f64>,
    covariance: &DMatrix<f64>,
) -> (f64, DVector<f64>, DMatrix<f64>) {
    let left = with_residual - products * mean;
    let size = mean.len();
    let inner = DMatrix::identity(size, size) + covariance * products;
    let lu = inner.lu();
    let posterior = lu.solve(covariance).unwrap_or_else(|| covariance.clone());
    let shift = &posterior * &left;
    let log_determinant = lu.u().diagonal().iter().map(|entry| entry.abs().max(1e-300).ln()).sum::<f64>();
    let gain =
        mean.dot(with_residual) - 0.5 * mean.dot(&(products * mean)) + 0.5 * left.dot(&shift) - 0.5 * log_determinant;
    (gain, mean + shift, posterior)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem() -> (Vec<Block>, Group, Group) {
        let t: Vec<f64> = (0..60).map(|row| 0.01 * f64::from(row)).collect();
        let first: Vec<f64> = t.iter().map(|t| (20.0 * t).sin()).collect();
        let second: Vec<f64> = t.iter().map(|t| (33.0 * t).cos()).collect();
        let y = first
            .iter()
            .zip(&second)
            .enumerate()
            .map(|(row, (a, b))| 0.8 * a - 0.5 * b + 0.3 * ((row * 7) as f64).sin());
        let block = Block { name: "one".to_owned(), y: y.collect(), t, sigma: 0.2 };
        let column = |rows: Vec<f64>| Column { parts: vec![(0, rows)] };
        let mut other = Group::single(column(second), 0.7);
        other.mean[0] = -0.2;
        (vec![block], Group::single(column(first), 1.0), other)
    }

    #[test]
    fn evidence_is_that_of_the_normal_distribution() {
        let (blocks, one, other) = problem();
        let found =
            posterior(&blocks, [std::slice::from_ref(&one), std::slice::from_ref(&other)], None, &Cache::default());
        let (shape, variance) = found.noise[0];
        let rows = blocks[0].t.len();
        let covariance = DMatrix::from_fn(rows, rows, |row, column| {
            let gap: f64 = blocks[0].t[row] - blocks[0].t[column];
            let shape = SHAPES[shape];
            let white = if row == column { 1.0 } else { 0.0 };
            let noise = variance * (white + shape.ratio * (-gap.abs() / shape.time).exp());
            let part = |group: &Group, row: usize| group.columns[0].parts[0].1[row] / blocks[0].sigma;
            noise + part(&one, row) * part(&one, column) + 0.49 * part(&other, row) * part(&other, column)
        });
        let y = DVector::from_fn(rows, |row, _| {
            (blocks[0].y[row] + 0.2 * other.columns[0].parts[0].1[row]) / blocks[0].sigma
        });
        let direct = -0.5 * y.dot(&(covariance.clone().try_inverse().expect("regular") * &y))
            - 0.5 * covariance.determinant().ln()
            - 0.5 * PRIOR_ROWS * (variance.ln() + 1.0 / variance);
        assert!((found.evidence - direct).abs() < 1e-6, "{} {direct}", found.evidence);
    }

    #[test]
    fn gain_of_a_candidate_is_the_difference_of_two_evidences_with_the_same_noise() {
        let (blocks, one, other) = problem();
        let before = posterior(&blocks, [std::slice::from_ref(&one), &[]], None, &Cache::default());
        let scores = Scores::new(&blocks, &[&one], &before, &[&other.columns[0]]);
        let products = DMatrix::from_element(1, 1, scores.product(0, 0));
        let with_residual = DVector::from_element(1, scores.with_residual[0]);
        let (gain, mean, _) = gain(&with_residual, &products, &other.mean, &other.covariance);
        // The same noise, so that nothing but the candidate differs.
        let fixed = |groups: &[&Group]| {
            let size = groups.len();
            let (precision, prior_mean, log_prior) = prior(groups, size);
            let members = members(1, groups);
            let products = vec![super::products(&blocks[0], &members[0], 0, &Cache::default())];
            let solution = solve(&products, &members, &before.noise, &precision, &prior_mean);
            let shift = &solution.mean - &prior_mean;
            let log_determinant =
                2.0 * solution.factor.l_dirty().diagonal().iter().map(|entry| entry.ln()).sum::<f64>();
            (
                -0.5 * solution.square + 0.5 * solution.with_residual.dot(&shift)
                    - 0.5 * log_determinant
                    - 0.5 * log_prior,
                solution.mean,
            )
        };
        let (with, means) = fixed(&[&one, &other]);
        assert!((gain - (with - fixed(&[&one]).0)).abs() < 1e-6);
        assert!((mean[0] - means[1]).abs() < 1e-9);
    }
}
