//! Parameters that are sought, and what a log tells about them.

use nalgebra::DMatrix;
use twinstep_effects::{Composition, Effect, EffectEntry, EntryError, ModelFile, Scope};
use twinstep_identify::least_squares::{Differences, LeastSquaresProblem};
use twinstep_identify::{
    Experiment, ExperimentError, FreeParameter, WindowConfig, free_parameters, initial_coordinate,
    predicted_information,
};
use twinstep_logs::Log;
use twinstep_model::{Precision, RobotModel, Rollout};

/// Parameters of effects that are sought.
pub struct Unknowns {
    file: ModelFile,
    parameters: Vec<FreeParameter>,
    /// Coordinates at which the information is computed.
    point: Vec<f64>,
    robot: RobotModel,
}

/// The information of a log cannot be computed.
#[derive(Debug, thiserror::Error)]
pub enum InformationError {
    /// An effect cannot have its scope, or the model is not valid.
    #[error(transparent)]
    Effect(#[from] EntryError),
    /// The log cannot be simulated.
    #[error(transparent)]
    Experiment(#[from] ExperimentError),
}

impl Unknowns {
    /// Prepares the parameters of `effects` on top of `model`.
    ///
    /// An effect that the model has, and that a new entry replaces, is linearised at its value; others at the mean of
    /// their prior, where they act.
    pub fn new(model: &ModelFile, effects: &[(&'static Effect, Scope)]) -> Result<Self, EntryError> {
        let (file, parameters) = free_parameters(model, effects)?;
        let is_known = |parameter: &FreeParameter| {
            let own = |entry: &EffectEntry| entry.effect == parameter.effect && entry.scope == parameter.scope;
            parameter.effect.composition == Composition::Replace && model.effects.iter().any(own)
        };
        let coordinate = |parameter: &FreeParameter| {
            if is_known(parameter) { initial_coordinate(&file, parameter) } else { parameter.prior[0] }
        };
        let point = parameters.iter().map(coordinate).collect();
        Ok(Self { robot: model.robot_model()?, file, parameters, point })
    }

    /// Returns the parameters.
    pub fn parameters(&self) -> &[FreeParameter] {
        &self.parameters
    }

    /// Returns the Fisher information of `log` and of the prior [1/prior std²].
    ///
    /// A search compares many logs by one-sided differences, at half of the cost of central ones. Returns `None` if a
    /// simulation diverges.
    pub fn information(
        &self,
        log: &Log,
        differences: Differences,
        simulator: &mut dyn Rollout,
    ) -> Result<Option<DMatrix<f64>>, InformationError> {
        let experiment = Experiment::new(log, &self.robot, WindowConfig::IDENTIFICATION)?;
        let problem = LeastSquaresProblem {
            file: &self.file,
            unknowns: &self.parameters,
            experiments: &[experiment],
            residual_scale: &[],
            tolerances: None,
            precision: Precision::Single,
        };
        Ok(predicted_information(&problem, differences, simulator, &self.point))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_effect_is_linearised_at_its_value_and_an_unknown_one_at_the_prior_mean() {
        let effect = Effect::named("torque_saturation").expect("an effect of the catalogue");
        let scope: Scope = "calf".parse().expect("a scope");
        let unknown = Unknowns::new(&ModelFile::default(), &[(effect, scope)]).expect("a valid effect");
        assert_eq!(unknown.point, [unknown.parameters[0].prior[0]]);
        let entry = EffectEntry::new(effect, scope, vec![22.0]).expect("a valid entry");
        let model = ModelFile { effects: vec![entry], ..ModelFile::default() };
        let known = Unknowns::new(&model, &[(effect, scope)]).expect("a valid effect");
        assert_eq!(known.point, [known.parameters[0].coordinate(22.0)]);
    }
}
