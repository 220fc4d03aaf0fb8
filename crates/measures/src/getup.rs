//! How fast fallen robots stand, of a policy of the task `getup`.

use serde::Serialize;
use twinstep_envs::GetupConfig;
use twinstep_model::{EnvError, EnvSpec, frames};

use crate::{Measure, MeasureError, Step};

/// Simulated time from the start in any orientation [s].
pub const GETUP_S: f64 = 5.0;
/// Time within which a robot is to stand [s].
const WITHIN_S: f64 = 3.0;
/// Largest tilt of a robot that stands [rad], and its least height relative to that of the default pose.
const MAX_TILT: f32 = 0.3;
const MIN_HEIGHT: f64 = 0.8;

/// Times after which robots stand.
#[derive(Debug, Serialize)]
pub struct GettingUpTimes {
    /// Share of the robots that stand within 3 s, and from then to the end.
    pub within_3_s: f64,
    /// Share of the robots that stand at the end.
    pub at_end: f64,
    /// Median of the times after which those stand that do at the end; NaN if none does [s].
    pub median_s: f64,
    /// Greatest of these times; NaN if none stands at the end [s].
    pub longest_s: f64,
}

/// Measures since when each robot stands.
///
/// It stands while the drawn base tilts by at most 0.3 rad, and the base's height in the critic's observation is at least 80 %
/// of that in the default pose. A robot whose simulation diverges never stands.
pub struct GettingUp {
    policy_dt: f64,
    critic_len: usize,
    height: usize,
    min_height: f64,
    /// Step at the end of which each robot began to stand without a break.
    stands_since: Vec<Option<usize>>,
}

impl GettingUp {
    /// Prepares the measure of environments of the task `getup`, for robots whose base has this height in the default pose [m].
    pub fn new(spec: &EnvSpec, robots: usize, standing_height: f64) -> Result<Self, MeasureError> {
        let (height, _) = spec.critic_field("base_height").ok_or(MeasureError::Missing("base_height"))?;
        Ok(Self {
            policy_dt: spec.policy_dt,
            critic_len: spec.critic_obs_len(),
            height,
            min_height: MIN_HEIGHT * standing_height,
            stands_since: vec![None; robots],
        })
    }

    /// Returns the settings of the task: no robot starts upright, and the episode outlasts the measure.
    pub fn task() -> GetupConfig {
        GetupConfig { upright_probability: 0.0, max_episode_s: 1e6, ..GetupConfig::default() }
    }
}

impl Measure for GettingUp {
    type Found = GettingUpTimes;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        for robot in step.robots() {
            let [_, _, _, qw, qx, qy, qz] = step.scene(robot)?.pose[0];
            let cos_tilt = -frames::projected_gravity([qw, qx, qy, qz]).z;
            let height = f64::from(step.batch.critic_obs[robot * self.critic_len + self.height]);
            let stands = cos_tilt >= MAX_TILT.cos() && height >= self.min_height;
            let since = &mut self.stands_since[robot];
            *since = if stands { since.or(Some(step.index + 1)) } else { None };
        }
        Ok(())
    }

    fn found(self, has_fallen: &[bool]) -> GettingUpTimes {
        let since = self.stands_since.iter().zip(has_fallen).filter(|(_, diverged)| !**diverged);
        let mut times: Vec<f64> = since.filter_map(|(since, _)| Some((*since)? as f64 * self.policy_dt)).collect();
        times.sort_by(f64::total_cmp);
        let share = |count: usize| count as f64 / has_fallen.len() as f64;
        let nan = f64::NAN;
        GettingUpTimes {
            within_3_s: share(times.partition_point(|time| *time <= WITHIN_S + 1e-9)),
            at_end: share(times.len()),
            median_s: times.get(times.len() / 2).copied().unwrap_or(nan),
            longest_s: times.last().copied().unwrap_or(nan),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn robot_that_stands_late_or_not_at_the_end_or_diverges_does_not_count_as_fast() {
        let stands_since = vec![Some(50), Some(150), Some(151), None, Some(10)];
        let measure = GettingUp { policy_dt: 0.02, critic_len: 0, height: 0, min_height: 0.0, stands_since };
        let found = measure.found(&[false, false, false, false, true]);
        assert_eq!((found.within_3_s, found.at_end), (0.4, 0.6));
        assert!((found.median_s - 3.0).abs() < 1e-9 && (found.longest_s - 3.02).abs() < 1e-9, "{found:?}");
    }
}
