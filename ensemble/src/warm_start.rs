//! Initial weights of a training from an earlier ensemble, whose data had other means and standard deviations.

use crate::EnsembleError;
use crate::ensemble::Ensemble;
use crate::metadata::EnsembleMetadata;
use crate::normaliser::{Normaliser, Normalisers};
use crate::weights::{Shape, Weights};

/// Returns weights with which networks of `description` compute what the members of `earlier` compute.
///
/// Means agree up to rounding. Variances agree where the network's output is far below 0, as it is for variances that are small
/// against that of the torque; elsewhere they differ by a factor.
pub fn initial_weights(earlier: &Ensemble, description: &EnsembleMetadata) -> Result<Vec<Weights>, EnsembleError> {
    let old = &earlier.description;
    let differ =
        |what, one: String, other: String| Err(EnsembleError::OtherEnsemble { what, earlier: one, given: other });
    if old.members != description.members {
        return differ("number of members", old.members.to_string(), description.members.to_string());
    }
    if old.hidden != description.hidden {
        return differ("number of hidden units", old.hidden.to_string(), description.hidden.to_string());
    }
    if old.joint_input != description.joint_input {
        let [one, other] = [old.joint_input, description.joint_input].map(|input| format!("{input:?}"));
        return differ("joint input", one, other);
    }
    if (old.input, old.target) != (description.input, description.target) {
        let [one, other] = [old, description].map(|model| format!("{:?}, {:?}", model.input, model.target));
        return differ("input or target", one, other);
    }
    if old.joints != description.joints {
        return differ("joints", old.joints.join(", "), description.joints.join(", "));
    }
    if old.gains != description.gains {
        return differ("gains", format!("{:?}", old.gains), format!("{:?}", description.gains));
    }
    earlier.check_step("the data", description.dt)?;
    let convert = |weights: &Weights| {
        let mut weights = weights.clone();
        rescale(&mut weights, description.shape(), &old.scales, &description.scales, old.variance_scale);
        weights
    };
    Ok(earlier.members.iter().map(convert).collect())
}

/// Changes weights for inputs and outputs that are normalised by `new` instead of `old`.
fn rescale(weights: &mut Weights, shape: Shape, old: &Normalisers, new: &Normalisers, variance_scale: f64) {
    let gates = 4 * shape.hidden;
    let mut shift = vec![0.0; gates];
    let input_weight = weights.get_mut("lstm.input_weight").expect("the layout has it");
    for (row, (from, to)) in input_weight.chunks_exact_mut(gates).zip(old.inputs.iter().zip(&new.inputs)) {
        let (factor, offset) = ((to.std / from.std) as f32, ((to.mean - from.mean) / from.std) as f32);
        for (weight, shift) in row.iter_mut().zip(&mut shift) {
            *shift += offset * *weight;
            *weight *= factor;
        }
    }
    let bias = weights.get_mut("lstm.bias").expect("the layout has it");
    bias.iter_mut().zip(shift).for_each(|(bias, shift)| *bias += shift);
    let (Normaliser { mean: from, std: from_std }, Normaliser { mean: to, std: to_std }) = (old.torque, new.torque);
    let (factor, offset) = ((from_std / to_std) as f32, ((from - to) / to_std) as f32);
    weights.get_mut("mean.weight").expect("the layout has it").iter_mut().for_each(|weight| *weight *= factor);
    weights
        .get_mut("mean.bias")
        .expect("the layout has it")
        .iter_mut()
        .for_each(|bias| *bias = *bias * factor + offset);
    // softplus(x) is about exp(x) far below 0, so that a factor of the variance is an offset of x.
    let log_factor = ((from_std / to_std).powi(2) * variance_scale).ln() as f32;
    weights.get_mut("variance.bias").expect("the layout has it").iter_mut().for_each(|bias| *bias += log_factor);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::tests::log;
    use crate::data::{DataSet, Split};
    use crate::train::{Training, TrainingResult};
    use crate::training_options::TrainingOptions;

    fn options(epochs: usize) -> TrainingOptions {
        TrainingOptions { members: 2, hidden: 8, epochs, seed: 1, ..TrainingOptions::default() }
    }

    fn trained(training: &Training) -> (Ensemble, f64) {
        match training.run(2, None, &mut |_| true).expect("trains") {
            TrainingResult::Trained(ensemble, curves) => (*ensemble, curves[0][0].validation_nll),
            TrainingResult::Interrupted(_) => panic!("the training was interrupted"),
        }
    }

    /// Returns data of the same actuator whose motion is `factor` times as large.
    fn data(factor: f64) -> DataSet {
        let scaled = log(4000, |_, columns| {
            for (name, cells) in columns.iter_mut().filter(|(name, _)| name != "t") {
                let offset = if name.starts_with("q_cmd") { 0.05 } else { 0.0 };
                for cell in cells.iter_mut() {
                    *cell = factor * *cell + offset;
                }
            }
        });
        DataSet::new(&[("here".to_owned(), scaled)]).expect("a set")
    }

    #[test]
    fn networks_with_converted_weights_predict_the_same() {
        let (gentle, violent) = (data(1.0), data(3.0));
        let (earlier, _) = trained(&Training::new(&gentle, options(3)).expect("options"));
        let training = Training::new(&violent, options(1)).expect("options");
        let members = initial_weights(&earlier, &training.description).expect("converted");
        let converted = Ensemble { description: training.description.clone(), members };
        let [one, other] = [&earlier, &converted].map(|ensemble| ensemble.predict(gentle.runs(Split::Test)));
        for (one, other) in one.iter().flatten().flatten().zip(other.iter().flatten().flatten()) {
            assert!((one.mean - other.mean).abs() < 1e-4, "{one:?} {other:?}");
            assert!((one.variance / other.variance).ln().abs() < 0.7, "{one:?} {other:?}");
        }
    }

    #[test]
    fn warm_start_has_a_lower_loss_after_the_first_epoch_and_other_members_are_rejected() {
        let (gentle, violent) = (data(1.0), data(1.5));
        let (earlier, _) = trained(&Training::new(&gentle, options(20)).expect("options"));
        let cold = Training::new(&violent, options(1)).expect("options");
        let mut warm = Training::new(&violent, options(1)).expect("options");
        warm.warm_start(&earlier).expect("the same settings");
        let [cold, warm] = [cold, warm].map(|training| trained(&training).1);
        assert!(warm < cold - 0.2, "{warm} nat, cold {cold} nat");

        let mut other = Training::new(&violent, TrainingOptions { members: 3, ..options(1) }).expect("options");
        let error = other.warm_start(&earlier).expect_err("rejected").to_string();
        assert_eq!(
            error,
            "the earlier ensemble has another number of members (2) than the training (3); a warm start needs the same"
        );
    }
}
