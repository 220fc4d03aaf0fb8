//! Errors that explain residuals and are no fault of the model: of mass, geometry and contact, which any robot has, and of the
//! measured state in which a window starts. A standing robot whose leg is mounted 2 mm too low has joints that are off by
//! 10 mrad, and a trunk that is put down 20 mm/s too fast swings for as long: both would be taken for loads and encoders.
//!
//! Their slopes are taken once, by simulation, and what they can explain at the price of their own size is taken out of
//! residuals: the cost of a corrected residual is that of generalised least squares, `rᵀ (1 + S P Sᵀ)⁻¹ r`. Starts go first,
//! window by window; what the robot's errors explain is what is left of it then.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use twinstep_model::{Precision, RobotModel, Rollout};

use crate::experiment::Experiment;

/// Standard deviations: of masses, relative; of where legs are mounted [m]; of the ground, relative.
const MASS_STD: f64 = 0.006;
const MOUNT_OFFSET_STD_M: f64 = 0.0012;
const GROUND_STD: [f64; 2] = [0.03, 0.15];
/// Where each of four legs is mounted, along three axes; masses of the trunk, and of hips, thighs and calves; the ground.
const NUM_NUISANCE: usize = 12 + 4 + 2;
/// Residuals that count as one: they depend on each other over this many rows.
const CORRELATION_ROWS: f64 = 40.0;

/// What tolerated errors do to residuals.
#[derive(Clone)]
pub struct NuisanceModel {
    starts: Vec<NuisanceBlock>,
    robot: NuisanceBlock,
    /// Slopes by the robot's errors as they are simulated, with no start corrected.
    slopes: DMatrix<f64>,
}

/// Errors that act on some of the residuals.
#[derive(Clone)]
struct NuisanceBlock {
    /// Which.
    rows: Vec<usize>,
    /// A row a residual, a column an error of one standard deviation.
    slopes: DMatrix<f64>,
    factor: Cholesky<f64, Dyn>,
}

impl NuisanceBlock {
    fn new(rows: Vec<usize>, slopes: DMatrix<f64>) -> Option<Self> {
        let prior = DMatrix::identity(slopes.ncols(), slopes.ncols()) * CORRELATION_ROWS;
        let factor = (slopes.tr_mul(&slopes) + prior).cholesky()?;
        Some(Self { rows, slopes, factor })
    }

    /// Takes out of residuals what the errors explain; what that costs is added at their end.
    fn take(&self, residuals: &mut Vec<f64>) {
        let mut own = DVector::from_iterator(self.rows.len(), self.rows.iter().map(|row| residuals[*row]));
        let sizes = self.factor.solve(&self.slopes.tr_mul(&own));
        own.gemv(-1.0, &self.slopes, &sizes, 1.0);
        for (row, value) in self.rows.iter().zip(&own) {
            residuals[*row] = *value;
        }
        residuals.extend(sizes.iter().map(|size| size * CORRELATION_ROWS.sqrt()));
    }

    fn divided(&self, spread: &[f64]) -> Option<Self> {
        let mut slopes = self.slopes.clone();
        for (mut slope, row) in slopes.row_iter_mut().zip(&self.rows) {
            slope /= spread[*row];
        }
        Self::new(self.rows.clone(), slopes)
    }
}

impl NuisanceModel {
    /// Around `robot`; none where it diverges.
    pub fn new(experiments: &[Experiment], robot: &RobotModel, simulator: &mut dyn Rollout) -> Option<Self> {
        let starts = starts(experiments, robot, simulator)?;
        let sides = |error: usize| [-1.0, 1.0].map(|side| perturbed_robot(robot, error, side));
        let robots: Vec<RobotModel> = (0..NUM_NUISANCE).flat_map(sides).collect();
        let mut columns = vec![Vec::new(); NUM_NUISANCE];
        for experiment in experiments {
            let residuals = experiment.residuals(simulator, &robots, Precision::Single);
            for (column, ends) in columns.iter_mut().zip(residuals.chunks(2)) {
                column.extend(half_difference(&ends[0], &ends[1]));
            }
        }
        let slopes = DMatrix::from_iterator(columns[0].len(), NUM_NUISANCE, columns.into_iter().flatten());
        slopes.iter().all(|slope| slope.is_finite()).then(|| Self::of(starts, slopes)).flatten()
    }

    fn of(starts: Vec<NuisanceBlock>, slopes: DMatrix<f64>) -> Option<Self> {
        let corrected = slopes.column_iter().map(|column| {
            let mut column = column.iter().copied().collect();
            for start in &starts {
                start.take(&mut column);
            }
            DVector::from_vec(column)
        });
        let corrected = DMatrix::from_columns(&corrected.collect::<Vec<_>>());
        let robot = NuisanceBlock::new((0..corrected.nrows()).collect(), corrected)?;
        Some(Self { starts, robot, slopes })
    }

    /// For residuals that are divided by `spread`, one by one.
    pub fn rescaled(&self, spread: &[f64]) -> Option<Self> {
        let mut slopes = self.slopes.clone();
        for (mut slope, spread) in slopes.row_iter_mut().zip(spread) {
            slope /= *spread;
        }
        Self::of(self.starts.iter().map(|start| start.divided(spread)).collect::<Option<_>>()?, slopes)
    }

    /// What each of the robot's errors, of one standard deviation, does to residuals that are divided by `spread` and have
    /// what is `taken` out of them.
    pub fn robot_errors(&self, spread: &[f64], taken: Option<&Self>) -> Vec<Vec<f64>> {
        let error = |slopes: nalgebra::DVectorView<f64>| {
            let mut residuals: Vec<f64> = slopes.iter().zip(spread).map(|(slope, spread)| slope / spread).collect();
            if let Some(taken) = taken {
                taken.project_out(&mut residuals);
            }
            residuals
        };
        self.slopes.column_iter().map(|column| error(column.as_view())).collect()
    }

    /// Takes out of residuals what the errors explain; what that costs is added at their end, to be squared like the others.
    pub fn project_out(&self, residuals: &mut Vec<f64>) {
        for errors in self.starts.iter().chain([&self.robot]) {
            errors.take(residuals);
        }
    }

    /// Evidence that is lost by the `costs` that [`NuisanceModel::project_out`] adds: of starts, and of the robot [nats].
    pub fn nats(costs: &[f64]) -> [f64; 2] {
        let (starts, robot) = costs.split_at(costs.len().saturating_sub(NUM_NUISANCE));
        [starts, robot].map(|costs| 0.5 * costs.iter().map(|cost| cost * cost).sum::<f64>() / CORRELATION_ROWS)
    }
}

/// Power that the robot's errors have above what any robot's have, if they cost so much [nats], in units of a row's noise.
pub fn excess(nats: f64) -> f64 {
    (2.0 * nats - NUM_NUISANCE as f64).max(0.0) * CORRELATION_ROWS
}

/// The errors of every window's start.
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
        if columns.iter().flatten().any(|slope| !slope.is_finite()) {
            return None;
        }
        for rows in experiment.free_windows() {
            let slopes = DMatrix::from_fn(rows.len(), columns.len(), |row, column| columns[column][rows[row]]);
            starts.push(NuisanceBlock::new(rows.into_iter().map(|row| first + row).collect(), slopes)?);
        }
        first += columns[0].len();
    }
    Some(starts)
}

fn half_difference<'a>(below: &'a [f64], above: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
    above.iter().zip(below).map(|(above, below)| 0.5 * (above - below))
}

/// `robot` with one of the errors, of `size` standard deviations.
fn perturbed_robot(robot: &RobotModel, error: usize, size: f64) -> RobotModel {
    let mut robot = robot.clone();
    match error {
        0..12 => robot.legs[error / 3].origins[0][error % 3] += size * MOUNT_OFFSET_STD_M,
        12 => robot.trunk = robot.trunk.scaled(1.0 + size * MASS_STD),
        13..16 => {
            for leg in &mut robot.legs {
                leg.bodies[error - 13] = leg.bodies[error - 13].scaled(1.0 + size * MASS_STD);
            }
        }
        16 => robot.contact.friction *= 1.0 + size * GROUND_STD[0],
        _ => robot.contact.time_constant *= 1.0 + size * GROUND_STD[1],
    }
    robot
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROWS: usize = 9_000;

    fn slope(row: usize, error: usize) -> f64 {
        if row % NUM_NUISANCE == error { 1.0 } else { 0.0 }
    }

    #[test]
    fn what_an_error_of_its_size_explains_is_taken_and_what_it_cannot_stays() {
        let slopes = DMatrix::from_fn(ROWS, NUM_NUISANCE, slope);
        let tolerances = NuisanceModel::of(Vec::new(), slopes).expect("a positive definite information");
        let mut residuals: Vec<f64> = (0..ROWS).map(|row| 2.0 * slope(row, 0)).collect();
        tolerances.project_out(&mut residuals);
        assert!(residuals[..ROWS].iter().all(|residual| residual.abs() < 0.2), "two deviations are no news");
        assert!((NuisanceModel::nats(&residuals[ROWS..])[1] - 2.0).abs() < 0.4, "and cost half their square");
        let mut others = vec![0.0; ROWS];
        others[1] = 5.0;
        tolerances.project_out(&mut others);
        assert!(others[1] > 4.9, "one row alone is no error of the robot");
    }

    #[test]
    fn start_explains_its_own_window_alone() {
        let window = |rows: std::ops::Range<usize>| {
            let slopes = DMatrix::from_element(rows.len(), 1, 1.0);
            NuisanceBlock::new(rows.collect(), slopes).expect("positive definite")
        };
        let starts = vec![window(0..ROWS / 2), window(ROWS / 2..ROWS)];
        let tolerances = NuisanceModel::of(starts, DMatrix::from_fn(ROWS, NUM_NUISANCE, slope)).expect("positive definite");
        let mut residuals: Vec<f64> = (0..ROWS).map(|row| if row < ROWS / 2 { 1.0 } else { -1.0 }).collect();
        tolerances.project_out(&mut residuals);
        assert!(residuals[..ROWS].iter().all(|residual| residual.abs() < 0.02));
        assert_eq!(residuals.len(), ROWS + 2 + NUM_NUISANCE);
    }
}
