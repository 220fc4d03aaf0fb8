//! The numbers that are sought: of entries of a model file, with bounds and prior.

use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, Scope};
use twinstep_effects::ModelFile;
use twinstep_model::RobotModel;

/// Prior deviations of log-Cholesky coordinates `[α, d1, d2, d3, s12, s23, s13, t1, t2, t3]` around the given body: mass
/// to 30 %, extents to a third, centre of mass to 5 cm.
const INERTIA_PRIOR: [f64; 10] = [0.15, 0.3, 0.3, 0.3, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05];

/// A number of an entry of a model file.
#[derive(Clone, Debug, PartialEq)]
pub struct FreeParameter {
    /// The effect.
    pub effect: &'static Effect,
    /// What it is about.
    pub scope: Scope,
    /// The parameter; of a vector its index after a dot, as in `shift_m.0`.
    pub parameter_name: String,
    /// Its unit.
    pub unit: &'static str,
    /// What is allowed.
    pub bounds: [f64; 2],
    /// What changes nothing.
    pub neutral: f64,
    /// Prior mean and standard deviation, in the coordinate of [`FreeParameter::coordinate`].
    pub prior: [f64; 2],
    /// Sought as its inverse, because none of it is infinity.
    inverse: bool,
    /// Which entry of the candidate's file, and which of its values.
    place: (usize, usize),
}

impl FreeParameter {
    /// The number as the search sees it: itself, or its inverse.
    pub fn coordinate(&self, value: f64) -> f64 {
        if self.inverse { 1.0 / value } else { value }
    }

    /// Back from [`FreeParameter::coordinate`], within the bounds.
    pub fn value(&self, coordinate: f64) -> f64 {
        let [low, high] = self.bounds;
        let value = if self.inverse { 1.0 / coordinate.max(1e-12) } else { coordinate };
        value.clamp(low, high)
    }

    /// The bounds of the coordinate.
    pub fn coordinate_bounds(&self) -> [f64; 2] {
        let [low, high] = self.bounds;
        if self.inverse { [1.0 / high, 1.0 / low] } else { [low, high] }
    }

    /// Its name for people, as in `coulomb_friction@calf torque_nm`.
    pub fn name(&self) -> String {
        format!("{}@{} {}", self.effect.name, self.scope, self.parameter_name)
    }
}

/// The numbers of `effects`, to be sought on top of `model`; and the model with an entry for each.
///
/// An effect that replaces takes the place of the model's entry of the same scope; others are added to what is there.
pub fn free_parameters(
    model: &ModelFile,
    effects: &[(&'static Effect, Scope)],
) -> Result<(ModelFile, Vec<FreeParameter>), EntryError> {
    let (mut file, mut unknowns) = (model.clone(), Vec::new());
    for (effect, scope) in effects {
        let start: Vec<f64> = effect
            .parameters
            .iter()
            .flat_map(|parameter| {
                // Where there is none of it, or next to none.
                let value = if parameter.no_effect_value.is_finite() { parameter.no_effect_value } else { parameter.bounds[1] };
                std::iter::repeat_n(value, parameter.count)
            })
            .collect();
        let own = file.effects.iter().rfind(|entry| entry.effect == *effect && entry.scope == *scope);
        let start = match own {
            Some(entry) if effect.composition == Composition::Replace => entry.values.clone(),
            _ if effect.name == "inertia" => nominal_inertia(model, *scope)?,
            _ => start,
        };
        if effect.composition == Composition::Replace {
            file.effects.retain(|entry| entry.effect != *effect || entry.scope != *scope);
        }
        file.effects.push(EffectEntry::new(effect, *scope, start.clone())?);
        let index = file.effects.len() - 1;
        let mut place = 0;
        for parameter in effect.parameters {
            for component in 0..parameter.count {
                let inverse = parameter.no_effect_value.is_infinite();
                let [low, high] = parameter.prior_range.map(|value| if inverse { 1.0 / value } else { value });
                let (low, high) = if inverse { (0.0, low) } else { (low, high) };
                let inertia = effect.name == "inertia";
                let middle = if inertia { start[place] } else { 0.5 * (low + high) };
                let deviation = if inertia { INERTIA_PRIOR[place] } else { (high - low).abs() / 3.92 };
                unknowns.push(FreeParameter {
                    effect,
                    scope: *scope,
                    parameter_name: if parameter.count == 1 {
                        parameter.name.to_owned()
                    } else {
                        format!("{}.{component}", parameter.name)
                    },
                    unit: parameter.unit,
                    bounds: parameter.bounds,
                    neutral: parameter.no_effect_value,
                    prior: [middle, deviation],
                    inverse,
                    place: (index, place),
                });
                place += 1;
            }
        }
    }
    Ok((file, unknowns))
}

/// Log-Cholesky coordinates of the link that the model has.
fn nominal_inertia(model: &ModelFile, scope: Scope) -> Result<Vec<f64>, EntryError> {
    let robot = model.robot_model()?;
    let body = match scope {
        Scope::Joint(joint) => robot.legs[joint.leg as usize].bodies[joint.kind as usize],
        _ => robot.trunk,
    };
    Ok(body.log_cholesky().to_vec())
}

/// The candidate's file with these coordinates, each brought within its bounds.
pub fn with_values(file: &ModelFile, unknowns: &[FreeParameter], coordinates: &[f64]) -> ModelFile {
    let mut file = file.clone();
    for (unknown, coordinate) in unknowns.iter().zip(coordinates) {
        let (entry, value) = unknown.place;
        file.effects[entry].values[value] = unknown.value(*coordinate);
    }
    file
}

/// The candidate robot; none where entries do not go together or a body could not be.
pub fn candidate(file: &ModelFile, unknowns: &[FreeParameter], coordinates: &[f64]) -> Option<RobotModel> {
    with_values(file, unknowns, coordinates).robot_model().ok()
}

/// Where an unknown starts [coordinate].
pub fn initial_coordinate(file: &ModelFile, unknown: &FreeParameter) -> f64 {
    let (entry, value) = unknown.place;
    unknown.coordinate(file.effects[entry].values[value])
}

/// Takes entries out of the file that were added to `model` and of which nothing was found; `told` says of each unknown
/// whether it was.
pub fn drop_unidentifiable(file: &mut ModelFile, model: &ModelFile, unknowns: &[FreeParameter], told: &[bool]) {
    let about = |index: usize| unknowns.iter().zip(told).filter(move |(unknown, _)| unknown.place.0 == index);
    let mut index = 0;
    file.effects.retain(|entry| {
        let untold = about(index).count() > 0 && about(index).all(|(_, told)| !told);
        let replaced = entry.effect.composition == Composition::Replace;
        let own = replaced && model.effects.iter().any(|own| own.effect == entry.effect && own.scope == entry.scope);
        index += 1;
        !untold || own
    });
}

/// Writes intervals, low and high, beside the values of the unknowns.
pub fn set_intervals(file: &mut ModelFile, unknowns: &[FreeParameter], intervals: &[Option<[f64; 2]>]) {
    for (unknown, interval) in unknowns.iter().zip(intervals) {
        let (entry, value) = unknown.place;
        file.effects[entry].intervals[value] = *interval;
    }
}
