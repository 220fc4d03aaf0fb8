//! Reward terms, one function each. Weights and signs are in the file of a task.

use crate::feet::FootState;

/// Terms that depend on the ground truth of a simulator. A task on a real robot has no such term.
pub const NEED_GROUND_TRUTH: [&str; 8] = [
    "track_linear_velocity",
    "linear_velocity_z",
    "base_height",
    "feet_air_time",
    "feet_clearance",
    "feet_slip",
    "undesired_contact",
    "epistemic_uncertainty",
];

/// Defines the weights of a task's reward terms: `name = default weight`, in the order of every per-term array.
///
/// A weight is per second: a term adds `weight · value · policy_dt` to the reward of a step. The name of a field is
/// that of its function, of its key in a config file and of its log entry. The module that uses the macro imports the
/// functions and their `RewardInput` as `terms`.
macro_rules! reward_weights {
    ($($(#[$doc:meta])* $name:ident = $weight:expr),+ $(,)?) => {
        /// Weights of the reward terms, per second: a term adds `weight · value · policy_dt` to the reward of a step.
        ///
        /// The name of a field is that of its function, of its key and of its log entry.
        #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct RewardWeights { $($(#[$doc])* pub $name: f32),+ }

        impl Default for RewardWeights {
            fn default() -> Self { Self { $($name: $weight),+ } }
        }

        impl RewardWeights {
            /// Names of the terms, in the order of every per-term array.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($name)),+];

            /// Returns the value of each weighted term, in the order of [`RewardWeights::NAMES`].
            pub fn evaluate(&self, input: &terms::RewardInput<'_>) -> [f32; Self::NAMES.len()] {
                [$(self.$name * terms::$name(input) * input.policy_dt),+]
            }

            /// Returns all weights times `factor`.
            pub fn scaled(&self, factor: f32) -> Self {
                Self { $($name: factor * self.$name),+ }
            }

            pub(crate) fn values(&self) -> impl Iterator<Item = (&'static str, f32)> {
                [$((stringify!($name), self.$name)),+].into_iter()
            }
        }
    };
}
pub(crate) use reward_weights;

/// State of one robot after one policy step, from which the reward terms are computed.
#[derive(Clone, Copy, Debug)]
pub struct RewardInput<'a> {
    /// One period of the policy [s].
    pub policy_dt: f32,
    /// Width σ of the tracking rewards [m²/s², rad²/s²].
    pub tracking_sigma: f32,
    /// Commanded velocity: forward [m/s], left [m/s], yaw rate [rad/s].
    pub command: [f32; 3],
    /// Velocity of the base in the base frame [m/s].
    pub linear_velocity: [f32; 3],
    /// Angular velocity of the base in the base frame [rad/s].
    pub angular_velocity: [f32; 3],
    /// Unit vector of gravity in the base frame.
    pub gravity: [f32; 3],
    /// Joint position [rad].
    pub q: &'a [f32],
    /// Joint velocity [rad/s].
    pub dq: &'a [f32],
    /// Joint velocity of the previous policy step [rad/s].
    pub previous_dq: &'a [f32],
    /// Joint torque [N·m].
    pub tau: &'a [f32],
    /// Weight times standing height relative to that of the Go2, by which torques are divided.
    pub torque_scale: f32,
    /// Action of this step, clipped.
    pub action: &'a [f32],
    /// Action of the previous step, clipped.
    pub previous_action: &'a [f32],
    /// The default pose [rad].
    pub default_pose: &'a [f32],
    /// Lower soft limit of the joint positions [rad].
    pub soft_lower: &'a [f32],
    /// Upper soft limit of the joint positions [rad].
    pub soft_upper: &'a [f32],
    /// Indices of the hips.
    pub hips: &'a [usize],
    /// Air time of each foot that touched down in this step, 0 for the others [s].
    pub touchdown_air_time: &'a [f32],
    /// Duration of a swing phase above which [`feet_air_time`] is positive [s].
    pub target_air_time: f32,
    /// True for each foot on the ground.
    pub foot_contact: &'a [bool],
    /// Motion of each foot; none without ground truth.
    pub feet: &'a [FootState],
    /// Height of swinging feet without a penalty [m].
    pub target_foot_height: f32,
    /// Height of the base above the ground under it [m].
    pub base_height: f32,
    /// Height of the base without a penalty [m].
    pub target_base_height: f32,
    /// True if the episode ends in this step, other than by the time limit.
    pub is_terminated: bool,
    /// True if the trunk or a thigh touches the ground.
    pub body_contact: bool,
    /// Epistemic uncertainty of the actuators, mean over the joints [nat].
    pub uncertainty: f32,
}

#[inline]
fn has_motion_command(input: &RewardInput<'_>) -> bool {
    input.command.iter().map(|value| value * value).sum::<f32>().sqrt() > 0.1
}

/// Returns `exp(−|v_xy − command_xy|² / σ)`, 1 without an error.
#[inline]
pub fn track_linear_velocity(input: &RewardInput<'_>) -> f32 {
    let error = (0..2).map(|axis| (input.command[axis] - input.linear_velocity[axis]).powi(2)).sum::<f32>();
    (-error / input.tracking_sigma).exp()
}

/// Returns `exp(−(ω_z − command_yaw)² / σ)`, 1 without an error.
#[inline]
pub fn track_angular_velocity(input: &RewardInput<'_>) -> f32 {
    (-(input.command[2] - input.angular_velocity[2]).powi(2) / input.tracking_sigma).exp()
}

/// Returns `v_z²` [m²/s²].
#[inline]
pub fn linear_velocity_z(input: &RewardInput<'_>) -> f32 {
    input.linear_velocity[2].powi(2)
}

/// Returns `ω_x² + ω_y²` [rad²/s²].
#[inline]
pub fn angular_velocity_xy(input: &RewardInput<'_>) -> f32 {
    input.angular_velocity[0].powi(2) + input.angular_velocity[1].powi(2)
}

/// Returns `g_x² + g_y²` of the gravity vector in the base frame, the squared sine of the tilt.
#[inline]
pub fn flat_orientation(input: &RewardInput<'_>) -> f32 {
    input.gravity[0].powi(2) + input.gravity[1].powi(2)
}

/// Returns Σ τ² over the joints, of torques that are divided by the weight times the standing height relative to the Go2 [N²·m²].
#[inline]
pub fn joint_torque(input: &RewardInput<'_>) -> f32 {
    input.tau.iter().map(|tau| tau * tau).sum::<f32>() / (input.torque_scale * input.torque_scale)
}

/// Returns Σ (Δdq / dt)² over the joints [rad²/s⁴].
#[inline]
pub fn joint_acceleration(input: &RewardInput<'_>) -> f32 {
    input.dq.iter().zip(input.previous_dq).map(|(now, previous)| ((now - previous) / input.policy_dt).powi(2)).sum()
}

/// Returns Σ (Δaction)².
#[inline]
pub fn action_rate(input: &RewardInput<'_>) -> f32 {
    input.action.iter().zip(input.previous_action).map(|(now, previous)| (now - previous).powi(2)).sum()
}

/// Returns Σ of the distance of each joint beyond its soft limits, the central 90 % of its range [rad].
#[inline]
pub fn joint_position_limits(input: &RewardInput<'_>) -> f32 {
    let outside = |j: usize| (input.soft_lower[j] - input.q[j]).max(0.0) + (input.q[j] - input.soft_upper[j]).max(0.0);
    (0..input.q.len()).map(outside).sum()
}

/// Returns Σ (air time − target) over the feet that touched down, or 0 if the velocity command is below 0.1 [s].
#[inline]
pub fn feet_air_time(input: &RewardInput<'_>) -> f32 {
    if !has_motion_command(input) {
        return 0.0;
    }
    input.touchdown_air_time.iter().filter(|time| **time > 0.0).map(|time| time - input.target_air_time).sum()
}

/// Returns Σ |height − target| · √speed over the feet, or 0 if the velocity command is below 0.1 [m^1.5/s^0.5].
///
/// The speed is horizontal, so that only swinging feet count.
#[inline]
pub fn feet_clearance(input: &RewardInput<'_>) -> f32 {
    if !has_motion_command(input) {
        return 0.0;
    }
    let clearance = |foot: &FootState| (foot.height - input.target_foot_height).abs() * foot.horizontal_speed.sqrt();
    input.feet.iter().map(clearance).sum()
}

/// Returns Σ of the squared horizontal speeds of the feet on the ground [m²/s²].
#[inline]
pub fn feet_slip(input: &RewardInput<'_>) -> f32 {
    let feet = input.feet.iter().map(|foot| foot.horizontal_speed).zip(input.foot_contact);
    feet.map(|(speed, contact)| if *contact { speed * speed } else { 0.0 }).sum()
}

/// Returns `(height − target)²` of the base above the ground [m²].
#[inline]
pub fn base_height(input: &RewardInput<'_>) -> f32 {
    (input.base_height - input.target_base_height).powi(2)
}

/// Returns Σ (q − q_default)² over the hips [rad²].
#[inline]
pub fn hip_deviation(input: &RewardInput<'_>) -> f32 {
    input.hips.iter().map(|hip| (input.q[*hip] - input.default_pose[*hip]).powi(2)).sum()
}

/// Returns `1 / policy_dt` if the episode ends in this step other than by the time limit, else 0 [1/s].
#[inline]
pub fn termination(input: &RewardInput<'_>) -> f32 {
    if input.is_terminated { 1.0 / input.policy_dt } else { 0.0 }
}

/// Returns 1 if the trunk or a thigh touches the ground, else 0.
#[inline]
pub fn undesired_contact(input: &RewardInput<'_>) -> f32 {
    f32::from(u8::from(input.body_contact))
}

/// Returns Σ |q − q_default| if the velocity command is below 0.1, else 0 [rad].
#[inline]
pub fn stand_still(input: &RewardInput<'_>) -> f32 {
    if has_motion_command(input) {
        return 0.0;
    }
    input.q.iter().zip(input.default_pose).map(|(q, default)| (q - default).abs()).sum()
}

/// Returns the epistemic uncertainty of the actuators, mean over the joints [nat].
///
/// U2E's epistemic-uncertainty function, eqs. 11 and 13.
#[inline]
pub fn epistemic_uncertainty(input: &RewardInput<'_>) -> f32 {
    input.uncertainty
}

#[cfg(test)]
mod tests {
    use super::*;

    const ZERO: [f32; 12] = [0.0; 12];
    const STANDS: FootState = FootState { height: 0.022, horizontal_speed: 0.0, vertical_velocity: 0.0 };

    fn at_rest() -> RewardInput<'static> {
        RewardInput {
            policy_dt: 0.02,
            tracking_sigma: 0.25,
            command: [0.0; 3],
            linear_velocity: [0.0; 3],
            angular_velocity: [0.0; 3],
            gravity: [0.0, 0.0, -1.0],
            q: &ZERO,
            dq: &ZERO,
            previous_dq: &ZERO,
            tau: &ZERO,
            torque_scale: 1.0,
            action: &ZERO,
            previous_action: &ZERO,
            default_pose: &ZERO,
            soft_lower: &[-1.0; 12],
            soft_upper: &[1.0; 12],
            hips: &[0, 3, 6, 9],
            touchdown_air_time: &[0.0; 4],
            target_air_time: 0.1,
            foot_contact: &[true; 4],
            feet: &[STANDS; 4],
            target_foot_height: 0.08,
            base_height: 0.3,
            target_base_height: 0.3,
            is_terminated: false,
            body_contact: false,
            uncertainty: 0.0,
        }
    }

    #[test]
    fn perfect_tracking_has_reward_one() {
        let input = RewardInput { command: [0.5, 0.1, 0.3], linear_velocity: [0.5, 0.1, 9.0], ..at_rest() };
        assert_eq!(track_linear_velocity(&input), 1.0);
        assert!((track_angular_velocity(&input) - (-0.09f32 / 0.25).exp()).abs() < 1e-6);
    }

    #[test]
    fn standing_in_the_default_pose_has_no_penalty() {
        let terms = crate::tasks::walk_config::RewardWeights::default().evaluate(&at_rest());
        let expected = 0.02 * (2.0 + 1.0);
        assert!((terms.iter().sum::<f32>() - expected).abs() < 1e-6, "{terms:?}");
    }

    #[test]
    fn long_swing_phase_is_rewarded_only_with_a_velocity_command() {
        let landed = RewardInput { touchdown_air_time: &[0.3, 0.0, 0.0, 0.0], ..at_rest() };
        assert_eq!(feet_air_time(&landed), 0.0);
        assert!((feet_air_time(&RewardInput { command: [1.0, 0.0, 0.0], ..landed }) - 0.2).abs() < 1e-6);
    }

    #[test]
    fn only_feet_on_the_ground_slip_and_only_moving_feet_need_clearance() {
        let feet = [0.5, 0.0, 0.0, 2.0].map(|horizontal_speed| FootState { horizontal_speed, ..STANDS });
        let moving = RewardInput { command: [1.0, 0.0, 0.0], feet: &feet, ..at_rest() };
        assert_eq!(feet_slip(&RewardInput { foot_contact: &[true, true, true, false], ..moving }), 0.25);
        let expected = 0.058 * (0.5f32.sqrt() + 2f32.sqrt());
        assert!((feet_clearance(&moving) - expected).abs() < 1e-6);
        let high = feet.map(|foot| FootState { height: 0.08, ..foot });
        assert_eq!(feet_clearance(&RewardInput { feet: &high, ..moving }), 0.0);
        assert_eq!(feet_clearance(&RewardInput { command: [0.0; 3], ..moving }), 0.0);
    }

    #[test]
    fn weight_of_a_fall_does_not_depend_on_the_policy_period() {
        let fallen = RewardInput { is_terminated: true, ..at_rest() };
        let index = crate::tasks::walk_config::RewardWeights::NAMES.iter().position(|name| *name == "termination");
        let term = crate::tasks::walk_config::RewardWeights::default().evaluate(&fallen)[index.expect("a term")];
        assert!((term + 5.0).abs() < 1e-6, "{term}");
    }

    #[test]
    fn penalty_of_a_joint_beyond_its_soft_limit_is_the_distance() {
        let mut q = ZERO;
        (q[3], q[7]) = (1.25, -1.5);
        assert!((joint_position_limits(&RewardInput { q: &q, ..at_rest() }) - 0.75).abs() < 1e-6);
    }
}
