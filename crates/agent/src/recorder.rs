//! Records what an agent sends and observes as a measured log.

use std::path::Path;

use glam::{Quat, Vec3};
use twinstep_logs::{Gain, LogWriter, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, EnvSpec};

use crate::error::AgentError;

/// Writes one row per policy step: the observation, and the command that was in force until the next one.
///
/// Columns that the endpoint does not give are absent. Angles and velocities come from the observation, orientation from
/// the scene. Position and velocity of the base are written only if the endpoint is a simulator, which knows them.
pub struct Recorder {
    writer: LogWriter,
    layout: Layout,
    spec: EnvSpec,
    /// Present row, without the commands.
    row: Vec<f64>,
}

/// First entry of each part of the observation.
#[derive(Clone, Copy, Debug)]
struct Layout {
    q: usize,
    dq: Option<usize>,
    gyro: Option<usize>,
    orientation: bool,
    /// In group `critic`.
    velocity: Option<usize>,
}

impl Recorder {
    /// Creates the log in `folder`, which must not exist or be empty. `has_scene` is true if the endpoint gives the pose of
    /// the base; `source` describes policy and endpoint.
    pub fn create(folder: &Path, spec: &EnvSpec, has_scene: bool, source: &str) -> Result<Self, AgentError> {
        let joints = spec.joint_order.len();
        let of_joints =
            |name: &str| spec.observation_field(name).filter(|(_, field)| field.size == joints && joints > 0);
        let vector = |field: Option<(usize, &twinstep_model::SpecField)>| {
            field.filter(|(_, field)| field.size == 3).map(|(start, _)| start)
        };
        let Some((q, _)) = of_joints("joint_position").filter(|_| spec.action_len() == joints) else {
            return Err(AgentError::MissingObservation {
                term: "joint_position".to_owned(),
                available: spec.observation.iter().map(|field| field.name.as_str()).collect::<Vec<_>>().join(", "),
                hint: "a log needs the positions and commands of the joints; run without --log",
            });
        };
        let layout = Layout {
            q,
            dq: of_joints("joint_velocity").map(|(start, _)| start),
            gyro: vector(spec.observation_field("base_angular_velocity")),
            orientation: has_scene,
            velocity: vector(spec.critic_field("true_linear_velocity")).filter(|_| has_scene),
        };
        let writer = LogWriter::create(folder, &meta(spec, &layout, source), &columns(spec, &layout))?;
        Ok(Self { writer, layout, spec: spec.clone(), row: Vec::new() })
    }

    /// Stores the measurements of a row: time [s], episode, observations, and the pose of the base.
    pub fn observe(&mut self, t: f64, episode: u64, obs: &[f32], critic_obs: &[f32], pose: Option<[f32; 7]>) {
        let joints = self.spec.joint_order.len();
        let Self { row, layout, spec, .. } = self;
        row.clear();
        row.extend([t, episode as f64]);
        row.extend((0..joints).map(|joint| f64::from(obs[layout.q + joint]) + spec.default_pose[joint]));
        row.extend(layout.dq.iter().flat_map(|start| &obs[*start..start + joints]).map(|value| f64::from(*value)));
        row.extend(layout.gyro.iter().flat_map(|start| &obs[*start..start + 3]).map(|value| f64::from(*value)));
        if !layout.orientation {
            return;
        }
        let [px, py, pz, w, x, y, z] = pose.unwrap_or([f32::NAN; 7]);
        row.extend([w, x, y, z].map(f64::from));
        if let Some(start) = layout.velocity {
            let velocity_base = Vec3::from_slice(&critic_obs[start..start + 3]);
            let velocity_world = Quat::from_xyzw(x, y, z, w) * velocity_base;
            row.extend([px, py, pz].map(f64::from));
            row.extend(velocity_world.to_array().map(f64::from));
        }
    }

    /// Writes the row with the action that was in force after its measurements, clipped.
    pub fn write(&mut self, action: &[f32]) -> Result<(), AgentError> {
        let EnvSpec { default_pose, action_scale, .. } = &self.spec;
        let targets = action.iter().zip(default_pose).map(|(action, pose)| pose + action_scale * f64::from(*action));
        self.row.extend(targets);
        Ok(self.writer.write_row(&self.row)?)
    }

    /// Returns true if rows contain the pose of the base.
    pub fn has_orientation(&self) -> bool {
        self.layout.orientation
    }

    /// Returns the number of rows so far.
    pub fn rows(&self) -> u64 {
        self.writer.rows()
    }
}

fn columns(spec: &EnvSpec, layout: &Layout) -> Vec<String> {
    let of_joints = |quantity: &'static str| spec.joint_order.iter().map(move |joint| format!("{quantity}_{joint}"));
    let of_axes =
        |quantity: &'static str, axes: &'static str| axes.chars().map(move |axis| format!("{quantity}_{axis}"));
    let mut columns = vec!["t".to_owned(), "episode".to_owned()];
    columns.extend(of_joints("q"));
    columns.extend(layout.dq.iter().flat_map(|_| of_joints("dq")));
    columns.extend(layout.gyro.iter().flat_map(|_| of_axes("gyro", "xyz")));
    if layout.orientation {
        columns.extend(of_axes("quat", "wxyz"));
        columns.extend(layout.velocity.iter().flat_map(|_| of_axes("pos", "xyz").chain(of_axes("vel", "xyz"))));
    }
    columns.extend(of_joints("q_cmd"));
    columns
}

fn meta(spec: &EnvSpec, layout: &Layout, source: &str) -> Meta {
    let policy_hz = 1.0 / spec.policy_dt;
    let segments = vec![Segment { name: "run".to_owned(), base: BaseMount::Floating }];
    let truth = if layout.velocity.is_some() { "; pos and vel are the simulator's, without noise" } else { "" };
    Meta {
        policy_hz: Some(policy_hz),
        joints: spec.joint_order.clone(),
        pd: Some(format!(
            "position targets held for {} s, PD loop every {} s, targets clipped to default pose ± {} rad",
            spec.policy_dt, spec.actuator_dt, spec.action_scale
        )),
        kp: Some(Gain::by_joint((0..spec.joint_order.len()).map(|joint| spec.gains(joint)[0]))),
        kd: Some(Gain::by_joint((0..spec.joint_order.len()).map(|joint| spec.gains(joint)[1]))),
        source: Some(format!("{source}; observations of an agent at the rate of its policy{truth}")),
        ..Meta::new(policy_hz, TorqueSensor::None, segments)
    }
}
