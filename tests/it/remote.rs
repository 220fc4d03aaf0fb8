//! The server and its client in one process, over a Zenoh link on loopback.

use std::sync::Arc;

use twinstep_client::{ClientError, ConnectOptions, GroupedVecEnv, RemoteVecEnv};
use twinstep_env_server::{Config, EnvFactory, EnvFactoryError, Server, SimEnvFactory};
use twinstep_envs::{Counter, OBS_LEN, TaskConfig, WalkConfig, check_vec_env};
use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, StepBatch, VecEnv, go2};
use twinstep_protocol::ErrorCode;
use twinstep_sim::Engine;

pub fn config(task: TaskConfig) -> Config {
    let mut config = Config { task, ..Config::default() };
    config.server.listen = "tcp/127.0.0.1:0".to_owned();
    config.server.envs = 64;
    config.server.seed = Some(1);
    config
}

/// Returns the settings of the task `walk`.
pub fn walk(config: &mut Config) -> &mut WalkConfig {
    let TaskConfig::Walk(walk) = &mut config.task else { panic!("another task") };
    walk
}

pub fn start(config: &Config) -> (Server, String) {
    start_with(config, Arc::new(SimEnvFactory::new(config.clone()).unwrap()))
}

pub fn start_with(config: &Config, host: Arc<dyn EnvFactory>) -> (Server, String) {
    let server = Server::start(&config.server, host).unwrap();
    let endpoint = server.endpoints().into_iter().find(|endpoint| endpoint.starts_with("tcp/127.0.0.1")).unwrap();
    (server, endpoint)
}

fn rejection(error: &EnvError) -> ErrorCode {
    let EnvError::Remote(error) = error else { panic!("{error}") };
    match error.downcast_ref::<ClientError>() {
        Some(ClientError::Rejected(rejection)) => rejection.code,
        other => panic!("{other:?}"),
    }
}

#[test]
fn critic_observations_are_sent_only_to_a_lease_that_requests_them() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    let mut local = SimEnvFactory::new(config).unwrap().build(2, AutoresetMode::SameStep, Some(3)).unwrap();
    for critic in [false, true] {
        let options = ConnectOptions {
            autoreset: AutoresetMode::SameStep,
            max_episode_steps: Some(3),
            critic,
            ..ConnectOptions::new(&endpoint, 2)
        };
        let mut remote = RemoteVecEnv::connect(&options).unwrap();
        assert_eq!(remote.spec().critic_observation.is_empty(), !critic);
        local.reset(&ResetRequest::seeded(5, 2)).unwrap();
        remote.reset(&ResetRequest::seeded(5, 2)).unwrap();
        assert_eq!(remote.critic_obs(), if critic { local.critic_obs() } else { &[] });
        for _ in 0..3 {
            let expected = local.step(&[0.1; 24]).unwrap().clone();
            let batch = remote.step(&[0.1; 24]).unwrap();
            assert_eq!(batch.obs, expected.obs);
            if critic {
                assert_eq!(*batch, expected);
            } else {
                assert!(batch.critic_obs.is_empty());
                assert!(batch.ended.iter().all(|episode| episode.final_critic_obs.is_empty()));
            }
        }
        remote.close().unwrap();
    }
    server.shutdown();
}

#[test]
fn groups_step_like_one_batch() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    for groups in [0, 8] {
        let error = GroupedVecEnv::connect(&ConnectOptions::new(&endpoint, 7), groups).err().unwrap();
        assert!(error.to_string().contains(&format!("`groups` = {groups}")), "{error}");
    }
    let options = ConnectOptions { max_episode_steps: Some(4), critic: true, ..ConnectOptions::new(&endpoint, 7) };
    let mut one = RemoteVecEnv::connect(&options).unwrap();
    let mut groups = GroupedVecEnv::connect(&options, 3).unwrap();
    assert_eq!([0, 1, 2].map(|group| groups.range(group)), [0..2, 2..4, 4..7]);
    let request = ResetRequest::seeded(5, 7);
    assert_eq!(groups.reset(&request).unwrap(), one.reset(&request).unwrap());
    for step in 0..9 {
        let actions: Vec<f32> = (0..7 * 12).map(|index| ((step * 84 + index) as f32).sin()).collect();
        assert_eq!(groups.step(&actions).unwrap(), one.step(&actions).unwrap(), "step {step}");
    }
    let mask = ResetRequest::masked((0..7).map(|env| env % 3 == 0).collect());
    assert_eq!(groups.reset(&mask).unwrap(), one.reset(&mask).unwrap());
    assert_eq!(groups.critic_obs(), one.critic_obs());
    assert_eq!(groups.scene(6).unwrap().pose, one.scene(6).unwrap().pose);
    let mut unseeded = GroupedVecEnv::connect(&ConnectOptions::new(&endpoint, 2), 2).unwrap();
    let obs = unseeded.reset(&ResetRequest::default()).unwrap();
    assert_ne!(obs[..obs.len() / 2], obs[obs.len() / 2..], "the groups are copies of each other");
    unseeded.close().unwrap();
    // A group steps while the others do not.
    groups.send(1, &[0.3; 24]).unwrap();
    assert_eq!(groups.recv(1).unwrap().reward.len(), 2);
    groups.close().unwrap();
    one.close().unwrap();
    server.shutdown();
}

#[test]
fn remote_walk_passes_the_checker_in_every_autoreset_mode() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    for autoreset in [AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled] {
        let critic = autoreset != AutoresetMode::Disabled;
        let options =
            ConnectOptions { autoreset, max_episode_steps: Some(7), critic, ..ConnectOptions::new(&endpoint, 3) };
        let mut env = RemoteVecEnv::connect(&options).unwrap();
        check_vec_env(&mut env, 30).unwrap();
        env.close().unwrap();
    }
    server.shutdown();
}

#[test]
fn walk_on_the_batch_engine_passes_the_checker() {
    let mut config = config(TaskConfig::default());
    config.sim.engine = Engine::Batch;
    config.randomise.mass_scale = [0.9, 1.1];
    let (server, endpoint) = start(&config);
    let options = ConnectOptions { max_episode_steps: Some(7), ..ConnectOptions::new(&endpoint, 11) };
    check_vec_env(&mut RemoteVecEnv::connect(&options).unwrap(), 30).unwrap();
    server.shutdown();
}

#[test]
fn remote_and_local_walk_are_bitwise_identical() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    let options = ConnectOptions { critic: true, ..ConnectOptions::new(&endpoint, 2) };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut local = SimEnvFactory::new(config).unwrap().build(2, AutoresetMode::NextStep, None).unwrap();
    let request = ResetRequest::seeded(5, 2);
    assert_eq!(remote.reset(&request).unwrap(), local.reset(&request).unwrap());
    for step in 0..50 {
        let actions: Vec<f32> = (0..24).map(|index| ((step * 7 + index) as f32).sin()).collect();
        assert_eq!(remote.step(&actions).unwrap(), local.step(&actions).unwrap(), "step {step}");
    }
    server.shutdown();
}

#[test]
fn concurrent_clients_have_separate_environments() {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let clients: Vec<_> = (1..4usize)
        .map(|num_envs| {
            let endpoint = endpoint.clone();
            std::thread::spawn(move || {
                let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, num_envs)).unwrap();
                env.reset(&ResetRequest::default()).unwrap();
                let mut expected = vec![Counter { resets: 1, ..Counter::default() }; num_envs];
                for step in 0..200 {
                    let actions: Vec<f32> = (0..12 * num_envs).map(|index| (step + index * num_envs) as f32).collect();
                    let batch = env.step(&actions).unwrap();
                    for (index, counter) in expected.iter_mut().enumerate() {
                        counter.step(&actions[12 * index..12 * (index + 1)]);
                        assert_eq!(batch.obs[index * OBS_LEN..][..4], counter.observation());
                    }
                }
            })
        })
        .collect();
    for client in clients {
        client.join().unwrap();
    }
    server.shutdown();
}

#[test]
fn overlapped_steps_are_executed_once_each() {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 1)).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    for step in 1..=20u32 {
        env.send(&[0.5; 12]).unwrap();
        assert!(env.send(&[0.5; 12]).is_err(), "one request at a time");
        assert_eq!(env.recv().unwrap().obs[0], step as f32);
    }
    assert!(env.recv().is_err(), "nothing was sent");
    server.shutdown();
}

#[test]
fn bad_input_is_rejected_by_name_and_the_next_valid_step_succeeds() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 2)).unwrap();
    assert_eq!(rejection(&env.step(&[0.0; 24]).unwrap_err()), ErrorCode::NeedsReset);
    env.reset(&ResetRequest::seeded(1, 2)).unwrap();
    let mut actions = [0.0; 24];
    actions[13] = f32::NAN;
    let error = env.step(&actions).unwrap_err();
    assert_eq!(rejection(&error), ErrorCode::NotFinite);
    assert!(error.to_string().contains("environment 1: joint_position_offset[FL_thigh] is NaN"), "{error}");
    assert!(env.step(&[0.0; 24]).is_ok());
    server.shutdown();
}

#[test]
fn request_for_too_many_environments_is_rejected_with_both_numbers() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    for num_envs in [65, 1_000_000_000] {
        let error = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, num_envs)).err().unwrap().to_string();
        assert!(error.contains(&format!("{num_envs} is too large: 64 of 64 are free")), "{error}");
    }
    assert!(RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 64)).is_ok());
    server.shutdown();
}

#[test]
fn spec_hash_of_another_robot_is_rejected() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let options = ConnectOptions { spec_hash: Some("0".repeat(32)), ..ConnectOptions::new(&endpoint, 1) };
    let Some(ClientError::Rejected(error)) = RemoteVecEnv::connect(&options).err() else { panic!("accepted") };
    assert_eq!(error.code, ErrorCode::SpecMismatch);
    server.shutdown();
}

#[test]
fn reclaimed_lease_continues_and_the_old_client_is_rejected() {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let options = ConnectOptions::new(&endpoint, 1);
    let mut first = RemoteVecEnv::connect(&options).unwrap();
    first.reset(&ResetRequest::default()).unwrap();
    first.step(&[1.0; 12]).unwrap();
    let mut second = RemoteVecEnv::reclaim(&options, first.ticket()).unwrap();
    assert_eq!(second.step(&[2.0; 12]).unwrap().obs[0], 2.0, "it continues from the state of the first client");
    assert_eq!(rejection(&first.step(&[3.0; 12]).unwrap_err()), ErrorCode::StaleEpoch);
    assert_eq!(second.step(&[4.0; 12]).unwrap().obs[0], 3.0, "the rejected step was not executed");
    server.shutdown();
}

#[test]
fn error_without_a_server_names_the_command_to_start_one() {
    let mut options = ConnectOptions::new("tcp/127.0.0.1:9", 1);
    options.connect_timeout = std::time::Duration::from_millis(300);
    let error = RemoteVecEnv::connect(&options).err().unwrap().to_string();
    assert!(error.starts_with("no server answers at tcp/127.0.0.1:9"), "{error}");
    assert!(error.contains("no program accepts connections there: start a server with `twinstep serve"), "{error}");
}

/// A factory of environments that panic in their third step.
pub struct FailingEnvFactory;

struct FragileEnv(Box<dyn VecEnv>, u32);

impl EnvFactory for FailingEnvFactory {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        _: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        let inner = Box::new(twinstep_envs::CounterEnv::new(&go2(), num_envs, autoreset));
        Ok(Box::new(FragileEnv(inner, 0)))
    }
}

impl VecEnv for FragileEnv {
    fn spec(&self) -> &EnvSpec {
        self.0.spec()
    }
    fn num_envs(&self) -> usize {
        self.0.num_envs()
    }
    fn autoreset(&self) -> AutoresetMode {
        self.0.autoreset()
    }
    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        self.0.reset(request)
    }
    fn obs(&self) -> &[f32] {
        self.0.obs()
    }
    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.1 += 1;
        assert!(self.1 < 3, "planted in the third step");
        self.0.step(actions)
    }
}

#[test]
fn panic_in_an_environment_gets_an_error_reply_and_the_server_continues() {
    let (server, endpoint) = start_with(&config(TaskConfig::Counter), Arc::new(FailingEnvFactory));
    let options = ConnectOptions::new(&endpoint, 1);
    let mut env = RemoteVecEnv::connect(&options).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    env.step(&[0.0; 12]).unwrap();
    env.step(&[0.0; 12]).unwrap();
    for _ in 0..2 {
        let error = env.step(&[0.0; 12]).unwrap_err();
        assert_eq!(rejection(&error), ErrorCode::LeaseLost);
        assert!(error.to_string().contains("planted in the third step"), "{error}");
    }
    let mut other = RemoteVecEnv::connect(&options).unwrap();
    assert!(other.reset(&ResetRequest::default()).is_ok());
    server.shutdown();
}

#[test]
fn client_of_a_stopping_server_receives_an_error() {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 1)).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    let stopper = std::thread::spawn(move || server.shutdown());
    let error = loop {
        if let Err(error) = env.step(&[0.0; 12]) {
            break error.to_string();
        }
    };
    assert!(error.contains("is shutting down"), "{error}");
    stopper.join().unwrap();
}
