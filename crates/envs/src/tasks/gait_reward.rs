//! Reward terms of the task `gait`, one function each: tracking of the contact schedule (Walk These Ways).

use twinstep_model::PerLeg;

/// Feet of one robot after one policy step, from which the terms are computed.
#[derive(Clone, Copy, Debug)]
pub struct RewardInput<'a> {
    /// One period of the policy [s].
    pub policy_dt: f32,
    /// Probability with which each foot is to be on the ground.
    pub desired_contact: PerLeg,
    /// Normal force on each foot [N].
    pub foot_force: &'a [f32],
    /// Speed of each foot [m/s].
    pub foot_speed: PerLeg,
    /// Height of each foot's centre above the ground under it [m].
    pub foot_height: PerLeg,
    /// Height that each foot's centre is to have [m].
    pub target_foot_height: PerLeg,
    /// Width σ of [`contact_force`] [N²].
    pub force_sigma: f32,
    /// Width σ of [`contact_velocity`] [m²/s²].
    pub velocity_sigma: f32,
}

/// Mean over the feet of `weight(foot) · value(foot)`.
fn mean(weight: impl Fn(usize) -> f32, value: impl Fn(usize) -> f32) -> f32 {
    (0..4).map(|leg| weight(leg) * value(leg)).sum::<f32>() / 4.0
}

/// Returns the mean of `(1 − desired contact) · exp(−force² / σ)` over the feet: swinging feet carry nothing.
///
/// That of Walk These Ways is this minus the mean of `1 − desired contact`, which does not depend on the robot.
pub fn contact_force(input: &RewardInput<'_>) -> f32 {
    mean(|leg| 1.0 - input.desired_contact[leg], |leg| (-input.foot_force[leg].powi(2) / input.force_sigma).exp())
}

/// Returns the mean of `desired contact · exp(−speed² / σ)` over the feet: feet on the ground do not move.
///
/// That of Walk These Ways is this minus the mean of the desired contact, which does not depend on the robot.
pub fn contact_velocity(input: &RewardInput<'_>) -> f32 {
    mean(|leg| input.desired_contact[leg], |leg| (-input.foot_speed[leg].powi(2) / input.velocity_sigma).exp())
}

/// Returns Σ `(1 − desired contact) · (height − target)²` over the feet [m²].
pub fn swing_height(input: &RewardInput<'_>) -> f32 {
    4.0 * mean(
        |leg| 1.0 - input.desired_contact[leg],
        |leg| (input.foot_height[leg] - input.target_foot_height[leg]).powi(2),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const TROT: RewardInput<'_> = RewardInput {
        policy_dt: 0.02,
        desired_contact: [1.0, 0.0, 0.0, 1.0],
        foot_force: &[75.0, 0.0, 0.0, 75.0],
        foot_speed: [0.0, 1.5, 1.5, 0.0],
        foot_height: [0.022, 0.1, 0.1, 0.022],
        target_foot_height: [0.022, 0.1, 0.1, 0.022],
        force_sigma: 100.0,
        velocity_sigma: 1.0,
    };

    #[test]
    fn robot_that_follows_the_schedule_has_the_full_terms() {
        assert_eq!((contact_force(&TROT), contact_velocity(&TROT), swing_height(&TROT)), (0.5, 0.5, 0.0));
    }

    #[test]
    fn loaded_swing_feet_moving_stance_feet_and_low_swing_feet_cost() {
        // The other diagonal pair is on the ground.
        let swapped = RewardInput { desired_contact: [0.0, 1.0, 1.0, 0.0], ..TROT };
        assert!(contact_force(&swapped) < 1e-6 && (contact_velocity(&swapped) - 0.5 * (-2.25f32).exp()).abs() < 1e-6);
        let low = RewardInput { foot_height: [0.022, 0.05, 0.1, 0.3], ..TROT };
        assert!((swing_height(&low) - 0.05f32.powi(2)).abs() < 1e-6, "only feet in the swing phase count");
    }
}
