//! Domain randomisation: robots sampled from the intervals of a model file.

use super::{EffectEntry, apply_effects};
use crate::{Effect, ModelFile, TreeModelFile};
use twinstep_model::{RobotModel, Stream, TreeModel, standard_normal, stream};

/// Number of samples that estimate the fraction of valid robots.
const TRIALS: usize = 100;
/// Half width of the central 95 % interval of a normal distribution [standard deviations].
const CENTRAL: f64 = 1.96;

/// Samples robots from the intervals of a model file.
///
/// A value with an interval is normally distributed with that interval as its central 95 %, clipped to the parameter's
/// bounds; friction and armature are clipped at zero, or at a stated value below it. Values without an interval are constant. All values are independent. Samples that are not valid robots are
/// rejected, for example if delays add up to more than [`twinstep_model::ActuatorParams::MAX_DELAY`] or a mass is not
/// positive.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotSampler<F = ModelFile>(F);

/// Model file with intervals.
pub trait SampledFile {
    /// What the file describes.
    type Robot;

    /// Samples a robot. Fails with the reason if it is not valid.
    fn attempt(&self, random: &mut Stream) -> Result<Self::Robot, String>;
}

/// Less than half of the samples are valid robots.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "only {possible} of {tried} samples from the intervals of the model file are valid robots; at least half must be \
     valid. One is not: {cause}. Make the intervals narrower"
)]
pub struct SamplingError {
    /// Number of samples.
    pub tried: usize,
    /// Number of samples that are valid robots.
    pub possible: usize,
    /// Reason why the first of the others is not valid.
    pub cause: String,
}

impl<F: SampledFile> RobotSampler<F> {
    /// Creates the sampler of a model file. Fails if more than half of 100 samples are not valid robots.
    pub fn new(file: F) -> Result<Self, SamplingError> {
        let this = Self(file);
        let mut trials = stream(0, "trial draws", 0);
        let causes: Vec<_> = (0..TRIALS).filter_map(|_| this.0.attempt(&mut trials).err()).collect();
        match causes.first() {
            Some(cause) if 2 * causes.len() > TRIALS => {
                Err(SamplingError { tried: TRIALS, possible: TRIALS - causes.len(), cause: cause.clone() })
            }
            _ => Ok(this),
        }
    }

    /// Samples a robot.
    pub fn sample(&self, random: &mut Stream) -> F::Robot {
        // Terminates quickly: `new` checked that about half of all samples are valid.
        loop {
            if let Ok(robot) = self.0.attempt(random) {
                return robot;
            }
        }
    }
}

impl SampledFile for ModelFile {
    type Robot = RobotModel;

    fn attempt(&self, random: &mut Stream) -> Result<RobotModel, String> {
        let sampled = |entry: &EffectEntry| EffectEntry {
            values: sampled(entry.effect, &entry.values, &entry.intervals, random),
            ..entry.clone()
        };
        let effects: Vec<_> = self.effects.iter().map(sampled).collect();
        apply_effects(&self.nominal.model, &effects).map_err(|error| error.to_string())
    }
}

impl SampledFile for TreeModelFile {
    type Robot = TreeModel;

    fn attempt(&self, random: &mut Stream) -> Result<TreeModel, String> {
        let mut file = self.clone();
        for entry in &mut file.effects {
            entry.values = sampled(entry.effect, &entry.values, &entry.intervals, random);
        }
        file.tree_model()
    }
}

/// Returns the values of an effect, those with an interval sampled from it.
fn sampled(effect: &Effect, values: &[f64], intervals: &[Option<[f64; 2]>], random: &mut Stream) -> Vec<f64> {
    let parameters = effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one, one.count));
    let mut values = values.to_vec();
    for ((value, interval), parameter) in values.iter_mut().zip(intervals).zip(parameters) {
        if let Some([low, high]) = interval {
            let [mut least, most] = parameter.bounds;
            if effect.is_of_sum() {
                // What the file takes away is possible, more may not be.
                least = least.max(value.min(0.0));
            }
            let std = (high - low) / (2.0 * CENTRAL);
            *value = (0.5 * (low + high) + std * standard_normal(random)).clamp(least, most);
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;
    use twinstep_model::{ActuatorParams, go2};

    fn draws(effects: &str) -> Result<RobotSampler, SamplingError> {
        RobotSampler::new(ModelFile::parse(&format!("robot = \"go2\"\n{effects}"), "robot.toml").expect("valid"))
    }

    fn effect(text: &str) -> String {
        format!("[[effect]]\n{}\n", text.replace("; ", "\n"))
    }

    #[test]
    fn interval_contains_95_percent_of_the_samples_and_is_centred_on_their_mean() {
        let friction =
            "name = \"coulomb_friction\"; scope = \"calf\"; torque_nm = 0.5; interval = { torque_nm = [0.4, 0.8] }";
        let (draws, mut random) = (draws(&effect(friction)).expect("robots"), stream(1, "draws", 0));
        let robots: Vec<_> = (0..4000).map(|_| draws.sample(&mut random)).collect();
        let drawn: Vec<f64> = robots.iter().map(|robot| robot.joints[2].coulomb_friction).collect();
        let inside = drawn.iter().filter(|torque| (0.4..0.8).contains(*torque)).count();
        // Four standard deviations of the count: 4 sqrt(4000 · 0.95 · 0.05) = 55.
        assert!(inside.abs_diff(3800) < 55, "{inside} of 4000");
        let mean = drawn.iter().sum::<f64>() / 4000.0;
        assert!((mean - 0.6).abs() < 0.007, "{mean} N·m");
        // One value per entry, and no friction at other joints.
        assert!(robots.iter().all(|robot| robot.joints[2].coulomb_friction == robot.joints[11].coulomb_friction));
        assert!(robots.iter().all(|robot| robot.joints[0] == go2().joints[0]));
    }

    #[test]
    fn component_without_an_interval_is_constant_and_samples_respect_the_bounds() {
        let load = "name = \"payload\"; scope = \"base\"; mass_kg = 0.0; position_m = [0.1, 0.0, 0.2]";
        let shift = "name = \"com_shift\"; scope = \"base\"; shift_m = [0.3, 0.0, 0.02]; \
                     interval = { shift_m = [[0.2, -inf, 0.01], [0.4, inf, 0.03]] }";
        let (draws, mut random) = (draws(&(effect(load) + &effect(shift))).expect("robots"), stream(1, "draws", 0));
        let nominal = go2().trunk.com;
        let shifts: Vec<_> = (0..200).map(|_| draws.sample(&mut random).trunk.com - nominal).collect();
        assert!(shifts.iter().all(|shift| shift.x <= 0.3 + 1e-12 && shift.y == 0.0), "{shifts:?}");
        assert!(shifts.iter().any(|shift| (shift.x - 0.3).abs() < 1e-12) && shifts.iter().any(|shift| shift.x < 0.25));
    }

    #[test]
    fn model_without_intervals_returns_its_robot_and_draws_no_random_numbers() {
        let friction = "name = \"coulomb_friction\"; scope = \"all\"; torque_nm = 0.5";
        let (draws, mut random) = (draws(&effect(friction)).expect("robots"), stream(1, "draws", 0));
        assert_eq!(draws.sample(&mut random), draws.0.robot_model().expect("no conflict"));
        assert_eq!(random, stream(1, "draws", 0));
    }

    /// Entries of two delays that add up at the hips.
    fn delays(high: f64) -> String {
        let of = |scope: &str| format!("name = \"command_delay\"; scope = \"{scope}\"; delay_s = 0.01");
        let interval = format!("; interval = {{ delay_s = [0.0, {high}] }}");
        effect(&(of("all") + &interval)) + &effect(&(of("hip") + &interval))
    }

    #[test]
    fn invalid_robots_are_rejected() {
        // The mean of each delay is 0.015 s: their sum sometimes exceeds 0.04 s.
        let (draws, mut random) = (draws(&delays(0.03)).expect("robots"), stream(1, "draws", 0));
        assert!((0..200).any(|_| draws.0.attempt(&mut random).is_err()));
        for _ in 0..200 {
            assert!(draws.sample(&mut random).joints[0].actuator.command_delay <= ActuatorParams::MAX_DELAY);
        }
    }

    #[test]
    fn intervals_with_few_valid_robots_are_rejected_with_the_reason() {
        let error = draws(&delays(0.06)).expect_err("refused");
        expect![[
            "only 19 of 100 samples from the intervals of the model file are valid robots; at least half must be \
                  valid. One is not: `command_delay` on hip conflicts with another entry or the robot: the delays of a joint add \
                  up to more than 0.04 s. Make the intervals narrower"
        ]]
        .assert_eq(&error.to_string());
    }
}
