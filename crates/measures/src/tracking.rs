//! Errors along a circle, a figure of eight and a square, of a policy of the task `track`.

use serde::Serialize;
use twinstep_envs::{GroundPose, Path, PathShape, TrackConfig, WalkConfig};
use twinstep_model::{EnvError, EnvSpec, Scene, stream};

use crate::{Measure, Step, share_up};

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

/// Measures the errors along a path.
///
/// The pose is that of the drawn robot, and the reference is computed here: both are independent of the observation.
pub struct Tracking {
    name: &'static str,
    motion_capture: bool,
    path: Path,
    dt: f32,
    reference: GroundPose,
    sums: [f64; 3],
    count: f64,
}

impl Tracking {
    /// The paths, with their names in tables.
    pub const PATHS: [(PathShape, &str); 3] =
        [(PathShape::Circle, "circle"), (PathShape::FigureEight, "figure of eight"), (PathShape::Square, "square")];

    /// Returns the settings of the task for each path. Episodes end by falls only.
    pub fn tasks(observe_pose_error: bool) -> [TrackConfig; 3] {
        Self::PATHS.map(|(path, _)| {
            let walk = WalkConfig { max_episode_s: 1e6, ..WalkConfig::default() };
            let max_position_error_m = 1e6;
            TrackConfig { path, observe_pose_error, max_position_error_m, walk, ..TrackConfig::default() }
        })
    }

    /// Prepares the measure along the path of a task.
    pub fn new(spec: &EnvSpec, task: &TrackConfig) -> Self {
        let name = Self::PATHS.iter().find(|(shape, _)| *shape == task.path).map_or("random", |(_, name)| name);
        Self {
            name,
            motion_capture: task.observe_pose_error,
            // Only random paths depend on the points and the stream.
            path: Path::new(task.path, task.radius_m, task.speed, [[0.0; 2]; 3], &mut stream(0, "path", 0)),
            dt: spec.policy_dt as f32,
            reference: GroundPose::default(),
            sums: [0.0; 3],
            count: 0.0,
        }
    }
}

impl Measure for Tracking {
    type Found = TrackingErrors;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        self.reference = self.path.advance(self.reference, step.index as f32 * self.dt, self.dt);
        for robot in step.robots() {
            let pose = ground_pose(&step.scene(robot)?);
            let [dx, dy] = [pose.x - self.reference.x, pose.y - self.reference.y];
            let yaw = pose.relative_to(self.reference)[2];
            let errors = [dx.abs() + dy.abs() + yaw.abs(), dx * dx + dy * dy, yaw * yaw];
            self.sums.iter_mut().zip(errors).for_each(|(sum, error)| *sum += f64::from(error));
            self.count += 1.0;
        }
        Ok(())
    }

    fn found(self, has_fallen: &[bool]) -> TrackingErrors {
        // NaN if every robot fell in the first step: there is no error to report.
        let [l_track, position, yaw] = self.sums.map(|sum| sum / self.count);
        TrackingErrors {
            path: self.name,
            motion_capture: self.motion_capture,
            up: share_up(has_fallen),
            l_track,
            position_rms: position.sqrt(),
            yaw_rms: yaw.sqrt(),
        }
    }
}

/// Returns the pose of a robot's trunk on the ground.
pub fn ground_pose(scene: &Scene) -> GroundPose {
    let [x, y, _, qw, qx, qy, qz] = scene.pose[0];
    GroundPose { x, y, yaw: (2.0 * (qw * qz + qx * qy)).atan2(1.0 - 2.0 * (qy * qy + qz * qz)) }
}
