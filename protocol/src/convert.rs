//! Conversions between messages and the types of `twinstep-model`.

use std::sync::Arc;

use twinstep_model::{EndedEpisode, EnvError, EnvSpec, Ground, HeightField, ResetRequest, Scene, StepBatch};

use crate::codec::encode_with_capacity;
use crate::{ErrorCode, ErrorReply, PROTOCOL, encode, message, tensor};

/// Upper bound on the size of a message without its tensors [bytes].
const MAP_OVERHEAD: usize = 256;

/// Entries of a velocity command: forward, left, yaw rate.
const VELOCITY_COMMAND_LEN: usize = 3;

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

/// Returns the maximum size of a request to `num_envs` environments [bytes].
pub fn max_request_bytes(num_envs: usize, spec: &EnvSpec) -> usize {
    let reset = size_of::<u64>() + size_of::<u8>();
    let step = (spec.action_len() + VELOCITY_COMMAND_LEN) * size_of::<f32>();
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
pub fn encode_observations(obs: &[f32], critic_obs: &[f32], seq: u64) -> Vec<u8> {
    let (obs, critic_obs) = (tensor::as_bytes(obs), tensor::as_bytes(critic_obs));
    encode(&message::ResetReply { protocol: PROTOCOL, seq, obs, critic_obs })
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
    let ended = &batch.ended;
    let env: Vec<u32> = ended.iter().map(|episode| episode.env as u32).collect();
    let length: Vec<u32> = ended.iter().map(|episode| episode.length).collect();
    let episode_return: Vec<f32> = ended.iter().map(|episode| episode.episode_return).collect();
    let terms: Vec<f32> = ended.iter().flat_map(|episode| episode.terms.iter().copied()).collect();
    let diverged: Vec<bool> = ended.iter().map(|episode| episode.diverged).collect();
    let final_obs: Vec<f32> = ended.iter().flat_map(|episode| episode.final_obs.iter().copied()).collect();
    let critic_obs = if with_critic { &batch.critic_obs[..] } else { &[] };
    let with_final_critic = ended.iter().filter(|_| with_critic);
    let final_critic_obs: Vec<f32> =
        with_final_critic.flat_map(|episode| episode.final_critic_obs.iter().copied()).collect();
    let reply = message::StepReply {
        protocol: PROTOCOL,
        seq,
        obs: tensor::as_bytes(&batch.obs),
        reward: tensor::as_bytes(&batch.reward),
        terminated: tensor::flags_as_bytes(&batch.terminated),
        truncated: tensor::flags_as_bytes(&batch.truncated),
        ended_env: tensor::as_bytes(&env),
        ended_length: tensor::as_bytes(&length),
        ended_return: tensor::as_bytes(&episode_return),
        ended_terms: tensor::as_bytes(&terms),
        ended_diverged: tensor::flags_as_bytes(if diverged.contains(&true) { &diverged } else { &[] }),
        final_obs: tensor::as_bytes(&final_obs),
        critic_obs: tensor::as_bytes(critic_obs),
        final_critic_obs: tensor::as_bytes(&final_critic_obs),
    };
    let critic = critic_obs.len() + final_critic_obs.len();
    let numbers = batch.obs.len() + batch.reward.len() + 3 * ended.len() + terms.len() + final_obs.len() + critic;
    let flags = batch.terminated.len() + batch.truncated.len();
    encode_with_capacity(&reply, MAP_OVERHEAD + numbers * size_of::<f32>() + flags)
}

/// Encodes a step request. `commands` are the velocity commands, if the client gives them.
pub fn encode_actions(actions: &[f32], commands: Option<&[[f32; 3]]>, epoch: u64, seq: u64) -> Vec<u8> {
    let (actions, command) = (tensor::as_bytes(actions), commands.map(tensor::as_bytes));
    let request = message::StepRequest { protocol: PROTOCOL, epoch, seq, actions, command };
    encode_with_capacity(&request, MAP_OVERHEAD + actions.len() + command.map_or(0, <[u8]>::len))
}

/// Decodes the velocity commands of a step request for `num_envs` environments. Checks the length before it copies.
pub fn read_commands(bytes: &[u8], num_envs: usize) -> Result<Vec<[f32; 3]>, ErrorReply> {
    check_length("command", bytes.len() / size_of::<f32>(), num_envs * VELOCITY_COMMAND_LEN)?;
    tensor::read(bytes, "command")
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
    let env: Vec<u32> = tensor::read(reply.ended_env, "ended_env")?;
    let length: Vec<u32> = tensor::read(reply.ended_length, "ended_length")?;
    let episode_return: Vec<f32> = tensor::read(reply.ended_return, "ended_return")?;
    let terms: Vec<f32> = tensor::read(reply.ended_terms, "ended_terms")?;
    let mut diverged = tensor::flags_from_bytes(reply.ended_diverged);
    let final_obs: Vec<f32> = tensor::read(reply.final_obs, "final_obs")?;
    tensor::read_into(reply.critic_obs, &mut batch.critic_obs, "critic_obs")?;
    let final_critic_obs: Vec<f32> = tensor::read(reply.final_critic_obs, "final_critic_obs")?;
    let (ended, obs_len, num_terms) = (env.len(), spec.obs_len(), spec.reward_terms.len());
    let critic_len = spec.critic_obs_len();
    if diverged.is_empty() {
        diverged.resize(ended, false);
    }
    for (field, given, expected) in [
        ("obs", batch.obs.len(), num_envs * obs_len),
        ("reward", batch.reward.len(), num_envs),
        ("terminated", batch.terminated.len(), num_envs),
        ("truncated", batch.truncated.len(), num_envs),
        ("ended_length", length.len(), ended),
        ("ended_return", episode_return.len(), ended),
        ("ended_terms", terms.len(), ended * num_terms),
        ("ended_diverged", diverged.len(), ended),
        ("final_obs", final_obs.len(), if final_obs.is_empty() { 0 } else { ended * obs_len }),
        ("critic_obs", batch.critic_obs.len(), num_envs * critic_len),
        ("final_critic_obs", final_critic_obs.len(), if final_obs.is_empty() { 0 } else { ended * critic_len }),
    ] {
        check_length(field, given, expected)?;
    }
    if let Some(env) = env.iter().find(|env| **env as usize >= num_envs) {
        let message = format!("`ended_env` has environment {env}; there are {num_envs}");
        return Err(ErrorReply::new(ErrorCode::OutOfRange, "ended_env", message));
    }
    batch.ended = (0..ended)
        .map(|k| EndedEpisode {
            env: env[k] as usize,
            length: length[k],
            episode_return: episode_return[k],
            terms: terms[k * num_terms..(k + 1) * num_terms].to_vec(),
            diverged: diverged[k],
            final_obs: final_obs.get(k * obs_len..(k + 1) * obs_len).unwrap_or_default().to_vec(),
            final_critic_obs: final_critic_obs.get(k * critic_len..(k + 1) * critic_len).unwrap_or_default().to_vec(),
        })
        .collect();
    Ok(())
}

/// Encodes the reply to a render request.
pub fn encode_scene(scene: Scene) -> Vec<u8> {
    let Scene { bodies, pose, shapes, ground, command } = scene;
    let pose = tensor::as_bytes(&pose);
    encode(&message::RenderReply { protocol: PROTOCOL, bodies, pose, shapes, ground: encode_ground(&ground), command })
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
/// Fails if a body has no pose, a shape refers to a missing body, or a vertex of the ground has no height.
pub fn decode_scene(reply: message::RenderReply<'_>) -> Result<Scene, ErrorReply> {
    let message::RenderReply { bodies, pose, shapes, ground, command, .. } = reply;
    let pose: Vec<[f32; 7]> = tensor::read(pose, "pose")?;
    check_length("pose", pose.len(), bodies.len())?;
    if let Some(shape) = shapes.iter().find(|shape| shape.body as usize >= bodies.len()) {
        let message = format!("`shapes` has body {}; there are {}", shape.body, bodies.len());
        return Err(ErrorReply::new(ErrorCode::OutOfRange, "shapes", message));
    }
    Ok(Scene { bodies, pose, shapes, ground: decode_ground(ground)?, command })
}

fn decode_ground(ground: message::Ground<'_>) -> Result<Ground, ErrorReply> {
    let message::Ground { point, normal, height_field } = ground;
    let height_field = height_field.map(read_height_field).transpose()?.map(Arc::new);
    Ok(Ground { point, normal, height_field })
}

fn read_height_field(field: message::HeightField<'_>) -> Result<HeightField, ErrorReply> {
    let message::HeightField { origin, cell_size, rows, columns, heights } = field;
    let heights: Vec<f32> = tensor::read(heights, "heights")?;
    HeightField::new(origin, cell_size, [rows, columns].map(|count| count as usize), heights)
        .map_err(|error| ErrorReply::new(ErrorCode::BadShape, "height_field", error.to_string()))
}

/// Checks that the length `given` of a field equals `expected`.
pub fn check_length(field: &'static str, given: usize, expected: usize) -> Result<(), ErrorReply> {
    if given == expected {
        return Ok(());
    }
    let message = format!("`{field}` has {given} entries; {expected} are expected");
    Err(ErrorReply::new(ErrorCode::BadShape, field, message))
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
        EnvError::VelocityCommand { value, .. } => {
            let code = if value.is_finite() { ErrorCode::OutOfRange } else { ErrorCode::NotFinite };
            (code, "command", "the bounds are those of `velocity_command` in the spec")
        }
        EnvError::NeedsReset { .. } => (ErrorCode::NeedsReset, "", "send `reset`, with `mask` for some environments"),
        EnvError::EnvOutOfRange { .. } => (ErrorCode::OutOfRange, "env", "environments are numbered from 0"),
        EnvError::RenderUnsupported { .. } => (ErrorCode::UnknownKey, "", "use a task with a robot, such as `walk`"),
        EnvError::Backend(_) | EnvError::Remote(_) => (ErrorCode::Internal, "", "read the log of the server"),
    };
    ErrorReply::new(code, field, error.to_string()).with_hint(hint)
}
