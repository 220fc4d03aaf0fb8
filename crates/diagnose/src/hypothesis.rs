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

/// Maximum number of scopes per effect in the result of a scan.
pub const OF_ONE_EFFECT: usize = 3;

/// Hypothesis with its score.
#[derive(Clone, Debug)]
pub struct ScoredHypothesis {
    /// The hypothesis, with the best values of the grid.
    pub hypothesis: Hypothesis,
    /// Log-likelihood gain minus the penalty of its scope [nat].
    pub score: f64,
}

/// Returns the size of an effect, relative to the distance from no effect to the end of the prior range.
///
/// It is the largest of the components of the first parameter.
pub fn relative_size(effect: &Effect, values: &[f64]) -> f64 {
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

/// Returns the model with an effect of these values on every joint of `joints`, or on supply, base or ground.
pub fn with_effect(
    model: &ModelFile,
    effect: &'static Effect,
    joints: Scope,
    values: &[f64],
) -> Result<ModelFile, EntryError> {
    let mut file = model.clone();
    // One entry per joint: if the effect replaces, the entry with the narrowest scope applies.
    let scopes: Vec<Scope> = match effect.target {
        Target::Joints => Joint::ALL.into_iter().filter(|joint| joints.contains(*joint)).map(Scope::Joint).collect(),
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

#[cfg(test)]
mod tests {
    use super::*;

    fn hypothesis(effect: &str, values: &[f64]) -> Hypothesis {
        let effect = Effect::named(effect).expect("in the catalogue");
        Hypothesis { effect, scope: Scope::All, values: values.to_vec() }
    }

    #[test]
    fn size_is_relative_to_the_prior_range() {
        let large_enough = |effect: &str, values: &[f64]| hypothesis(effect, values).exceeds_min_size();
        // Prior range 0 to 1.5 N·m, at least a tenth.
        assert!(large_enough("coulomb_friction", &[0.16]) && !large_enough("coulomb_friction", &[0.14]));
        // A limit has no effect at infinity: half the range is twice the limit of the full range.
        let low = Effect::named("torque_saturation").expect("known").parameters[0].prior_range[0];
        assert!(large_enough("torque_saturation", &[2.0 * low]) && !large_enough("torque_saturation", &[20.0 * low]));
        // Geometry errors of a millimetre imitate small encoder offsets.
        let high = Effect::named("encoder_offset").expect("known").parameters[0].prior_range[1];
        assert!(large_enough("encoder_offset", &[0.46 * high]) && !large_enough("encoder_offset", &[0.44 * high]));
        // The largest component of a vector counts.
        assert!(large_enough("com_shift", &[0.0, 0.0, -0.04]) && !large_enough("com_shift", &[0.001; 3]));
    }

    #[test]
    fn values_far_outside_the_prior_range_are_implausible() {
        let plausible = |values: &[f64]| hypothesis("coulomb_friction", values).is_plausible();
        assert!(plausible(&[1.5]) && plausible(&[2.2]) && !plausible(&[2.3]));
    }

    #[test]
    fn probes_of_a_delay_are_closer_to_each_other_than_those_of_a_friction() {
        let ratio = |name: &str| {
            let probes = fine_probes(Effect::named(name).expect("known"));
            let mut sizes: Vec<f64> = probes.iter().map(|values| values[0]).collect();
            sizes.sort_by(f64::total_cmp);
            sizes.windows(2).map(|pair| pair[1] / pair[0]).fold(f64::INFINITY, f64::min)
        };
        assert!(ratio("torque_delay") < 1.3 && ratio("viscous_friction") > 1.5);
    }

    #[test]
    fn effect_on_every_joint_replaces_the_entries_of_the_model() {
        let effect = Effect::named("viscous_friction").expect("known");
        let file = with_effect(&ModelFile::default(), effect, Scope::All, &[0.2]).expect("allowed");
        let twice = with_effect(&file, effect, Scope::All, &[0.3]).expect("allowed").robot_model().expect("a robot");
        let expected = if effect.composition == Composition::Replace { 0.3 } else { 0.5 };
        assert!(twice.joints.iter().all(|joint| (joint.viscous_friction - expected).abs() < 1e-12));
    }
}
