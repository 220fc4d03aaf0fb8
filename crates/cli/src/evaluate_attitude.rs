//! Evaluation of a policy of the task `attitude`: errors of roll, pitch and height.

use std::fmt::Write;

use serde::Serialize;
use twinstep_envs::{AttitudeConfig, WalkConfig, roll_and_pitch};
use twinstep_model::{EnvError, ResetRequest, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};

/// Errors under a condition.
#[derive(Serialize)]
pub struct AttitudeRow {
    /// Conditions of the robots.
    pub condition: &'static str,
    /// Physics engine.
    pub engine: twinstep_sim::Engine,
    /// Errors of the base.
    #[serde(flatten)]
    pub errors: AttitudeErrors,
}

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

/// Returns the settings of the task. Episodes end by falls only.
pub fn task() -> AttitudeConfig {
    let default = AttitudeConfig::default();
    AttitudeConfig { walk: WalkConfig { max_episode_s: 1e6, ..default.walk }, ..default }
}

/// Steps all robots of `env` for `seconds` with the mean action of `policy`, and measures their errors.
///
/// Roll and pitch are those of the drawn robot, the height is that of the critic's observation, the reference that of the
/// observation before each step. A robot counts until it falls. `proceed` is called after each step; the evaluation stops if it returns false.
pub fn evaluate(
    policy: &Policy,
    env: &mut dyn VecEnv,
    (seconds, seed): (f64, u64),
    mut proceed: impl FnMut(f64) -> bool,
) -> Result<Option<AttitudeErrors>, EnvError> {
    let spec = env.spec().clone();
    let num_envs = env.num_envs();
    let (command, _) = spec.observation_field("attitude_command").expect("the task observes its command");
    let (height, _) = spec.critic_field("base_height").expect("a simulated robot");
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut actions = vec![0.0; num_envs * spec.action_len()];
    let mut is_up = vec![true; num_envs];
    let (mut sums, mut count) = ([0.0; 4], 0.0);
    let steps = (seconds / spec.policy_dt).round() as usize;
    for step in 0..steps {
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions)?;
        let heights: Vec<f32> = batch.critic_obs.iter().skip(height).step_by(spec.critic_obs_len()).copied().collect();
        let next_obs = batch.obs.clone();
        for (robot, is_up) in is_up.iter_mut().enumerate() {
            *is_up &= !batch.done(robot);
        }
        for robot in (0..num_envs).filter(|robot| is_up[*robot]) {
            let [_, _, _, qw, qx, qy, qz] = env.scene(robot)?.pose[0];
            let [roll, pitch] = roll_and_pitch([qw, qx, qy, qz]);
            let wanted = &obs[robot * spec.obs_len() + command..][..3];
            let [roll, pitch, height] = [roll - wanted[0], pitch - wanted[1], heights[robot] - wanted[2]];
            let errors = [roll.abs() + pitch.abs(), roll * roll, pitch * pitch, height * height];
            sums.iter_mut().zip(errors).for_each(|(sum, error)| *sum += f64::from(error));
            count += 1.0;
        }
        obs = next_obs;
        if !proceed((step + 1) as f64 / steps as f64) {
            return Ok(None);
        }
    }
    // NaN if every robot fell in the first step: there is no error to report.
    let [l_attitude, roll, pitch, height] = sums.map(|sum| sum / count);
    let up = is_up.iter().filter(|is_up| **is_up).count() as f64 / num_envs as f64;
    let [roll_rms, pitch_rms, height_rms] = [roll, pitch, height].map(f64::sqrt);
    Ok(Some(AttitudeErrors { up, l_attitude, roll_rms, pitch_rms, height_rms }))
}

/// Returns the errors as a table.
pub fn table(robots: u32, seconds: f64, rows: &[AttitudeRow]) -> String {
    let mut text = format!(
        "{robots} robots, {seconds} s. L_attitude: mean |droll| + |dpitch| [rad]\n\n\
         condition  engine   up       L_attitude  roll RMS   pitch RMS  height RMS\n"
    );
    for AttitudeRow { condition, engine, errors } in rows {
        let engine = format!("{engine:?}").to_lowercase();
        let AttitudeErrors { up, l_attitude, roll_rms, pitch_rms, height_rms } = errors;
        let _ = writeln!(
            text,
            "{condition:10} {engine:8} {:5.1} %  {l_attitude:.4}      {roll_rms:.4}     {pitch_rms:.4}     {height_rms:.4} m",
            100.0 * up
        );
    }
    text
}
