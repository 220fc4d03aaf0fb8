//! Records joints, torques and base of a robot in every actuator period as a measured log.

use std::path::Path;

use twinstep_logs::{Gain, LogWriter, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, EnvSpec, RobotSample, VecEnv};

use crate::error::AgentError;

/// Writes one row per actuator period: readings, commanded positions and measured torques.
///
/// Position and velocity of the base are written only if the endpoint knows them.
pub struct JointRecorder {
    writer: LogWriter,
    spec: EnvSpec,
    has_base: bool,
    /// Present row.
    row: Vec<f64>,
    /// Actuator periods since the start, with those of a policy period for each reset.
    periods: u64,
    episode: u64,
}

impl JointRecorder {
    /// Creates the log in `folder`, which must not exist or be empty, and begins sampling. `has_base` is true if the
    /// endpoint knows position and velocity of the base; `source` describes policy and endpoint.
    pub fn create(folder: &Path, env: &mut dyn VecEnv, has_base: bool, source: &str) -> Result<Self, AgentError> {
        env.samples(0)?;
        let spec = env.spec().clone();
        let writer = LogWriter::create(folder, &meta(&spec, has_base, source), &columns(&spec, has_base))?;
        Ok(Self { writer, spec, has_base, row: Vec::new(), periods: 0, episode: 0 })
    }

    /// Writes the rows of the last step.
    pub fn write(&mut self, env: &mut dyn VecEnv) -> Result<(), AgentError> {
        for sample in env.samples(0)? {
            self.write_row(&sample)?;
        }
        Ok(())
    }

    /// Begins an episode after a reset. A gap in time separates it from the last one.
    pub fn begin_episode(&mut self) {
        self.episode += 1;
        self.periods += (self.spec.policy_dt / self.spec.actuator_dt).round() as u64;
    }

    /// Returns the number of rows so far.
    pub fn rows(&self) -> u64 {
        self.writer.rows()
    }

    fn write_row(&mut self, sample: &RobotSample) -> Result<(), AgentError> {
        let RobotSample { q, dq, q_cmd, tau, orientation, gyro, base } = sample;
        let row = &mut self.row;
        row.clear();
        row.extend([self.periods as f64 * self.spec.actuator_dt, self.episode as f64]);
        row.extend(q.iter().chain(dq).chain(q_cmd).chain(tau).chain(gyro).chain(orientation).copied().map(f64::from));
        if self.has_base {
            let [position, velocity] = base.unwrap_or([[f32::NAN; 3]; 2]);
            row.extend(position.into_iter().chain(velocity).map(f64::from));
        }
        self.periods += 1;
        Ok(self.writer.write_row(row)?)
    }
}

fn columns(spec: &EnvSpec, has_base: bool) -> Vec<String> {
    let mut columns = vec!["t".to_owned(), "episode".to_owned()];
    for quantity in ["q", "dq", "q_cmd", "tau_measured"] {
        columns.extend(spec.joint_order.iter().map(|joint| format!("{quantity}_{joint}")));
    }
    let quantities = [("gyro", "xyz"), ("quat", "wxyz"), ("pos", "xyz"), ("vel", "xyz")];
    for (quantity, axes) in quantities.into_iter().take(if has_base { 4 } else { 2 }) {
        columns.extend(axes.chars().map(|axis| format!("{quantity}_{axis}")));
    }
    columns
}

fn meta(spec: &EnvSpec, has_base: bool, source: &str) -> Meta {
    let segments = vec![Segment { name: "run".to_owned(), base: BaseMount::Floating }];
    let truth = if has_base { "; pos and vel are the simulator's, without noise" } else { "" };
    Meta {
        policy_hz: Some(1.0 / spec.policy_dt),
        joints: spec.joint_order.clone(),
        pd: Some(format!(
            "position targets held for {} s, PD loop every {} s, targets clipped to default pose ± {} rad",
            spec.policy_dt, spec.actuator_dt, spec.action_scale
        )),
        kp: Some(Gain::by_joint((0..spec.joint_order.len()).map(|joint| spec.gains(joint)[0]))),
        kd: Some(Gain::by_joint((0..spec.joint_order.len()).map(|joint| spec.gains(joint)[1]))),
        source: Some(format!("{source}; joints at the rate of the actuators{truth}")),
        ..Meta::new(1.0 / spec.actuator_dt, TorqueSensor::MotorCurrent, segments)
    }
}
