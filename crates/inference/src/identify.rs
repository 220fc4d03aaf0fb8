//! Identification: estimates with intervals and correlations.

use std::sync::atomic::Ordering;

use nalgebra::DMatrix;
use twinstep_effects::TreeModelFile;

use crate::fit::FitProblem;
use crate::parameter::write_estimates;
use crate::{Candidate, FreeParameter, IdentifyOptions, InferenceError, JointLog, Quantity, WindowLength, windows};

/// Half width of a 95 % interval [standard deviations].
const INTERVAL: f64 = 1.96;
/// Absolute correlation above which a pair of estimates is reported.
const HIGH_CORRELATION: f64 = 0.95;
/// Posterior standard deviation above which the log says little about a parameter [prior std].
const WIDE: f64 = 0.7;
/// Number of times that the noise is estimated.
const ROUNDS: usize = 4;
/// Largest number of steps of the fit in each round.
const STEPS: usize = 15;
/// Coordinates of unknown gains and of delays from which the fit starts [prior std]: a loop has local minima in both.
const GAIN_STARTS: [f64; 3] = [0.0, 0.8, -0.8];
const DELAY_STARTS: [f64; 3] = [-0.8, 0.2, 1.1];
/// Number of windows on which the starts compete, and number of their steps.
const START_WINDOWS: usize = 8;
const START_STEPS: usize = 6;

/// Estimate of one parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// The parameter.
    pub parameter: FreeParameter,
    /// Its value; the gain itself for a gain.
    pub value: f64,
    /// 95 % interval.
    pub interval: [f64; 2],
    /// True if the log says little: the interval is nearly that of the prior.
    pub is_wide: bool,
}

/// Result of an identification.
#[derive(Clone, Debug)]
pub struct Identification {
    /// The model with the estimates.
    pub model: TreeModelFile,
    /// Estimate of each parameter.
    pub estimates: Vec<Estimate>,
    /// Pairs of estimates that the log hardly separates: names and correlation.
    pub correlated: Vec<(String, String, f64)>,
    /// True if it was interrupted: the estimates are the best so far, with the intervals of their priors.
    pub interrupted: bool,
}

/// Estimates parameters from a log. `progress` receives round (0: the start is chosen), number of rounds and cost.
pub fn identify(
    file: &TreeModelFile,
    log: &JointLog,
    options: &IdentifyOptions,
    progress: &mut dyn FnMut(usize, usize, f64),
) -> Result<Identification, InferenceError> {
    let given = Candidate::of(file)?;
    let parameters = FreeParameter::of(&options.requests, file, log)?;
    let windows = windows(log, &given.robot.tree, WindowLength::IDENTIFICATION);
    let mut problem = FitProblem::new(log, &windows, &parameters, &given, options);
    let is_stopped = || options.stop.load(Ordering::Relaxed);
    let few: Vec<_> = windows.iter().step_by(windows.len().div_ceil(START_WINDOWS)).cloned().collect();
    let of_few = FitProblem::new(log, &few, &parameters, &given, options);
    let mut point = start(&of_few, &parameters, &given, |cost| progress(0, ROUNDS, cost))?;
    for round in 1..=ROUNDS {
        point = problem.minimise(point, STEPS, |cost| progress(round, ROUNDS, cost))?;
        match problem.estimate_noise(&point) {
            Err(InferenceError::Interrupted) => break,
            estimated => estimated?,
        }
    }
    let count = parameters.len();
    let covariance = match problem.covariance(&point) {
        Err(InferenceError::Interrupted) => DMatrix::identity(count, count),
        covariance => covariance?,
    };
    let interval = |index: usize| {
        let half = INTERVAL * covariance[(index, index)].sqrt();
        [point[index] - half, point[index] + half].map(|end| parameters[index].value(end))
    };
    let values: Vec<_> = (0..count).map(|index| (parameters[index].value(point[index]), interval(index))).collect();
    let estimate = |(index, parameter): (usize, &FreeParameter)| {
        let reported = |value| given.reported(parameter, value);
        let (value, interval) = values[index];
        let is_wide = covariance[(index, index)].sqrt() > WIDE;
        Estimate { parameter: parameter.clone(), value: reported(value), interval: interval.map(reported), is_wide }
    };
    let estimates = parameters.iter().enumerate().map(estimate).collect();
    let mut model = file.clone();
    write_estimates(&mut model, &given, log, &parameters, &values);
    Ok(Identification { model, estimates, correlated: correlated(&parameters, &covariance), interrupted: is_stopped() })
}

/// Returns the best point of short fits: from the given model, and from other gains and delays.
fn start(
    problem: &FitProblem,
    parameters: &[FreeParameter],
    given: &Candidate,
    mut each: impl FnMut(f64),
) -> Result<Vec<f64>, InferenceError> {
    let own = |parameter: &FreeParameter| {
        let value = parameter.quantity.get(&given.robot.joints[parameter.joints[0]]);
        if value > 0.0 { parameter.coordinate(value) } else { 0.0 }
    };
    let with = |gain: f64, delay: f64| {
        let coordinate = |parameter: &FreeParameter| match parameter.quantity {
            Quantity::PositionGain | Quantity::VelocityGain => gain,
            Quantity::CommandDelay => delay,
            _ => own(parameter),
        };
        parameters.iter().map(coordinate).collect::<Vec<_>>()
    };
    let mut starts = vec![vec![parameters.iter().map(own).collect()]];
    starts.extend(DELAY_STARTS.map(|delay| GAIN_STARTS.map(|gain| with(gain, delay)).to_vec()));
    let mut best = (f64::INFINITY, starts[0][0].clone());
    for alike in starts {
        match fit_best(problem, &alike, &mut each) {
            Err(InferenceError::Interrupted) => return Ok(best.1),
            Ok((cost, point)) if cost < best.0 => best = (cost, point),
            tried => drop(tried?),
        }
    }
    if best.0.is_finite() { Ok(best.1) } else { Err(InferenceError::Diverges) }
}

/// Fits from the best of some points in a few steps. Returns cost and point; the cost is infinite if all of them diverge.
fn fit_best(
    problem: &FitProblem,
    points: &[Vec<f64>],
    each: &mut dyn FnMut(f64),
) -> Result<(f64, Vec<f64>), InferenceError> {
    let costs = problem.costs(points)?;
    let least = (0..points.len()).min_by(|one, other| costs[*one].total_cmp(&costs[*other])).unwrap_or(0);
    if costs[least].is_infinite() {
        return Ok((f64::INFINITY, points[least].clone()));
    }
    let point = problem.minimise(points[least].clone(), START_STEPS, each)?;
    let cost = problem.costs(std::slice::from_ref(&point))?[0];
    Ok((cost, point))
}

fn correlated(parameters: &[FreeParameter], covariance: &DMatrix<f64>) -> Vec<(String, String, f64)> {
    let mut pairs = Vec::new();
    for one in 0..parameters.len() {
        for other in one + 1..parameters.len() {
            let product = covariance[(one, one)] * covariance[(other, other)];
            let correlation = covariance[(one, other)] / product.sqrt();
            if correlation.abs() > HIGH_CORRELATION {
                pairs.push((parameters[one].name(), parameters[other].name(), correlation));
            }
        }
    }
    pairs
}
