//! Errors of the joints, of a policy of the task `pose`.

use serde::Serialize;
use twinstep_model::{EnvError, EnvSpec};

use crate::{Measure, MeasureError, Step, share_up};

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

/// Measures how joints follow their targets: both are those of the observation after each step.
pub struct PoseFollowing {
    obs_len: usize,
    position: usize,
    target: usize,
    joints: Vec<String>,
    squares: Vec<f64>,
    targets: f64,
    count: f64,
}

impl PoseFollowing {
    /// Prepares the measure of environments of the task `pose`.
    pub fn new(spec: &EnvSpec) -> Result<Self, MeasureError> {
        let start = |name| spec.observation_field(name).map(|(start, _)| start).ok_or(MeasureError::Missing(name));
        Ok(Self {
            obs_len: spec.obs_len(),
            position: start("joint_position")?,
            target: start("joint_target")?,
            joints: spec.joint_order.clone(),
            squares: vec![0.0; spec.joint_order.len()],
            targets: 0.0,
            count: 0.0,
        })
    }
}

impl Measure for PoseFollowing {
    type Found = PoseErrors;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        for robot in step.robots() {
            let of_robot = &step.batch.obs[robot * self.obs_len..];
            for (joint, square) in self.squares.iter_mut().enumerate() {
                let wanted = of_robot[self.target + joint];
                *square += f64::from(of_robot[self.position + joint] - wanted).powi(2);
                self.targets += f64::from(wanted).powi(2);
            }
            self.count += 1.0;
        }
        Ok(())
    }

    fn found(self, has_fallen: &[bool]) -> PoseErrors {
        let rms = |sum: f64, count: f64| (sum / count).sqrt();
        let all = self.count * self.joints.len() as f64;
        PoseErrors {
            up: share_up(has_fallen),
            rms: rms(self.squares.iter().sum(), all),
            target_rms: rms(self.targets, all),
            joints: self.joints.into_iter().zip(self.squares.iter().map(|sum| rms(*sum, self.count))).collect(),
        }
    }
}
