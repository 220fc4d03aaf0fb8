//! Entries of a model file, and the robot that they make.

use super::{Composition, Effect, EffectSite, Scope, Target};
use crate::{Joint, RobotModel};

/// An effect with its scope and values.
#[derive(Clone, Debug, PartialEq)]
pub struct EffectEntry {
    /// The effect.
    pub effect: &'static Effect,
    /// What it is about.
    pub scope: Scope,
    /// Its values, parameter after parameter.
    pub values: Vec<f64>,
    /// The 95 % intervals of the values, low and high, where somebody measured them.
    pub intervals: Vec<Option<[f64; 2]>>,
}

/// Why an entry is not allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EntryError {
    /// The effect cannot be about this.
    #[error("`{effect}` cannot have scope \"{scope}\"; possible: {possible}")]
    Scope {
        /// The effect.
        effect: &'static str,
        /// The scope.
        scope: Scope,
        /// What is possible.
        possible: &'static str,
    },
    /// A value is outside its bounds.
    #[error("`{effect}` on {scope}: `{parameter}` = {value} is not allowed: {low} to {high}")]
    Value {
        /// The effect.
        effect: &'static str,
        /// The scope.
        scope: Scope,
        /// The parameter.
        parameter: &'static str,
        /// Its value.
        value: f64,
        /// The lowest that is allowed.
        low: f64,
        /// The highest that is allowed.
        high: f64,
    },
    /// Entries that meet at a joint cannot be made one.
    #[error("`{effect}` on {scope} does not go with another entry: {reason}")]
    Conflict {
        /// The effect.
        effect: &'static str,
        /// The scope.
        scope: Scope,
        /// Why.
        reason: &'static str,
    },
}

impl EffectEntry {
    /// An entry without intervals; `values` are the effect's, parameter after parameter.
    ///
    /// # Panics
    /// If the number of values is wrong.
    pub fn new(effect: &'static Effect, scope: Scope, values: Vec<f64>) -> Result<Self, EntryError> {
        assert_eq!(values.len(), effect.num_values(), "values of `{}`", effect.name);
        let intervals = vec![None; values.len()];
        let entry = Self { effect, scope, values, intervals };
        entry.check()?;
        Ok(entry)
    }

    fn check(&self) -> Result<(), EntryError> {
        let (effect, scope) = (self.effect, self.scope);
        let (fits, possible) = match effect.target {
            Target::Joints => {
                (scope.joints() > 0, "all, hip, thigh, calf, FL, FR, RL, RR, left, right, or a joint such as FL_hip")
            }
            Target::Supply => (scope == Scope::All, "all"),
            Target::Bodies => {
                (matches!(scope, Scope::Base | Scope::Joint(_)), "base, or a joint for the link behind it")
            }
            Target::Base => (scope == Scope::Base, "base"),
            Target::Ground => (scope == Scope::Ground, "ground"),
        };
        if !fits {
            return Err(EntryError::Scope { effect: effect.name, scope, possible });
        }
        let parameters = effect.parameters.iter().flat_map(|parameter| std::iter::repeat_n(parameter, parameter.count));
        for (parameter, value) in parameters.zip(&self.values) {
            let [low, high] = parameter.bounds;
            if !(low..=high).contains(value) {
                let (effect, value, parameter) = (effect.name, *value, parameter.name);
                return Err(EntryError::Value { effect, scope, parameter, value, low, high });
            }
        }
        Ok(())
    }

    /// Where it is applied.
    fn sites(&self) -> Vec<EffectSite> {
        match (self.effect.target, self.scope) {
            (Target::Joints, scope) => Joint::ALL
                .into_iter()
                .filter(|joint| scope.contains(*joint))
                .map(|joint| EffectSite::Joint(joint.index()))
                .collect(),
            (Target::Bodies, Scope::Joint(joint)) => vec![EffectSite::Joint(joint.index())],
            _ => vec![EffectSite::Global],
        }
    }

    /// True if another entry of the same name replaces this one at `place`.
    fn is_replaced(&self, own: usize, place: EffectSite, entries: &[EffectEntry]) -> bool {
        if self.effect.composition != Composition::Replace {
            return false;
        }
        let rank = |index: usize| (std::cmp::Reverse(entries[index].scope.joints()), index);
        let others = entries.iter().enumerate().filter(|(_, other)| other.effect == self.effect);
        others.filter(|(_, other)| other.sites().contains(&place)).any(|(index, _)| rank(index) > rank(own))
    }
}

/// `robot` with the effects of `entries`: each adds, multiplies or replaces as its [`Composition`] says.
pub fn apply_effects(robot: &RobotModel, entries: &[EffectEntry]) -> Result<RobotModel, EntryError> {
    let mut composed = robot.clone();
    // A body that is replaced altogether is there before anything is added to it.
    let (whole, others): (Vec<_>, Vec<_>) =
        entries.iter().enumerate().partition(|(_, entry)| entry.effect.name == "inertia");
    for (index, entry) in whole.into_iter().chain(others) {
        entry.check()?;
        for place in entry.sites() {
            if !entry.is_replaced(index, place, entries) {
                let (effect, scope) = (entry.effect.name, entry.scope);
                (entry.effect.apply)(&mut composed, place, &entry.values).map_err(|reason| EntryError::Conflict {
                    effect,
                    scope,
                    reason,
                })?;
            }
        }
    }
    match entries.last().zip(check_robot(&composed)) {
        Some((entry, reason)) => Err(EntryError::Conflict { effect: entry.effect.name, scope: entry.scope, reason }),
        None => Ok(composed),
    }
}

/// Why no such robot can be, if so.
fn check_robot(robot: &RobotModel) -> Option<&'static str> {
    for joint in &robot.joints {
        if joint.armature < 0.0 {
            return Some("the armature of a joint adds up to less than zero");
        }
        if joint.armature <= 0.0 && (joint.actuator.backlash > 0.0 || joint.actuator.gear_stiffness.is_finite()) {
            return Some("a rotor behind a gear with play or a spring needs an armature above zero");
        }
    }
    let bodies = robot.legs.iter().flat_map(|leg| &leg.bodies).chain([&robot.trunk]);
    let definite = |body: &crate::RigidBody| {
        let i = &body.inertia;
        let minor = i.x_axis.x * i.y_axis.y - i.x_axis.y * i.y_axis.x;
        body.mass > 0.0 && i.x_axis.x > 0.0 && minor > 0.0 && i.determinant() > 0.0
    };
    (!bodies.into_iter().all(definite)).then_some("a body's mass or inertia is no longer positive")
}
