//! Entries of a model file, and their application to a robot.

use super::{Composition, Effect, EffectSite, LEAST_SUM, Scope, Target};
use twinstep_model::{ActuatorParams, Joint, RigidBody, RobotModel};

/// Effect with its scope and values.
#[derive(Clone, Debug, PartialEq)]
pub struct EffectEntry {
    /// The effect.
    pub effect: &'static Effect,
    /// Joints or part of the robot to which it applies.
    pub scope: Scope,
    /// Values of all parameters, in the order of the effect's parameters.
    pub values: Vec<f64>,
    /// 95 % interval of each value, low and high; `None` if it was not measured.
    pub intervals: Vec<Option<[f64; 2]>>,
}

/// Reason why an entry is not allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EntryError {
    /// The effect cannot have this scope.
    #[error("`{effect}` cannot have scope \"{scope}\"; possible: {possible}")]
    Scope {
        /// The effect.
        effect: &'static str,
        /// The scope.
        scope: Scope,
        /// Allowed scopes.
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
        /// Value of the parameter.
        value: f64,
        /// Lowest allowed value.
        low: f64,
        /// Highest allowed value.
        high: f64,
    },
    /// Entries that apply to the same joint or body cannot be combined.
    #[error("`{effect}` on {scope} conflicts with another entry or the robot: {reason}")]
    Conflict {
        /// The effect.
        effect: &'static str,
        /// The scope.
        scope: Scope,
        /// Reason of the conflict.
        reason: &'static str,
    },
}

impl EffectEntry {
    /// Returns an entry without intervals. `values` are in the order of the effect's parameters.
    ///
    /// # Panics
    /// Panics if the number of values differs from [`Effect::num_values`].
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
            Target::Bodies => (matches!(scope, Scope::Base | Scope::Joint(_)), "base, or a joint for its child link"),
            Target::Imu => (scope == Scope::Base, "base"),
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

    /// Returns the sites at which the entry is applied.
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

    /// Returns true if another entry of the same effect replaces this one at `site`.
    fn is_replaced(&self, own: usize, site: EffectSite, entries: &[EffectEntry]) -> bool {
        if self.effect.composition != Composition::Replace {
            return false;
        }
        let rank = |index: usize| (std::cmp::Reverse(entries[index].scope.joints()), index);
        let others = entries.iter().enumerate().filter(|(_, other)| other.effect == self.effect);
        others.filter(|(_, other)| other.sites().contains(&site)).any(|(index, _)| rank(index) > rank(own))
    }
}

/// Returns `robot` with the effects of `entries`, combined by their [`Composition`].
pub fn apply_effects(robot: &RobotModel, entries: &[EffectEntry]) -> Result<RobotModel, EntryError> {
    let mut composed = robot.clone();
    // An effect that replaces a body is applied before effects that add to the body.
    let (whole, others): (Vec<_>, Vec<_>) =
        entries.iter().enumerate().partition(|(_, entry)| entry.effect.replaces_body());
    for (index, entry) in whole.into_iter().chain(others) {
        entry.check()?;
        for site in entry.sites() {
            if !entry.is_replaced(index, site, entries) {
                let (effect, scope) = (entry.effect.name, entry.scope);
                entry.effect.apply(&mut composed, site, &entry.values).map_err(|reason| EntryError::Conflict {
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

/// Returns why the robot is physically impossible, or `None` if it is possible.
fn check_robot(robot: &RobotModel) -> Option<&'static str> {
    for joint in &robot.joints {
        let ActuatorParams { command_delay, torque_delay, sensor_delay, .. } = joint.actuator;
        if [command_delay, torque_delay, sensor_delay].iter().any(|delay| *delay > ActuatorParams::MAX_DELAY + 1e-9) {
            return Some("the delays of a joint add up to more than 0.04 s");
        }
        let sums = [joint.armature, joint.viscous_friction, joint.coulomb_friction];
        if sums.iter().any(|sum| *sum < LEAST_SUM) {
            return Some("the armature or the friction of a joint adds up to less than zero");
        }
        if joint.armature <= 0.0 && (joint.actuator.backlash > 0.0 || joint.actuator.gear_stiffness.is_finite()) {
            return Some("a joint with backlash or gear elasticity needs an armature above zero");
        }
    }
    let bodies = robot.legs.iter().flat_map(|leg| &leg.bodies).chain([&robot.trunk]);
    (!bodies.into_iter().all(RigidBody::is_physical)).then_some("a body's mass or inertia is no longer positive")
}
