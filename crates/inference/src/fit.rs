//! Least-squares fit of the free parameters: Levenberg–Marquardt on residuals in units of their standard deviation.
//!
//! The estimate is that of the smallest simulation error. Its interval allows for errors that are correlated in time.

use nalgebra::{DMatrix, DVector};
use twinstep_identify::least_squares::Linearisation;
use twinstep_identify::refine::information;

use crate::noise::effective_std;
use crate::{Candidate, FreeParameter, IdentifyOptions, InferenceError, JointLog, Window, simulate};

/// Decrease of the cost below which the fit has converged; one standard deviation is a cost of 1.
const COST_TOLERANCE: f64 = 0.1;
/// Damping factors of Levenberg–Marquardt, all tried at once.
const DAMPING: [f64; 6] = [0.0, 0.01, 0.1, 1.0, 10.0, 100.0];
/// Step of the differences that approximate derivatives [prior std].
const STEP: f64 = 0.02;
/// Furthest point from the prior's median [prior std].
const FURTHEST: f64 = 4.0;

/// Residuals of one channel: position or torque of one joint, in all windows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Channel {
    Position(usize),
    Torque(usize),
}

/// Least-squares problem on one or more windows of a log.
pub struct FitProblem<'a> {
    log: &'a JointLog,
    windows: &'a [Window],
    parameters: &'a [FreeParameter],
    given: &'a Candidate,
    options: &'a IdentifyOptions,
    channels: Vec<Channel>,
    /// Standard deviation of the errors of each channel, times the root of the number of rows that count as one.
    std: Vec<f64>,
}

impl<'a> FitProblem<'a> {
    /// Creates the problem. The first errors are expected to be a tenth of the measured motion.
    pub fn new(
        log: &'a JointLog,
        windows: &'a [Window],
        parameters: &'a [FreeParameter],
        given: &'a Candidate,
        options: &'a IdentifyOptions,
    ) -> Self {
        let torques = (0..log.joints.len()).filter(|joint| log.joints[*joint].tau.is_some()).map(Channel::Torque);
        let channels: Vec<_> = (0..log.joints.len()).map(Channel::Position).chain(torques).collect();
        let mut problem = Self { log, windows, parameters, given, options, channels, std: Vec::new() };
        let deviation = |channel: &Channel| {
            let cells: Vec<f64> = problem.rows().map(|row| problem.measured(*channel)[row]).collect();
            let cells: Vec<f64> = cells.into_iter().filter(|cell| cell.is_finite()).collect();
            let mean = cells.iter().sum::<f64>() / cells.len().max(1) as f64;
            (cells.iter().map(|cell| (cell - mean).powi(2)).sum::<f64>() / cells.len().max(1) as f64).sqrt()
        };
        let rows_as_one = (0.2 * log.rate_hz).max(1.0).sqrt();
        let std = |channel| (0.1 * deviation(channel) + 1e-3) * rows_as_one;
        problem.std = problem.channels.iter().map(std).collect();
        problem
    }

    fn rows(&self) -> impl Iterator<Item = usize> + '_ {
        self.windows.iter().flat_map(|window| window.first_compared..window.rows.end)
    }

    fn measured(&self, channel: Channel) -> &[f64] {
        match channel {
            Channel::Position(joint) => &self.log.joints[joint].q,
            Channel::Torque(joint) => self.log.joints[joint].tau.as_deref().unwrap_or_default(),
        }
    }

    /// Returns the errors of each channel at each point, simulated minus measured; NaN where a cell is missing. `None` if it diverges.
    fn errors(&self, points: &[Vec<f64>]) -> Result<Vec<Option<Vec<Vec<f64>>>>, InferenceError> {
        let candidates: Vec<_> = points.iter().map(|point| self.given.at(self.parameters, point)).collect();
        let simulated = simulate(self.log, self.windows, &candidates, self.options.actuator_hz, &self.options.stop)?;
        let of_channel = |traces: &[crate::Trace], channel: Channel| {
            let measured = self.measured(channel);
            let mut errors = Vec::new();
            for (window, trace) in self.windows.iter().zip(traces) {
                let rows = window.first_compared..window.rows.end;
                for (row, measured) in rows.clone().zip(&measured[rows]) {
                    let inner = row - window.rows.start;
                    let simulated = match channel {
                        Channel::Position(joint) => trace.q[joint][inner],
                        Channel::Torque(joint) => trace.tau[joint][inner],
                    };
                    let is_last_torque = matches!(channel, Channel::Torque(_)) && row + 1 == window.rows.end;
                    errors.push(if is_last_torque { f64::NAN } else { simulated - measured });
                }
            }
            errors
        };
        let of_point = |traces: Vec<crate::Trace>| {
            let errors: Vec<_> = self.channels.iter().map(|channel| of_channel(&traces, *channel)).collect();
            let diverges = traces.iter().flat_map(|trace| trace.q.iter().flatten()).any(|q| !q.is_finite());
            (!diverges).then_some(errors)
        };
        Ok(simulated.into_iter().map(of_point).collect())
    }

    /// Returns the weighted residuals at each point.
    fn residuals(&self, points: &[Vec<f64>]) -> Result<Vec<Option<DVector<f64>>>, InferenceError> {
        let weighted = |errors: Vec<Vec<f64>>| {
            let each = errors.iter().zip(&self.std).flat_map(|(errors, std)| {
                errors.iter().map(move |error| if error.is_nan() { 0.0 } else { error / std })
            });
            DVector::from_vec(each.collect())
        };
        Ok(self.errors(points)?.into_iter().map(|errors| errors.map(weighted)).collect())
    }

    /// Returns the cost of each point: squared residuals and squared distance from the prior; infinite if it diverges.
    pub fn costs(&self, points: &[Vec<f64>]) -> Result<Vec<f64>, InferenceError> {
        let cost = |(residuals, point): (Option<DVector<f64>>, &Vec<f64>)| {
            let prior = point.iter().map(|coordinate| coordinate * coordinate).sum::<f64>();
            residuals.map_or(f64::INFINITY, |residuals| residuals.norm_squared() + prior)
        };
        Ok(self.residuals(points)?.into_iter().zip(points).map(cost).collect())
    }

    /// Returns residuals and derivatives at a point, by differences to one side.
    pub fn linearise(&self, point: &[f64]) -> Result<Linearisation, InferenceError> {
        let moved = |index: usize| {
            let mut moved = point.to_vec();
            moved[index] += STEP;
            moved
        };
        let points: Vec<_> = std::iter::once(point.to_vec()).chain((0..point.len()).map(moved)).collect();
        let mut all = self.residuals(&points)?.into_iter();
        let mut next = || all.next().flatten().ok_or(InferenceError::Diverges);
        let residuals = next()?;
        let mut jacobian = DMatrix::zeros(residuals.len(), point.len());
        for index in 0..point.len() {
            jacobian.set_column(index, &((next()? - &residuals) / STEP));
        }
        Ok(Linearisation { residuals, jacobian })
    }

    /// Minimises the cost from a point in at most `steps` steps. If it is interrupted, it returns the best point so far. `each` receives the cost after every step.
    pub fn minimise(
        &self,
        mut point: Vec<f64>,
        steps: usize,
        mut each: impl FnMut(f64),
    ) -> Result<Vec<f64>, InferenceError> {
        for _ in 0..steps {
            let here = match self.linearise(&point) {
                Err(InferenceError::Interrupted) => break,
                here => here?,
            };
            let prior = DVector::from_column_slice(&point);
            let now = here.residuals.norm_squared() + prior.norm_squared();
            let gradient = here.jacobian.tr_mul(&here.residuals) + &prior;
            let information = information(&here);
            let step = |damping: &f64| {
                let mut damped = information.clone();
                for index in 0..point.len() {
                    damped[(index, index)] *= 1.0 + damping;
                }
                let step = damped.cholesky()?.solve(&gradient);
                Some(point.iter().zip(step.iter()).map(|(x, step)| (x - step).clamp(-FURTHEST, FURTHEST)).collect())
            };
            let points: Vec<Vec<f64>> = DAMPING.iter().filter_map(step).collect();
            let costs = match self.costs(&points) {
                Err(InferenceError::Interrupted) => break,
                costs => costs?,
            };
            let best = (0..points.len()).min_by(|one, other| costs[*one].total_cmp(&costs[*other]));
            let Some(best) = best.filter(|best| costs[*best] < now) else { break };
            point.clone_from(&points[best]);
            each(costs[best]);
            if now - costs[best] < COST_TOLERANCE {
                break;
            }
        }
        Ok(point)
    }

    /// Estimates the standard deviations from the errors at a point.
    pub fn estimate_noise(&mut self, point: &[f64]) -> Result<(), InferenceError> {
        let errors = self.errors(&[point.to_vec()])?.remove(0).ok_or(InferenceError::Diverges)?;
        let lengths: Vec<_> = self.windows.iter().map(|window| window.rows.end - window.first_compared).collect();
        self.std = errors.iter().map(|errors| effective_std(errors, &lengths)).collect();
        Ok(())
    }

    /// Returns the covariance of the estimates at a point [prior std²].
    pub fn covariance(&self, point: &[f64]) -> Result<DMatrix<f64>, InferenceError> {
        let information = information(&self.linearise(point)?);
        information.cholesky().map(|factor| factor.inverse()).ok_or(InferenceError::Diverges)
    }
}
