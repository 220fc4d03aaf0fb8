//! Evaluation of a policy of the task `pose`: errors of the joints, and falls.

use std::fmt::Write;

use serde::Serialize;
use twinstep_model::{EnvError, ResetRequest, VecEnv};
use twinstep_policy::{Policy, PolicyRunner};

/// Errors of the joints from their targets.
#[derive(Debug, Serialize)]
pub struct PoseErrors {
    /// Share of the robots that did not fall.
    pub up: f64,
    /// Root mean square error of all joints [rad or m], NaN if every robot fell at once.
    pub rms: f64,
    /// The same of each joint.
    pub joints: Vec<(String, f64)>,
    /// Root mean square of the targets, which is the error of a robot that does not move [rad or m].
    pub target_rms: f64,
}

/// Steps all robots of `env` for `seconds` with the mean action of `policy`, and measures their errors.
///
/// Position and target are those of the observation after each step. A robot counts until it falls; the end of an episode by time
/// is not a fall. `proceed` is called after each step; the evaluation stops if it returns false.
pub fn evaluate(
    policy: &Policy,
    env: &mut dyn VecEnv,
    (seconds, seed): (f64, u64),
    mut proceed: impl FnMut(f64) -> bool,
) -> Result<Option<PoseErrors>, EnvError> {
    let spec = env.spec().clone();
    let num_envs = env.num_envs();
    let start = |name: &str| spec.observation_field(name).expect("the task observes positions and targets").0;
    let (position, target) = (start("joint_position"), start("joint_target"));
    let joints = spec.joint_order.len();
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut actions = vec![0.0; num_envs * spec.action_len()];
    let mut is_up = vec![true; num_envs];
    let (mut squares, mut targets, mut count) = (vec![0.0; joints], 0.0, 0.0);
    let steps = (seconds / spec.policy_dt).round() as usize;
    for step in 0..steps {
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions)?;
        is_up.iter_mut().zip(&batch.terminated).for_each(|(is_up, fell)| *is_up &= !fell);
        obs.clone_from(&batch.obs);
        for robot in (0..num_envs).filter(|robot| is_up[*robot]) {
            let of_robot = &obs[robot * spec.obs_len()..];
            for (joint, square) in squares.iter_mut().enumerate() {
                let wanted = of_robot[target + joint];
                *square += f64::from(of_robot[position + joint] - wanted).powi(2);
                targets += f64::from(wanted).powi(2);
            }
            count += 1.0;
        }
        if !proceed((step + 1) as f64 / steps as f64) {
            return Ok(None);
        }
    }
    let rms = |sum: f64, count: f64| (sum / count).sqrt();
    let all = count * joints as f64;
    Ok(Some(PoseErrors {
        up: is_up.iter().filter(|is_up| **is_up).count() as f64 / num_envs as f64,
        rms: rms(squares.iter().sum(), all),
        joints: spec.joint_order.iter().cloned().zip(squares.iter().map(|sum| rms(*sum, count))).collect(),
        target_rms: rms(targets, all),
    }))
}

/// Returns the errors as a table, the largest first.
pub fn table(robots: usize, seconds: f64, errors: &PoseErrors) -> String {
    let PoseErrors { up, rms, joints, target_rms } = errors;
    let mut text = format!(
        "{robots} fresh robots, {seconds:.0} s, mean action:\n\
         \x20 still up          {:.1} %\n\
         \x20 joint error, RMS  {rms:.4} rad or m ({target_rms:.4} without motion)\n",
        100.0 * up
    );
    let mut joints: Vec<_> = joints.iter().collect();
    joints.sort_by(|(_, one), (_, other)| other.total_cmp(one));
    for (joint, rms) in joints {
        let _ = writeln!(text, "    {joint:32} {rms:.4}");
    }
    text
}
