//! Samples of a robot in every actuator period: the same from a server, and without effect on the episode.

use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{EnvFactory, SimEnvFactory};
use twinstep_envs::TaskConfig;
use twinstep_model::{AutoresetMode, EnvError, NUM_JOINTS, ResetRequest, VecEnv, go2};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::SamplesRequest;
use twinstep_protocol::{ErrorCode, PROTOCOL, encode};

use crate::raw_client::RawClient;
use crate::remote::{config, start};

#[test]
fn samples_of_a_server_are_those_of_the_simulation_and_sampling_does_not_change_the_episode() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    let host = SimEnvFactory::new(config).unwrap();
    let options = ConnectOptions { critic: true, ..ConnectOptions::new(&endpoint, 2) };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut local = host.build(2, AutoresetMode::NextStep, None).unwrap();
    let mut unsampled = host.build(2, AutoresetMode::NextStep, None).unwrap();
    assert!(remote.samples(1).unwrap().is_empty() && local.samples(1).unwrap().is_empty(), "sampling begins");
    let request = ResetRequest::seeded(5, 2);
    for env in [&mut remote as &mut dyn VecEnv, local.as_mut(), unsampled.as_mut()] {
        env.reset(&request).unwrap();
    }
    let control = go2().control;
    let (q, _) = unsampled.spec().observation_field("joint_position").unwrap();
    for step in 0..40 {
        let actions: Vec<f32> = (0..24).map(|index| ((step * 7 + index) as f32).sin()).collect();
        let before = unsampled.obs().to_vec();
        let expected = unsampled.step(&actions).unwrap().clone();
        assert_eq!(remote.step(&actions).unwrap(), &expected, "step {step}");
        assert_eq!(local.step(&actions).unwrap(), &expected, "step {step}");
        for env in 0..2 {
            let samples = local.samples(env).unwrap();
            assert_eq!(remote.samples(env).unwrap(), samples);
            assert_eq!(remote.samples(env).unwrap(), samples, "a repeated request");
            // The first step after the end of an episode resets it.
            let Some(first) = samples.first() else { continue };
            assert_eq!(samples.len(), control.decimation);
            let row = &before[env * (before.len() / 2)..];
            for joint in 0..NUM_JOINTS {
                let wanted =
                    control.default_pose[joint] + control.action_scale * f64::from(actions[env * NUM_JOINTS + joint]);
                assert!((f64::from(first.q_cmd[joint]) - wanted).abs() < 1e-5);
                let position = f64::from(row[q + joint]) + control.default_pose[joint];
                assert!((f64::from(first.q[joint]) - position).abs() < 1e-5, "reading at the beginning");
            }
            assert!(first.base.is_some() && samples[3].q != first.q && samples[3].tau != first.tau);
        }
    }
    local.reset(&request).unwrap();
    assert!(local.samples(0).unwrap().is_empty(), "a reset removes the samples");
    remote.close().unwrap();
    server.shutdown();
}

#[test]
fn torque_of_a_sample_is_that_of_the_pd_loop_from_its_reading() {
    let config = config(TaskConfig::default());
    let mut env = SimEnvFactory::new(config).unwrap().build(1, AutoresetMode::NextStep, None).unwrap();
    env.samples(0).unwrap();
    env.reset(&ResetRequest::seeded(3, 1)).unwrap();
    let control = go2().control;
    for step in 0..10 {
        env.step(&[0.1 * (step as f32).sin(); 12]).unwrap();
        for sample in env.samples(0).unwrap() {
            for joint in 0..NUM_JOINTS {
                let error = f64::from(sample.q_cmd[joint]) - f64::from(sample.q[joint]);
                let torque = control.kp[joint] * error - control.kd[joint] * f64::from(sample.dq[joint]);
                // An ideal actuator within its limit.
                assert!((torque - f64::from(sample.tau[joint])).abs() < 2e-3, "{torque} {}", sample.tau[joint]);
            }
        }
    }
}

#[test]
fn invalid_requests_for_samples_are_rejected_by_name() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let client = RawClient::connect(&endpoint, server.sid(), "samples");
    let lease = client.lease(1);
    let ask = |epoch, env| {
        client.ask_env(&lease, EnvMethod::Samples, &encode(&SamplesRequest { protocol: PROTOCOL, epoch, env }))
    };
    assert!(ask(lease.epoch, 0).is_ok());
    assert_eq!(ask(lease.epoch, 1).unwrap_err().code, ErrorCode::OutOfRange);
    assert_eq!(ask(lease.epoch + 1, 0).unwrap_err().code, ErrorCode::StaleEpoch);
    server.shutdown();

    let mut counter =
        SimEnvFactory::new(config(TaskConfig::Counter)).unwrap().build(1, AutoresetMode::NextStep, None).unwrap();
    assert!(matches!(counter.samples(0), Err(EnvError::SamplesUnsupported { .. })));
}
