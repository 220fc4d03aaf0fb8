//! Reward terms of the task `jump`, one function each: U2E, Table II, and those that densify the reward.

use twinstep_model::{Joint, JointKind, Leg, PerLeg};

use super::jump_flight::Stage;

/// Distance from the target within which a landing is a success [m].
const SUCCESS_DISTANCE: f32 = 0.05;
/// Yaw error within which a landing is a success [rad].
const SUCCESS_YAW: f32 = 0.2;
/// Width of the terms of landing and its prediction [m].
const LANDING_WIDTH: f32 = 0.15;
/// Width of the term of the prediction before the take-off [m].
const TAKEOFF_WIDTH: f32 = 0.5;
/// Distance that counts like an error of the yaw of 1 rad [m].
const YAW_WEIGHT: f32 = 0.3;

/// Distance and angle between two poses on the ground.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LandingError {
    /// Distance [m].
    pub distance: f32,
    /// Angle, without sign [rad].
    pub yaw: f32,
}

impl LandingError {
    fn total(self) -> f32 {
        self.distance + YAW_WEIGHT * self.yaw
    }
}

/// State of one robot after one policy step, from which the terms are computed.
#[derive(Clone, Copy, Debug)]
pub struct RewardInput<'a> {
    /// One period of the policy [s].
    pub policy_dt: f32,
    /// Stage of the jump.
    pub stage: Stage,
    /// True before the phase has reached the time for the take-off.
    pub may_take_off: bool,
    /// True if the robot has landed in this step.
    pub lands: bool,
    /// Error of the landing: predicted from the motion until the robot has landed.
    pub landing_error: LandingError,
    /// Horizontal velocity of the base minus that of a take-off to the target [m/s].
    pub takeoff_error_xy: f32,
    /// Vertical velocity of the base minus that of a take-off to the target [m/s].
    pub takeoff_error_z: f32,
    /// Yaw rate of the base minus that of a take-off to the target [rad/s].
    pub takeoff_error_yaw: f32,
    /// Height of each foot relative to the base, in the base frame [m].
    pub foot_z: PerLeg,
    /// Height of the feet in flight relative to the base [m].
    pub target_foot_z: f32,
    /// Joint position [rad].
    pub q: &'a [f32],
    /// Joint position of the default pose [rad].
    pub default_pose: &'a [f32],
    /// Horizontal speed of the base [m/s].
    pub speed: f32,
}

fn indicator(condition: bool) -> f32 {
    f32::from(u8::from(condition))
}

/// Returns `exp(−error / width)` (U2E, Table III).
fn rho(error: f32, width: f32) -> f32 {
    (-error / width).exp()
}

/// Returns `exp(−error / 0.15 m) / policy_dt` in the step of the landing, else 0 [1/s]: the weight is per landing.
pub fn landing_position(input: &RewardInput<'_>) -> f32 {
    indicator(input.lands) * rho(input.landing_error.total(), LANDING_WIDTH) / input.policy_dt
}

/// Returns `1 / policy_dt` in the step of a landing within 5 cm and 0.2 rad of the target, else 0 [1/s].
pub fn success(input: &RewardInput<'_>) -> f32 {
    let LandingError { distance, yaw } = input.landing_error;
    indicator(input.lands && distance < SUCCESS_DISTANCE && yaw < SUCCESS_YAW) / input.policy_dt
}

/// Returns 1 in flight, else 0.
pub fn in_air(input: &RewardInput<'_>) -> f32 {
    indicator(input.stage == Stage::Flight)
}

/// Returns `exp(−|Δv_xy| / 1 m/s)` before the take-off, else 0.
pub fn takeoff_velocity_xy(input: &RewardInput<'_>) -> f32 {
    indicator(input.may_take_off) * rho(input.takeoff_error_xy.abs(), 1.0)
}

/// Returns `exp(−|Δv_z| / 2.5 m/s)` before the take-off, else 0.
pub fn takeoff_velocity_z(input: &RewardInput<'_>) -> f32 {
    indicator(input.may_take_off) * rho(input.takeoff_error_z.abs(), 2.5)
}

/// Returns `exp(−Σ|z − target| / 0.75 m)` of the feet in flight, else 0.
pub fn feet_relative_z(input: &RewardInput<'_>) -> f32 {
    let error = input.foot_z.iter().map(|z| (z - input.target_foot_z).abs()).sum();
    in_air(input) * rho(error, 0.75)
}

/// Returns the norm of the difference between the left legs and the mirrored right legs [rad].
pub fn symmetry(input: &RewardInput<'_>) -> f32 {
    let q = |leg: Leg, kind: JointKind| input.q[Joint { leg, kind }.index()];
    let difference = |left: Leg, right: Leg| {
        let hip = q(left, JointKind::Hip) + q(right, JointKind::Hip);
        let others = [JointKind::Thigh, JointKind::Calf].map(|kind| q(left, kind) - q(right, kind));
        hip * hip + others.iter().map(|other| other * other).sum::<f32>()
    };
    (difference(Leg::FL, Leg::FR) + difference(Leg::RL, Leg::RR)).sqrt()
}

/// Returns `exp(−|Δω_z| / 3 rad/s)` before the take-off, else 0.
pub fn takeoff_yaw_rate(input: &RewardInput<'_>) -> f32 {
    indicator(input.may_take_off) * rho(input.takeoff_error_yaw.abs(), 3.0)
}

/// Returns `exp(−error / 0.5 m)` of the predicted landing before the take-off, else 0.
pub fn takeoff_prediction(input: &RewardInput<'_>) -> f32 {
    indicator(input.may_take_off) * rho(input.landing_error.total(), TAKEOFF_WIDTH)
}

/// Returns `exp(−error / 0.15 m)` of the predicted landing in flight and of the actual one after it, else 0.
///
/// The landing is predicted as that of a projectile, which rewards every step of the flight for its end.
pub fn landing_prediction(input: &RewardInput<'_>) -> f32 {
    indicator(input.stage != Stage::BeforeTakeOff) * rho(input.landing_error.total(), LANDING_WIDTH)
}

/// Returns `exp(−|q − q_default| − speed / 0.5 m/s)` after the landing times the term of its error, else 0.
pub fn recovery(input: &RewardInput<'_>) -> f32 {
    let offset = input.q.iter().zip(input.default_pose).map(|(q, default)| (q - default).powi(2)).sum::<f32>().sqrt();
    let accuracy = rho(input.landing_error.total(), LANDING_WIDTH);
    indicator(input.stage == Stage::Landed) * rho(offset + 2.0 * input.speed, 1.0) * accuracy
}

#[cfg(test)]
mod tests {
    use super::*;

    const ZERO: [f32; 12] = [0.0; 12];

    fn input() -> RewardInput<'static> {
        RewardInput {
            policy_dt: 0.02,
            stage: Stage::BeforeTakeOff,
            may_take_off: true,
            lands: false,
            landing_error: LandingError { distance: 0.3, yaw: 0.5 },
            takeoff_error_xy: -0.5,
            takeoff_error_z: -1.0,
            takeoff_error_yaw: 1.5,
            foot_z: [-0.3, -0.2, -0.2, -0.15],
            target_foot_z: -0.2,
            q: &ZERO,
            default_pose: &ZERO,
            speed: 0.25,
        }
    }

    fn close(value: f32, expected: f32) -> bool {
        (value - expected).abs() < 1e-6
    }

    #[test]
    fn terms_of_the_take_off_end_with_it() {
        let before = input();
        let terms = [takeoff_velocity_xy, takeoff_velocity_z, takeoff_yaw_rate, takeoff_prediction];
        // 0.3 m and 0.5 rad at 0.3 m/rad are 0.45 m.
        for (term, exponent) in terms.iter().zip([-0.5f32, -0.4, -0.5, -0.9]) {
            assert!(close(term(&before), exponent.exp()), "{exponent}");
            assert_eq!(term(&RewardInput { may_take_off: false, ..before }), 0.0);
        }
        assert_eq!(
            [in_air(&before), landing_prediction(&before), feet_relative_z(&before), recovery(&before)],
            [0.0; 4]
        );
    }

    #[test]
    fn flight_and_landing_are_rewarded_by_their_error() {
        let flight = RewardInput { stage: Stage::Flight, may_take_off: false, ..input() };
        assert!(close(landing_prediction(&flight), (-0.45f32 / 0.15).exp()) && in_air(&flight) == 1.0);
        assert!(close(feet_relative_z(&flight), (-0.15f32 / 0.75).exp()));
        let near = LandingError { distance: 0.04, yaw: 0.1 };
        let landing = RewardInput { stage: Stage::Landed, lands: true, landing_error: near, ..flight };
        assert!(close(landing_position(&landing) * 0.02, (-0.07f32 / 0.15).exp()) && success(&landing) == 50.0);
        let turned = LandingError { distance: 0.04, yaw: 0.25 };
        assert_eq!(success(&RewardInput { landing_error: turned, ..landing }), 0.0);
        assert!(close(recovery(&landing), (-0.5f32 - 0.07 / 0.15).exp()));
    }

    #[test]
    fn only_differences_between_left_and_right_are_asymmetric() {
        let mut q = ZERO;
        // Both hips outward, both thighs forward.
        (q[0], q[3], q[1], q[4]) = (0.2, -0.2, 0.5, 0.5);
        assert_eq!(symmetry(&RewardInput { q: &q, ..input() }), 0.0);
        (q[3], q[8]) = (0.1, 0.4);
        assert!(close(symmetry(&RewardInput { q: &q, ..input() }), 0.5));
    }
}
