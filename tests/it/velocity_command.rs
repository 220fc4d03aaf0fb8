//! Commands of the agent in place of the task's own: the fields `command` and `gait_command` of the step request.

use twinstep_client::{ConnectOptions, GroupedVecEnv, RemoteVecEnv, ShardedVecEnv};
use twinstep_env_server::{EnvFactory, SimEnvFactory};
use twinstep_envs::TaskConfig;
use twinstep_model::{AutoresetMode, EnvError, GaitCommand, ResetRequest, StepBatch, VecEnv};
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::{LeaseReply, StepReply, StepRequest};
use twinstep_protocol::tensor::{self, as_bytes};
use twinstep_protocol::{ErrorCode, PROTOCOL, decode, encode};

use crate::raw_client::{Answer, RawClient};
use crate::remote::{config, start};

const COMMANDS: [[f32; 3]; 2] = [[0.5, 0.0, -0.25], [-1.0, 0.125, 0.0]];

fn commands_in(obs: &[f32]) -> Vec<[f32; 3]> {
    obs.chunks_exact(45).map(|row| [row[6], row[7], row[8]]).collect()
}

#[test]
fn commands_stay_in_force_through_resets_until_they_are_set_again() {
    let config = config(TaskConfig::default());
    let (server, endpoint) = start(&config);
    let mut local = SimEnvFactory::new(config).unwrap().build(2, AutoresetMode::SameStep, Some(4)).unwrap();
    let options = ConnectOptions {
        autoreset: AutoresetMode::SameStep,
        max_episode_steps: Some(4),
        ..ConnectOptions::new(&endpoint, 2)
    };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut grouped = GroupedVecEnv::connect(&options, 2).unwrap();
    let same = |one: &StepBatch, other: &StepBatch| one.obs == other.obs && one.reward == other.reward;
    for env in [&mut *local, &mut remote, &mut grouped] {
        env.reset(&ResetRequest::seeded(3, 2)).unwrap();
    }
    for step in 0..14 {
        let wanted = if step < 9 { COMMANDS } else { [COMMANDS[1], COMMANDS[0]] };
        if step == 0 || step == 9 {
            for env in [&mut *local, &mut remote, &mut grouped] {
                env.set_velocity_commands(&wanted).unwrap();
            }
        }
        let batch = local.step(&[0.1; 24]).unwrap().clone();
        assert_eq!(commands_in(&batch.obs), wanted, "step {step}");
        assert!(same(remote.step(&[0.1; 24]).unwrap(), &batch) && same(grouped.step(&[0.1; 24]).unwrap(), &batch));
    }
    remote.close().unwrap();
    grouped.close().unwrap();
    server.shutdown();
}

#[test]
fn gait_commands_stay_in_force_and_have_the_bounds_of_the_spec() {
    const GAITS: [GaitCommand; 2] = [[2.5, 0.5, 0.5, 0.0], [3.5, 0.0, 0.5, 0.5]];
    let config = config(TaskConfig::named("gait").unwrap());
    let (server, endpoint) = start(&config);
    let mut local = SimEnvFactory::new(config).unwrap().build(2, AutoresetMode::SameStep, Some(4)).unwrap();
    let options = ConnectOptions {
        autoreset: AutoresetMode::SameStep,
        max_episode_steps: Some(4),
        ..ConnectOptions::new(&endpoint, 2)
    };
    let mut remote = RemoteVecEnv::connect(&options).unwrap();
    let mut grouped = GroupedVecEnv::connect(&options, 2).unwrap();
    let mut sharded = ShardedVecEnv::connect(&options, std::slice::from_ref(&endpoint)).unwrap();
    for env in [&mut *local, &mut remote, &mut grouped, &mut sharded] {
        env.reset(&ResetRequest::seeded(3, 2)).unwrap();
        let error = env.set_gait_commands(&[GAITS[0], [2.0, 0.0, 0.0, 1.5]]).unwrap_err().to_string();
        assert!(error.starts_with("`gait_command` of environment 1: phase_offset[2] is 1.5; 0 to 1"), "{error}");
        env.set_gait_commands(&GAITS).unwrap();
        env.set_velocity_commands(&COMMANDS).unwrap();
        for step in 0..10 {
            let obs = env.step(&[0.1; 24]).unwrap().obs.clone();
            let found: Vec<_> = obs.chunks_exact(57).map(|row| [row[45], row[46], row[47], row[48]]).collect();
            assert_eq!(found, GAITS, "step {step}");
        }
    }
    remote.close().unwrap();
    grouped.close().unwrap();
    server.shutdown();
}

#[test]
fn random_numbers_of_the_task_do_not_depend_on_given_commands() {
    let factory = SimEnvFactory::new(config(TaskConfig::default())).unwrap();
    let poses = |commands: Option<&[[f32; 3]]>| {
        let mut env = factory.build(2, AutoresetMode::Disabled, None).unwrap();
        let first = env.reset(&ResetRequest::seeded(3, 2)).unwrap().to_vec();
        if let Some(commands) = commands {
            env.set_velocity_commands(commands).unwrap();
        }
        env.step(&[0.0; 24]).unwrap();
        let second = env.reset(&ResetRequest::default()).unwrap().to_vec();
        [first, second].map(|obs| obs.chunks_exact(45).map(|row| row[9..21].to_vec()).collect::<Vec<_>>())
    };
    assert_eq!(poses(None), poses(Some(&COMMANDS)));
}

#[test]
fn residual_on_a_base_policy_keeps_the_contract_of_environments() {
    let path = twinstep_tests::python::root().join("data/policies/walk.safetensors");
    let base = twinstep_policy::Policy::read(path).unwrap().0;
    let factory = SimEnvFactory::new(config(TaskConfig::default())).unwrap();
    let walk = factory.build(2, AutoresetMode::NextStep, Some(20)).unwrap();
    let mut env = twinstep_policy::ResidualEnv::new(walk, "explore", &base, 0.5).unwrap();
    twinstep_envs::check_vec_env(&mut env, 60).unwrap();
    env.reset(&ResetRequest::seeded(1, 2)).unwrap();
    let before = env.obs()[6..9].to_vec();
    env.set_velocity_commands(&COMMANDS).unwrap();
    let error = env.step(&[f32::NAN; 24]).unwrap_err().to_string();
    assert!(error.contains("residual[FL_hip] is NaN"), "{error}");
    // A rejected step discards the commands, as it does without a residual.
    assert_eq!(env.step(&[0.0; 24]).unwrap().obs[6..9], before);
    env.set_velocity_commands(&COMMANDS).unwrap();
    assert_eq!(env.step(&[0.0; 24]).unwrap().obs[6..9], COMMANDS[0]);
}

#[test]
fn invalid_commands_are_errors_of_the_environment() {
    let factory = SimEnvFactory::new(config(TaskConfig::default())).unwrap();
    let mut env = factory.build(2, AutoresetMode::Disabled, None).unwrap();
    let mut error = |commands: &[[f32; 3]]| env.set_velocity_commands(commands).unwrap_err();
    assert!(matches!(error(&COMMANDS[..1]), EnvError::WrongLength { field: "command", given: 3, expected: 6 }));
    assert_eq!(
        error(&[[0.0; 3], [0.0, 0.0, 5.5]]).to_string(),
        "`command` of environment 1: velocity_command[2] is 5.5; -5 to 5 is allowed; no environment was stepped"
    );
    assert!(error(&[[f32::NAN, 0.0, 0.0], [0.0; 3]]).to_string().contains("velocity_command[0] is NaN"));
}

fn step(client: &RawClient, lease: &LeaseReply, seq: u64, action: f32, command: Option<&[f32]>) -> Answer {
    let (actions, command) = ([action; 24], command.map(as_bytes));
    let request = StepRequest {
        protocol: PROTOCOL,
        epoch: lease.epoch,
        seq,
        actions: as_bytes(&actions),
        command,
        gait_command: None,
        for_tick: None,
    };
    client.ask_env(lease, EnvMethod::Step, &encode(&request))
}

#[test]
fn rejected_commands_change_nothing() {
    let (server, endpoint) = start(&config(TaskConfig::default()));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(2);
    client.reset(&lease, 1).unwrap();
    let given = COMMANDS.concat();
    let observed = |answer: Answer| {
        let bytes = answer.unwrap();
        commands_in(&tensor::read(decode::<StepReply<'_>>(&bytes).unwrap().obs, "obs").unwrap())
    };
    assert_eq!(observed(step(&client, &lease, 2, 0.0, Some(&given))), COMMANDS);
    for (command, code) in [
        (&given[..3], ErrorCode::BadShape),
        (&[0.0, 0.0, f32::NAN, 0.0, 0.0, 0.0], ErrorCode::NotFinite),
        (&[0.0, 0.0, 0.0, 9.0, 0.0, 0.0], ErrorCode::OutOfRange),
    ] {
        let error = step(&client, &lease, 3, 0.0, Some(command)).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (code, "command"), "{error}");
    }
    // The action is invalid, the commands are not.
    let error = step(&client, &lease, 3, f32::INFINITY, Some(&[0.75; 6])).unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (ErrorCode::NotFinite, "actions"));
    assert_eq!(observed(step(&client, &lease, 3, 0.0, None)), COMMANDS);
    server.shutdown();
}

#[test]
fn tasks_without_a_velocity_command_refuse_it() {
    let (server, endpoint) = start(&config(TaskConfig::Counter));
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(2);
    client.reset(&lease, 1).unwrap();
    let error = step(&client, &lease, 2, 0.0, Some(&[0.0; 6])).unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "command"));
    assert!(error.message.contains("the task `counter` has no velocity command"), "{error}");
    let gait_command = Some(as_bytes(&[0.0f32; 8]));
    let (actions, command, for_tick) = (as_bytes(&[0.0f32; 24]), None, None);
    let request =
        StepRequest { protocol: PROTOCOL, epoch: lease.epoch, seq: 2, actions, command, gait_command, for_tick };
    let error = client.ask_env(&lease, EnvMethod::Step, &encode(&request)).unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "gait_command"));
    step(&client, &lease, 2, 0.0, None).unwrap();
    server.shutdown();
}
