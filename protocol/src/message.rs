//! One struct a message. Requests and replies of each key stand together.
//!
//! Every message is a map and carries `protocol`. Readers ignore fields they do not know; fields marked `default` may be
//! left out.

use serde::{Deserialize, Serialize};
use twinstep_model::{AutoresetMode, EnvSpec, SceneShape};

/// Asks a server who it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HelloRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Program and version, for the server's log.
    #[serde(default)]
    pub client: String,
}

/// Who a server is and what it hosts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HelloReply {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Lowest and highest protocol version that the server speaks.
    pub protocols: [u16; 2],
    /// Program and version.
    pub server_version: String,
    /// The robot's name.
    pub name: String,
    /// The server's id.
    pub server_id: String,
    /// Layouts, periods, gains and limits.
    pub spec: EnvSpec,
    /// [`EnvSpec::hash`] of `spec`.
    pub spec_hash: String,
    /// Environments that the server hosts at most.
    pub max_envs: u64,
    /// Environments that are free.
    pub free_envs: u64,
    /// Time that a lost client's environments wait for it [s].
    pub lease_grace_s: f64,
    /// Environment steps that the server has executed.
    pub env_steps: u64,
}

/// Asks for environments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeaseRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// The client's id, as in its liveliness token. A client declares the token before it asks.
    pub client: String,
    /// Number of environments.
    pub num_envs: u64,
    /// When an ended episode starts anew.
    pub autoreset: AutoresetMode,
    /// Policy steps after which an episode is truncated; the server's own number without.
    #[serde(default)]
    pub max_episode_steps: Option<u32>,
    /// The spec hash that the client was made for; refused if it is not the server's.
    #[serde(default)]
    pub spec_hash: Option<String>,
    /// Takes over a lease instead of asking for a new one.
    #[serde(default)]
    pub reclaim: Option<Reclaim>,
}

/// A lease that a client had and wants to go on with.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reclaim {
    /// The lease's id.
    pub lease: String,
    /// Its last known epoch.
    pub epoch: u64,
}

/// Environments that were granted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeaseReply {
    /// Protocol version of the server.
    pub protocol: u16,
    /// The lease's id, part of the keys to its environments.
    pub lease: String,
    /// Goes up with every reclaim; requests carry it.
    pub epoch: u64,
    /// Number of environments.
    pub num_envs: u64,
    /// When an ended episode starts anew.
    pub autoreset: AutoresetMode,
    /// Sequence number of the last request that was executed; 0 for none. The next has one more.
    pub last_seq: u64,
    /// Layouts, periods, gains and limits; `max_episode_steps` as granted.
    pub spec: EnvSpec,
}

/// Starts episodes anew.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResetRequest<'a> {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: one more than the last.
    pub seq: u64,
    /// `num_envs` × u64; without, each environment continues its random stream.
    #[serde(default, borrow, with = "serde_bytes")]
    pub seeds: Option<&'a [u8]>,
    /// `num_envs` × u8, 1 where to reset; without, all are.
    #[serde(default, borrow, with = "serde_bytes")]
    pub mask: Option<&'a [u8]>,
}

/// First observations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResetReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
    /// `num_envs × obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub obs: &'a [u8],
}

/// Advances all environments by one policy period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepRequest<'a> {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: one more than the last.
    pub seq: u64,
    /// `num_envs × action_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub actions: &'a [u8],
}

/// What the step gave.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
    /// `num_envs × obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub obs: &'a [u8],
    /// `num_envs` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub reward: &'a [u8],
    /// `num_envs` × u8.
    #[serde(borrow, with = "serde_bytes")]
    pub terminated: &'a [u8],
    /// `num_envs` × u8.
    #[serde(borrow, with = "serde_bytes")]
    pub truncated: &'a [u8],
    /// Environments whose episode ended, k × u32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_env: &'a [u8],
    /// Policy steps of those episodes, k × u32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_length: &'a [u8],
    /// Sum of rewards of those episodes, k × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_return: &'a [u8],
    /// Sums of their weighted reward terms, `k × reward_terms` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_terms: &'a [u8],
    /// Their last observations, `k × obs_len` × f32; empty unless autoreset is SameStep.
    #[serde(borrow, with = "serde_bytes")]
    pub final_obs: &'a [u8],
}

/// Gives the environments back.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CloseRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: one more than the last.
    pub seq: u64,
}

/// The environments are free.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CloseReply {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
}

/// Asks what it takes to draw one environment. It reads only: no sequence number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RenderRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// The environment.
    pub env: u64,
}

/// What it takes to draw one robot without knowing it, as [`twinstep_model::Scene`] has it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RenderReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Names of the bodies; the first is the trunk.
    pub bodies: Vec<String>,
    /// World-from-body, `bodies` × 7 × f32: position [m], then quaternion `[w, x, y, z]`.
    #[serde(borrow, with = "serde_bytes")]
    pub pose: &'a [u8],
    /// What the bodies look like.
    pub shapes: Vec<SceneShape>,
    /// What the robot stands on.
    #[serde(borrow)]
    pub ground: Ground<'a>,
    /// Wanted velocity in the base frame: forward [m/s], left [m/s], yaw [rad/s].
    #[serde(default)]
    pub command: Option<[f32; 3]>,
}

/// The ground: a plane, with a height field in it where it is rough.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ground<'a> {
    /// A point of the plane in the world [m].
    pub point: [f32; 3],
    /// Its unit normal in the world.
    pub normal: [f32; 3],
    /// The heights around the robot. Left out where the ground is the plane.
    #[serde(default, borrow, skip_serializing_if = "Option::is_none")]
    pub height_field: Option<HeightField<'a>>,
}

/// Heights on a grid, as [`twinstep_model::HeightField`] has them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeightField<'a> {
    /// x and y of the first vertex in the world [m].
    pub corner: [f32; 2],
    /// Distance between neighbouring vertices [m].
    pub cell: f32,
    /// Number of vertices along x.
    pub rows: u32,
    /// Number of vertices along y.
    pub columns: u32,
    /// Height of every vertex in the world [m], `rows × columns` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub heights: &'a [u8],
}

/// What [`ResetRequest`], [`StepRequest`] and [`CloseRequest`] have in common: enough to tell whether to execute one.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct RequestHeader {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number.
    pub seq: u64,
}
