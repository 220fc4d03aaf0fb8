//! The reward terms of the task `walk`, one function each. Weights and signs are in [`crate::RewardWeights`].

use twinstep_model::{NUM_JOINTS, PerJoint, PerLeg};

/// What the reward terms see of one robot after one policy step.
#[derive(Clone, Copy, Debug)]
pub struct RewardInput<'a> {
    /// One period of the policy [s].
    pub policy_dt: f32,
    /// Width of the tracking bells [m²/s², rad²/s²].
    pub tracking_width: f32,
    /// Commanded velocity: forward [m/s], left [m/s], turning left [rad/s].
    pub command: [f32; 3],
    /// Velocity of the base in the base frame [m/s].
    pub linear_velocity: [f32; 3],
    /// Angular velocity of the base in the base frame [rad/s].
    pub angular_velocity: [f32; 3],
    /// Gravity direction in the base frame.
    pub gravity: [f32; 3],
    /// Joint position [rad].
    pub q: &'a PerJoint,
    /// Joint velocity [rad/s].
    pub dq: &'a PerJoint,
    /// Joint velocity one policy step before [rad/s].
    pub previous_dq: &'a PerJoint,
    /// Joint torque [N·m].
    pub tau: &'a PerJoint,
    /// Action of this step, clipped.
    pub action: &'a PerJoint,
    /// Action of the step before, clipped.
    pub previous_action: &'a PerJoint,
    /// The default pose [rad].
    pub default_pose: &'a PerJoint,
    /// Joint range that counts as safe, lower end [rad].
    pub soft_lower: &'a PerJoint,
    /// Joint range that counts as safe, upper end [rad].
    pub soft_upper: &'a PerJoint,
    /// Time in the air of each foot that touched down in this step, 0 for the others [s].
    pub touchdown_air_time: PerLeg,
    /// True if the trunk or a thigh touches the ground.
    pub body_contact: bool,
    /// What is unknown about the drives, mean over the joints [nat].
    pub uncertainty: f32,
}

#[inline]
fn has_motion_command(moment: &RewardInput<'_>) -> bool {
    moment.command.iter().map(|value| value * value).sum::<f32>().sqrt() > 0.1
}

/// `exp(−|v_xy − command_xy|² / width)`, 1 at best.
#[inline]
pub fn track_linear_velocity(moment: &RewardInput<'_>) -> f32 {
    let error = (0..2).map(|axis| (moment.command[axis] - moment.linear_velocity[axis]).powi(2)).sum::<f32>();
    (-error / moment.tracking_width).exp()
}

/// `exp(−(ω_z − command_yaw)² / width)`, 1 at best.
#[inline]
pub fn track_angular_velocity(moment: &RewardInput<'_>) -> f32 {
    (-(moment.command[2] - moment.angular_velocity[2]).powi(2) / moment.tracking_width).exp()
}

/// `v_z²` [m²/s²].
#[inline]
pub fn linear_velocity_z(moment: &RewardInput<'_>) -> f32 {
    moment.linear_velocity[2].powi(2)
}

/// `ω_x² + ω_y²` [rad²/s²].
#[inline]
pub fn angular_velocity_xy(moment: &RewardInput<'_>) -> f32 {
    moment.angular_velocity[0].powi(2) + moment.angular_velocity[1].powi(2)
}

/// Horizontal part of gravity in the base frame, squared.
#[inline]
pub fn orientation(moment: &RewardInput<'_>) -> f32 {
    moment.gravity[0].powi(2) + moment.gravity[1].powi(2)
}

/// Σ τ² [N²·m²].
#[inline]
pub fn torque(moment: &RewardInput<'_>) -> f32 {
    moment.tau.iter().map(|tau| tau * tau).sum()
}

/// Σ (Δdq / dt)² [rad²/s⁴].
#[inline]
pub fn joint_acceleration(moment: &RewardInput<'_>) -> f32 {
    moment.dq.iter().zip(moment.previous_dq).map(|(now, before)| ((now - before) / moment.policy_dt).powi(2)).sum()
}

/// Σ (Δaction)².
#[inline]
pub fn action_rate(moment: &RewardInput<'_>) -> f32 {
    moment.action.iter().zip(moment.previous_action).map(|(now, before)| (now - before).powi(2)).sum()
}

/// Σ of how far joints are outside the safe 90 % of their range [rad].
#[inline]
pub fn joint_position_limits(moment: &RewardInput<'_>) -> f32 {
    let outside =
        |j: usize| (moment.soft_lower[j] - moment.q[j]).max(0.0) + (moment.q[j] - moment.soft_upper[j]).max(0.0);
    (0..NUM_JOINTS).map(outside).sum()
}

/// Σ over feet that touched down of (time in the air − 0.5 s), while told to move [s].
#[inline]
pub fn feet_air_time(moment: &RewardInput<'_>) -> f32 {
    if !has_motion_command(moment) {
        return 0.0;
    }
    moment.touchdown_air_time.iter().filter(|time| **time > 0.0).map(|time| time - 0.5).sum()
}

/// 1 if the trunk or a thigh touches the ground.
#[inline]
pub fn body_contact(moment: &RewardInput<'_>) -> f32 {
    f32::from(u8::from(moment.body_contact))
}

/// Σ |q − q_default| while told to stand [rad].
#[inline]
pub fn stand_still(moment: &RewardInput<'_>) -> f32 {
    if has_motion_command(moment) {
        return 0.0;
    }
    moment.q.iter().zip(moment.default_pose).map(|(q, rest)| (q - rest).abs()).sum()
}

/// What is unknown about the drives, mean over the joints [nat]: U2E's epistemic-uncertainty function (equations 11 and 13).
#[inline]
pub fn uncertainty(moment: &RewardInput<'_>) -> f32 {
    moment.uncertainty
}

#[cfg(test)]
mod tests {
    use super::*;

    const ZERO: PerJoint = [0.0; NUM_JOINTS];

    fn at_rest() -> RewardInput<'static> {
        RewardInput {
            policy_dt: 0.02,
            tracking_width: 0.25,
            command: [0.0; 3],
            linear_velocity: [0.0; 3],
            angular_velocity: [0.0; 3],
            gravity: [0.0, 0.0, -1.0],
            q: &ZERO,
            dq: &ZERO,
            previous_dq: &ZERO,
            tau: &ZERO,
            action: &ZERO,
            previous_action: &ZERO,
            default_pose: &ZERO,
            soft_lower: &[-1.0; NUM_JOINTS],
            soft_upper: &[1.0; NUM_JOINTS],
            touchdown_air_time: [0.0; 4],
            body_contact: false,
            uncertainty: 0.0,
        }
    }

    #[test]
    fn robot_that_does_as_told_gets_the_whole_tracking_reward() {
        let moment = RewardInput { command: [0.5, 0.1, 0.3], linear_velocity: [0.5, 0.1, 9.0], ..at_rest() };
        assert_eq!(track_linear_velocity(&moment), 1.0);
        assert!((track_angular_velocity(&moment) - (-0.09f32 / 0.25).exp()).abs() < 1e-6);
    }

    #[test]
    fn standing_in_the_default_pose_costs_nothing() {
        let terms = crate::RewardWeights::default().evaluate(&at_rest());
        let expected = 0.02 * (1.0 + 0.5);
        assert!((terms.iter().sum::<f32>() - expected).abs() < 1e-6, "{terms:?}");
    }

    #[test]
    fn long_step_pays_only_while_told_to_move() {
        let landed = RewardInput { touchdown_air_time: [0.7, 0.0, 0.0, 0.0], ..at_rest() };
        assert_eq!(feet_air_time(&landed), 0.0);
        assert!((feet_air_time(&RewardInput { command: [1.0, 0.0, 0.0], ..landed }) - 0.2).abs() < 1e-6);
    }

    #[test]
    fn joint_beyond_its_safe_range_costs_the_distance() {
        let mut q = ZERO;
        (q[3], q[7]) = (1.25, -1.5);
        assert!((joint_position_limits(&RewardInput { q: &q, ..at_rest() }) - 0.75).abs() < 1e-6);
    }
}
