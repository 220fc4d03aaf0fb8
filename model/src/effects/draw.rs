//! Domain randomisation: robots drawn from the intervals of a model file.

use super::{EffectEntry, EntryError};
use crate::{ModelFile, RobotModel, Stream, standard_normal, stream};

/// Draws that are tried to see whether the intervals are of any robots.
const TRIALS: usize = 100;
/// Standard deviations from the middle of a normal's central 95 % to either end.
const CENTRAL: f64 = 1.96;

/// Robots that differ as far as the intervals of a model file allow.
///
/// A value with an interval is normal with that interval as its central 95 %, clipped to the parameter's bounds; the
/// others are as the file has them. Values are independent of each other. What is no robot, because delays add up to
/// more than a drive remembers or a mass is not positive, is drawn again.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotSampler(ModelFile);

/// Most of what the intervals allow is no robot.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "of {tried} robots drawn from the intervals of the model file only {possible} can be, at least half must: {cause}; \
     make the intervals narrower"
)]
pub struct SamplingError {
    /// Robots drawn.
    pub tried: usize,
    /// Those that can be.
    pub possible: usize,
    /// Why one of the others cannot.
    pub cause: EntryError,
}

impl RobotSampler {
    /// The robots of `file`; fails if more than half of all draws are none.
    pub fn new(file: ModelFile) -> Result<Self, SamplingError> {
        let this = Self(file);
        let mut trials = stream(0, "trial draws", 0);
        let causes: Vec<_> = (0..TRIALS).filter_map(|_| this.attempt(&mut trials).err()).collect();
        match causes.first() {
            Some(cause) if 2 * causes.len() > TRIALS => {
                Err(SamplingError { tried: TRIALS, possible: TRIALS - causes.len(), cause: cause.clone() })
            }
            _ => Ok(this),
        }
    }

    /// One of the robots.
    pub fn sample(&self, random: &mut Stream) -> RobotModel {
        // Ends soon: `new` has seen that about every second draw is a robot.
        loop {
            if let Ok(robot) = self.attempt(random) {
                return robot;
            }
        }
    }

    fn attempt(&self, random: &mut Stream) -> Result<RobotModel, EntryError> {
        let effects = self.0.effects.iter().map(|entry| entry.drawn(random)).collect();
        ModelFile { robot: self.0.robot.clone(), effects, actuator: None }.robot_model()
    }
}

impl EffectEntry {
    fn drawn(&self, random: &mut Stream) -> EffectEntry {
        let mut drawn = self.clone();
        let parameters = self.effect.parameters.iter().flat_map(|one| std::iter::repeat_n(one, one.count));
        for ((value, interval), parameter) in drawn.values.iter_mut().zip(&self.intervals).zip(parameters) {
            if let Some([low, high]) = interval {
                let [least, most] = parameter.bounds;
                let deviation = (high - low) / (2.0 * CENTRAL);
                *value = (0.5 * (low + high) + deviation * standard_normal(random)).clamp(least, most);
            }
        }
        drawn
    }
}

#[cfg(test)]
mod tests {
    use expect_test::expect;

    use super::*;
    use crate::{ActuatorParams, go2};

    fn draws(effects: &str) -> Result<RobotSampler, SamplingError> {
        RobotSampler::new(ModelFile::parse(&format!("robot = \"go2\"\n{effects}"), "robot.toml").expect("valid"))
    }

    fn effect(text: &str) -> String {
        format!("[[effect]]\n{}\n", text.replace("; ", "\n"))
    }

    #[test]
    fn ninety_five_of_a_hundred_draws_lie_in_the_interval_around_its_middle() {
        let friction =
            "name = \"coulomb_friction\"; scope = \"calf\"; torque_nm = 0.5; interval = { torque_nm = [0.4, 0.8] }";
        let (draws, mut random) = (draws(&effect(friction)).expect("robots"), stream(1, "draws", 0));
        let robots: Vec<_> = (0..4000).map(|_| draws.sample(&mut random)).collect();
        let drawn: Vec<f64> = robots.iter().map(|robot| robot.joints[2].coulomb_friction).collect();
        let inside = drawn.iter().filter(|torque| (0.4..0.8).contains(*torque)).count();
        // Four deviations of 4000 draws: 55 of 3800.
        assert!(inside.abs_diff(3800) < 55, "{inside} of 4000");
        let mean = drawn.iter().sum::<f64>() / 4000.0;
        assert!((mean - 0.6).abs() < 0.007, "{mean} N·m");
        // One value an entry, and no other joint has any.
        assert!(robots.iter().all(|robot| robot.joints[2].coulomb_friction == robot.joints[11].coulomb_friction));
        assert!(robots.iter().all(|robot| robot.joints[0] == go2().joints[0]));
    }

    #[test]
    fn component_without_an_interval_stays_and_draws_do_not_leave_the_bounds() {
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
    fn model_without_intervals_gives_its_own_robot_and_takes_no_random_numbers() {
        let friction = "name = \"coulomb_friction\"; scope = \"all\"; torque_nm = 0.5";
        let (draws, mut random) = (draws(&effect(friction)).expect("robots"), stream(1, "draws", 0));
        assert_eq!(draws.sample(&mut random), draws.0.robot_model().expect("no conflict"));
        assert_eq!(random, stream(1, "draws", 0));
    }

    /// Two delays that add up at the hips.
    fn delays(high: f64) -> String {
        let of = |scope: &str| format!("name = \"command_delay\"; scope = \"{scope}\"; delay_s = 0.01");
        let interval = format!("; interval = {{ delay_s = [0.0, {high}] }}");
        effect(&(of("all") + &interval)) + &effect(&(of("hip") + &interval))
    }

    #[test]
    fn what_is_no_robot_is_drawn_again() {
        // Each is 0.015 s in the middle: they add up to more than 0.04 s now and then.
        let (draws, mut random) = (draws(&delays(0.03)).expect("robots"), stream(1, "draws", 0));
        assert!((0..200).any(|_| draws.attempt(&mut random).is_err()));
        for _ in 0..200 {
            assert!(draws.sample(&mut random).joints[0].actuator.command_delay <= ActuatorParams::MAX_DELAY);
        }
    }

    #[test]
    fn intervals_that_are_of_hardly_any_robot_are_refused_with_the_reason() {
        let error = draws(&delays(0.06)).expect_err("refused");
        expect![["of 100 robots drawn from the intervals of the model file only 19 can be, at least half must: \
                  `command_delay` on hip does not go with another entry: the delays of a joint add up to more than \
                  0.04 s; make the intervals narrower"]]
        .assert_eq(&error.to_string());
    }
}
