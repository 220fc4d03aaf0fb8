//! Rendering: a remote scene equals the simulated one, and requesting it does not change the episode.

use twinstep_client::{ClientError, ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{EnvFactory, SimEnvFactory};
use twinstep_envs::TaskConfig;
use twinstep_model::{AutoresetMode, EnvError, Ground, ResetRequest, Scene, VecEnv};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::{LeaseReply, RenderRequest};
use twinstep_protocol::{ErrorCode, PROTOCOL, encode};
use twinstep_sim::Terrain;

use crate::raw_client::{Answer, RawClient};
use crate::remote::{config, start};

fn render(client: &RawClient, lease: &LeaseReply, env: u64) -> Answer {
    client.ask_env(lease, EnvMethod::Render, &encode(&RenderRequest { protocol: PROTOCOL, epoch: lease.epoch, env }))
}

#[test]
fn remote_and_local_scenes_are_equal_and_rendering_does_not_change_the_episode() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    let host = SimEnvFactory::new(config).unwrap();
    let options = ConnectOptions { critic: true, ..ConnectOptions::new(&endpoint, 2) };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut local = host.build(2, AutoresetMode::NextStep, None).unwrap();
    let mut unrendered = host.build(2, AutoresetMode::NextStep, None).unwrap();
    let request = ResetRequest::seeded(5, 2);
    remote.reset(&request).unwrap();
    assert_eq!(local.reset(&request).unwrap(), unrendered.reset(&request).unwrap());
    for step in 0..20 {
        for env in 0..2 {
            // What a server does not send is known in process only.
            let local = local.scene(env).unwrap();
            assert!(local.velocity.is_some() && local.torque.is_some() && local.contact_force.is_some());
            assert!(!local.reward_terms.is_empty());
            let sent = Scene { velocity: None, torque: None, contact_force: None, reward_terms: Vec::new(), ..local };
            assert_eq!(remote.scene(env).unwrap(), sent, "step {step}, environment {env}");
        }
        let actions: Vec<f32> = (0..24).map(|index| ((step * 7 + index) as f32).sin()).collect();
        let expected = unrendered.step(&actions).unwrap();
        assert_eq!(remote.step(&actions).unwrap(), expected, "step {step}");
        assert_eq!(local.step(&actions).unwrap(), expected, "step {step}");
    }
    assert_ne!(remote.scene(0).unwrap().pose, remote.scene(1).unwrap().pose);
    remote.send(&[0.0; 24]).unwrap();
    remote.scene(0).unwrap();
    remote.recv().unwrap();
    remote.close().unwrap();
    server.shutdown();
}

#[test]
fn scene_has_the_simulated_ground() {
    let mut config = config(TaskConfig::default());
    config.sim.terrain = Terrain::SlopeRad(0.2);
    let mut env = SimEnvFactory::new(config).unwrap().build(1, AutoresetMode::NextStep, None).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    let ground = env.scene(0).unwrap().ground;
    assert_eq!(ground, Ground { normal: [-0.2f32.sin(), 0.0, 0.2f32.cos()], ..Ground::FLAT });
}

#[test]
fn invalid_render_is_rejected_by_name_and_consumes_no_sequence_number() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(2);
    assert_eq!(render(&client, &lease, 0).unwrap_err().code, ErrorCode::NeedsReset);
    client.reset(&lease, 1).unwrap();
    let first = render(&client, &lease, 1).unwrap();
    assert_eq!(render(&client, &lease, 1).unwrap(), first);
    for env in [2, u64::MAX] {
        let error = render(&client, &lease, env).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "env"), "{env}");
    }
    let stale = LeaseReply { epoch: 2, ..lease.clone() };
    assert_eq!(render(&client, &stale, 0).unwrap_err().code, ErrorCode::StaleEpoch);
    client.step(&lease, 2).unwrap();
    assert_ne!(render(&client, &lease, 1).unwrap(), first);
    client.close(&lease, 3).unwrap();
    server.shutdown();
}

#[test]
fn counter_cannot_be_rendered() {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 1)).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    let EnvError::Remote(error) = env.scene(0).unwrap_err() else { panic!("not an error of the server") };
    let Some(ClientError::Rejected(rejection)) = error.downcast_ref() else { panic!("{error}") };
    assert_eq!(
        (rejection.code, rejection.message.as_str()),
        (ErrorCode::UnknownKey, "the task `counter` cannot be rendered")
    );
    env.step(&[0.0; 12]).unwrap();
    server.shutdown();
}
