//! The effects that an identification estimates, as written on the command line: `coulomb_friction@calf`.

use std::str::FromStr;

use twinstep_effects::{CATALOGUE, Effect, Scope, UnknownScope};

/// Effects that are estimated by default: the largest ones on a real Go2 with its feet in the air.
pub const DEFAULT_EFFECTS: &str = "armature@hip,armature@thigh,armature@calf,coulomb_friction@hip,coulomb_friction@thigh,\
                                   coulomb_friction@calf,viscous_friction@hip,viscous_friction@thigh,\
                                   viscous_friction@calf,command_delay@all";

/// An effect with its scope, as in `coulomb_friction@calf`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EffectAtScope(pub &'static Effect, pub Scope);

/// Reason why a text is not an effect with its scope.
#[derive(Debug, thiserror::Error)]
pub enum EffectAtScopeError {
    /// The scope is missing.
    #[error("`{0}` has no scope: write it as in coulomb_friction@calf")]
    NoScope(String),
    /// The catalogue has no such effect.
    #[error(transparent)]
    UnknownEffect(#[from] UnknownEffect),
    /// The scope is not one.
    #[error(transparent)]
    Scope(#[from] UnknownScope),
}

/// The catalogue has no such effect.
#[derive(Debug, thiserror::Error)]
#[error("`{name}` is not in the catalogue; possible: {}", CATALOGUE.map(|effect| effect.name).join(", "))]
pub struct UnknownEffect {
    name: String,
}

/// Returns the effect of this name.
pub fn named(name: &str) -> Result<&'static Effect, UnknownEffect> {
    Effect::named(name).ok_or_else(|| UnknownEffect { name: name.to_owned() })
}

impl FromStr for EffectAtScope {
    type Err = EffectAtScopeError;

    fn from_str(text: &str) -> Result<Self, EffectAtScopeError> {
        let (name, scope) = text.trim().split_once('@').ok_or_else(|| EffectAtScopeError::NoScope(text.to_owned()))?;
        Ok(EffectAtScope(named(name)?, scope.parse::<Scope>()?))
    }
}

/// Returns [`DEFAULT_EFFECTS`].
pub fn default_effects() -> Vec<(&'static Effect, Scope)> {
    let parsed = |text: &str| text.parse().map(|EffectAtScope(effect, scope)| (effect, scope));
    DEFAULT_EFFECTS.split(',').map(|text| parsed(text).expect("the defaults are in the catalogue")).collect()
}
