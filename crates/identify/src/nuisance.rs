//! Nuisance parameters: errors of mass, leg mounting, ground contact, measured torques, lead of the encoder positions and
//! initial state that any robot has.
//!
//! Left in the residuals, they are attributed to a payload or an encoder offset. A leg that is mounted 2 mm too low
//! changes the joint positions of a standing robot by 10 mrad. An initial velocity that is 20 mm/s too high lets the
//! trunk swing through the whole window.
//!
//! Their Jacobian S is simulated once. Generalised least squares removes their effect; the cost is `rᵀ (I + S P Sᵀ)⁻¹
//! r`, where P is their prior covariance. The initial states are eliminated first, window by window, then the errors of
//! the robot.

use std::ops::Range;

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use rayon::prelude::*;
use twinstep_model::{NUM_JOINTS, Precision, RobotModel, Rollout};

use crate::experiment::Experiment;

/// Relative standard deviation of the trunk's mass.
const TRUNK_MASS_STD: f64 = 0.006;
/// Relative standard deviation of the mass of a link of a leg: cables, covers, feet that were replaced.
const LINK_MASS_STD: f64 = 0.03;
/// Standard deviation of the trunk's centre of mass along each axis [m].
const CENTRE_STD_M: f64 = 0.001;
/// Standard deviation of the mounting position of a leg along each axis [m].
const MOUNT_OFFSET_STD_M: f64 = 0.0012;
/// Standard deviation of the length of a thigh, and of all calves [m].
const LENGTH_STD_M: f64 = 0.001;
/// Standard deviation of the time by which positions of the encoders are ahead of their velocities [s].
///
/// Drives filter the velocity. A simulator that updates positions with the new velocity is ahead by half of its time step.
const ENCODER_LEAD_STD_S: f64 = 0.0004;
/// Relative standard deviations of ground friction and of the contact's time constant.
const GROUND_STD: [f64; 2] = [0.03, 0.15];
/// Standard deviation of the error of each measured torque of a standing robot, such as friction at rest [N·m].
const TORQUE_STD_NM: f64 = 0.05;
/// Number of nuisance parameters of the robot: [`perturbed_robot`] has the list.
const NUM_ROBOT_ERRORS: usize = 37;
/// Index of the time by which positions of the encoders are ahead.
const ENCODER_LEAD: usize = 35;
/// Number of nuisance parameters of robot and torques.
const NUM_NUISANCE: usize = NUM_ROBOT_ERRORS + NUM_JOINTS;
/// Largest size of a nuisance parameter [prior std]: what is larger is an error of the model.
const LARGEST: f64 = 3.0;
/// Correlation length of the residuals [rows].
const CORRELATION_ROWS: f64 = 40.0;
/// Number of rows of a Jacobian whose products are summed by one thread at a time.
const ROWS_AT_ONCE: usize = 8192;
/// Number of zeros after which a range of nonzero cells ends.
const SHORTEST_GAP: usize = 64;
/// Number of partial sums of an inner product.
const LANES: usize = 32;

/// Linear model of the effect of nuisance parameters on residuals.
#[derive(Clone)]
pub struct NuisanceModel {
    starts: Vec<NuisanceBlock>,
    robot: NuisanceBlock,
    /// Jacobian with respect to the errors of the robot, before elimination of the initial states.
    jacobian: DMatrix<f64>,
}

/// Nuisance parameters that affect a subset of the residuals.
#[derive(Clone)]
struct NuisanceBlock {
    /// Indices of the residuals.
    rows: Vec<usize>,
    /// Jacobian: one row per residual, one column per nuisance parameter [prior std]. Single precision halves the time of
    /// an elimination, which reads it twice.
    jacobian: DMatrix<f32>,
    /// Ranges of the rows in which a column is not zero: a link has no effect on the other legs of a robot that hangs.
    affected: Vec<Vec<Range<usize>>>,
    factor: Cholesky<f64, Dyn>,
    /// False if sizes have no penalty.
    costs: bool,
}

impl NuisanceBlock {
    fn new(rows: Vec<usize>, jacobian: DMatrix<f64>) -> Option<Self> {
        let prior = DMatrix::identity(jacobian.ncols(), jacobian.ncols()) * CORRELATION_ROWS;
        let factor = (gram(&jacobian) + prior).cholesky()?;
        let jacobian = jacobian.map(|slope| slope as f32);
        let affected = jacobian.column_iter().map(|column| nonzero_ranges(column.as_slice())).collect();
        Some(Self { rows, jacobian, affected, factor, costs: true })
    }

    /// Subtracts the effect of the estimated nuisance parameters, each at most `largest` [prior std], and appends their
    /// penalties to the residuals.
    fn eliminate(&self, residuals: &mut Vec<f64>, largest: f64) {
        if self.rows.is_empty() {
            residuals.extend(vec![0.0; self.affected.len()]);
            return;
        }
        let own: Vec<f32> = self.rows.iter().map(|row| residuals[*row] as f32).collect();
        let columns = || self.jacobian.as_slice().chunks(self.rows.len().max(1)).zip(&self.affected);
        let products = columns().map(|(column, affected)| {
            affected.iter().map(|range| f64::from(dot(&column[range.clone()], &own[range.clone()]))).sum::<f64>()
        });
        let sizes = self.factor.solve(&DVector::from_iterator(self.affected.len(), products));
        let sizes = sizes.map(|size| size.clamp(-largest, largest));
        let mut explained = own;
        explained.fill(0.0);
        for ((column, affected), size) in columns().zip(&sizes) {
            for range in affected {
                let part = explained[range.clone()].iter_mut().zip(&column[range.clone()]);
                part.for_each(|(sum, slope)| *sum += *size as f32 * slope);
            }
        }
        for (row, value) in self.rows.iter().zip(&explained) {
            residuals[*row] -= f64::from(*value);
        }
        let penalty = if self.costs { CORRELATION_ROWS.sqrt() } else { 0.0 };
        residuals.extend(sizes.iter().map(|size| size * penalty));
    }

    fn rescaled(&self, spread: &[f64]) -> Option<Self> {
        let mut jacobian = self.jacobian.map(f64::from);
        for (mut derivative, row) in jacobian.row_iter_mut().zip(&self.rows) {
            derivative /= spread[*row];
        }
        Some(Self { costs: self.costs, ..Self::new(self.rows.clone(), jacobian)? })
    }
}

impl NuisanceModel {
    /// Linearises at `robot`. Returns `None` if a simulation diverges.
    pub fn new(experiments: &[Experiment], robot: &RobotModel, simulator: &mut dyn Rollout) -> Option<Self> {
        let starts = starts(experiments, robot, simulator)?;
        let mut columns = slopes(experiments, robot, 0..NUM_ROBOT_ERRORS, simulator);
        // On the ground, errors of contact exceed the effect of the lead.
        let mut first = 0;
        for experiment in experiments {
            let on_ground = experiment.free_windows().into_iter().flatten();
            on_ground.for_each(|row| columns[ENCODER_LEAD][first + row] = 0.0);
            first += experiment.dynamic_residuals().len();
        }
        columns.extend((0..NUM_JOINTS).map(|joint| {
            let change = |one: &Experiment| one.change_with_torque_error(robot, joint, TORQUE_STD_NM);
            experiments.iter().flat_map(change).collect()
        }));
        Self::of_columns(experiments, starts, columns)
    }

    /// Linearises only the lead of the encoder positions, for logs or rows with a fixed base: there, wrong masses of the links
    /// imitate friction that acts in one direction.
    pub fn of_encoder_lead(
        experiments: &[Experiment],
        robot: &RobotModel,
        simulator: &mut dyn Rollout,
    ) -> Option<Self> {
        let columns = slopes(experiments, robot, ENCODER_LEAD..ENCODER_LEAD + 1, simulator);
        Self::of_columns(experiments, Vec::new(), columns)
    }

    fn of_columns(experiments: &[Experiment], starts: Vec<NuisanceBlock>, mut columns: Vec<Vec<f64>>) -> Option<Self> {
        // Where the robot walks, contact events would decide the sizes.
        let dynamic: Vec<bool> = experiments.iter().flat_map(Experiment::dynamic_residuals).collect();
        if dynamic.is_empty() {
            return None;
        }
        for column in &mut columns {
            column.iter_mut().zip(&dynamic).filter(|(_, dynamic)| **dynamic).for_each(|(slope, _)| *slope = 0.0);
        }
        let jacobian = DMatrix::from_iterator(dynamic.len(), columns.len(), columns.into_iter().flatten());
        jacobian.iter().all(|derivative| derivative.is_finite()).then(|| Self::of(starts, jacobian)).flatten()
    }

    fn of(starts: Vec<NuisanceBlock>, jacobian: DMatrix<f64>) -> Option<Self> {
        let columns = jacobian.as_slice().par_chunks(jacobian.nrows().max(1)).map(|column| {
            let mut column = column.to_vec();
            for start in &starts {
                start.eliminate(&mut column, f64::INFINITY);
            }
            column
        });
        let columns: Vec<Vec<f64>> = columns.collect();
        // The residuals of a robot that walks or jumps do not depend on them.
        let is_affected = |row: &usize| columns.iter().any(|column| column[*row] != 0.0);
        let rows: Vec<usize> = (0..columns[0].len()).filter(is_affected).collect();
        let slopes = columns.iter().flat_map(|column| rows.iter().map(|row| column[*row]));
        let corrected = DMatrix::from_iterator(rows.len(), columns.len(), slopes);
        let robot = NuisanceBlock::new(rows, corrected)?;
        Some(Self { starts, robot, jacobian })
    }

    /// Returns the model for residuals that are divided by `spread`, with one entry per residual.
    pub fn rescaled(&self, spread: &[f64]) -> Option<Self> {
        let mut jacobian = self.jacobian.clone();
        let columns = jacobian.as_mut_slice().par_chunks_mut(spread.len().max(1));
        columns.for_each(|column| column.iter_mut().zip(spread).for_each(|(slope, spread)| *slope /= spread));
        Self::of(self.starts.par_iter().map(|start| start.rescaled(spread)).collect::<Option<_>>()?, jacobian)
    }

    /// Eliminates all nuisance parameters from the residuals, and appends their penalties.
    ///
    /// The sum of squares of the result is the generalised least-squares cost, if no parameter is larger than [`LARGEST`].
    pub fn project_out(&self, residuals: &mut Vec<f64>) {
        for errors in self.starts.iter().chain([&self.robot]) {
            errors.eliminate(residuals, LARGEST);
        }
    }

    /// Returns the decrease of the log-likelihood [nat] by the penalties `costs` of [`NuisanceModel::project_out`].
    ///
    /// The first value is for the initial states, the second for the errors of the robot.
    pub fn nats(costs: &[f64]) -> [f64; 2] {
        let (starts, robot) = costs.split_at(costs.len().saturating_sub(NUM_NUISANCE));
        [starts, robot].map(|costs| 0.5 * costs.iter().map(|cost| cost * cost).sum::<f64>() / CORRELATION_ROWS)
    }
}

/// Returns the ranges of nonzero cells; shorter runs of zeros than [`SHORTEST_GAP`] do not divide a range.
fn nonzero_ranges(cells: &[f32]) -> Vec<Range<usize>> {
    let mut ranges = Vec::<Range<usize>>::new();
    for row in (0..cells.len()).filter(|row| cells[*row] != 0.0) {
        match ranges.last_mut() {
            Some(last) if row < last.end + SHORTEST_GAP => last.end = row + 1,
            _ => ranges.push(row..row + 1),
        }
    }
    ranges
}

/// Returns the inner product, in sums that a compiler can compute at once.
fn dot(one: &[f32], other: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    let (one, other) = (one.chunks_exact(LANES), other.chunks_exact(LANES));
    let rest: f32 = one.remainder().iter().zip(other.remainder()).map(|(a, b)| a * b).sum();
    for (one, other) in one.zip(other) {
        for lane in 0..LANES {
            sums[lane] += one[lane] * other[lane];
        }
    }
    sums.iter().sum::<f32>() + rest
}

/// Returns `JᵀJ`.
fn gram(jacobian: &DMatrix<f64>) -> DMatrix<f64> {
    let (rows, columns) = jacobian.shape();
    let of_rows = |first: usize| {
        let part = jacobian.rows(first, ROWS_AT_ONCE.min(rows - first));
        part.transpose() * part
    };
    let parts: Vec<_> = (0..rows).into_par_iter().step_by(ROWS_AT_ONCE).map(of_rows).collect();
    parts.into_iter().fold(DMatrix::zeros(columns, columns), |sum, part| sum + part)
}

/// Returns the power [noise variance of a row] by which the robot's errors exceed their expectation.
///
/// `nats` is the decrease of the log-likelihood by their penalties [nat]. The lead of the encoder positions alone has none.
pub fn excess(nats: f64) -> f64 {
    (2.0 * nats - NUM_NUISANCE as f64).max(0.0) * CORRELATION_ROWS
}

/// Returns the effect of each error in `errors`, of one standard deviation, on the residuals of all experiments.
fn slopes(
    experiments: &[Experiment],
    robot: &RobotModel,
    errors: Range<usize>,
    simulator: &mut dyn Rollout,
) -> Vec<Vec<f64>> {
    let sides = |error: usize| [-1.0, 1.0].map(|side| perturbed_robot(robot, error, side));
    let mut columns = vec![Vec::new(); errors.len()];
    let robots: Vec<RobotModel> = errors.flat_map(sides).collect();
    for experiment in experiments {
        let residuals = experiment.residuals(simulator, &robots, Precision::Single);
        for (column, ends) in columns.iter_mut().zip(residuals.chunks(2)) {
            column.extend(half_difference(&ends[0], &ends[1]));
        }
    }
    columns
}

/// Returns the nuisance parameters of the initial state of every window.
fn starts(experiments: &[Experiment], robot: &RobotModel, simulator: &mut dyn Rollout) -> Option<Vec<NuisanceBlock>> {
    let (mut starts, mut first) = (Vec::new(), 0);
    for experiment in experiments {
        let mut residuals = |part: usize, side: f64| {
            let one = std::slice::from_ref(robot);
            experiment.with_perturbed_start(part, side).residuals(simulator, one, Precision::Single).remove(0)
        };
        let columns: Vec<Vec<f64>> = (0..Experiment::INITIAL_STATE_DIM)
            .map(|part| half_difference(&residuals(part, -1.0), &residuals(part, 1.0)).collect())
            .collect();
        if columns.iter().flatten().any(|derivative| !derivative.is_finite()) {
            return None;
        }
        let dynamic = experiment.dynamic_residuals();
        for rows in experiment.free_windows() {
            let jacobian = DMatrix::from_fn(rows.len(), columns.len(), |row, column| columns[column][rows[row]]);
            let costs = !dynamic[rows[0]];
            let block = NuisanceBlock::new(rows.into_iter().map(|row| first + row).collect(), jacobian)?;
            starts.push(NuisanceBlock { costs, ..block });
        }
        first += columns[0].len();
    }
    Some(starts)
}

fn half_difference<'a>(below: &'a [f64], above: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
    above.iter().zip(below).map(|(above, below)| 0.5 * (above - below))
}

/// Returns `robot` with one error of `size` standard deviations.
fn perturbed_robot(robot: &RobotModel, error: usize, size: f64) -> RobotModel {
    let mut robot = robot.clone();
    match error {
        0..12 => robot.legs[error / 3].origins[0][error % 3] += size * MOUNT_OFFSET_STD_M,
        12..24 => {
            let body = &mut robot.legs[(error - 12) / 3].bodies[error % 3];
            *body = body.scaled(1.0 + size * LINK_MASS_STD);
        }
        24..28 => robot.legs[error - 24].origins[2].z += size * LENGTH_STD_M,
        28 => robot.shapes.foot_centre.z += size * LENGTH_STD_M,
        29 => robot.trunk = robot.trunk.scaled(1.0 + size * TRUNK_MASS_STD),
        30..33 => robot.trunk.com[error - 30] += size * CENTRE_STD_M,
        33 => robot.contact.friction *= 1.0 + size * GROUND_STD[0],
        34 => robot.contact.time_constant *= 1.0 + size * GROUND_STD[1],
        ENCODER_LEAD => {
            robot.joints.iter_mut().for_each(|joint| joint.actuator.encoder_lead += size * ENCODER_LEAD_STD_S);
        }
        // The trunk's moments of inertia, at the same mass.
        _ => robot.trunk.inertia *= 1.0 + size * LINK_MASS_STD,
    }
    robot
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const ROWS: usize = 18_000;

    fn derivative(row: usize, error: usize) -> f64 {
        if row % NUM_NUISANCE == error { 1.0 } else { 0.0 }
    }

    #[test]
    fn effects_of_nuisance_parameters_are_eliminated_and_others_remain() {
        let jacobian = DMatrix::from_fn(ROWS, NUM_NUISANCE, derivative);
        let nuisance = NuisanceModel::of(Vec::new(), jacobian).expect("a positive definite information");
        let mut residuals: Vec<f64> = (0..ROWS).map(|row| 2.0 * derivative(row, 0)).collect();
        nuisance.project_out(&mut residuals);
        assert!(
            residuals[..ROWS].iter().all(|residual| residual.abs() < 0.2),
            "an error of two standard deviations is eliminated"
        );
        assert!((NuisanceModel::nats(&residuals[ROWS..])[1] - 2.0).abs() < 0.4, "its penalty is half its square");
        let mut others = vec![0.0; ROWS];
        others[1] = 5.0;
        nuisance.project_out(&mut others);
        assert!(others[1] > 4.9, "an error in a single row is not due to the robot");
    }

    #[test]
    fn parameter_without_any_effect_changes_no_residual() {
        let nuisance = NuisanceModel::of(Vec::new(), DMatrix::zeros(3, 1)).expect("positive definite");
        let mut residuals = vec![1.0, -2.0, 3.0];
        nuisance.project_out(&mut residuals);
        assert_eq!(residuals, [1.0, -2.0, 3.0, 0.0]);
    }

    #[test]
    fn initial_state_affects_only_its_own_window() {
        let window = |rows: Range<usize>| {
            let jacobian = DMatrix::from_element(rows.len(), 1, 1.0);
            NuisanceBlock::new(rows.collect(), jacobian).expect("positive definite")
        };
        let starts = vec![window(0..ROWS / 2), window(ROWS / 2..ROWS)];
        let nuisance =
            NuisanceModel::of(starts, DMatrix::from_fn(ROWS, NUM_NUISANCE, derivative)).expect("positive definite");
        let mut residuals: Vec<f64> = (0..ROWS).map(|row| if row < ROWS / 2 { 1.0 } else { -1.0 }).collect();
        nuisance.project_out(&mut residuals);
        assert!(residuals[..ROWS].iter().all(|residual| residual.abs() < 0.02));
        assert_eq!(residuals.len(), ROWS + 2 + NUM_NUISANCE);
    }

    proptest! {
        #[test]
        fn elimination_of_a_sparse_jacobian_is_that_of_the_dense_one(
            first in 0usize..700, length in 1usize..200, gap in 1usize..200, slope in 0.1f64..3.0, residual in -3.0f64..3.0,
        ) {
            const COUNT: usize = 1000;
            let is_zero = |row: usize| row < first || row >= first + length || (row - first) % (gap + 20) < gap;
            let cell = |row: usize, column: usize| match column {
                0 if is_zero(row) => 0.0,
                0 => slope,
                _ => (0.37 * row as f64).sin(),
            };
            let jacobian = DMatrix::from_fn(COUNT, 2, cell);
            let given = DVector::from_fn(COUNT, |row, _| residual * (0.1 * row as f64).cos());
            let prior = DMatrix::identity(2, 2) * CORRELATION_ROWS;
            let sizes = (jacobian.tr_mul(&jacobian) + prior).lu().solve(&jacobian.tr_mul(&given)).expect("definite");
            let expected = &given - &jacobian * &sizes;
            let block = NuisanceBlock::new((0..COUNT).collect(), jacobian).expect("positive definite");
            let mut residuals: Vec<f64> = given.iter().copied().collect();
            block.eliminate(&mut residuals, f64::INFINITY);
            for (found, expected) in residuals.iter().zip(&expected) {
                prop_assert!((found - expected).abs() < 1e-4, "{found} {expected}");
            }
        }
    }
}
