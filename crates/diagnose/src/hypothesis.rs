//! Hypothesis: an effect on a scope, with values.

use twinstep_effects::ModelFile;
use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, Scope, Target};
use twinstep_model::Joint;

/// Grid of sizes, relative to the distance from no effect to the end of the prior range.
const SHARES: [f64; 5] = [0.1, 0.2, 0.4, 0.75, 1.3];
/// Minimum size of a cause, relative to its prior range.
const LEAST_SHARE: f64 = 0.1;
/// Minimum sizes of effects that geometry errors of 1 mm or another contact law imitate.
const LEAST_SHARES: [(&str, f64); 3] = [("encoder_offset", 0.3), ("com_shift", 0.12), ("ground_stiffness", 0.3)];

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
        let own = LEAST_SHARES.iter().find(|(name, _)| *name == self.effect.name);
        relative_size(self.effect, &self.values) >= own.map_or(LEAST_SHARE, |(_, least)| *least)
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
        Target::Bodies | Target::Base => vec![Scope::Base],
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

/// Returns the grid of values, from small to large, for effects on joints and on the supply.
pub fn grid(effect: &Effect) -> Vec<Vec<f64>> {
    let main = &effect.parameters[0];
    let [low, high] = main.prior_range;
    let mut firsts = Vec::new();
    for share in SHARES {
        if main.no_effect_value.is_infinite() {
            firsts.push(low / share);
            continue;
        }
        for end in [low, high] {
            if (end - main.no_effect_value).abs() > 1e-9 {
                firsts.push(main.no_effect_value + share * (end - main.no_effect_value));
            }
        }
    }
    let seconds: &[&[f64]] = match effect.name {
        "stribeck_friction" => &[&[0.15], &[0.6], &[2.0]],
        "joint_spring" => &[&[-1.2], &[0.0], &[1.2]],
        "thermal_derating" => &[&[35.0]],
        "torque_ripple" => return ripples(),
        "pd_gain" => return pd_gains(effect),
        _ => &[&[]],
    };
    let [least, most] = main.bounds;
    let firsts = firsts.into_iter().map(|first| first.clamp(least, most));
    firsts.flat_map(|first| seconds.iter().map(move |second| [&[first][..], second].concat())).collect()
}

/// Returns the grid of values of an effect on one scope, from small to large.
///
/// The grid of delays and lags is finer: an oscillating loop stays in phase only if they are nearly correct.
pub fn fine_grid(effect: &Effect) -> Vec<Vec<f64>> {
    let coarse = match effect.target {
        Target::Joints | Target::Supply if effect.name != "encoder_offset" => grid(effect),
        _ => return body_grid(effect),
    };
    if !["command_delay", "torque_delay", "drive_lag"].contains(&effect.name) {
        return coarse;
    }
    coarse.iter().flat_map(|values| [0.8, 1.0, 1.25].map(|factor| vec![factor * values[0]])).collect()
}

/// Returns the grid of values of an effect that is evaluated on the whole log, for each component of a vector alone.
pub fn body_grid(effect: &Effect) -> Vec<Vec<f64>> {
    match effect.name {
        "payload" => [-0.5, 0.3, 0.8, 2.0].map(|mass| vec![mass, 0.0, 0.0, 0.0]).to_vec(),
        "com_shift" | "gyro_bias" => {
            let along = |axis: usize| {
                [-0.5, -0.15, 0.15, 0.5].map(|share| {
                    let size = share * effect.parameters[0].prior_range[1];
                    (0..3).map(|one| if one == axis { size } else { 0.0 }).collect()
                })
            };
            (0..3).flat_map(along).collect()
        }
        "encoder_offset" => [-0.02, 0.02].map(|offset| vec![offset]).to_vec(),
        "ground_friction" => [0.3, 0.5, 0.65, 1.1].map(|friction| vec![friction]).to_vec(),
        "ground_stiffness" => [0.005, 0.01, 0.02, 0.04].map(|time| vec![time]).to_vec(),
        _ => Vec::new(),
    }
}

/// Returns scales of one gain at a time, from small to large changes.
fn pd_gains(effect: &Effect) -> Vec<Vec<f64>> {
    let scales = |index: usize| {
        let [low, high] = effect.parameters[index].prior_range;
        SHARES.into_iter().flat_map(move |share| [low, high].map(|end| 1.0 + share * (end - 1.0)))
    };
    scales(0).map(|kp| vec![kp, 1.0]).chain(scales(1).map(|kd| vec![1.0, kd])).collect()
}

/// Returns ripples of one amplitude, with every third number of cycles and four phases.
///
/// Joints move within 0.5 rad of their mean position. There the phase error to the nearest grid value is at most 0.5
/// rad, which the refinement corrects.
fn ripples() -> Vec<Vec<f64>> {
    let phases = [0.0, 0.5, 1.0, -0.5].map(|turn| turn * std::f64::consts::PI);
    (7..=150).step_by(3).flat_map(|cycles| phases.map(|phase| vec![0.12, f64::from(cycles), phase])).collect()
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
