//! Errors of roll, pitch and height, of a policy of the task `attitude`.

use serde::Serialize;
use twinstep_envs::{AttitudeConfig, WalkConfig, roll_and_pitch};
use twinstep_model::{EnvError, EnvSpec};

use crate::{Measure, MeasureError, Step, share_up};

/// Errors of the base from its reference.
#[derive(Debug, Serialize)]
pub struct AttitudeErrors {
    /// Share of the robots that did not fall.
    pub up: f64,
    /// Mean over time and robots of |Δroll| + |Δpitch| [rad].
    pub l_attitude: f64,
    /// Root mean square error of the roll angle [rad].
    pub roll_rms: f64,
    /// Root mean square error of the pitch angle [rad].
    pub pitch_rms: f64,
    /// Root mean square error of the height above the ground [m].
    pub height_rms: f64,
}

/// Measures the attitude of the base.
///
/// Roll and pitch are those of the drawn robot, the height is that of the critic's observation, the reference that of the
/// observation before each step.
pub struct AttitudeFollowing {
    obs_len: usize,
    critic_len: usize,
    command: usize,
    height: usize,
    sums: [f64; 4],
    count: f64,
}

impl AttitudeFollowing {
    /// Prepares the measure of environments of the task `attitude`.
    pub fn new(spec: &EnvSpec) -> Result<Self, MeasureError> {
        let (command, _) =
            spec.observation_field("attitude_command").ok_or(MeasureError::Missing("attitude_command"))?;
        let (height, _) = spec.critic_field("base_height").ok_or(MeasureError::Missing("base_height"))?;
        let (obs_len, critic_len) = (spec.obs_len(), spec.critic_obs_len());
        Ok(Self { obs_len, critic_len, command, height, sums: [0.0; 4], count: 0.0 })
    }

    /// Returns the settings of the task. Episodes end by falls only.
    pub fn task() -> AttitudeConfig {
        let default = AttitudeConfig::default();
        AttitudeConfig { walk: WalkConfig { max_episode_s: 1e6, ..default.walk }, ..default }
    }
}

impl Measure for AttitudeFollowing {
    type Found = AttitudeErrors;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        for robot in step.robots() {
            let [_, _, _, qw, qx, qy, qz] = step.scene(robot)?.pose[0];
            let [roll, pitch] = roll_and_pitch([qw, qx, qy, qz]);
            let wanted = &step.before[robot * self.obs_len + self.command..][..3];
            let height = step.batch.critic_obs[robot * self.critic_len + self.height];
            let [roll, pitch, height] = [roll - wanted[0], pitch - wanted[1], height - wanted[2]];
            let errors = [roll.abs() + pitch.abs(), roll * roll, pitch * pitch, height * height];
            self.sums.iter_mut().zip(errors).for_each(|(sum, error)| *sum += f64::from(error));
            self.count += 1.0;
        }
        Ok(())
    }

    fn found(self, has_fallen: &[bool]) -> AttitudeErrors {
        // NaN if every robot fell in the first step: there is no error to report.
        let [l_attitude, roll, pitch, height] = self.sums.map(|sum| sum / self.count);
        let [roll_rms, pitch_rms, height_rms] = [roll, pitch, height].map(f64::sqrt);
        AttitudeErrors { up: share_up(has_fallen), l_attitude, roll_rms, pitch_rms, height_rms }
    }
}
