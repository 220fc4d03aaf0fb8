//! Evaluation of a policy of the task `track`: errors along a circle, a figure of eight and a square.

use std::fmt::Write;

use serde::Serialize;
use twinstep_envs::{GroundPose, Path, PathShape, TrackConfig, WalkConfig};
use twinstep_model::{EnvError, ResetRequest, Scene, VecEnv, stream};
use twinstep_policy::{Policy, PolicyRunner};

/// The paths, with their names in tables.
const PATHS: [(PathShape, &str); 3] =
    [(PathShape::Circle, "circle"), (PathShape::FigureEight, "figure of eight"), (PathShape::Square, "square")];

/// Errors along a path.
#[derive(Serialize)]
pub struct TrackingRow {
    /// Conditions of the robots.
    pub condition: &'static str,
    /// Physics engine.
    pub engine: twinstep_sim::Engine,
    /// Errors by path.
    pub paths: Vec<TrackingErrors>,
}

/// Errors along one path.
#[derive(Serialize)]
pub struct TrackingErrors {
    /// Name of the path.
    pub path: &'static str,
    /// True if the policy observed its pose error, as by motion capture.
    pub motion_capture: bool,
    /// Share of the robots that did not fall.
    pub up: f64,
    /// L_track: mean over time and robots of |Δx| + |Δy| + |Δyaw| (U2E, eq. 15) [m + rad].
    pub l_track: f64,
    /// Root mean square distance from the reference [m].
    pub position_rms: f64,
    /// Root mean square error of the yaw [rad].
    pub yaw_rms: f64,
}

/// Returns the settings of the task for each path, with the names of the paths. Episodes end by falls only.
pub fn tasks(observe_pose_error: bool) -> [(TrackConfig, &'static str); 3] {
    PATHS.map(|(path, name)| {
        let walk = WalkConfig { max_episode_s: 1e6, ..WalkConfig::default() };
        let max_position_error_m = 1e6;
        (TrackConfig { path, observe_pose_error, max_position_error_m, walk, ..TrackConfig::default() }, name)
    })
}

/// Steps all robots of `env` for `seconds` with the mean action of `policy` along the path of `task`, and measures their
/// errors.
///
/// The pose is that of the drawn robot, and the reference is computed here: both are independent of the observation. A
/// robot counts until it falls. `proceed` is called after each step; the evaluation stops if it returns false.
pub fn evaluate(
    policy: &Policy,
    env: &mut dyn VecEnv,
    (task, name): &(TrackConfig, &'static str),
    (seconds, seed): (f64, u64),
    mut proceed: impl FnMut(f64) -> bool,
) -> Result<Option<TrackingErrors>, EnvError> {
    let spec = env.spec().clone();
    let (num_envs, dt) = (env.num_envs(), spec.policy_dt as f32);
    // Only random paths depend on these.
    let path = Path::new(task.path, task.radius_m, task.speed, [[0.0; 2]; 3], &mut stream(0, "path", 0));
    let mut runner = PolicyRunner::new(policy);
    let mut obs = env.reset(&ResetRequest::seeded(seed, num_envs))?.to_vec();
    let mut actions = vec![0.0; num_envs * spec.action_len()];
    let mut is_up = vec![true; num_envs];
    let (mut reference, mut sums, mut count) = (GroundPose::default(), [0.0; 3], 0);
    let steps = (seconds / spec.policy_dt).round() as usize;
    for step in 0..steps {
        runner.run(&obs, &mut actions);
        let batch = env.step(&actions)?;
        reference = path.advance(reference, step as f32 * dt, dt);
        for (robot, is_up) in is_up.iter_mut().enumerate() {
            *is_up &= !batch.done(robot);
        }
        obs.copy_from_slice(&batch.obs);
        for robot in (0..num_envs).filter(|robot| is_up[*robot]) {
            let pose = ground_pose(&env.scene(robot)?);
            let [dx, dy] = [pose.x - reference.x, pose.y - reference.y];
            let yaw = pose.relative_to(reference)[2];
            let errors = [dx.abs() + dy.abs() + yaw.abs(), dx * dx + dy * dy, yaw * yaw];
            sums.iter_mut().zip(errors).for_each(|(sum, error)| *sum += f64::from(error));
            count += 1;
        }
        if !proceed((step + 1) as f64 / steps as f64) {
            return Ok(None);
        }
    }
    // NaN if every robot fell in the first step: there is no error to report.
    let [l_track, position, yaw] = sums.map(|sum| sum / f64::from(count));
    let up = is_up.iter().filter(|is_up| **is_up).count() as f64 / num_envs as f64;
    Ok(Some(TrackingErrors {
        path: name,
        motion_capture: task.observe_pose_error,
        up,
        l_track,
        position_rms: position.sqrt(),
        yaw_rms: yaw.sqrt(),
    }))
}

/// Returns the pose of a robot's trunk on the ground.
pub fn ground_pose(scene: &Scene) -> GroundPose {
    let [x, y, _, qw, qx, qy, qz] = scene.pose[0];
    GroundPose { x, y, yaw: (2.0 * (qw * qz + qx * qy)).atan2(1.0 - 2.0 * (qy * qy + qz * qz)) }
}

/// Returns the errors as a table.
pub fn table(robots: u32, seconds: f64, rows: &[TrackingRow]) -> String {
    let mut text = format!(
        "{robots} robots, {seconds} s along each path at 0.5 m/s. L_track: mean |dx| + |dy| + |dyaw| [m + rad] (RMS \
         distance,\nshare that did not fall). Without motion capture the observed pose error is zero.\n\n"
    );
    let _ = writeln!(text, "condition  engine   motion capture  {:24} {:24} {:24}", PATHS[0].1, PATHS[1].1, PATHS[2].1);
    for TrackingRow { condition, engine, paths } in rows {
        let engine = format!("{engine:?}").to_lowercase();
        for paths in paths.chunks(PATHS.len()) {
            let observed = if paths[0].motion_capture { "yes" } else { "no" };
            let _ = write!(text, "{condition:10} {engine:8} {observed:14}");
            for errors in paths {
                let TrackingErrors { l_track, position_rms, up, .. } = errors;
                let _ = write!(text, "  {l_track:.3} ({position_rms:.3} m, {:3.0} %) ", 100.0 * up);
            }
            text.push('\n');
        }
    }
    text
}
