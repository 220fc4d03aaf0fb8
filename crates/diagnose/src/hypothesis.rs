//! Hypothesis: an effect on a scope, with values.

use twinstep_effects::ModelFile;
use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, Scope, Target};
use twinstep_model::Joint;

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

    /// Returns true if it is large enough to be reported as a cause.
    pub fn exceeds_min_size(&self) -> bool {
        relative_size(self.effect, &self.values) >= self.effect.search.min_share
    }

    /// Returns true if all values are plausible: at most half the range outside the prior range.
    pub fn is_plausible(&self) -> bool {
        let parameters = self.effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one, one.count));
        parameters.zip(&self.values).all(|(parameter, value)| {
            let [low, high] = parameter.prior_range;
            let beyond = 0.5 * (high - parameter.no_effect_value).max(parameter.no_effect_value - low);
            // The value without effect is infinite: only values below the range are implausible.
            if parameter.no_effect_value.is_infinite() {
                *value >= 0.5 * low
            } else {
                (low - beyond..=high + beyond).contains(value)
            }
        })
    }
}

/// Returns the size of an effect, relative to the distance from no effect to the end of the prior range.
///
/// It is the largest of the components of the first parameter.
fn relative_size(effect: &Effect, values: &[f64]) -> f64 {
    let parameter = &effect.parameters[0];
    let [low, high] = parameter.prior_range;
    let of = |value: &f64| {
        if parameter.no_effect_value.is_infinite() {
            return low / value;
        }
        let end = if *value > parameter.no_effect_value { high } else { low };
        if (end - parameter.no_effect_value).abs() < 1e-12 {
            0.0
        } else {
            (value - parameter.no_effect_value) / (end - parameter.no_effect_value)
        }
    };
    values[..parameter.count].iter().map(of).fold(0.0, f64::max)
}

/// Returns the model with an effect of these values on every joint, or on supply, base or ground.
pub fn with_effect(model: &ModelFile, effect: &'static Effect, values: &[f64]) -> Result<ModelFile, EntryError> {
    let mut file = model.clone();
    // One entry per joint: if the effect replaces, the entry with the narrowest scope applies.
    let scopes: Vec<Scope> = match effect.target {
        Target::Joints => Joint::ALL.map(Scope::Joint).to_vec(),
        Target::Supply => vec![Scope::All],
        Target::Bodies | Target::Imu => vec![Scope::Base],
        Target::Ground => vec![Scope::Ground],
    };
    for scope in scopes {
        if effect.composition == Composition::Replace {
            file.effects.retain(|entry| entry.effect != effect || entry.scope != scope);
        }
        file.effects.push(EffectEntry::new(effect, scope, values.to_vec())?);
    }
    Ok(file)
}

/// Returns the probes of an effect on one scope, from small to large; close to each other if the loop may oscillate.
pub fn fine_probes(effect: &Effect) -> Vec<Vec<f64>> {
    let whole_log = effect.probe_values(effect.search.whole_log_probes);
    let coarse = if whole_log.is_empty() { effect.probe_values(effect.search.probes) } else { whole_log };
    if !effect.search.oscillates {
        return coarse;
    }
    coarse.iter().flat_map(|values| [0.8, 1.0, 1.25].map(|factor| vec![factor * values[0]])).collect()
}

/// Returns the penalty for the selection among all scopes of the same kind [nat].
pub fn selection_penalty(scope: Scope) -> f64 {
    let kinds: f64 = match scope {
        Scope::Kind(_) => 3.0,
        Scope::Leg(_) => 4.0,
        Scope::Left | Scope::Right => 2.0,
        Scope::Joint(_) => 12.0,
        Scope::All | Scope::Base | Scope::Ground => 1.0,
    };
    kinds.ln()
}
