//! Free parameters: values of entries of a model file that are estimated, with bounds and prior.

use twinstep_effects::ModelFile;
use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, Scope};
use twinstep_model::{Joint, RobotModel};

/// Prior standard deviations of log-Cholesky coordinates `[α, d1, d2, d3, s12, s23, s13, t1, t2, t3]`.
///
/// They are relative to the nominal body: 30 % of the mass, a third of the extents, 5 cm of the centre of mass.
const INERTIA_PRIOR: [f64; 10] = [0.15, 0.3, 0.3, 0.3, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05];

/// Value of an entry of a model file that is estimated.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeParameter {
    /// The effect.
    pub effect: &'static Effect,
    /// The scope of the effect.
    pub scope: Scope,
    /// Name of the parameter; for a vector with the component's index, as in `shift_m.0`.
    pub parameter_name: String,
    /// Unit; empty if dimensionless.
    pub unit: &'static str,
    /// Lowest and highest allowed value.
    pub bounds: [f64; 2],
    /// Value without any effect.
    pub neutral: f64,
    /// Prior mean and standard deviation, in the coordinate of [`FreeParameter::coordinate`].
    pub prior: [f64; 2],
    /// True if the coordinate is the inverse of the value, because the value without effect is infinite.
    inverse: bool,
    /// Index of the entry in the candidate's file, and of the value in the entry.
    location: (usize, usize),
}

impl FreeParameter {
    /// Returns the coordinate of a value in the search space: the value, or its inverse.
    pub fn coordinate(&self, value: f64) -> f64 {
        if self.inverse { 1.0 / value } else { value }
    }

    /// Returns the value of a coordinate, clipped to the bounds.
    pub fn value(&self, coordinate: f64) -> f64 {
        let [low, high] = self.bounds;
        let value = if self.inverse { 1.0 / coordinate.max(1e-12) } else { coordinate };
        value.clamp(low, high)
    }

    /// Returns the bounds of the coordinate.
    pub fn coordinate_bounds(&self) -> [f64; 2] {
        let [low, high] = self.bounds;
        if self.inverse { [1.0 / high, 1.0 / low] } else { [low, high] }
    }

    /// Returns the name for display, as in `coulomb_friction@calf torque_nm`.
    pub fn name(&self) -> String {
        format!("{}@{} {}", self.effect.name, self.scope, self.parameter_name)
    }
}

/// Returns `model` with an entry for each of `effects`, and the free parameters of these entries.
///
/// An effect whose composition is to replace overrides the model's entry of the same scope. Other effects are added to
/// the existing entries.
pub fn free_parameters(
    model: &ModelFile,
    effects: &[(&'static Effect, Scope)],
) -> Result<(ModelFile, Vec<FreeParameter>), EntryError> {
    let (mut file, mut unknowns) = (model.clone(), Vec::new());
    let robot = model.robot_model()?;
    // Before an entry is added, so that the index of each stays valid.
    let is_replaced = |entry: &EffectEntry| {
        entry.effect.composition == Composition::Replace && effects.contains(&(entry.effect, entry.scope))
    };
    file.effects.retain(|entry| !is_replaced(entry));
    for (effect, scope) in effects {
        let start: Vec<f64> = effect
            .parameters
            .iter()
            .flat_map(|parameter| {
                // The value without effect, or, if that is infinite, the bound with the least effect.
                let value =
                    if parameter.no_effect_value.is_finite() { parameter.no_effect_value } else { parameter.bounds[1] };
                std::iter::repeat_n(value, parameter.count)
            })
            .collect();
        let own = model.effects.iter().rfind(|entry| entry.effect == *effect && entry.scope == *scope);
        let start = match own {
            Some(entry) if effect.composition == Composition::Replace => entry.values.clone(),
            _ if effect.replaces_body() => nominal_inertia(model, *scope)?,
            _ => start,
        };
        file.effects.push(EffectEntry::new(effect, *scope, start.clone())?);
        let index = file.effects.len() - 1;
        let mut component_index = 0;
        for parameter in effect.parameters {
            for component in 0..parameter.count {
                let inverse = parameter.no_effect_value.is_infinite();
                let [low, high] = parameter.prior_range.map(|value| if inverse { 1.0 / value } else { value });
                let (low, high) = if inverse { (0.0, low) } else { (low, high) };
                let [mut least, most] = parameter.bounds;
                if effect.is_of_sum() {
                    // No joint has less than nothing.
                    let joints = Joint::ALL.into_iter().filter(|joint| scope.contains(*joint));
                    let amounts = joints.map(|joint| effect.amount(&robot.joints[joint.index()]));
                    least = least.max(-amounts.fold(f64::INFINITY, f64::min));
                }
                let inertia = effect.replaces_body();
                let mean = if inertia { start[component_index] } else { 0.5 * (low + high) };
                let std = if inertia { INERTIA_PRIOR[component_index] } else { (high - low).abs() / 3.92 };
                unknowns.push(FreeParameter {
                    effect,
                    scope: *scope,
                    parameter_name: if parameter.count == 1 {
                        parameter.name.to_owned()
                    } else {
                        format!("{}.{component}", parameter.name)
                    },
                    unit: parameter.unit,
                    bounds: [least, most],
                    neutral: parameter.no_effect_value,
                    prior: [mean, std],
                    inverse,
                    location: (index, component_index),
                });
                component_index += 1;
            }
        }
    }
    Ok((file, unknowns))
}

/// Returns the log-Cholesky coordinates of the model's body.
fn nominal_inertia(model: &ModelFile, scope: Scope) -> Result<Vec<f64>, EntryError> {
    let robot = model.robot_model()?;
    let body = match scope {
        Scope::Joint(joint) => robot.legs[joint.leg as usize].bodies[joint.kind as usize],
        _ => robot.trunk,
    };
    Ok(body.log_cholesky().to_vec())
}

/// Returns the file with the values of these coordinates, clipped to their bounds.
pub fn with_values(file: &ModelFile, unknowns: &[FreeParameter], coordinates: &[f64]) -> ModelFile {
    let mut file = file.clone();
    for (unknown, coordinate) in unknowns.iter().zip(coordinates) {
        let (entry, value) = unknown.location;
        file.effects[entry].values[value] = unknown.value(*coordinate);
    }
    file
}

/// Returns the candidate robot. Returns `None` if entries conflict or a body is not physically consistent.
pub fn candidate(file: &ModelFile, unknowns: &[FreeParameter], coordinates: &[f64]) -> Option<RobotModel> {
    with_values(file, unknowns, coordinates).robot_model().ok()
}

/// Returns the initial coordinate of a free parameter: that of its value in the file.
pub fn initial_coordinate(file: &ModelFile, unknown: &FreeParameter) -> f64 {
    let (entry, value) = unknown.location;
    unknown.coordinate(file.effects[entry].values[value])
}

/// Returns the coordinate of a free parameter in the last entry of its effect at its scope. Returns `None` without one.
pub fn coordinate_in(model: &ModelFile, unknown: &FreeParameter) -> Option<f64> {
    let own = |entry: &&EffectEntry| entry.effect == unknown.effect && entry.scope == unknown.scope;
    let entry = model.effects.iter().rfind(own)?;
    let [low, high] = unknown.coordinate_bounds();
    Some(unknown.coordinate(entry.values[unknown.location.1]).clamp(low, high))
}

/// Removes entries from the file that were added to `model` and have no identifiable parameter.
///
/// `identifiable` has one entry per free parameter.
pub fn drop_unidentifiable(file: &mut ModelFile, model: &ModelFile, unknowns: &[FreeParameter], identifiable: &[bool]) {
    let of_entry =
        |index: usize| unknowns.iter().zip(identifiable).filter(move |(unknown, _)| unknown.location.0 == index);
    let mut index = 0;
    file.effects.retain(|entry| {
        let unidentifiable = of_entry(index).count() > 0 && of_entry(index).all(|(_, identifiable)| !identifiable);
        let replaced = entry.effect.composition == Composition::Replace;
        let own = replaced && model.effects.iter().any(|own| own.effect == entry.effect && own.scope == entry.scope);
        index += 1;
        !unidentifiable || own
    });
}

/// Writes the intervals of the free parameters, low and high, to their entries.
pub fn set_intervals(file: &mut ModelFile, unknowns: &[FreeParameter], intervals: &[Option<[f64; 2]>]) {
    for (unknown, interval) in unknowns.iter().zip(intervals) {
        let (entry, value) = unknown.location;
        file.effects[entry].intervals[value] = *interval;
    }
}
