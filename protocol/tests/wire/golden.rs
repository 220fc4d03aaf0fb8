//! The bytes of every kind of message, kept in `golden/` for the clients in other languages to read as well.
//!
//! `UPDATE_GOLDEN=1 cargo test --release --workspace --test wire golden` writes the files again. Other bytes are another
//! protocol: clients in the field stop understanding the server unless the change only adds an optional field.

use std::fmt::Debug;
use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use twinstep_model::{
    AutoresetMode, ConvexMesh, EnvSpec, Ground, HeightField, Scene, SceneShape, ShapeKind, SpecField,
};
use twinstep_protocol::convert::encode_ground;
use twinstep_protocol::message::{
    CloseReply, CloseRequest, HelloReply, HelloRequest, LeaseReply, LeaseRequest, RealTime, Reclaim, RenderReply,
    RenderRequest, ResetReply, ResetRequest, RolloutPolicy, RolloutReply, RolloutRequest, StepReply, StepRequest,
    StopReply, StopRequest,
};
use twinstep_protocol::tensor::as_bytes;
use twinstep_protocol::{ErrorCode, ErrorReply, PROTOCOL, decode, encode};

/// Name of every golden file, without `.msgpack`.
pub const NAMES: [&str; 34] = [
    "hello_request",
    "hello_reply",
    "hello_reply_real_time",
    "hello_reply_joint_gains",
    "lease_request",
    "lease_request_reclaim",
    "lease_request_critic",
    "lease_reply",
    "lease_reply_reclaimed",
    "reset_request",
    "reset_request_seeds_mask",
    "reset_reply",
    "reset_reply_critic",
    "reset_reply_real_time",
    "step_request",
    "step_request_command",
    "step_request_gait",
    "step_request_real_time",
    "step_reply",
    "step_reply_ended",
    "step_reply_critic",
    "step_reply_real_time",
    "rollout_request",
    "rollout_request_held",
    "rollout_reply",
    "rollout_reply_critic",
    "stop_request",
    "stop_reply",
    "close_request",
    "close_reply",
    "render_request",
    "render_reply",
    "render_reply_rough",
    "error",
];

const LEASE: &str = "00c0ffee00c0ffee";

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("golden")
}

/// The bytes of the golden file `name`. Leaked, because messages borrow from them.
pub fn read(name: &str) -> &'static [u8] {
    let path = folder().join(name).with_extension("msgpack");
    let bytes = std::fs::read(&path).unwrap_or_else(|error| {
        panic!(
            "{}: {error}\n  UPDATE_GOLDEN=1 cargo test --release --workspace --test wire golden writes it",
            path.display()
        )
    });
    bytes.leak()
}

/// `message` encodes to the bytes of the file `name`, and they decode to `message`.
fn check<T: Serialize + Deserialize<'static> + PartialEq + Debug>(name: &str, message: &T) {
    assert!(NAMES.contains(&name), "{name} is missing in NAMES");
    let bytes = encode(message);
    if std::env::var_os("UPDATE_GOLDEN").is_some() {
        std::fs::write(folder().join(name).with_extension("msgpack"), &bytes).expect("the folder can be written");
    }
    let golden = read(name);
    assert!(
        golden == bytes,
        "`{name}` is no longer what golden/{name}.msgpack holds: a change of bytes is a change of protocol\n  \
         if it is meant: raise PROTOCOL unless old clients still understand it, write it into SPEC.md, then\n  \
         UPDATE_GOLDEN=1 cargo test --release --workspace --test wire golden\n  file {}\n  now  {}",
        golden.escape_ascii(),
        bytes.escape_ascii(),
    );
    assert_eq!(&decode::<T>(golden).expect("golden bytes are a message"), message, "{name}");
}

/// A robot with two joints: observations of 5, actions of 2 entries.
pub fn small_spec() -> EnvSpec {
    let field = |name: &str, size, unit: &str, bound: f32, text: &str| SpecField {
        name: name.to_owned(),
        size,
        unit: unit.to_owned(),
        low: -bound,
        high: bound,
        description: text.to_owned(),
    };
    EnvSpec {
        task: "walk".to_owned(),
        robot: "go2".to_owned(),
        observation: vec![
            field("gravity", 3, "", 1.0, "unit vector of gravity in the base frame"),
            field("joint_position", 2, "rad", 6.25, "q - q_default"),
        ],
        critic_observation: Vec::new(),
        action: vec![field("joint_position_offset", 2, "action_scale", 1.0, "offset from q_default")],
        joint_order: vec!["FL_hip".to_owned(), "FL_thigh".to_owned()],
        policy_dt: 0.02,
        actuator_dt: 0.005,
        kp: 20.0,
        kd: 0.5,
        joint_gains: Vec::new(),
        action_scale: 0.25,
        default_pose: vec![0.1, 0.8],
        reward_terms: vec!["tracking".to_owned(), "torque".to_owned()],
        max_episode_steps: 1000,
    }
}

#[test]
fn hello_has_its_golden_bytes() {
    check("hello_request", &HelloRequest { protocol: PROTOCOL, client: "golden 1.0".to_owned() });
    let reply = HelloReply {
        protocol: PROTOCOL,
        protocols: [1, 1],
        server_version: "twinstep 0.1.0".to_owned(),
        name: "go2".to_owned(),
        server_id: "0123456789abcdef".to_owned(),
        spec_hash: small_spec().hash(),
        spec: EnvSpec { critic_observation: small_spec().observation[..1].to_vec(), ..small_spec() },
        max_envs: 4096,
        free_envs: 4032,
        max_envs_per_client: 1024,
        max_request_bytes: 197_632,
        lease_grace_s: 10.0,
        lease_idle_s: Some(600.0),
        env_steps: 1_000_000_007,
        max_rollout_steps: 128,
        max_policy_bytes: 268_435_456,
        real_time: None,
    };
    check("hello_reply", &reply);
    let real_time = RealTime {
        absent_reward_terms: vec!["tracking".to_owned()],
        absent_ends: vec!["base_height".to_owned()],
        state: "ready".to_owned(),
        stop_port: Some(7448),
    };
    let spec = EnvSpec { joint_gains: vec![[30.0, 0.75], [40.0, 1.0]], ..small_spec() };
    check("hello_reply_joint_gains", &HelloReply { spec_hash: spec.hash(), spec, ..reply.clone() });
    check("hello_reply_real_time", &HelloReply { max_envs: 1, real_time: Some(real_time), ..reply });
}

#[test]
fn lease_has_its_golden_bytes() {
    let request = LeaseRequest {
        protocol: PROTOCOL,
        client: "golden-1".to_owned(),
        num_envs: 2,
        autoreset: AutoresetMode::SameStep,
        max_episode_steps: None,
        critic: false,
        spec_hash: None,
        reclaim: None,
    };
    check("lease_request", &request);
    check("lease_request_critic", &LeaseRequest { critic: true, ..request.clone() });
    let reclaim = LeaseRequest {
        autoreset: AutoresetMode::NextStep,
        max_episode_steps: Some(500),
        spec_hash: Some(small_spec().hash()),
        reclaim: Some(Reclaim { lease: LEASE.to_owned(), epoch: 1 }),
        ..request
    };
    check("lease_request_reclaim", &reclaim);
    let reply = LeaseReply {
        protocol: PROTOCOL,
        lease: LEASE.to_owned(),
        epoch: 1,
        num_envs: 2,
        autoreset: AutoresetMode::SameStep,
        last_seq: 0,
        spec: small_spec(),
    };
    check("lease_reply", &reply);
    check("lease_reply_reclaimed", &LeaseReply { epoch: 2, autoreset: AutoresetMode::Disabled, last_seq: 77, ..reply });
}

#[test]
fn reset_has_its_golden_bytes() {
    let request = ResetRequest { protocol: PROTOCOL, epoch: 1, seq: 1, seeds: None, mask: None };
    check("reset_request", &request);
    let seeds = [7u64, u64::MAX];
    check("reset_request_seeds_mask", &ResetRequest { seeds: Some(as_bytes(&seeds)), mask: Some(&[0, 1]), ..request });
    let obs = [0.0f32, 0.0, -1.0, 0.125, -0.25, 0.5, 0.5, -0.5, 1.5, -2.5];
    let (obs, tick, stamp_ns) = (as_bytes(&obs), None, None);
    let reply = ResetReply { protocol: PROTOCOL, seq: 1, obs, critic_obs: &[], tick, stamp_ns };
    check("reset_reply", &reply);
    let real_time = ResetReply { tick: Some(70), stamp_ns: Some(1_400_500_000), ..reply.clone() };
    check("reset_reply_real_time", &real_time);
    check("reset_reply_critic", &ResetReply { critic_obs: as_bytes(&[0.5f32, -0.25, 1.5, 2.5]), ..reply });
}

#[test]
fn step_has_its_golden_bytes() {
    let actions = [0.5f32, -0.5, 1.0, -1.0];
    let (actions, command, for_tick) = (as_bytes(&actions), None, None);
    let gait_command = None;
    let request = StepRequest { protocol: PROTOCOL, epoch: 1, seq: 2, actions, command, gait_command, for_tick };
    check("step_request", &request);
    let commands = [0.5f32, 0.0, -0.25, 0.0, 0.125, 1.0];
    check("step_request_command", &StepRequest { command: Some(as_bytes(&commands)), ..request.clone() });
    let gaits = [2.5f32, 0.5, 0.5, 0.0, 3.5, 0.0, 0.5, 0.5];
    check("step_request_gait", &StepRequest { gait_command: Some(as_bytes(&gaits)), ..request.clone() });
    check("step_request_real_time", &StepRequest { for_tick: Some(70), ..request });
    let obs = [0.0f32, 0.0, -1.0, 0.25, -0.5, 0.0, 0.0, -1.0, 0.0, 0.125];
    let running = StepReply {
        protocol: PROTOCOL,
        seq: 2,
        obs: as_bytes(&obs),
        reward: as_bytes(&[0.75f32, -1.25]),
        terminated: &[0, 0],
        truncated: &[0, 0],
        ended_env: &[],
        ended_length: &[],
        ended_return: &[],
        ended_terms: &[],
        ended_diverged: &[],
        final_obs: &[],
        critic_obs: &[],
        final_critic_obs: &[],
        tick: None,
        stamp_ns: None,
        late_ticks: None,
        applied: &[],
        refused: None,
        fault: None,
    };
    check("step_reply", &running);
    let applied = [0.5f32, -0.5, 0.25, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.125];
    let real_time = StepReply {
        tick: Some(71),
        stamp_ns: Some(1_420_500_000),
        late_ticks: Some(2),
        applied: as_bytes(&applied),
        refused: Some("the action is for tick 69, but 70 is the present one"),
        fault: Some("the trunk is tilted by 61°"),
        ..running.clone()
    };
    check("step_reply_real_time", &real_time);
    let ended = StepReply {
        seq: 3,
        terminated: &[0, 1],
        ended_env: as_bytes(&[1u32]),
        ended_length: as_bytes(&[300u32]),
        ended_return: as_bytes(&[12.5f32]),
        ended_terms: as_bytes(&[15.0f32, -2.5]),
        final_obs: as_bytes(&[0.5f32, 0.5, -0.5, 1.5, -2.5]),
        ..running
    };
    check("step_reply_ended", &ended);
    let (critic_obs, final_critic_obs) = ([0.5f32, -0.25, 1.5, 2.5], [0.75f32, -1.0]);
    let critic = StepReply {
        ended_diverged: &[1],
        critic_obs: as_bytes(&critic_obs),
        final_critic_obs: as_bytes(&final_critic_obs),
        ..ended
    };
    check("step_reply_critic", &critic);
}

#[test]
fn stop_has_its_golden_bytes() {
    check("stop_request", &StopRequest { protocol: PROTOCOL });
    check("stop_reply", &StopReply { protocol: PROTOCOL });
}

#[test]
fn rollout_has_its_golden_bytes() {
    // One layer: outputs × inputs, then the biases.
    let weights = [0.5f32, -0.5, 0.25, 0.0, 1.0, -1.0, 0.125, 0.0, 2.0, -0.25, 0.75, -0.75];
    let (mean, std) = ([0.0f32, 0.0, -1.0, 0.5, -0.5], [1.0f32, 1.0, 0.5, 2.0, 0.25]);
    let policy = RolloutPolicy {
        sizes: vec![5, 2],
        weights: as_bytes(&weights),
        mean: as_bytes(&mean),
        std: as_bytes(&std),
        log_std: as_bytes(&[-0.5f32, -1.0]),
    };
    let request = RolloutRequest {
        protocol: PROTOCOL,
        epoch: 1,
        seq: 4,
        steps: 2,
        noise_seed: 77,
        policy: Some(policy),
        policy_id: None,
    };
    check("rollout_request", &request);
    check("rollout_request_held", &RolloutRequest { seq: 5, policy: None, policy_id: Some(4), ..request });
    let obs: Vec<f32> = (0..30).map(|index| index as f32 / 8.0 - 1.0).collect();
    let actions = [0.5f32, -0.5, 1.0, -1.0, 1.5, 0.25, -0.125, 0.0];
    let reply = RolloutReply {
        protocol: PROTOCOL,
        seq: 4,
        obs: as_bytes(&obs),
        critic_obs: &[],
        actions: as_bytes(&actions),
        log_prob: as_bytes(&[-1.0f32, -2.0, -0.5, -4.0]),
        reward: as_bytes(&[0.75f32, -1.25, 0.5, 0.0]),
        terminated: &[0, 0, 0, 1],
        truncated: &[1, 0, 0, 0],
        ended_step: as_bytes(&[0u32, 1]),
        ended_env: as_bytes(&[0u32, 1]),
        ended_length: as_bytes(&[1000u32, 300]),
        ended_return: as_bytes(&[12.5f32, -3.0]),
        ended_terms: as_bytes(&[15.0f32, -2.5, 1.0, -4.0]),
        ended_diverged: &[],
        final_obs: as_bytes(&[0.5f32, 0.5, -0.5, 1.5, -2.5, 0.25, 0.25, -0.25, 0.75, -1.25]),
        final_critic_obs: &[],
    };
    check("rollout_reply", &reply);
    let (critic_obs, final_critic_obs) = ([0.5f32; 12], [0.75f32, -1.0, 0.25, 2.0]);
    let critic = RolloutReply {
        critic_obs: as_bytes(&critic_obs),
        ended_diverged: &[1, 0],
        final_critic_obs: as_bytes(&final_critic_obs),
        ..reply
    };
    check("rollout_reply_critic", &critic);
}

#[test]
fn close_has_its_golden_bytes() {
    check("close_request", &CloseRequest { protocol: PROTOCOL, epoch: 2, seq: 300 });
    check("close_reply", &CloseReply { protocol: PROTOCOL, seq: 300 });
}

/// A box with a leg that hangs 0.2 m below it.
pub fn small_scene() -> Scene {
    let shape = |body, kind, size, z| SceneShape {
        body,
        kind,
        size,
        offset: [0.0, 0.0, z, 1.0, 0.0, 0.0, 0.0],
        colour: None,
        mesh: None,
    };
    // The head, a tetrahedron.
    let points = vec![[0.0625, 0.0, 0.0], [-0.0625, 0.0625, 0.0], [-0.0625, -0.0625, 0.0], [-0.03125, 0.0, 0.125]];
    let mesh = Some(Arc::new(ConvexMesh { points, faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]] }));
    let head = SceneShape { colour: Some([0.75, 0.5, 0.25]), mesh, ..shape(0, ShapeKind::Convex, [0.0; 3], 0.0625) };
    Scene {
        bodies: vec!["trunk".to_owned(), "FL_hip".to_owned()],
        pose: vec![[0.5, 0.0, 0.25, 1.0, 0.0, 0.0, 0.0], [0.75, 0.125, 0.25, 0.5, 0.5, 0.5, 0.5]],
        shapes: vec![
            shape(0, ShapeKind::Box, [0.25, 0.125, 0.0625], 0.0),
            shape(1, ShapeKind::Capsule, [0.03125, 0.09375, 0.0], -0.125),
            shape(1, ShapeKind::Sphere, [0.03125, 0.0, 0.0], -0.25),
            shape(1, ShapeKind::Cylinder, [0.0625, 0.03125, 0.0], 0.0),
            head,
        ],
        ground: Ground::FLAT,
        command: Some([1.0, 0.0, -0.5]),
        velocity: None,
        torque: None,
        contact_force: None,
        reward_terms: Vec::new(),
        uncertainty: None,
    }
}

/// Four metres with a hill of 0.375 m on the far side and a ridge to the left.
pub fn rough_ground() -> Ground {
    let heights = vec![0.0, 0.0, 0.125, 0.0, 0.0625, 0.125, 0.0, 0.375, 0.25];
    let field = HeightField::new([-2.0, -1.0], 2.0, [3, 3], heights).expect("a field");
    Ground { height_field: Some(field.into()), ..Ground::FLAT }
}

#[test]
fn render_has_its_golden_bytes() {
    check("render_request", &RenderRequest { protocol: PROTOCOL, epoch: 1, env: 1 });
    let Scene { bodies, pose, shapes, ground, command, .. } = small_scene();
    let pose = as_bytes(&pose);
    let flat = RenderReply { protocol: PROTOCOL, bodies, pose, shapes, ground: encode_ground(&ground), command };
    check("render_reply", &flat);
    let rough = rough_ground();
    check("render_reply_rough", &RenderReply { ground: encode_ground(&rough), ..flat });
}

#[test]
fn error_has_its_golden_bytes() {
    let error = ErrorReply::new(ErrorCode::BadShape, "actions", "`actions` has 3 entries; 4 are wanted")
        .with_hint("shapes are num_envs × the spec's lengths");
    check("error", &error);
}

#[test]
fn every_golden_file_belongs_to_a_message() {
    for entry in std::fs::read_dir(folder()).expect("the folder is there") {
        let path = entry.expect("the folder can be read").path();
        let name = path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        // Its test is in `stop_channel.rs`.
        assert!(NAMES.contains(&name) || name == "stop_channel", "no test reads {}", path.display());
    }
}
