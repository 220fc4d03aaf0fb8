//! The effects of the catalogue as the equations see them: unknowns, their priors, and what they change.

use twinstep_effects::{CATALOGUE, Effect, LawForm};
pub use twinstep_effects::{Place, Presence};

/// A form of an effect in its unknowns.
#[derive(Clone, Debug)]
pub struct Law {
    /// The effect.
    pub effect: &'static Effect,
    /// The form.
    pub form: &'static LawForm,
    /// True if it may be named as a cause; else it is only a nuisance, because the log cannot show it.
    pub is_cause: bool,
    /// Values of the only unknown that are tried, if the residuals are far from linear in it; else empty.
    pub strengths: Vec<f64>,
    /// Values that are tried of a parameter which is no unknown of its own, such as the period of a ripple; one if there is none.
    pub shapes: Vec<f64>,
}

impl Law {
    fn new(effect: &'static Effect, form: &'static LawForm) -> Self {
        let strengths = if form.is_strength { STRENGTHS.to_vec() } else { Vec::new() };
        Self { effect, form, is_cause: true, strengths, shapes: form.shapes.values() }
    }

    /// Returns the standard deviation of an unknown where it is too small to be reported.
    pub fn small_std(&self, unknown: usize) -> f64 {
        self.form.small.get(unknown).copied().unwrap_or(0.0)
    }

    /// Returns the parameters of the effect at a joint whose motor is by a factor stronger than a Go2's.
    pub fn parameters(&self, unknowns: &[f64], shape: f64, scale: f64) -> Vec<f64> {
        let mut values = (self.form.values)(unknowns, shape);
        if self.form.is_of_torque {
            values[0] *= scale;
        }
        values
    }

    /// Returns the possible value of the first unknown that is closest to a value. A strength is never zero, where some effects are infinite.
    pub fn possible(&self, value: f64, least: f64) -> f64 {
        value.max(if self.strengths.is_empty() { least } else { LEAST_STRENGTH })
    }

    /// Returns true if the parameters of the effect are within their bounds.
    pub fn allows(&self, unknowns: &[f64], shape: f64) -> bool {
        // The parameters of other bodies depend on the body.
        let is_of_body = self.form.place == Place::Body;
        let bounds = self.effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one.bounds, one.count));
        is_of_body
            || (self.form.values)(unknowns, shape)
                .into_iter()
                .zip(bounds)
                .all(|(value, [low, high])| value >= low && value <= high)
    }
}

/// Least strength.
const LEAST_STRENGTH: f64 = 1e-3;
/// Strengths that are tried, relative to the end of the prior range.
const STRENGTHS: [f64; 12] = [0.03, 0.06, 0.1, 0.15, 0.22, 0.32, 0.45, 0.6, 0.8, 1.0, 1.25, 1.6];

/// Returns the laws, in the order of the chain from command to motion.
pub fn laws() -> Vec<Law> {
    let of_effect = |effect: &'static Effect| effect.laws.iter().map(move |form| Law::new(effect, form));
    CATALOGUE.into_iter().flat_map(of_effect).collect()
}
