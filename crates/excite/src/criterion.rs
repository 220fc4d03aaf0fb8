//! The number that an experiment maximises.

use std::str::FromStr;

use nalgebra::DMatrix;

/// Number that an experiment maximises, from the Fisher information of its log.
///
/// The information has the units of the prior: the identity is what the prior knows.
#[derive(Clone, Debug, PartialEq)]
pub enum Criterion {
    /// Trace of the information (SPI-Active, eq. 6): the sum over the parameters, as if the others were known.
    Trace,
    /// Half the logarithm of the determinant of information and prior: the expected gain in information [nat].
    ///
    /// A direction that the log does not show counts 0.
    DOptimal,
    /// Minus the sum of the posterior variances of some parameters, in units of their prior variances. The others are
    /// nuisance parameters, of which nothing has to be known (QOED's subset of interest).
    AOptimal(
        /// Indices of the parameters of interest.
        Vec<usize>,
    ),
    /// Expected gain in information about some parameters, after the others were eliminated [nat]: half the logarithm of the
    /// determinant of their marginal information (QOED).
    ///
    /// The others are those that no log identifies, or that do not matter to the task.
    Qoed(
        /// Indices of the parameters of interest; empty for those that the first random sequence identifies.
        Vec<usize>,
    ),
}

/// There is no criterion of this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("criterion `{0}` does not exist; choose trace, d-optimal, a-optimal or qoed")]
pub struct UnknownCriterion(pub String);

impl FromStr for Criterion {
    type Err = UnknownCriterion;

    /// The parameters of interest are set by the caller.
    fn from_str(name: &str) -> Result<Self, UnknownCriterion> {
        match name {
            "trace" => Ok(Self::Trace),
            "d-optimal" => Ok(Self::DOptimal),
            "a-optimal" => Ok(Self::AOptimal(Vec::new())),
            "qoed" => Ok(Self::Qoed(Vec::new())),
            _ => Err(UnknownCriterion(name.to_owned())),
        }
    }
}

impl Criterion {
    /// Returns the name.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Trace => "trace",
            Self::DOptimal => "d-optimal",
            Self::AOptimal(_) => "a-optimal",
            Self::Qoed(_) => "qoed",
        }
    }

    /// Returns the value for the information of a log and of the prior [1/prior std²].
    pub fn value(&self, information: &DMatrix<f64>) -> f64 {
        match self {
            Self::Trace => information.trace() - information.nrows() as f64,
            Self::DOptimal => {
                let cholesky = information.clone().cholesky();
                cholesky.map_or(f64::NEG_INFINITY, |root| root.l().diagonal().iter().map(|root| root.ln()).sum())
            }
            Self::AOptimal(of_interest) => {
                let std = posterior_std(information);
                -of_interest.iter().map(|index| std[*index] * std[*index]).sum::<f64>()
            }
            Self::Qoed(of_interest) => {
                // The covariance of some parameters is a part of the whole: the others are eliminated in the inverse.
                let covariance = information.clone().cholesky().map(|root| root.inverse());
                let part = covariance.map(|whole| whole.select_rows(of_interest).select_columns(of_interest));
                let root = part.and_then(DMatrix::cholesky);
                root.map_or(f64::NEG_INFINITY, |root| -root.l().diagonal().iter().map(|root| root.ln()).sum::<f64>())
            }
        }
    }
}

/// Largest remaining standard deviation of an identifiable parameter [prior std].
const IDENTIFIABLE_STD: f64 = 0.5;

/// Returns the parameters of which logs with this information leave less than half of the prior's standard deviation.
pub fn identifiable(information: &DMatrix<f64>) -> Vec<usize> {
    let std = posterior_std(information);
    (0..std.len()).filter(|index| std[*index] < IDENTIFIABLE_STD).collect()
}

/// Returns the standard deviation of each parameter that information and prior leave [prior std].
///
/// It is the Cramér–Rao bound: 1 for a parameter of which the log tells nothing.
pub fn posterior_std(information: &DMatrix<f64>) -> Vec<f64> {
    let inverse = information.clone().cholesky().map(|root| root.inverse());
    let unknown = || vec![1.0; information.nrows()];
    inverse.map_or_else(unknown, |covariance| covariance.diagonal().iter().map(|variance| variance.sqrt()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Information of one measurement that sees only the sum of two parameters, and of the prior.
    fn sum_only(size: f64) -> DMatrix<f64> {
        DMatrix::from_row_slice(2, 2, &[1.0 + size, size, size, 1.0 + size])
    }

    fn diagonal([one, other]: [f64; 2]) -> DMatrix<f64> {
        DMatrix::from_row_slice(2, 2, &[one, 0.0, 0.0, other])
    }

    #[test]
    fn a_log_without_information_has_the_value_of_the_prior() {
        let prior = DMatrix::identity(2, 2);
        assert!(Criterion::Trace.value(&prior).abs() < 1e-12);
        assert!(Criterion::DOptimal.value(&prior).abs() < 1e-12);
        assert!((Criterion::AOptimal(vec![0, 1]).value(&prior) + 2.0).abs() < 1e-12);
        assert_eq!(posterior_std(&prior), [1.0, 1.0]);
    }

    #[test]
    fn trace_counts_what_cannot_be_separated_and_the_others_do_not() {
        // Twice 100 along one direction, or 40 along both: the trace prefers the first, from which neither parameter is
        // known better than half of its prior variance.
        let (one, both) = (sum_only(100.0), DMatrix::from_diagonal_element(2, 2, 41.0));
        assert!(Criterion::Trace.value(&one) > Criterion::Trace.value(&both));
        assert!(Criterion::DOptimal.value(&one) < Criterion::DOptimal.value(&both));
        assert!(Criterion::AOptimal(vec![0]).value(&one) < Criterion::AOptimal(vec![0]).value(&both));
        assert!(posterior_std(&one)[0] > 0.7 && posterior_std(&both)[0] < 0.16);
    }

    #[test]
    fn qoed_ignores_what_cannot_be_identified_and_what_does_not_matter() {
        // The first log tells most of the second parameter alone, which does not matter.
        let (one, other) = (diagonal([2.0, 1e6]), diagonal([50.0, 2.0]));
        assert!(Criterion::DOptimal.value(&one) > Criterion::DOptimal.value(&other));
        let of_first = Criterion::Qoed(vec![0]);
        assert!(of_first.value(&one) < of_first.value(&other));
        assert!((of_first.value(&other) - 0.5 * 50f64.ln()).abs() < 1e-12, "half the logarithm of the information");
        // A log that shows only the sum tells little of one of them, however exact it is: the other is unknown.
        assert!((of_first.value(&sum_only(1e9)) - 0.5 * 2f64.ln()).abs() < 1e-6);
        assert_eq!(identifiable(&one), [1], "a standard deviation of 0.7 remains of the first");
        assert_eq!(identifiable(&sum_only(1e9)), [0; 0]);
    }

    #[test]
    fn names_are_read() {
        assert_eq!("trace".parse(), Ok(Criterion::Trace));
        assert_eq!("d-optimal".parse(), Ok(Criterion::DOptimal));
        let error = "e-optimal".parse::<Criterion>().expect_err("no such criterion").to_string();
        assert!(error.contains("`e-optimal`") && error.contains("a-optimal"), "{error}");
    }
}
