//! Messages of the protocol: examples, and decoding as client and server do.

use std::sync::LazyLock;

use serde::Deserialize;
use twinstep_model::{EnvSpec, StepBatch, Trajectory};
use twinstep_protocol::message::{
    CloseReply, CloseRequest, HelloReply, HelloRequest, LeaseReply, LeaseRequest, RenderReply, RenderRequest,
    RequestHeader, ResetReply, ResetRequest, RolloutReply, RolloutRequest, StepReply, StepRequest,
};
use twinstep_protocol::{ErrorReply, convert, decode, encode, keys, tensor};

use super::format::{Message, Outcome, examples_in};

/// Number of environments in the golden messages.
const NUM_ENVS: usize = 2;
/// Number of steps in the golden rollout.
const NUM_STEPS: usize = 2;

impl Message {
    /// Returns the golden files of this kind.
    pub fn examples(self) -> Vec<Vec<u8>> {
        let (_, name) = Self::ALL[self as usize];
        examples_in("protocol/golden", name, ".msgpack")
    }

    /// Returns true if clients send it and the server reads it.
    fn is_request(self) -> bool {
        Self::ALL[self as usize].1.ends_with("request")
    }

    /// Decodes a message and converts it as its reader does.
    pub fn read(self, bytes: &[u8]) -> Outcome {
        // The server refuses larger requests before it decodes them.
        let limit = match self {
            Message::RolloutRequest => convert::MAX_ROLLOUT_REQUEST_BYTES,
            _ => convert::max_request_bytes(64, &GOLDEN_SPEC),
        };
        if self.is_request() && bytes.len() > limit {
            return Outcome::Refused;
        }
        match self {
            Message::HelloRequest => then::<HelloRequest>(bytes, |_| true),
            Message::HelloReply => then::<HelloReply>(bytes, |reply| uses_spec(&reply.spec, NUM_ENVS as u64)),
            Message::LeaseRequest => {
                then::<LeaseRequest>(bytes, |request| !keys::live_client("", &request.client).is_empty())
            }
            Message::LeaseReply => then::<LeaseReply>(bytes, |reply| uses_spec(&reply.spec, reply.num_envs)),
            Message::ResetRequest => {
                header(bytes);
                then::<ResetRequest<'_>>(bytes, |request| convert::read_reset(&request, NUM_ENVS).is_ok())
            }
            Message::ResetReply => then::<ResetReply<'_>>(bytes, |reply| {
                convert::decode_observations(&reply, spec_of(reply.critic_obs), NUM_ENVS, &mut StepBatch::default())
                    .is_ok()
            }),
            Message::StepRequest => {
                header(bytes);
                then::<StepRequest<'_>>(bytes, |request| {
                    let expected = NUM_ENVS * GOLDEN_SPEC.action_len();
                    convert::check_length("actions", request.actions.len() / size_of::<f32>(), expected).is_ok()
                        && tensor::read::<f32>(request.actions, "actions").is_ok()
                        && convert::read_commands(&request, NUM_ENVS).is_ok()
                })
            }
            Message::StepReply => then::<StepReply<'_>>(bytes, |reply| {
                convert::decode_step(&reply, spec_of(reply.critic_obs), NUM_ENVS, &mut StepBatch::default()).is_ok()
            }),
            Message::RolloutRequest => {
                header(bytes);
                then::<RolloutRequest<'_>>(bytes, |request| match request.policy {
                    Some(policy) => tensor::read::<f32>(policy.weights, "policy.weights").is_ok(),
                    None => request.policy_id.is_some(),
                })
            }
            Message::RolloutReply => then::<RolloutReply<'_>>(bytes, |reply| {
                let (spec, mut trajectory) = (spec_of(reply.critic_obs), Trajectory::default());
                convert::decode_trajectory(&reply, spec, NUM_ENVS, NUM_STEPS, &mut trajectory).is_ok()
            }),
            Message::CloseRequest => then::<CloseRequest>(bytes, |_| true),
            Message::CloseReply => then::<CloseReply>(bytes, |_| true),
            Message::RenderRequest => then::<RenderRequest>(bytes, |_| true),
            Message::RenderReply => {
                then::<RenderReply<'_>>(bytes, |reply| match convert::decode_scene(reply) {
                    // A scene that was accepted can be sent again.
                    Ok(scene) => !convert::encode_scene(scene).is_empty(),
                    Err(_) => false,
                })
            }
            Message::Error => then::<ErrorReply>(bytes, |error| !error.to_string().is_empty()),
        }
    }
}

fn then<'a, T: Deserialize<'a>>(bytes: &'a [u8], is_accepted: impl FnOnce(T) -> bool) -> Outcome {
    match decode::<T>(bytes) {
        Ok(message) => Outcome::checked(is_accepted(message)),
        Err(error) => {
            // The server sends the error.
            encode(&error);
            Outcome::Refused
        }
    }
}

/// Decodes what a worker of the server reads of each request first.
fn header(bytes: &[u8]) {
    drop(decode::<RequestHeader>(bytes));
}

/// Uses a spec as a client does: its texts, its lengths, and a step reply with it.
fn uses_spec(spec: &EnvSpec, num_envs: u64) -> bool {
    let texts = [spec.hash(), spec.observation_entry(4), spec.action_entry(usize::MAX)];
    let Ok(num_envs) = convert::check_lease(num_envs, spec) else { return false };
    let reply: StepReply<'_> = decode(&STEP_REPLY).expect("the golden file is a step reply");
    // The spec of another robot does not fit this reply.
    drop(convert::decode_step(&reply, spec, num_envs, &mut StepBatch::default()));
    !texts.concat().is_empty()
}

/// A step reply of two environments of [`GOLDEN_SPEC`].
static STEP_REPLY: LazyLock<Vec<u8>> =
    LazyLock::new(|| examples_in("protocol/golden", "step_reply_ended", ".msgpack").remove(0));

/// Spec of the golden messages, from the golden lease reply.
static GOLDEN_SPEC: LazyLock<EnvSpec> = LazyLock::new(|| {
    let lease = examples_in("protocol/golden", "lease_reply", ".msgpack").remove(0);
    decode::<LeaseReply>(&lease).expect("the golden file is a lease reply").spec
});

/// The same with the group `critic` of the golden replies.
static CRITIC_SPEC: LazyLock<EnvSpec> =
    LazyLock::new(|| EnvSpec { critic_observation: GOLDEN_SPEC.action.clone(), ..GOLDEN_SPEC.clone() });

/// Returns the spec of a lease that has these observations of group `critic`.
fn spec_of(critic_obs: &[u8]) -> &'static EnvSpec {
    if critic_obs.is_empty() { &GOLDEN_SPEC } else { &CRITIC_SPEC }
}
