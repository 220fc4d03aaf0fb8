//! Conversions between messages and the types of `twinstep-model`.

use std::sync::Arc;

use twinstep_model::{
    AgentCommands, BackendError, EndedEpisode, EnvError, EnvSpec, Ground, HeightField, NUM_JOINTS, PerJoint,
    RealTimeReport, ResetRequest, RobotSample, RobotStop, Scene, StepBatch, Trajectory,
};

use crate::codec::encode_with_capacity;
use crate::{ErrorCode, ErrorReply, PROTOCOL, encode, message, tensor};

/// Upper bound on the size of a message without its tensors [bytes].
const MAP_OVERHEAD: usize = 256;

/// Entries of a velocity command and of a gait command.
const COMMANDS_LEN: usize = 3 + 4;
/// Maximum size of a rollout request [bytes]: a policy with a million weights.
pub const MAX_ROLLOUT_REQUEST_BYTES: usize = 4 << 20;

/// Maximum size of one array in the reply to a step [bytes]. Zenoh refuses messages of more than 1 GiB.
const MAX_ARRAY_BYTES: u64 = 1 << 30;

/// Returns the number of environments of a lease. Fails if a client could not receive their observations.
///
/// Without this check, the lengths in a damaged lease reply would decide how much memory a client allocates.
pub fn check_lease(num_envs: u64, spec: &EnvSpec) -> Result<usize, ErrorReply> {
    let too_large = |field, sum: u64| {
        let message = format!("the lease has {num_envs} environments with {sum} numbers each, more than a reply holds");
        Err(ErrorReply::new(ErrorCode::OutOfRange, field, message))
    };
    let fields = [
        ("observation", &spec.observation),
        ("critic_observation", &spec.critic_observation),
        ("action", &spec.action),
    ];
    for (name, fields) in fields {
        let sum = fields.iter().fold(0u64, |sum, field| sum.saturating_add(field.size as u64));
        if num_envs.saturating_mul(sum.max(1)).saturating_mul(size_of::<f32>() as u64) > MAX_ARRAY_BYTES {
            return too_large(name, sum);
        }
    }
    Ok(num_envs as usize)
}

/// Encodes a reset request.
pub fn encode_reset(request: &ResetRequest, epoch: u64, seq: u64) -> Vec<u8> {
    encode(&message::ResetRequest {
        protocol: PROTOCOL,
        epoch,
        seq,
        seeds: request.seeds.as_ref().map(|seeds| tensor::as_bytes(seeds)),
        mask: request.mask.as_ref().map(|mask| tensor::flags_as_bytes(mask)),
    })
}

/// Returns the maximum size of a request to `num_envs` environments [bytes]. A rollout may have
/// [`MAX_ROLLOUT_REQUEST_BYTES`].
pub fn max_request_bytes(num_envs: usize, spec: &EnvSpec) -> usize {
    let reset = size_of::<u64>() + size_of::<u8>();
    let step = (spec.action_len() + COMMANDS_LEN) * size_of::<f32>();
    4 * MAP_OVERHEAD + num_envs * reset.max(step)
}

/// Decodes a reset request for `num_envs` environments. Checks lengths before it copies.
pub fn read_reset(request: &message::ResetRequest<'_>, num_envs: usize) -> Result<ResetRequest, ErrorReply> {
    if let Some(seeds) = request.seeds {
        check_length("seeds", seeds.len() / size_of::<u64>(), num_envs)?;
    }
    if let Some(mask) = request.mask {
        check_length("mask", mask.len(), num_envs)?;
    }
    let seeds = request.seeds.map(|bytes| tensor::read(bytes, "seeds")).transpose()?;
    Ok(ResetRequest { seeds, mask: request.mask.map(tensor::flags_from_bytes) })
}

/// Encodes the reply to a reset. `critic_obs` is empty unless the lease requested the group `critic`.
pub fn encode_observations(obs: &[f32], critic_obs: &[f32], robot: Option<&RealTimeReport>, seq: u64) -> Vec<u8> {
    let (obs, critic_obs) = (tensor::as_bytes(obs), tensor::as_bytes(critic_obs));
    let (tick, stamp_ns) = (robot.map(|report| report.tick), robot.map(|report| report.stamp_ns));
    encode(&message::ResetReply { protocol: PROTOCOL, seq, obs, critic_obs, tick, stamp_ns })
}

/// Decodes the reply to a reset into `batch`. Fails if a length does not match `num_envs` environments of `spec`.
pub fn decode_observations(
    reply: &message::ResetReply<'_>,
    spec: &EnvSpec,
    num_envs: usize,
    batch: &mut StepBatch,
) -> Result<(), ErrorReply> {
    tensor::read_into(reply.obs, &mut batch.obs, "obs")?;
    tensor::read_into(reply.critic_obs, &mut batch.critic_obs, "critic_obs")?;
    check_length("obs", batch.obs.len(), num_envs * spec.obs_len())?;
    check_length("critic_obs", batch.critic_obs.len(), num_envs * spec.critic_obs_len())
}

/// Encodes the reply to a step, with the group `critic` if the lease requested it.
pub fn encode_step(batch: &StepBatch, seq: u64, with_critic: bool) -> Vec<u8> {
    let robot = batch.real_time.as_ref();
    let ended = EndedArrays::new(batch.ended.iter(), with_critic);
    let critic_obs = if with_critic { &batch.critic_obs[..] } else { &[] };
    let reply = message::StepReply {
        protocol: PROTOCOL,
        seq,
        obs: tensor::as_bytes(&batch.obs),
        reward: tensor::as_bytes(&batch.reward),
        terminated: tensor::flags_as_bytes(&batch.terminated),
        truncated: tensor::flags_as_bytes(&batch.truncated),
        ended_env: tensor::as_bytes(&ended.env),
        ended_length: tensor::as_bytes(&ended.length),
        ended_return: tensor::as_bytes(&ended.episode_return),
        ended_terms: tensor::as_bytes(&ended.terms),
        ended_diverged: ended.diverged(),
        final_obs: tensor::as_bytes(&ended.final_obs),
        critic_obs: tensor::as_bytes(critic_obs),
        final_critic_obs: tensor::as_bytes(&ended.final_critic_obs),
        tick: robot.map(|report| report.tick),
        stamp_ns: robot.map(|report| report.stamp_ns),
        late_ticks: robot.map(|report| report.late_ticks),
        applied: robot.map_or(&[], |report| tensor::as_bytes(&report.applied)),
        refused: robot.and_then(|report| report.refused.as_deref()),
        fault: robot.and_then(|report| report.stop.as_ref()).map(|stop| stop.reason.as_str()),
    };
    let numbers = batch.obs.len() + batch.reward.len() + critic_obs.len();
    let flags = batch.terminated.len() + batch.truncated.len();
    encode_with_capacity(&reply, MAP_OVERHEAD + numbers * size_of::<f32>() + flags + ended.num_bytes())
}

/// Encodes the reply to a rollout, with the group `critic` if the lease requested it.
pub fn encode_trajectory(trajectory: &Trajectory, seq: u64, with_critic: bool) -> Vec<u8> {
    let ended = EndedArrays::new(trajectory.ended.iter().map(|(_, episode)| episode), with_critic);
    let ended_step: Vec<u32> = trajectory.ended.iter().map(|(step, _)| *step as u32).collect();
    let critic_obs = if with_critic { &trajectory.critic_obs[..] } else { &[] };
    let reply = message::RolloutReply {
        protocol: PROTOCOL,
        seq,
        obs: tensor::as_bytes(&trajectory.obs),
        critic_obs: tensor::as_bytes(critic_obs),
        actions: tensor::as_bytes(&trajectory.actions),
        log_prob: tensor::as_bytes(&trajectory.log_prob),
        reward: tensor::as_bytes(&trajectory.reward),
        terminated: tensor::flags_as_bytes(&trajectory.terminated),
        truncated: tensor::flags_as_bytes(&trajectory.truncated),
        ended_step: tensor::as_bytes(&ended_step),
        ended_env: tensor::as_bytes(&ended.env),
        ended_length: tensor::as_bytes(&ended.length),
        ended_return: tensor::as_bytes(&ended.episode_return),
        ended_terms: tensor::as_bytes(&ended.terms),
        ended_diverged: ended.diverged(),
        final_obs: tensor::as_bytes(&ended.final_obs),
        final_critic_obs: tensor::as_bytes(&ended.final_critic_obs),
    };
    let Trajectory { obs, actions, log_prob, reward, terminated, truncated, .. } = trajectory;
    let numbers = obs.len() + critic_obs.len() + actions.len() + log_prob.len() + reward.len() + ended_step.len();
    let flags = terminated.len() + truncated.len();
    encode_with_capacity(&reply, 2 * MAP_OVERHEAD + numbers * size_of::<f32>() + flags + ended.num_bytes())
}

/// Episodes as arrays.
#[derive(Default)]
struct EndedArrays {
    env: Vec<u32>,
    length: Vec<u32>,
    episode_return: Vec<f32>,
    terms: Vec<f32>,
    diverged: Vec<bool>,
    final_obs: Vec<f32>,
    final_critic_obs: Vec<f32>,
}

impl EndedArrays {
    fn new<'a>(episodes: impl Iterator<Item = &'a EndedEpisode>, with_critic: bool) -> Self {
        let mut arrays = Self::default();
        for episode in episodes {
            arrays.env.push(episode.env as u32);
            arrays.length.push(episode.length);
            arrays.episode_return.push(episode.episode_return);
            arrays.terms.extend(&episode.terms);
            arrays.diverged.push(episode.diverged);
            arrays.final_obs.extend(&episode.final_obs);
            if with_critic {
                arrays.final_critic_obs.extend(&episode.final_critic_obs);
            }
        }
        arrays
    }

    /// Returns the field `ended_diverged`, which is absent if no simulation diverged.
    fn diverged(&self) -> &[u8] {
        tensor::flags_as_bytes(if self.diverged.contains(&true) { &self.diverged } else { &[] })
    }

    /// Returns the size of all arrays [bytes].
    fn num_bytes(&self) -> usize {
        let numbers = 3 * self.env.len() + self.terms.len() + self.final_obs.len() + self.final_critic_obs.len();
        numbers * size_of::<f32>() + self.diverged.len()
    }

    /// Returns the episodes. Fails if a length does not match, or if there is no such environment.
    fn read(mut self, spec: &EnvSpec, num_envs: usize) -> Result<impl Iterator<Item = EndedEpisode>, ErrorReply> {
        let (ended, obs_len, critic_len) = (self.env.len(), spec.obs_len(), spec.critic_obs_len());
        let num_terms = spec.reward_terms.len();
        if self.diverged.is_empty() {
            self.diverged.resize(ended, false);
        }
        let finals = if self.final_obs.is_empty() { 0 } else { ended };
        for (field, given, expected) in [
            ("ended_length", self.length.len(), ended),
            ("ended_return", self.episode_return.len(), ended),
            ("ended_terms", self.terms.len(), ended * num_terms),
            ("ended_diverged", self.diverged.len(), ended),
            ("final_obs", self.final_obs.len(), finals * obs_len),
            ("final_critic_obs", self.final_critic_obs.len(), finals * critic_len),
        ] {
            check_length(field, given, expected)?;
        }
        if let Some(env) = self.env.iter().find(|env| **env as usize >= num_envs) {
            let message = format!("`ended_env` has environment {env}; there are {num_envs}");
            return Err(ErrorReply::new(ErrorCode::OutOfRange, "ended_env", message));
        }
        let row = |values: &[f32], index: usize, len: usize| {
            values.get(index * len..(index + 1) * len).unwrap_or_default().to_vec()
        };
        Ok((0..ended).map(move |k| EndedEpisode {
            env: self.env[k] as usize,
            length: self.length[k],
            episode_return: self.episode_return[k],
            terms: row(&self.terms, k, num_terms),
            diverged: self.diverged[k],
            final_obs: row(&self.final_obs, k, obs_len),
            final_critic_obs: row(&self.final_critic_obs, k, critic_len),
        }))
    }
}

/// Encodes a step request. `commands` are those that the client gives. `for_tick` is the policy period of the actions, if
/// it is not that of the last observation.
pub fn encode_actions(
    actions: &[f32],
    commands: &AgentCommands,
    for_tick: Option<u64>,
    epoch: u64,
    seq: u64,
) -> Vec<u8> {
    let actions = tensor::as_bytes(actions);
    let command = commands.velocity.as_deref().map(tensor::as_bytes);
    let gait_command = commands.gait.as_deref().map(tensor::as_bytes);
    let request = message::StepRequest { protocol: PROTOCOL, epoch, seq, actions, command, gait_command, for_tick };
    let len = |bytes: Option<&[u8]>| bytes.map_or(0, <[u8]>::len);
    encode_with_capacity(&request, MAP_OVERHEAD + actions.len() + len(command) + len(gait_command))
}

/// Decodes the commands of a step request for `num_envs` environments. Checks the lengths before it copies.
pub fn read_commands(request: &message::StepRequest<'_>, num_envs: usize) -> Result<AgentCommands, ErrorReply> {
    let (velocity, gait) = (request.command, request.gait_command);
    Ok(AgentCommands {
        velocity: velocity.map(|bytes| read_command_rows(bytes, num_envs, "command")).transpose()?,
        gait: gait.map(|bytes| read_command_rows(bytes, num_envs, "gait_command")).transpose()?,
    })
}

fn read_command_rows<const N: usize>(
    bytes: &[u8],
    num_envs: usize,
    field: &'static str,
) -> Result<Vec<[f32; N]>, ErrorReply> {
    check_length(field, bytes.len() / size_of::<f32>(), num_envs * N)?;
    tensor::read(bytes, field)
}

/// Decodes the reply to a step into `batch`. Fails if a length does not match `num_envs` environments of `spec`.
pub fn decode_step(
    reply: &message::StepReply<'_>,
    spec: &EnvSpec,
    num_envs: usize,
    batch: &mut StepBatch,
) -> Result<(), ErrorReply> {
    tensor::read_into(reply.obs, &mut batch.obs, "obs")?;
    tensor::read_into(reply.reward, &mut batch.reward, "reward")?;
    tensor::read_flags_into(reply.terminated, &mut batch.terminated);
    tensor::read_flags_into(reply.truncated, &mut batch.truncated);
    tensor::read_into(reply.critic_obs, &mut batch.critic_obs, "critic_obs")?;
    for (field, given, expected) in [
        ("obs", batch.obs.len(), num_envs * spec.obs_len()),
        ("reward", batch.reward.len(), num_envs),
        ("terminated", batch.terminated.len(), num_envs),
        ("truncated", batch.truncated.len(), num_envs),
        ("critic_obs", batch.critic_obs.len(), num_envs * spec.critic_obs_len()),
    ] {
        check_length(field, given, expected)?;
    }
    let ended = EndedArrays {
        env: tensor::read(reply.ended_env, "ended_env")?,
        length: tensor::read(reply.ended_length, "ended_length")?,
        episode_return: tensor::read(reply.ended_return, "ended_return")?,
        terms: tensor::read(reply.ended_terms, "ended_terms")?,
        diverged: tensor::flags_from_bytes(reply.ended_diverged),
        final_obs: tensor::read(reply.final_obs, "final_obs")?,
        final_critic_obs: tensor::read(reply.final_critic_obs, "final_critic_obs")?,
    };
    batch.ended = ended.read(spec, num_envs)?.collect();
    batch.real_time = decode_real_time(reply, batch.terminated.contains(&true))?;
    Ok(())
}

/// Returns the report of a robot in real time. `None` if the server simulates. `terminates`: the episode terminated.
fn decode_real_time(reply: &message::StepReply<'_>, terminates: bool) -> Result<Option<RealTimeReport>, ErrorReply> {
    let Some(tick) = reply.tick else { return Ok(None) };
    let applied: Vec<f32> = tensor::read(reply.applied, "applied")?;
    let applied: PerJoint =
        applied.try_into().map_err(|applied: Vec<f32>| wrong_length("applied", applied.len(), NUM_JOINTS))?;
    Ok(Some(RealTimeReport {
        tick,
        stamp_ns: reply.stamp_ns.unwrap_or_default(),
        late_ticks: reply.late_ticks.unwrap_or_default(),
        applied,
        refused: reply.refused.map(str::to_owned),
        stop: reply.fault.map(|reason| RobotStop { reason: reason.to_owned(), terminates }),
    }))
}

/// Decodes the reply to a rollout of `steps` steps into `trajectory`.
///
/// Fails if a length does not match `num_envs` environments of `spec`. `steps × num_envs` numbers of each entry must be
/// within the memory of this process.
pub fn decode_trajectory(
    reply: &message::RolloutReply<'_>,
    spec: &EnvSpec,
    num_envs: usize,
    steps: usize,
    trajectory: &mut Trajectory,
) -> Result<(), ErrorReply> {
    (trajectory.steps, trajectory.num_envs) = (steps, num_envs);
    tensor::read_into(reply.obs, &mut trajectory.obs, "obs")?;
    tensor::read_into(reply.critic_obs, &mut trajectory.critic_obs, "critic_obs")?;
    tensor::read_into(reply.actions, &mut trajectory.actions, "actions")?;
    tensor::read_into(reply.log_prob, &mut trajectory.log_prob, "log_prob")?;
    tensor::read_into(reply.reward, &mut trajectory.reward, "reward")?;
    tensor::read_flags_into(reply.terminated, &mut trajectory.terminated);
    tensor::read_flags_into(reply.truncated, &mut trajectory.truncated);
    let rows = steps * num_envs;
    for (field, given, expected) in [
        ("obs", trajectory.obs.len(), (rows + num_envs) * spec.obs_len()),
        ("critic_obs", trajectory.critic_obs.len(), (rows + num_envs) * spec.critic_obs_len()),
        ("actions", trajectory.actions.len(), rows * spec.action_len()),
        ("log_prob", trajectory.log_prob.len(), rows),
        ("reward", trajectory.reward.len(), rows),
        ("terminated", trajectory.terminated.len(), rows),
        ("truncated", trajectory.truncated.len(), rows),
    ] {
        check_length(field, given, expected)?;
    }
    let ended_step: Vec<u32> = tensor::read(reply.ended_step, "ended_step")?;
    if let Some(step) = ended_step.iter().find(|step| **step as usize >= steps) {
        let message = format!("`ended_step` has step {step}; there are {steps}");
        return Err(ErrorReply::new(ErrorCode::OutOfRange, "ended_step", message));
    }
    let ended = EndedArrays {
        env: tensor::read(reply.ended_env, "ended_env")?,
        length: tensor::read(reply.ended_length, "ended_length")?,
        episode_return: tensor::read(reply.ended_return, "ended_return")?,
        terms: tensor::read(reply.ended_terms, "ended_terms")?,
        diverged: tensor::flags_from_bytes(reply.ended_diverged),
        final_obs: tensor::read(reply.final_obs, "final_obs")?,
        final_critic_obs: tensor::read(reply.final_critic_obs, "final_critic_obs")?,
    };
    check_length("ended_step", ended_step.len(), ended.env.len())?;
    trajectory.ended = ended_step.iter().map(|step| *step as usize).zip(ended.read(spec, num_envs)?).collect();
    Ok(())
}

/// Encodes the reply to a render request.
pub fn encode_scene(scene: Scene) -> Vec<u8> {
    let Scene { bodies, pose, shapes, ground, command, .. } = scene;
    let pose = tensor::as_bytes(&pose);
    encode(&message::RenderReply { protocol: PROTOCOL, bodies, pose, shapes, ground: encode_ground(&ground), command })
}

/// Number of the numbers of a sample: four per joint; rotation, angular velocity, position and velocity of the base.
const SAMPLE_LEN: usize = 4 * NUM_JOINTS + 13;

/// Encodes the reply to a request for samples. An unknown position or velocity of the base is NaN.
pub fn encode_samples(samples: &[RobotSample]) -> Vec<u8> {
    let numbers = |sample: &RobotSample| -> [f32; SAMPLE_LEN] {
        let [position, velocity] = sample.base.unwrap_or([[f32::NAN; 3]; 2]);
        let joints = [sample.q, sample.dq, sample.q_cmd, sample.tau];
        let mut rest = sample.orientation.into_iter().chain(sample.gyro).chain(position).chain(velocity);
        let mut joints = joints.into_iter().flatten();
        std::array::from_fn(|_| joints.next().or_else(|| rest.next()).unwrap_or(f32::NAN))
    };
    let samples: Vec<[f32; SAMPLE_LEN]> = samples.iter().map(numbers).collect();
    encode(&message::SamplesReply { protocol: PROTOCOL, samples: tensor::as_bytes(samples.as_flattened()) })
}

/// Decodes the reply to a request for samples.
pub fn decode_samples(reply: message::SamplesReply<'_>) -> Result<Vec<RobotSample>, ErrorReply> {
    let numbers: Vec<f32> = tensor::read(reply.samples, "samples")?;
    let (samples, rest) = numbers.as_chunks::<SAMPLE_LEN>();
    if !rest.is_empty() {
        return Err(wrong_length("samples", numbers.len(), samples.len() * SAMPLE_LEN));
    }
    Ok(samples.iter().map(read_sample).collect())
}

fn read_sample(numbers: &[f32; SAMPLE_LEN]) -> RobotSample {
    let mut numbers = numbers.iter().copied();
    let mut next = || numbers.next().expect("the sizes below add up to the length of the array");
    let [q, dq, q_cmd, tau]: [PerJoint; 4] = std::array::from_fn(|_| std::array::from_fn(|_| next()));
    let (orientation, gyro) = (std::array::from_fn(|_| next()), std::array::from_fn(|_| next()));
    let base: [[f32; 3]; 2] = std::array::from_fn(|_| std::array::from_fn(|_| next()));
    let base = base.iter().flatten().all(|value| value.is_finite()).then_some(base);
    RobotSample { q, dq, q_cmd, tau, orientation, gyro, base }
}

/// Returns the ground of a scene as part of a message, without copying the heights.
pub fn encode_ground(ground: &Ground) -> message::Ground<'_> {
    let height_field = ground.height_field.as_deref().map(|field| {
        let [rows, columns] = field.shape().map(|count| count as u32);
        let heights = tensor::as_bytes(field.heights());
        message::HeightField { origin: field.origin(), cell_size: field.cell_size(), rows, columns, heights }
    });
    message::Ground { point: ground.point, normal: ground.normal, height_field }
}

/// Decodes the reply to a render request.
///
/// Fails if a body has no pose, a shape refers to a missing body, a face to a missing point, or a vertex of the ground has
/// no height.
pub fn decode_scene(reply: message::RenderReply<'_>) -> Result<Scene, ErrorReply> {
    let message::RenderReply { bodies, pose, shapes, ground, command, .. } = reply;
    let pose: Vec<[f32; 7]> = tensor::read(pose, "pose")?;
    check_length("pose", pose.len(), bodies.len())?;
    if let Some(shape) = shapes.iter().find(|shape| shape.body as usize >= bodies.len()) {
        let message = format!("`shapes` has body {}; there are {}", shape.body, bodies.len());
        return Err(ErrorReply::new(ErrorCode::OutOfRange, "shapes", message));
    }
    for mesh in shapes.iter().filter_map(|shape| shape.mesh.as_ref()) {
        if let Some(point) = mesh.faces.iter().flatten().find(|point| usize::from(**point) >= mesh.points.len()) {
            let message = format!("`shapes.mesh.faces` has point {point}; there are {}", mesh.points.len());
            return Err(ErrorReply::new(ErrorCode::OutOfRange, "shapes.mesh.faces", message));
        }
    }
    let ground = decode_ground(ground)?;
    Ok(Scene {
        bodies,
        pose,
        shapes,
        ground,
        command,
        velocity: None,
        torque: None,
        contact_force: None,
        reward_terms: Vec::new(),
        uncertainty: None,
    })
}

fn decode_ground(ground: message::Ground<'_>) -> Result<Ground, ErrorReply> {
    let message::Ground { point, normal, height_field } = ground;
    let height_field = height_field.map(read_height_field).transpose()?.map(Arc::new);
    Ok(Ground { point, normal, height_field, patches: None })
}

fn read_height_field(field: message::HeightField<'_>) -> Result<HeightField, ErrorReply> {
    let message::HeightField { origin, cell_size, rows, columns, heights } = field;
    let heights: Vec<f32> = tensor::read(heights, "heights")?;
    HeightField::new(origin, cell_size, [rows, columns].map(|count| count as usize), heights)
        .map_err(|error| ErrorReply::new(ErrorCode::BadShape, "height_field", error.to_string()))
}

/// Checks that the length `given` of a field equals `expected`.
pub fn check_length(field: &'static str, given: usize, expected: usize) -> Result<(), ErrorReply> {
    if given == expected { Ok(()) } else { Err(wrong_length(field, given, expected)) }
}

fn wrong_length(field: &'static str, given: usize, expected: usize) -> ErrorReply {
    let message = format!("`{field}` has {given} entries; {expected} are expected");
    ErrorReply::new(ErrorCode::BadShape, field, message)
}

/// Converts an error of an environment to an error reply.
pub fn wire_error(error: &EnvError) -> ErrorReply {
    let (code, field, hint) = match error {
        EnvError::WrongLength { field, .. } => {
            (ErrorCode::BadShape, *field, "expected are `num_envs` × the size in the spec")
        }
        EnvError::ActionNotFinite { .. } => {
            (ErrorCode::NotFinite, "actions", "check the policy that computed the action")
        }
        EnvError::NoVelocityCommand { .. } => (
            ErrorCode::OutOfRange,
            "command",
            "leave the field out, or use a task with a velocity command, such as `walk`",
        ),
        EnvError::NoGaitCommand { .. } => (
            ErrorCode::OutOfRange,
            "gait_command",
            "leave the field out, or use a task with a gait command, such as `gait`",
        ),
        EnvError::CommandOutOfRange { value, field, .. } => {
            let code = if value.is_finite() { ErrorCode::OutOfRange } else { ErrorCode::NotFinite };
            (code, *field, "the bounds are those of the entries of the observation in the spec")
        }
        EnvError::NeedsReset { .. } => (ErrorCode::NeedsReset, "", "send `reset`, with `mask` for some environments"),
        EnvError::EnvOutOfRange { .. } => (ErrorCode::OutOfRange, "env", "environments are numbered from 0"),
        EnvError::RenderUnsupported { .. } | EnvError::SamplesUnsupported { .. } => {
            (ErrorCode::UnknownKey, "", "use a task with a robot, such as `walk`")
        }
        EnvError::Backend(BackendError::Waiting { .. }) => {
            (ErrorCode::Waiting, "", "repeat the request; the robot's operator moves it to its standing pose")
        }
        EnvError::Backend(_) | EnvError::Remote(_) => (ErrorCode::Internal, "", "read the log of the server"),
    };
    ErrorReply::new(code, field, error.to_string()).with_hint(hint)
}
