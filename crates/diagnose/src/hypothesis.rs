//! Hypothesis: an effect on a scope, with values.

use twinstep_effects::{Effect, Scope};

/// Effect on a scope, with values.
#[derive(Clone, Debug, PartialEq)]
pub struct Hypothesis {
    /// The effect.
    pub effect: &'static Effect,
    /// The scope of the effect.
    pub scope: Scope,
    /// Values of all parameters, in the order of the effect's parameters.
    pub values: Vec<f64>,
}

impl Hypothesis {
    /// Returns the name with scope, as in `armature@calf`.
    pub fn name(&self) -> String {
        format!("{}@{}", self.effect.name, self.scope)
    }
}
