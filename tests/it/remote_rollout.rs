//! Rollouts on a server: the same bits as in process, executed once, refused with the field.

use std::time::Duration;

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{EnvFactory, SimEnvFactory};
use twinstep_envs::TaskConfig;
use twinstep_model::{AutoresetMode, EnvSpec, ResetRequest, Trajectory, VecEnv, stream};
use twinstep_policy::{BehaviourPolicy, Collector, Mlp, Normaliser, StepCollector};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::{LeaseReply, LeaseRequest, RolloutPolicy, RolloutReply, RolloutRequest};
use twinstep_protocol::tensor::{self, as_bytes};
use twinstep_protocol::{ErrorCode, PROTOCOL, decode, encode};

use crate::raw_client::{RawClient, steps_in};
use crate::remote::{config, start};

/// Returns a policy with random weights for the observations and actions of `spec`.
pub fn policy(spec: &EnvSpec, std: f32) -> BehaviourPolicy {
    let actor = Mlp::orthogonal(&[spec.obs_len(), 20, spec.action_len()], 0.3, &mut stream(3, "policy", 0));
    let mean: Vec<f32> = (0..spec.obs_len()).map(|entry| 0.01 * entry as f32).collect();
    let normaliser = Normaliser::from_mean_and_std(&mean, &vec![0.7; mean.len()]);
    BehaviourPolicy::new(actor, normaliser, vec![std.ln(); spec.action_len()])
}

/// Encodes a rollout request with a policy.
pub fn rollout_bytes(lease: &LeaseReply, seq: u64, policy: &BehaviourPolicy, steps: u64) -> Vec<u8> {
    request(lease, seq, policy, steps, |_| ())
}

/// Encodes a rollout request that `change` has changed.
fn request(
    lease: &LeaseReply,
    seq: u64,
    policy: &BehaviourPolicy,
    steps: u64,
    change: impl FnOnce(&mut RolloutRequest),
) -> Vec<u8> {
    let (weights, (mean, std)) = (policy.actor().weights(), policy.normaliser().mean_and_std());
    let policy = RolloutPolicy {
        sizes: policy.actor().sizes().iter().map(|size| *size as u64).collect(),
        weights: as_bytes(&weights),
        mean: as_bytes(&mean),
        std: as_bytes(&std),
        log_std: as_bytes(policy.log_std()),
    };
    let mut request = RolloutRequest {
        protocol: PROTOCOL,
        epoch: lease.epoch,
        seq,
        steps,
        noise_seed: 5,
        policy: Some(policy),
        policy_id: None,
    };
    change(&mut request);
    encode(&request)
}

#[test]
fn rollout_on_a_server_has_the_bits_of_one_in_process() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    for (autoreset, critic) in [(AutoresetMode::SameStep, true), (AutoresetMode::NextStep, false)] {
        let options =
            ConnectOptions { autoreset, critic, max_episode_steps: Some(7), ..ConnectOptions::new(&endpoint, 5) };
        let mut remote = RemoteVecEnv::connect(&options).unwrap();
        let local = SimEnvFactory::new(config.clone()).unwrap().build(5, autoreset, Some(7)).unwrap();
        let mut local = StepCollector(local);
        local.0.reset(&ResetRequest::seeded(5, 5)).unwrap();
        remote.reset(&ResetRequest::seeded(5, 5)).unwrap();
        let (mut expected, mut trajectory) = (Trajectory::default(), Trajectory::default());
        // The third rollout uses the held policy.
        for (rollout, std) in [0.3, 0.2, 0.2].into_iter().enumerate() {
            let policy = policy(remote.spec(), std);
            local.collect(&policy, rollout as u64, 10, &mut expected).unwrap();
            remote.rollout(&policy, rollout as u64, 10, &mut trajectory).unwrap();
            if !critic {
                expected.critic_obs.clear();
                expected.ended.iter_mut().for_each(|(_, episode)| episode.final_critic_obs.clear());
            }
            assert_eq!(trajectory, expected);
            assert!(trajectory.ended.len() >= 5 && trajectory.ended.iter().any(|(step, _)| *step > 0));
            assert_eq!(trajectory.obs[10 * 5 * 45..], *remote.obs());
        }
        let actions = [0.1; 60];
        assert_eq!(remote.step(&actions).unwrap().obs, local.0.step(&actions).unwrap().obs, "steps follow rollouts");
        remote.close().unwrap();
    }
    server.shutdown();
}

#[test]
fn log_probabilities_are_those_of_the_sampled_actions() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 3)).unwrap();
    env.reset(&ResetRequest::seeded(5, 3)).unwrap();
    let (policy, mut trajectory) = (policy(env.spec(), 0.5), Trajectory::default());
    env.rollout(&policy, 1, 4, &mut trajectory).unwrap();
    let mut runner = twinstep_policy::PolicyRunner::from_parts(policy.actor(), policy.normaliser());
    let mut mean = vec![0.0; trajectory.actions.len()];
    runner.run(&trajectory.obs[..4 * 3 * 45], &mut mean);
    let noise: Vec<f32> = trajectory.actions.iter().zip(&mean).map(|(action, mean)| (action - mean) / 0.5).collect();
    for (row, noise) in noise.chunks_exact(12).enumerate() {
        // ln of the normal density, with σ = ½ in each of 12 entries.
        let expected: f32 = noise.iter().map(|z| -0.5 * z * z - 0.918_938_5 + std::f32::consts::LN_2).sum();
        assert!((trajectory.log_prob[row] - expected).abs() < 1e-3, "{} {expected}", trajectory.log_prob[row]);
    }
    assert!(noise.iter().all(|z| z.abs() < 6.0) && noise[..12] != noise[12..24], "robots have noise of their own");
    server.shutdown();
}

/// Runs `test` with a client and its lease of two counters, reset with sequence number 1.
fn with_counters(test: impl FnOnce(&RawClient, &LeaseReply)) {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(2);
    client.reset(&lease, 1).unwrap();
    test(&client, &lease);
    server.shutdown();
}

#[test]
fn rollout_sent_three_times_is_executed_once() {
    with_counters(|client, lease| {
        let policy = policy(&lease.spec, 0.1);
        let ask = |bytes: &[u8]| client.ask_env(lease, EnvMethod::Rollout, bytes);
        let bytes = rollout_bytes(lease, 2, &policy, 3);
        let first = ask(&bytes).unwrap();
        assert_eq!([ask(&bytes).unwrap(), ask(&bytes).unwrap()], [first.clone(), first]);
        assert_eq!(steps_in(&client.step(lease, 3).unwrap()), 4.0);
        let other_seed = request(lease, 3, &policy, 3, |request| request.noise_seed += 1);
        assert_eq!(ask(&other_seed).unwrap_err().code, ErrorCode::StaleSequence, "number 3 was a step");
        let held = request(lease, 4, &policy, 1, |request| (request.policy, request.policy_id) = (None, Some(2)));
        let reply = ask(&held).unwrap();
        let reply: RolloutReply<'_> = decode(&reply).unwrap();
        let obs: Vec<f32> = tensor::read(reply.obs, "obs").unwrap();
        assert_eq!((obs[0], obs[2 * obs.len() / 4]), (4.0, 5.0), "before and after the step");
    });
}

#[test]
fn invalid_rollouts_are_rejected_with_the_field_and_without_effect() {
    with_counters(|client, lease| {
        let good = policy(&lease.spec, 0.1);
        let nan = vec![f32::NAN; good.actor().weights().len()];
        let (zeros, large) = (vec![0.0f32; lease.spec.obs_len()], vec![30.0f32; lease.spec.action_len()]);
        let check = |field: &str, code: ErrorCode, steps: u64, change: &dyn Fn(&mut RolloutRequest)| {
            let bytes = request(lease, 2, &good, steps, change);
            let error = client.ask_env(lease, EnvMethod::Rollout, &bytes).unwrap_err();
            assert_eq!((error.code, error.field.as_str()), (code, field), "{error}");
        };
        let with = |change: &'static dyn Fn(&mut RolloutPolicy)| {
            move |request: &mut RolloutRequest| change(request.policy.as_mut().unwrap())
        };
        check("steps", ErrorCode::OutOfRange, 0, &|_| ());
        check("steps", ErrorCode::OutOfRange, 129, &|_| ());
        check("steps", ErrorCode::OutOfRange, u64::MAX, &|_| ());
        check("policy.sizes", ErrorCode::OutOfRange, 1, &with(&|policy| policy.sizes = vec![]));
        check("policy.sizes", ErrorCode::OutOfRange, 1, &with(&|policy| policy.sizes[0] += 1));
        check("policy.sizes", ErrorCode::OutOfRange, 1, &with(&|policy| policy.sizes[1] = 0));
        check("policy.sizes", ErrorCode::OutOfRange, 1, &with(&|policy| policy.sizes[1] = u64::MAX));
        check("policy.weights", ErrorCode::BadShape, 1, &with(&|policy| policy.sizes[1] = 65_536));
        // Layers of one unit are padded to 16 times their size.
        check(
            "policy.sizes",
            ErrorCode::TooLarge,
            1,
            &with(&|policy| {
                policy.sizes =
                    [&policy.sizes[..1], &[1, 65_536, 1, 65_536, 1], &policy.sizes[policy.sizes.len() - 1..]].concat();
            }),
        );
        check("policy.weights", ErrorCode::BadShape, 1, &with(&|policy| policy.weights = &policy.weights[4..]));
        check("policy.std", ErrorCode::BadShape, 1, &with(&|policy| policy.std = &[]));
        check("policy.weights", ErrorCode::NotFinite, 1, &|request| {
            // The request borrows for as long as it is encoded.
            request.policy.as_mut().unwrap().weights = as_bytes(Vec::leak(nan.clone()));
        });
        check("policy.std", ErrorCode::OutOfRange, 1, &|request| {
            request.policy.as_mut().unwrap().std = as_bytes(Vec::leak(zeros.clone()));
        });
        check("policy.log_std", ErrorCode::OutOfRange, 1, &|request| {
            request.policy.as_mut().unwrap().log_std = as_bytes(Vec::leak(large.clone()));
        });
        check("policy", ErrorCode::Malformed, 1, &|request| request.policy = None);
        check("policy_id", ErrorCode::UnknownPolicy, 1, &|request| {
            (request.policy, request.policy_id) = (None, Some(1));
        });
        assert_eq!(steps_in(&client.step(lease, 2).unwrap()), 1.0, "the sequence number was not consumed");

        let request = LeaseRequest { autoreset: AutoresetMode::Disabled, ..client.lease_request(1) };
        let other = RawClient::with_own_secret(client);
        let lease = other.ask_lease(&request).unwrap();
        other.reset(&lease, 1).unwrap();
        let error = other.ask_env(&lease, EnvMethod::Rollout, &rollout_bytes(&lease, 2, &good, 1)).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "autoreset"));
    });
}

#[test]
fn rollout_before_the_first_reset_is_rejected() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(2);
    let bytes = rollout_bytes(&lease, 1, &policy(&lease.spec, 0.1), 3);
    assert_eq!(client.ask_env(&lease, EnvMethod::Rollout, &bytes).unwrap_err().code, ErrorCode::NeedsReset);
    client.reset(&lease, 1).unwrap();
    server.shutdown();
}

#[test]
fn server_without_rollouts_has_no_such_key() {
    let mut config = config(TaskConfig::Counter);
    config.server.max_rollout_steps = 0;
    let (server, endpoint) = start(&config);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(1);
    client.reset(&lease, 1).unwrap();
    assert_eq!(client.hello().max_rollout_steps, 0);
    let bytes = rollout_bytes(&lease, 2, &policy(&lease.spec, 0.1), 1);
    assert_eq!(client.ask_env(&lease, EnvMethod::Rollout, &bytes).unwrap_err().code, ErrorCode::UnknownKey);
    assert_eq!(steps_in(&client.step(&lease, 2).unwrap()), 1.0);
    server.shutdown();
}

#[test]
fn other_leases_and_hello_are_served_during_a_long_rollout_and_shutdown_ends_it() {
    let mut config = config(TaskConfig::default());
    config.server.max_rollout_steps = 1_000_000;
    config.server.envs = 8;
    config.sim.physics_hz = Some(1000);
    let (server, endpoint) = start(&config);
    let mut busy = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 1)).unwrap();
    busy.reset(&ResetRequest::seeded(1, 1)).unwrap();
    let policy = policy(busy.spec(), 0.1);
    // About 200 000 steps of one robot take longer than the rest of this test.
    busy.send_rollout(&policy, 1, 200_000).unwrap();
    let mut other = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 1)).unwrap();
    other.reset(&ResetRequest::seeded(1, 1)).unwrap();
    for _ in 0..20 {
        other.step(&[0.0; 12]).unwrap();
    }
    let mut trajectory = Trajectory::default();
    let timeout = busy.recv_rollout_within(Duration::from_millis(50), &mut trajectory).unwrap_err().to_string();
    assert!(timeout.contains("is still in progress"), "{timeout}");
    let stopper = std::thread::spawn(move || server.shutdown());
    let error = busy.recv_rollout(&mut trajectory).unwrap_err().to_string();
    assert!(error.contains("is shutting down") || error.contains("no longer visible"), "{error}");
    stopper.join().unwrap();
}

#[test]
fn policies_of_all_leases_share_one_budget_which_a_closed_lease_frees() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let options = ConnectOptions::new(&endpoint, 1);
    let lease = || {
        let mut env = RemoteVecEnv::connect(&options).unwrap();
        env.reset(&ResetRequest::seeded(5, 1)).unwrap();
        env
    };
    let spec = lease().spec().clone();
    // Some 4 MB of parameters, and as much for their arrangement.
    let actor = Mlp::zeros(&[spec.obs_len(), 1000, 960, spec.action_len()]);
    let normaliser = Normaliser::from_mean_and_std(&vec![0.0; spec.obs_len()], &vec![1.0; spec.obs_len()]);
    let policy = BehaviourPolicy::new(actor, normaliser, vec![-1.0; spec.action_len()]);
    let (mut leases, mut trajectory) = (Vec::new(), Trajectory::default());
    let refusal = loop {
        let mut env = lease();
        match env.rollout(&policy, 0, 1, &mut trajectory) {
            Ok(()) => leases.push(env),
            Err(error) => break error.to_string(),
        }
        assert!(leases.len() < 40, "256 MiB are enough for 31");
    };
    assert!(refusal.contains("policies of all rollouts") && refusal.contains("268435456"), "{refusal}");
    assert!(leases.len() >= 25, "{} policies", leases.len());
    leases.pop().unwrap().close().unwrap();
    lease().rollout(&policy, 0, 1, &mut trajectory).unwrap();
    server.shutdown();
}
