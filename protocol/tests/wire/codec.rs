//! What the codec holds for all messages and all bytes.

use std::fmt::Debug;
use std::sync::Arc;

use proptest::prelude::*;
use serde::{Deserialize, Serialize};
use twinstep_model::{AutoresetMode, EndedEpisode, RealTimeReport, RobotStop, Scene, StepBatch, Trajectory};
use twinstep_protocol::message::{
    CloseReply, CloseRequest, HelloReply, HelloRequest, LeaseReply, LeaseRequest, RealTime, Reclaim, RenderReply,
    RenderRequest, RequestHeader, ResetReply, ResetRequest, RolloutPolicy, RolloutReply, RolloutRequest, StepReply,
    StepRequest, StopReply, StopRequest,
};
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, convert, decode, encode, tensor};

use crate::golden;

/// Kinds of messages.
const KINDS: usize = 18;

/// Decodes `bytes` as every kind of message; the codes of those that were refused.
fn refusals(bytes: &[u8]) -> Vec<ErrorCode> {
    fn refusal<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Option<ErrorCode> {
        decode::<T>(bytes).err().map(|error| error.code)
    }
    [
        refusal::<HelloRequest>(bytes),
        refusal::<HelloReply>(bytes),
        refusal::<LeaseRequest>(bytes),
        refusal::<LeaseReply>(bytes),
        refusal::<ResetRequest<'_>>(bytes),
        refusal::<ResetReply<'_>>(bytes),
        refusal::<StepRequest<'_>>(bytes),
        refusal::<StepReply<'_>>(bytes),
        refusal::<RolloutRequest<'_>>(bytes),
        refusal::<RolloutReply<'_>>(bytes),
        refusal::<CloseRequest>(bytes),
        refusal::<CloseReply>(bytes),
        refusal::<StopRequest>(bytes),
        refusal::<StopReply>(bytes),
        refusal::<RenderRequest>(bytes),
        refusal::<RenderReply<'_>>(bytes),
        refusal::<RequestHeader>(bytes),
        refusal::<ErrorReply>(bytes),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn round_trips<'a, T: Serialize + Deserialize<'a> + PartialEq + Debug>(message: &T, buffer: &'a mut Vec<u8>) {
    *buffer = encode(message);
    assert_eq!(&decode::<T>(buffer).expect("what was encoded decodes"), message);
}

fn any_autoreset() -> impl Strategy<Value = AutoresetMode> {
    prop::sample::select(vec![AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled])
}

/// The same message with one more field, first or last.
fn with_unknown_field(message: &[u8], first: bool, value: &[u8]) -> Vec<u8> {
    // A map of up to 15 fields, or `map 16`.
    let (count, fields) = match message[0] {
        0xde => (u16::from_be_bytes([message[1], message[2]]), &message[3..]),
        short => (u16::from(short & 0x0f), &message[1..]),
    };
    let head = [&[0xde][..], &(count + 1).to_be_bytes()].concat();
    let mut field = b"\xa7unknown".to_vec();
    // `value` as MessagePack `bin 8`.
    field.extend([0xc4, value.len() as u8]);
    field.extend(value);
    let (before, after) = if first { (field, Vec::new()) } else { (Vec::new(), field) };
    [head, before, fields.to_vec(), after].concat()
}

proptest! {
    #[test]
    fn requests_for_a_lease_round_trip(
        protocol: u16, client: String, num_envs: u64, autoreset in any_autoreset(), max_episode_steps: Option<u32>,
        critic: bool, spec_hash: Option<String>, reclaim: Option<(String, u64)>,
    ) {
        round_trips(&HelloRequest { protocol, client: client.clone() }, &mut Vec::new());
        let reclaim = reclaim.map(|(lease, epoch)| Reclaim { lease, epoch });
        let request =
            LeaseRequest { protocol, client, num_envs, autoreset, max_episode_steps, critic, spec_hash, reclaim };
        round_trips(&request, &mut Vec::new());
    }

    #[test]
    fn what_a_server_tells_of_itself_round_trips(
        protocols: [u16; 2], name: String, counts: [u64; 3], lease_grace_s in 0.0..1e9, autoreset in any_autoreset(),
    ) {
        let [max_envs, free_envs, env_steps] = counts;
        let spec = golden::small_spec();
        let hello = HelloReply {
            protocol: PROTOCOL, protocols, server_version: name.clone(), server_id: name.clone(), spec_hash: spec.hash(),
            spec: spec.clone(), max_envs, free_envs, lease_grace_s, max_envs_per_client: max_envs, max_request_bytes: free_envs,
            lease_idle_s: Some(lease_grace_s), env_steps, max_rollout_steps: env_steps, max_policy_bytes: max_envs,
            name: name.clone(),
            real_time: Some(RealTime { absent_reward_terms: vec![name.clone()], state: name.clone(), ..RealTime::default() }),
        };
        round_trips(&hello, &mut Vec::new());
        let granted = LeaseReply {
            protocol: PROTOCOL, lease: name, epoch: max_envs, num_envs: free_envs, autoreset, last_seq: env_steps, spec,
        };
        round_trips(&granted, &mut Vec::new());
    }

    #[test]
    fn requests_of_a_lease_round_trip(
        protocol: u16, epoch: u64, seq: u64, bytes: Vec<u8>, seeds: Option<Vec<u8>>, mask: Option<Vec<u8>>,
        tick: Option<u64>,
    ) {
        let (seeds, mask) = (seeds.as_deref(), mask.as_deref());
        round_trips(&ResetRequest { protocol, epoch, seq, seeds, mask }, &mut Vec::new());
        round_trips(&ResetReply { protocol, seq, obs: &bytes, critic_obs: &bytes, tick, stamp_ns: tick }, &mut Vec::new());
        round_trips(&StepRequest { protocol, epoch, seq, actions: &bytes, command: None, gait_command: None, for_tick: tick }, &mut Vec::new());
        let policy = RolloutPolicy { sizes: vec![epoch, seq], weights: &bytes, mean: &bytes, std: &bytes, log_std: &bytes };
        for (policy, policy_id) in [(Some(policy), None), (None, Some(epoch))] {
            let request = RolloutRequest { protocol, epoch, seq, steps: seq, noise_seed: epoch, policy, policy_id };
            round_trips(&request, &mut Vec::new());
        }
        round_trips(&CloseRequest { protocol, epoch, seq }, &mut Vec::new());
        round_trips(&CloseReply { protocol, seq }, &mut Vec::new());
        round_trips(&StopRequest { protocol }, &mut Vec::new());
        round_trips(&StopReply { protocol }, &mut Vec::new());
        round_trips(&RenderRequest { protocol, epoch, env: seq }, &mut Vec::new());
    }

    #[test]
    fn errors_round_trip(code in prop::sample::select(ErrorCode::ALL.to_vec()), words: [String; 3]) {
        let [field, message, hint] = words;
        round_trips(&ErrorReply::new(code, field, message).with_hint(hint), &mut Vec::new());
    }

    #[test]
    fn steps_round_trip_with_their_ended_episodes(
        rows in prop::collection::vec((-1e9f32..1e9, any::<bool>(), any::<bool>(), any::<u32>()), 1..6), seq: u64,
        tick: Option<u64>, reason: Option<String>,
    ) {
        let mut spec = golden::small_spec();
        spec.critic_observation = spec.action.clone();
        let mut batch = StepBatch::new(rows.len(), &spec);
        for (env, (reward, terminated, truncated, length)) in rows.iter().copied().enumerate() {
            batch.reward[env] = reward;
            batch.terminated[env] = terminated;
            batch.truncated[env] = truncated;
            batch.obs[env] = -reward;
            if batch.done(env) {
                let terms = vec![reward, -reward];
                let final_obs = vec![reward; spec.obs_len()];
                let final_critic_obs = vec![-reward; spec.critic_obs_len()];
                let ended = EndedEpisode { env, length, episode_return: reward, terms, diverged: env == 0, final_obs, final_critic_obs };
                batch.ended.push(ended);
            }
        }
        batch.critic_obs.fill(0.5);
        let terminates = batch.terminated.contains(&true);
        batch.real_time = tick.map(|tick| RealTimeReport {
            tick,
            stamp_ns: seq,
            late_ticks: 3,
            applied: [0.5; 12],
            refused: reason.clone(),
            stop: reason.map(|reason| RobotStop { reason, terminates }),
        });
        let bytes = convert::encode_step(&batch, seq, true);
        let reply: StepReply<'_> = decode(&bytes).expect("what was encoded decodes");
        let mut read = StepBatch::default();
        convert::decode_step(&reply, &spec, rows.len(), &mut read).expect("the lengths fit");
        prop_assert_eq!(read, batch);
    }

    #[test]
    fn rollouts_round_trip_with_their_ended_episodes(
        num_envs in 1..4usize, ends in prop::collection::vec((any::<bool>(), any::<bool>(), -1e9f32..1e9), 1..20), seq: u64,
        with_critic: bool,
    ) {
        let mut spec = golden::small_spec();
        if with_critic {
            spec.critic_observation = spec.action.clone();
        }
        let steps = ends.len() / num_envs;
        let mut trajectory = Trajectory::default();
        let critic_obs = vec![0.25; num_envs * spec.critic_obs_len()];
        trajectory.start(steps, &spec, &vec![0.5; num_envs * spec.obs_len()], &critic_obs);
        for step in ends.chunks_exact(num_envs) {
            let mut batch = StepBatch::new(num_envs, &spec);
            for (env, (terminated, truncated, reward)) in step.iter().copied().enumerate() {
                (batch.terminated[env], batch.truncated[env], batch.reward[env]) = (terminated, truncated, reward);
                batch.obs[env] = -reward;
                if batch.done(env) {
                    batch.ended.push(EndedEpisode {
                        env,
                        length: 7,
                        episode_return: reward,
                        terms: vec![reward, 1.0],
                        diverged: truncated,
                        final_obs: vec![reward; spec.obs_len()],
                        final_critic_obs: vec![-reward; spec.critic_obs_len()],
                    });
                }
            }
            trajectory.push(&batch);
        }
        let bytes = convert::encode_trajectory(&trajectory, seq, with_critic);
        let reply: RolloutReply<'_> = decode(&bytes).expect("what was encoded decodes");
        let mut read = Trajectory::default();
        convert::decode_trajectory(&reply, &spec, num_envs, steps, &mut read).expect("the lengths fit");
        prop_assert_eq!(&read, &trajectory);
        // A reply with another number of steps or environments does not fit.
        prop_assert!(convert::decode_trajectory(&reply, &spec, num_envs, steps + 1, &mut read).is_err());
        prop_assert!(convert::decode_trajectory(&reply, &spec, num_envs + 1, steps, &mut read).is_err());
    }

    #[test]
    fn unknown_fields_are_ignored(
        name in prop::sample::select(golden::NAMES.to_vec()), first: bool,
        value in prop::collection::vec(any::<u8>(), 0..20),
    ) {
        let message = golden::read(name);
        prop_assert_eq!(refusals(&with_unknown_field(message, first, &value)), refusals(message));
    }

    #[test]
    fn truncated_messages_are_malformed(
        name in prop::sample::select(golden::NAMES.to_vec()), cut in any::<prop::sample::Index>(),
    ) {
        let message = golden::read(name);
        let codes = refusals(&message[..cut.index(message.len())]);
        prop_assert_eq!(codes, vec![ErrorCode::Malformed; KINDS]);
    }

    #[test]
    fn mutated_messages_are_refused_or_read(
        name in prop::sample::select(golden::NAMES.to_vec()),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let mut message = golden::read(name).to_vec();
        for (at, byte) in changes {
            let at = at.index(message.len());
            message[at] = byte;
        }
        prop_assert!(refusals(&message).iter().all(|code| matches!(code, ErrorCode::Malformed | ErrorCode::Version)));
    }

    // A few random bytes can be a message whose fields are all optional, so not all of them are refused.
    #[test]
    fn random_bytes_are_refused_or_read(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let codes = refusals(&bytes);
        prop_assert!(codes.iter().all(|code| matches!(code, ErrorCode::Malformed | ErrorCode::Version)));
        let is_map = matches!(bytes.first(), Some(0x80..=0x8f | 0xde | 0xdf));
        prop_assert!(is_map || codes.len() == KINDS);
    }
}

#[test]
fn missing_optional_fields_take_their_defaults() {
    #[derive(Serialize)]
    struct Lease {
        protocol: u16,
        client: &'static str,
        num_envs: u64,
        autoreset: &'static str,
    }
    let lease = encode(&Lease { protocol: PROTOCOL, client: "c1", num_envs: 3, autoreset: "NextStep" });
    let lease: LeaseRequest = decode(&lease).expect("the rest is optional");
    assert_eq!((lease.max_episode_steps, lease.spec_hash, lease.reclaim), (None, None, None));
    let least = encode(&CloseRequest { protocol: PROTOCOL, epoch: 1, seq: 1 });
    let reset: ResetRequest<'_> = decode(&least).expect("the rest is optional");
    assert_eq!((reset.seeds, reset.mask), (None, None));
    let hello: HelloRequest = decode(b"\x81\xa8protocol\x01").expect("the rest is optional");
    assert_eq!(hello.client, "");
}

#[test]
fn integers_may_have_any_width() {
    let close = decode::<CloseReply>(b"\x82\xa8protocol\xcf\0\0\0\0\0\0\0\x01\xa3seq\xd2\0\0\0\x07");
    assert_eq!(close, Ok(CloseReply { protocol: PROTOCOL, seq: 7 }));
}

#[test]
fn missing_required_fields_are_named() {
    let close = encode(&CloseRequest { protocol: PROTOCOL, epoch: 1, seq: 1 });
    let error = decode::<StepRequest<'_>>(&close).expect_err("it has no actions");
    assert_eq!((error.code, error.message.as_str()), (ErrorCode::Malformed, "missing field `actions`"));
}

#[test]
fn fields_by_position_are_malformed() {
    // [1, 1, 1] would be a close request if fields could go without names.
    assert_eq!(refusals(&[0x93, 1, 1, 1]), vec![ErrorCode::Malformed; KINDS]);
}

#[test]
fn foreign_version_is_told_apart_even_if_the_fields_changed() {
    let error = decode::<StepRequest<'_>>(b"\x82\xa8protocol\x02\xa3new\x01").expect_err("version 2");
    assert_eq!(error.code, ErrorCode::Version);
}

#[test]
fn deep_nesting_is_malformed() {
    // {"protocol": [[[…]]]} with a hundred thousand brackets.
    let bytes = [b"\x81\xa8protocol".to_vec(), vec![0x91; 100_000]].concat();
    assert_eq!(refusals(&bytes), vec![ErrorCode::Malformed; KINDS]);
}

#[test]
fn tensors_are_read_from_golden_bytes() {
    let reply: StepReply<'_> = decode(golden::read("step_reply_ended")).expect("golden");
    let mut batch = StepBatch::default();
    convert::decode_step(&reply, &golden::small_spec(), 2, &mut batch).expect("the lengths fit");
    assert_eq!(batch.reward, [0.75, -1.25]);
    assert_eq!((batch.ended[0].env, batch.ended[0].length), (1, 300));
    assert_eq!(batch.ended[0].final_obs, [0.5, 0.5, -0.5, 1.5, -2.5]);
    let reset: ResetRequest<'_> = decode(golden::read("reset_request_seeds_mask")).expect("golden");
    assert_eq!(tensor::read::<u64>(reset.seeds.expect("seeds"), "seeds").expect("whole numbers"), [7, u64::MAX]);
}

#[test]
fn lease_that_no_reply_could_hold_is_refused() {
    let mut spec = golden::small_spec();
    assert_eq!(convert::check_lease(4096, &spec), Ok(4096));
    let error = convert::check_lease(u64::MAX, &spec).expect_err("too many environments");
    assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "observation"));
    // The sum of both sizes is 1 in 64-bit arithmetic without a check.
    (spec.observation[0].size, spec.observation[1].size) = (usize::MAX, 2);
    assert!(convert::check_lease(1, &spec).is_err());
}

#[test]
fn scene_survives_the_wire_and_a_shape_without_a_body_is_refused() {
    let scene = golden::small_scene();
    let bytes = convert::encode_scene(scene.clone());
    let reply: RenderReply<'_> = decode(&bytes).expect("what was encoded decodes");
    assert_eq!(convert::decode_scene(reply.clone()).expect("it fits"), scene);
    let mut stray = reply.clone();
    stray.shapes[0].body = 2;
    let error = convert::decode_scene(stray).expect_err("there are two bodies");
    assert_eq!((error.code, error.message.as_str()), (ErrorCode::OutOfRange, "`shapes` has body 2; there are 2"));
    let mut stray = reply.clone();
    let head = stray.shapes[4].mesh.as_mut().expect("the head has a mesh");
    Arc::make_mut(head).faces[0][1] = 4;
    let error = convert::decode_scene(stray).expect_err("there are four points");
    assert_eq!(error.message, "`shapes.mesh.faces` has point 4; there are 4");
    let error = convert::decode_scene(RenderReply { pose: &reply.pose[..28], ..reply }).expect_err("one pose of two");
    assert_eq!((error.code, error.field.as_str()), (ErrorCode::BadShape, "pose"));
}

#[test]
fn rough_ground_survives_the_wire_and_a_grid_with_too_few_heights_is_refused() {
    let scene = Scene { ground: golden::rough_ground(), ..golden::small_scene() };
    let bytes = convert::encode_scene(scene.clone());
    let mut reply: RenderReply<'_> = decode(&bytes).expect("what was encoded decodes");
    assert_eq!(convert::decode_scene(reply.clone()).expect("it fits"), scene);
    for (rows, columns) in [(3, 2), (0, 0), (u32::MAX, u32::MAX)] {
        let field = reply.ground.height_field.as_mut().expect("it was sent");
        (field.rows, field.columns) = (rows, columns);
        let error = convert::decode_scene(reply.clone()).expect_err("nine heights are no such grid");
        assert_eq!((error.code, error.field.as_str()), (ErrorCode::BadShape, "height_field"), "{rows} × {columns}");
    }
}

#[test]
fn error_code_of_a_newer_server_is_read_with_its_message() {
    let mut reply = ErrorReply::new(ErrorCode::Busy, "", "the robot has fallen");
    let bytes = encode(&reply);
    let at = bytes.windows(4).position(|window| window == b"busy").expect("the code");
    let newer = [&bytes[..at], b"fell", &bytes[at + 4..]].concat();
    reply.code = ErrorCode::Unknown;
    assert_eq!(decode::<ErrorReply>(&newer).expect("read"), reply);
}
