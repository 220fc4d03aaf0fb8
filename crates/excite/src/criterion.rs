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
}

/// There is no criterion of this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("criterion `{0}` does not exist; choose trace, d-optimal or a-optimal")]
pub struct UnknownCriterion(pub String);

impl FromStr for Criterion {
    type Err = UnknownCriterion;

    /// The parameters of interest of an A-optimal criterion are set by the caller.
    fn from_str(name: &str) -> Result<Self, UnknownCriterion> {
        match name {
            "trace" => Ok(Self::Trace),
            "d-optimal" => Ok(Self::DOptimal),
            "a-optimal" => Ok(Self::AOptimal(Vec::new())),
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
        }
    }
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
    fn names_are_read() {
        assert_eq!("trace".parse(), Ok(Criterion::Trace));
        assert_eq!("d-optimal".parse(), Ok(Criterion::DOptimal));
        let error = "e-optimal".parse::<Criterion>().expect_err("no such criterion").to_string();
        assert!(error.contains("`e-optimal`") && error.contains("a-optimal"), "{error}");
    }
}
