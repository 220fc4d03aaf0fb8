//! One struct per message. The request and the reply of each key are next to each other.
//!
//! Every message is a map and contains `protocol`. Readers ignore unknown fields. Fields marked `default` are optional.

use serde::{Deserialize, Serialize};
use twinstep_model::{AutoresetMode, EnvSpec, SceneShape};

/// Requests the identity of a server.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HelloRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Program and version of the client, for the server's log.
    #[serde(default)]
    pub client: String,
}

/// Identity of a server and what it hosts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HelloReply {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Lowest and highest protocol version that the server supports.
    pub protocols: [u16; 2],
    /// Program and version of the server.
    pub server_version: String,
    /// Name of the robot.
    pub name: String,
    /// Id of the server.
    pub server_id: String,
    /// Spec of the environments: layouts, periods, gains and limits.
    pub spec: EnvSpec,
    /// [`EnvSpec::hash`] of `spec`.
    pub spec_hash: String,
    /// Maximum number of environments.
    pub max_envs: u64,
    /// Number of environments that are not leased.
    pub free_envs: u64,
    /// Maximum number of environments that one client id may lease.
    pub max_envs_per_client: u64,
    /// Maximum size of a request [bytes]; larger ones are rejected or get no reply.
    pub max_request_bytes: u64,
    /// Time for which the environments of a disconnected client are kept [s].
    pub lease_grace_s: f64,
    /// Time without a request after which a lease is released, even if its client is connected [s]. Default: never.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lease_idle_s: Option<f64>,
    /// Number of environment steps executed since the start of the server.
    pub env_steps: u64,
    /// Maximum number of steps of a rollout. Default: 0, a server without rollouts.
    #[serde(default)]
    pub max_rollout_steps: u64,
    /// Memory for the policies of all rollouts [bytes]. Default: 0, not stated.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub max_policy_bytes: u64,
    /// What differs from a simulation; absent if the server simulates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub real_time: Option<RealTime>,
}

/// What differs from a simulation if the server fronts a robot, which does not wait for its agent.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RealTime {
    /// Reward terms of the task that need the ground truth. They are absent, not estimated.
    pub absent_reward_terms: Vec<String>,
    /// Ends of episodes that need the ground truth. No episode ends for these reasons.
    pub absent_ends: Vec<String>,
    /// State of the robot, such as `observe` or `ready`.
    pub state: String,
    /// Port of the stop listener, which waits for no other request. Absent if there is none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop_port: Option<u16>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_zero(value: &u64) -> bool {
    *value == 0
}

/// Requests a lease of environments.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeaseRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Id of the client, as in its liveliness token. A client declares the token before it requests a lease.
    pub client: String,
    /// Number of environments.
    pub num_envs: u64,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Number of policy steps after which an episode is truncated. Default: the server's.
    #[serde(default)]
    pub max_episode_steps: Option<u32>,
    /// True to receive the observations of group `critic` with every reset and step.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub critic: bool,
    /// Spec hash for which the client's policy was trained. A server with a different one rejects the request.
    #[serde(default)]
    pub spec_hash: Option<String>,
    /// Takes over an existing lease instead of requesting a new one.
    #[serde(default)]
    pub reclaim: Option<Reclaim>,
}

/// A lease to take over.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reclaim {
    /// Id of the lease.
    pub lease: String,
    /// Last known epoch of the lease.
    pub epoch: u64,
}

/// A granted lease.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LeaseReply {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Id of the lease, part of the keys of its environments.
    pub lease: String,
    /// Fencing token, increased by one at each reclaim. Requests contain it.
    pub epoch: u64,
    /// Number of environments.
    pub num_envs: u64,
    /// When a new episode starts after one has ended.
    pub autoreset: AutoresetMode,
    /// Last sequence number that was consumed; 0 for none. The next request has this number plus one.
    pub last_seq: u64,
    /// Spec of the environments, with `max_episode_steps` as granted, and without the group `critic` unless requested.
    pub spec: EnvSpec,
}

/// Starts new episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResetRequest<'a> {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: the last one plus one.
    pub seq: u64,
    /// Seed of each environment, `num_envs` × u64. Default: each continues its random stream.
    #[serde(default, borrow, with = "serde_bytes")]
    pub seeds: Option<&'a [u8]>,
    /// 1 for environments to reset, `num_envs` × u8. Default: all.
    #[serde(default, borrow, with = "serde_bytes")]
    pub mask: Option<&'a [u8]>,
}

/// Observations after a reset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResetReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
    /// Observations, `num_envs × obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub obs: &'a [u8],
    /// Observations of group `critic`, `num_envs × critic_obs_len` × f32; absent unless the lease requested it.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub critic_obs: &'a [u8],
    /// Policy period that begins with the observation; absent in a simulation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tick: Option<u64>,
    /// Time of the sensor readings since the start of the robot's clock [ns]; absent in a simulation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stamp_ns: Option<u64>,
}

/// Advances all environments by one policy period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepRequest<'a> {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: the last one plus one.
    pub seq: u64,
    /// Actions, `num_envs × action_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub actions: &'a [u8],
    /// Velocity commands from this step on, in place of the task's own, `num_envs × 3` × f32: forward [m/s], left [m/s],
    /// yaw rate [rad/s]. Default: unchanged.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "Option::is_none")]
    pub command: Option<&'a [u8]>,
    /// Gait commands from this step on, in place of the task's own, `num_envs × 4` × f32: step frequency [Hz], phases of
    /// FR, RL and RR relative to FL [cycles]. Default: unchanged.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "Option::is_none")]
    pub gait_command: Option<&'a [u8]>,
    /// Policy period for which the actions are, on a robot in real time. Default: `tick` of the last reply.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub for_tick: Option<u64>,
}

/// Result of a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
    /// Observations, `num_envs × obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub obs: &'a [u8],
    /// Rewards, `num_envs` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub reward: &'a [u8],
    /// 1 if the task ended the episode, `num_envs` × u8.
    #[serde(borrow, with = "serde_bytes")]
    pub terminated: &'a [u8],
    /// 1 if the time limit ended the episode, `num_envs` × u8.
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
    /// 1 for those whose simulation became NaN or infinite, k × u8; absent if there is none.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub ended_diverged: &'a [u8],
    /// Their last observations, `k × obs_len` × f32; empty unless autoreset is SameStep.
    #[serde(borrow, with = "serde_bytes")]
    pub final_obs: &'a [u8],
    /// Observations of group `critic`, `num_envs × critic_obs_len` × f32; absent unless the lease requested it.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub critic_obs: &'a [u8],
    /// As `final_obs`, of group `critic`.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub final_critic_obs: &'a [u8],
    /// Policy period that begins with the observation; absent in a simulation, as are all fields below.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tick: Option<u64>,
    /// Time of the sensor readings since the start of the robot's clock [ns].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stamp_ns: Option<u64>,
    /// Number of policy periods in a row that ended without an action.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late_ticks: Option<u64>,
    /// Action in force after clipping and limiting, `action_len` × f32. The next observation contains it.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub applied: &'a [u8],
    /// Reason why the action was not executed; absent if it was.
    #[serde(default, borrow, skip_serializing_if = "Option::is_none")]
    pub refused: Option<&'a str>,
    /// Why the robot follows no actions; absent while it follows them.
    #[serde(default, borrow, skip_serializing_if = "Option::is_none")]
    pub fault: Option<&'a str>,
}

/// Runs a policy next to the environments for several policy periods.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutRequest<'a> {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: the last one plus one.
    pub seq: u64,
    /// Number of steps.
    pub steps: u64,
    /// Seed of the noise of environment 0; environment `i` has this plus `i`.
    pub noise_seed: u64,
    /// The policy. Default: the one of `policy_id`, which is then required.
    #[serde(default, borrow, skip_serializing_if = "Option::is_none")]
    pub policy: Option<RolloutPolicy<'a>>,
    /// Sequence number of the last rollout that was executed with a `policy`, which is used again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy_id: Option<u64>,
}

/// A policy: a normal distribution of actions around the output of a network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutPolicy<'a> {
    /// Numbers of inputs, of units of each hidden layer, and of outputs.
    pub sizes: Vec<u64>,
    /// Weight (outputs × inputs) and bias of each layer, one after the other, f32.
    #[serde(borrow, with = "serde_bytes")]
    pub weights: &'a [u8],
    /// Mean of each entry of the observation, `obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub mean: &'a [u8],
    /// Standard deviation of each entry of the observation, `obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub std: &'a [u8],
    /// Logarithm of the standard deviation of each entry of the action, `action_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub log_std: &'a [u8],
}

/// Result of a rollout of `k` steps, in which `e` episodes ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RolloutReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
    /// Observations, `k + 1 × num_envs × obs_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub obs: &'a [u8],
    /// Observations of group `critic`, `k + 1 × num_envs × critic_obs_len` × f32; absent unless the lease requested it.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub critic_obs: &'a [u8],
    /// Sampled actions, not clipped, `k × num_envs × action_len` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub actions: &'a [u8],
    /// Logarithm of the probability density of each action, `k × num_envs` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub log_prob: &'a [u8],
    /// Rewards, `k × num_envs` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub reward: &'a [u8],
    /// 1 if the task ended the episode, `k × num_envs` × u8.
    #[serde(borrow, with = "serde_bytes")]
    pub terminated: &'a [u8],
    /// 1 if the time limit ended the episode, `k × num_envs` × u8.
    #[serde(borrow, with = "serde_bytes")]
    pub truncated: &'a [u8],
    /// Step in which each ended episode ended, e × u32, in ascending order.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_step: &'a [u8],
    /// Its environment, e × u32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_env: &'a [u8],
    /// Its policy steps, e × u32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_length: &'a [u8],
    /// Its sum of rewards, e × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_return: &'a [u8],
    /// Sums of its weighted reward terms, `e × reward_terms` × f32.
    #[serde(borrow, with = "serde_bytes")]
    pub ended_terms: &'a [u8],
    /// 1 if its simulation became NaN or infinite, e × u8; absent if none did.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub ended_diverged: &'a [u8],
    /// Its last observation, `e × obs_len` × f32; empty unless autoreset is SameStep.
    #[serde(borrow, with = "serde_bytes")]
    pub final_obs: &'a [u8],
    /// As `final_obs`, of group `critic`.
    #[serde(default, borrow, with = "serde_bytes", skip_serializing_if = "<[u8]>::is_empty")]
    pub final_critic_obs: &'a [u8],
}

/// Ends the lease.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CloseRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number: the last one plus one.
    pub seq: u64,
}

/// Confirms that the lease has ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CloseReply {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Sequence number of the request.
    pub seq: u64,
}

/// Stops a robot at once. Needs neither a lease nor a sequence number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopRequest {
    /// Protocol version of the client.
    pub protocol: u16,
}

/// Confirms that the motors are damped from now on, until the robot's operator arms them again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopReply {
    /// Protocol version of the server.
    pub protocol: u16,
}

/// Requests the scene of one environment. Only reads, so it has no sequence number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RenderRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Index of the environment.
    pub env: u64,
}

/// Requests the samples of one environment in the last step. It does not change an episode, so it has no sequence number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SamplesRequest {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Index of the environment.
    pub env: u64,
}

/// One robot over the actuator periods of the last step, as [`twinstep_model::RobotSample`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SamplesReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Numbers of each sample, samples × 61 × f32; no sample in the reply to the first request.
    #[serde(borrow, with = "serde_bytes")]
    pub samples: &'a [u8],
}

/// Everything needed to draw one robot without a robot model, as in [`twinstep_model::Scene`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RenderReply<'a> {
    /// Protocol version of the server.
    pub protocol: u16,
    /// Names of the bodies; the first is the trunk.
    pub bodies: Vec<String>,
    /// World-from-body pose of each body, `bodies` × 7 × f32: position [m], then quaternion `[w, x, y, z]`.
    #[serde(borrow, with = "serde_bytes")]
    pub pose: &'a [u8],
    /// Geometry of the bodies.
    pub shapes: Vec<SceneShape>,
    /// Ground under the robot.
    #[serde(borrow)]
    pub ground: Ground<'a>,
    /// Commanded velocity in the base frame: forward [m/s], left [m/s], yaw rate [rad/s].
    #[serde(default)]
    pub command: Option<[f32; 3]>,
}

/// The ground: a plane, and a height field if it is rough.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ground<'a> {
    /// A point of the plane, in the world frame [m].
    pub point: [f32; 3],
    /// Unit normal of the plane, in the world frame.
    pub normal: [f32; 3],
    /// Heights that replace the plane around the robot; absent if the ground is the plane.
    #[serde(default, borrow, skip_serializing_if = "Option::is_none")]
    pub height_field: Option<HeightField<'a>>,
}

/// Heights on a grid, as in [`twinstep_model::HeightField`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeightField<'a> {
    /// x and y of the first vertex, in the world frame [m].
    pub origin: [f32; 2],
    /// Distance between neighbouring vertices [m].
    pub cell_size: f32,
    /// Number of vertices along x.
    pub rows: u32,
    /// Number of vertices along y.
    pub columns: u32,
    /// z of each vertex in the world frame, `rows × columns` × f32 [m].
    #[serde(borrow, with = "serde_bytes")]
    pub heights: &'a [u8],
}

/// Common fields of [`ResetRequest`], [`StepRequest`], [`RolloutRequest`] and [`CloseRequest`], which decide whether to execute one.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct RequestHeader {
    /// Protocol version of the client.
    pub protocol: u16,
    /// Epoch of the lease.
    pub epoch: u64,
    /// Sequence number.
    pub seq: u64,
}
