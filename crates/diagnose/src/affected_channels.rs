//! Channels in which a cause must explain the residual.

use std::ops::Range;

use twinstep_effects::Target;
use twinstep_model::Joint;

use super::hypothesis::Hypothesis;
use super::residual_power::{CHANNELS, DYNAMIC, GYRO, GYRO_AT_REST, ResidualPower, STANCE, TORQUE, TRUNK, WRENCH};

/// Fraction of the power above noise that may remain in the channels that a cause affects, after the joint refit.
///
/// A wrong law imitates the true one in part: Coulomb friction explains 57 % of the power of friction that acts in one
/// direction only. True causes leave less than 1 % if robot and model share the code of their laws; in MuJoCo, with actuators
/// of their own, elastic gears left 26 % and backlash of a leg 28 %. With this limit none of twelve such robots with an effect
/// outside the catalogue had a cause.
pub const MAX_REMAINING_FRACTION: f64 = 1.0 / 3.0;
/// Power above noise per row that is negligible [noise variance].
pub const NEGLIGIBLE_EXCESS: f64 = 1.0;
/// Share of the rows with a floating base in which force and moment on it must be known to stand for all of them.
///
/// A robot that walks and pauses has a quarter, in which its feet still move: a payload does not explain them.
const MIN_SHARE_OF_WRENCH: f64 = 0.5;

/// Returns true if a cause leaves at most [`MAX_REMAINING_FRACTION`] of the excess power in the channels that it affects.
///
/// `at_sensor` tells whether it changes the torque at the sensor.
pub fn explains_affected_channels(
    hypothesis: &Hypothesis,
    at_sensor: bool,
    given: &ResidualPower,
    left: &ResidualPower,
) -> bool {
    affected_channels(hypothesis, at_sensor, given).into_iter().all(|channels| {
        let excess = |left: &ResidualPower| channels.iter().map(|channel| left.channel_excess(*channel)).sum::<f64>();
        let rows: f64 = channels.iter().flat_map(|channel| left.counts[*channel]).sum();
        excess(left) <= NEGLIGIBLE_EXCESS * rows || excess(left) <= MAX_REMAINING_FRACTION * excess(given)
    })
}

/// Returns the groups of channels that a cause must explain, each separately.
///
/// For joints, these are the positions with a fixed base, and the torques. If the base never is fixed, positions have the
/// errors of the contact model, too: a cause that the torque sensor shows must explain the torques, another the
/// positions. For the gyroscope, it is that with a fixed base, if there is one. For bodies, the group is force and moment on
/// the base; where they are known in less than [`MIN_SHARE_OF_WRENCH`] of the rows, and for the ground, all motion channels
/// with a floating base; for the ground of a robot that walks or jumps, those of that.
fn affected_channels(hypothesis: &Hypothesis, at_sensor: bool, given: &ResidualPower) -> Vec<Vec<usize>> {
    let rows = |channel: usize| given.counts[channel].iter().sum::<f64>();
    let has = |mut channels: Range<usize>| channels.any(|channel| rows(channel) > 0.0);
    let joints = |first: usize| {
        let all = Joint::ALL.into_iter().filter(|joint| hypothesis.scope.contains(*joint));
        all.map(|joint| first + joint.index()).collect()
    };
    match hypothesis.effect.target {
        Target::Joints if has(0..TORQUE) => vec![joints(0), joints(TORQUE)],
        Target::Joints if at_sensor => vec![joints(TORQUE)],
        Target::Joints => vec![joints(STANCE)],
        Target::Imu if has(GYRO_AT_REST..DYNAMIC) => vec![(GYRO_AT_REST..DYNAMIC).collect()],
        Target::Imu => vec![(GYRO..STANCE).collect()],
        Target::Ground if has(DYNAMIC..CHANNELS) => vec![(DYNAMIC..CHANNELS).collect()],
        Target::Bodies if rows(WRENCH) > MIN_SHARE_OF_WRENCH * rows(STANCE) => vec![(WRENCH..GYRO_AT_REST).collect()],
        Target::Bodies | Target::Ground => vec![(TRUNK..GYRO).chain(STANCE..GYRO_AT_REST).collect()],
        Target::Supply => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, Scope};

    use super::*;

    fn hypothesis(effect: &str, scope: Scope) -> Hypothesis {
        Hypothesis { effect: Effect::named(effect).expect("an effect of the catalogue"), scope, values: Vec::new() }
    }

    /// Returns 100 rows of every channel with this residual power [noise variance].
    fn residual_power(power: impl Fn(usize) -> f64) -> ResidualPower {
        let mut left = ResidualPower::empty();
        for channel in 0..CHANNELS {
            left.sums[channel][0] = 100.0 * power(channel);
            left.counts[channel][0] = 100.0;
        }
        left
    }

    #[test]
    fn cause_must_explain_most_of_the_excess_in_its_channels() {
        let (hip, calf) = (Joint::ALL[0], Joint::ALL[2]);
        let given = residual_power(|channel| if channel == hip.index() { 20.0 } else { 10.0 });
        let only_hip = residual_power(|channel| if channel == hip.index() { 1.0 } else { 9.9 });
        let explains = |effect, scope| explains_affected_channels(&hypothesis(effect, scope), true, &given, &only_hip);
        assert!(!explains("backlash", Scope::Joint(hip)), "the torque of the hip is not explained");
        assert!(!explains("backlash", Scope::Joint(calf)));
        assert!(!explains("com_shift", Scope::Base), "an effect on the base affects all joints");
        assert!(!explains("gyro_bias", Scope::Base));
        let noise = residual_power(|_| 1.0);
        for (effect, scope) in [("backlash", Scope::Joint(hip)), ("com_shift", Scope::Base), ("gyro_bias", Scope::Base)]
        {
            assert!(explains_affected_channels(&hypothesis(effect, scope), true, &given, &noise));
        }
    }

    #[test]
    fn cause_on_the_base_must_explain_force_and_moment_where_they_are_known() {
        let shift = hypothesis("com_shift", Scope::Base);
        let explains =
            |given: &ResidualPower, left: &ResidualPower| explains_affected_channels(&shift, false, given, left);
        let is_wrench = |channel: usize| (WRENCH..GYRO_AT_REST).contains(&channel);
        let given = residual_power(|_| 20.0);
        assert!(explains(&given, &residual_power(|channel| if is_wrench(channel) { 1.0 } else { 20.0 })));
        assert!(!explains(&given, &residual_power(|channel| if is_wrench(channel) { 20.0 } else { 1.0 })));
        let unknown = |mut left: ResidualPower| {
            left.counts[WRENCH..GYRO_AT_REST].fill([0.0; 2]);
            left.sums[WRENCH..GYRO_AT_REST].fill([0.0; 2]);
            left
        };
        assert!(!explains(&unknown(given), &unknown(residual_power(|_| 19.0))), "positions are not explained");
    }

    /// A robot that walks pauses at times. What its feet do then is not what its payload does to its steps.
    #[test]
    fn cause_on_the_base_must_explain_the_motion_if_the_robot_seldom_stands() {
        let payload = hypothesis("payload", Scope::Base);
        let is_wrench = |channel: usize| (WRENCH..GYRO_AT_REST).contains(&channel);
        let standing = |share: f64, power: [f64; 2]| {
            let mut left = residual_power(|channel| power[usize::from(is_wrench(channel))]);
            for channel in WRENCH..GYRO_AT_REST {
                left.sums[channel][0] *= share;
                left.counts[channel][0] *= share;
            }
            left
        };
        let explains = |share: f64, left: [f64; 2]| {
            explains_affected_channels(&payload, false, &standing(share, [20.0, 20.0]), &standing(share, left))
        };
        let (motion, wrench) = ([1.0, 20.0], [20.0, 1.0]);
        assert!(explains(0.25, motion) && !explains(0.25, wrench));
        assert!(!explains(1.0, motion) && explains(1.0, wrench));
    }

    /// Contact adds to the position error of every joint. A delay is seen in the torques, friction in the positions.
    #[test]
    fn cause_of_a_robot_that_never_hangs_must_explain_the_channel_that_shows_it() {
        let scope = Scope::Joint(Joint::ALL[2]);
        let floating = |power: [f64; 2]| {
            let mut left = residual_power(|channel| if channel >= STANCE { power[0] } else { power[1] });
            left.counts[..TORQUE].fill([0.0; 2]);
            left.sums[..TORQUE].fill([0.0; 2]);
            left
        };
        let [given, torque_explained, position_explained] = [[5.0, 13.0], [5.0, 1.0], [1.0, 13.0]].map(floating);
        let explains =
            |effect, at_sensor, left| explains_affected_channels(&hypothesis(effect, scope), at_sensor, &given, left);
        assert!(explains("torque_delay", true, &torque_explained));
        assert!(!explains("torque_delay", true, &position_explained));
        assert!(explains("coulomb_friction", false, &position_explained));
        assert!(!explains("coulomb_friction", false, &torque_explained));
    }
}
