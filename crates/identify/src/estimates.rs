//! Estimates of an identification, with intervals and correlations.

use nalgebra::DMatrix;

use crate::parameter::FreeParameter;

/// Absolute correlation from which a pair of parameters is reported.
const MIN_CORRELATION: f64 = 0.9;
/// Half width of the central 95 % interval of a normal distribution [standard deviations].
const Z_95: f64 = 1.96;

/// Estimate of a free parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct ParameterEstimate {
    /// The free parameter.
    pub parameter: FreeParameter,
    /// Estimated value.
    pub value: f64,
    /// 95 % interval; `None` if the parameter is not identifiable.
    pub interval: Option<[f64; 2]>,
    /// 95 % interval around the prior mean, predicted before the search.
    pub predicted_interval: [f64; 2],
    /// Status of the estimate.
    pub verdict: EstimateStatus,
}

/// Status of an estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EstimateStatus {
    /// The parameter was estimated.
    Identified,
    /// The estimate is at its bound; the true value may be outside.
    AtBound,
    /// The parameter is not identifiable from the log and keeps its initial value.
    NotIdentifiable,
}

/// Pairs of highly correlated parameters: names, correlation, and an experiment that discriminates between them.
pub type CorrelatedPairs = Vec<(String, String, f64, Option<&'static str>)>;

/// Returns the 95 % interval around a coordinate for a standard deviation [prior std].
fn interval_around(unknown: &FreeParameter, coordinate: f64, std: f64) -> [f64; 2] {
    let half = Z_95 * std * unknown.prior[1];
    let ends = [unknown.value(coordinate - half), unknown.value(coordinate + half)];
    [ends[0].min(ends[1]), ends[0].max(ends[1])]
}

/// Returns the estimates of all parameters at `point`, with intervals from the covariance `spread` of the `free` ones [prior
/// std²], and the highly correlated pairs.
pub fn estimates(
    all: &[FreeParameter],
    predicted: &[f64],
    identifiable: &[bool],
    free: &[FreeParameter],
    point: &[f64],
    begin: &[f64],
    spread: Option<&DMatrix<f64>>,
) -> (Vec<ParameterEstimate>, CorrelatedPairs) {
    let mut findings = Vec::new();
    let mut free_index = 0;
    for (index, unknown) in all.iter().enumerate() {
        let predicted = interval_around(unknown, unknown.prior[0], predicted[index]);
        if !identifiable[index] {
            let (unknown, value) = (unknown.clone(), unknown.value(begin[index]));
            findings.push(ParameterEstimate {
                parameter: unknown,
                value,
                interval: None,
                predicted_interval: predicted,
                verdict: EstimateStatus::NotIdentifiable,
            });
            continue;
        }
        let [low, high] = unknown.coordinate_bounds();
        let at_bound = |end: f64| (point[free_index] - end).abs() < 1e-6 * unknown.prior[1];
        let verdict =
            if at_bound(low) || at_bound(high) { EstimateStatus::AtBound } else { EstimateStatus::Identified };
        let interval =
            spread.map(|spread| interval_around(unknown, point[free_index], spread[(free_index, free_index)].sqrt()));
        let (unknown, value) = (unknown.clone(), unknown.value(point[free_index]));
        findings.push(ParameterEstimate {
            parameter: unknown,
            value,
            interval,
            predicted_interval: predicted,
            verdict,
        });
        free_index += 1;
    }
    let mut correlated = Vec::new();
    if let Some(spread) = spread {
        for i in 0..free.len() {
            for j in 0..i {
                let correlation = spread[(i, j)] / (spread[(i, i)] * spread[(j, j)]).sqrt();
                if correlation.abs() >= MIN_CORRELATION {
                    let experiment =
                        free[i].effect.confounders.iter().find(|other| other.effect == free[j].effect.name);
                    let back = free[j].effect.confounders.iter().find(|other| other.effect == free[i].effect.name);
                    let experiment = experiment.or(back).map(|confounder| confounder.discriminating_experiment);
                    correlated.push((free[j].name(), free[i].name(), correlation, experiment));
                }
            }
        }
    }
    (findings, correlated)
}
