//! Environments that are divided among several servers.

use std::path::Path;
use std::time::{Duration, Instant};

use twinstep_client::{ClientError, ConnectOptions, RemoteVecEnv, ShardedVecEnv};
use twinstep_env_server::Server;
use twinstep_envs::{Counter, OBS_LEN, TaskConfig};
use twinstep_model::{AutoresetMode, EnvError, ResetRequest, StepBatch, VecEnv};
use twinstep_tests::process::Process;
use twinstep_tests::test_bed::{free_endpoint, start_server};

use crate::discovery::{router, wait_for};
use crate::remote::{config, start};

const FAULTS: &str = env!("CARGO_BIN_EXE_faults");
/// Number of environments.
const ROWS: usize = 5;

fn actions(step: usize, rows: usize) -> Vec<f32> {
    (0..rows * 12).map(|index| ((step * rows * 12 + index) as f32).sin()).collect()
}

#[test]
fn rows_are_the_same_on_any_number_of_servers() {
    let config = config(TaskConfig::default());
    let (servers, endpoints): (Vec<Server>, Vec<String>) = [(); 3].map(|()| start(&config)).into_iter().unzip();
    for autoreset in [AutoresetMode::NextStep, AutoresetMode::SameStep, AutoresetMode::Disabled] {
        let options = |endpoint: &str| ConnectOptions {
            autoreset,
            max_episode_steps: Some(4),
            critic: true,
            ..ConnectOptions::new(endpoint, ROWS)
        };
        let mut one = RemoteVecEnv::connect(&options(&endpoints[0])).unwrap();
        let expected = observed(&mut one, autoreset);
        assert!(expected.1.iter().map(|step| step.ended.len()).sum::<usize>() >= 2 * ROWS);
        one.close().unwrap();
        for count in 1..=3 {
            let mut sharded = ShardedVecEnv::connect(&options(""), &endpoints[..count]).unwrap();
            assert!(observed(&mut sharded, autoreset) == expected, "{count} servers, {autoreset:?}");
            assert!(sharded.held() == [false; ROWS] && sharded.lost().is_empty());
            sharded.close().unwrap();
        }
    }
    servers.into_iter().for_each(Server::shutdown);
}

/// Returns all observations after resets and all steps.
fn observed(env: &mut dyn VecEnv, autoreset: AutoresetMode) -> (Vec<Vec<f32>>, Vec<StepBatch>) {
    let (mut resets, mut steps) = (Vec::new(), Vec::new());
    let some = [true, false, true, true, false].to_vec();
    let masked = ResetRequest { mask: Some(some), ..ResetRequest::seeded(49, ROWS) };
    for request in [ResetRequest::seeded(40, ROWS), masked, ResetRequest::default()] {
        resets.push(env.reset(&request).unwrap().to_vec());
        resets.push(env.critic_obs().to_vec());
    }
    for step in 0..11 {
        let batch = env.step(&actions(step, ROWS)).unwrap().clone();
        if autoreset == AutoresetMode::Disabled && !batch.ended.is_empty() {
            let mask = (0..ROWS).map(|row| batch.done(row)).collect();
            resets.push(env.reset(&ResetRequest::masked(mask)).unwrap().to_vec());
        }
        steps.push(batch);
    }
    resets.push(env.scene(ROWS - 1).unwrap().pose.concat());
    (resets, steps)
}

#[test]
fn killed_server_costs_its_own_rows_one_episode_until_it_is_back() {
    let endpoints = [(); 2].map(|()| free_endpoint().unwrap());
    // There is no room for the lost environments elsewhere.
    let launch = |endpoint: &str| start_server(Path::new(FAULTS), endpoint, None, &words(&["--envs", "2"])).unwrap();
    let mut servers = endpoints.each_ref().map(|endpoint| launch(endpoint));
    steps_over_a_loss(&endpoints, |is_lost| {
        servers[1].kill();
        if is_lost {
            servers[1] = launch(&endpoints[1]);
        }
    });
}

#[test]
fn environments_of_a_killed_server_behind_a_router_are_leased_at_another_one() {
    let (_router, endpoint) = router();
    let launch = |listen: String| start_server(Path::new(FAULTS), &listen, Some(&endpoint), &[]).unwrap();
    let mut servers: [Process; 2] = [(); 2].map(|()| launch(free_endpoint().unwrap()));
    wait_for(&endpoint, 2);
    steps_over_a_loss(&[endpoint.clone(), endpoint.clone()], |is_lost| {
        if !is_lost {
            servers[1].kill();
        }
    });
}

fn words(words: &[&str]) -> Vec<String> {
    words.iter().map(|word| (*word).to_owned()).collect()
}

/// Steps four counters, two at each server, and compares every row with its own counter.
///
/// `event(false)` is called before a step and kills the second server, `event(true)` after the loss was reported.
fn steps_over_a_loss(endpoints: &[String], mut event: impl FnMut(bool)) {
    let options = ConnectOptions { timeout: Duration::from_secs(8), ..ConnectOptions::new("", 4) };
    let mut env = ShardedVecEnv::connect(&options, endpoints).unwrap();
    let new = Counter { resets: 1, ..Counter::default() };
    let mut counters = [new; 4];
    env.reset(&ResetRequest::seeded(1, 4)).unwrap();
    let (mut lost, mut steps_after) = (Vec::new(), 0);
    let since = Instant::now();
    for step in 0.. {
        if step == 20 {
            event(false);
        }
        let actions = actions(step, 4);
        let batch = env.step(&actions).unwrap().clone();
        let first_loss = lost.is_empty() && !env.lost().is_empty();
        lost.extend(env.lost());
        for (row, counter) in counters.iter_mut().enumerate() {
            let obs = &batch.obs[row * OBS_LEN..][..4];
            assert_eq!(batch.truncated[row], env.lost().contains(&row), "row {row} of step {step}");
            if !env.held()[row] {
                counter.step(&actions[row * 12..][..12]);
            } else if obs == new.observation() {
                *counter = new;
            }
            assert_eq!(obs, counter.observation(), "row {row} of step {step}");
        }
        if first_loss {
            assert_eq!(batch.ended.iter().map(|episode| episode.length).collect::<Vec<_>>(), [20, 20]);
            event(true);
        }
        let is_complete = !lost.is_empty() && env.held() == [false; 4];
        steps_after += usize::from(is_complete);
        if steps_after == 50 {
            break;
        }
        assert!(since.elapsed() < Duration::from_mins(1), "not leased again");
        if lost.len() == 2 && !is_complete {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    assert!(lost == [0, 1] || lost == [2, 3], "each lost environment is truncated once: {lost:?}");
    let untouched = counters.iter().filter(|counter| counter.steps > 70).count();
    assert_eq!(untouched, 2, "{counters:?}");
    env.close().unwrap();
}

#[test]
fn invalid_use_is_refused_before_anything_is_sent() {
    let (walk, first) = start(&config(TaskConfig::default()));
    let (counter, second) = start(&config(TaskConfig::Counter));
    let refused = |options: &ConnectOptions, endpoints: &[&str]| {
        ShardedVecEnv::connect(options, &words(endpoints)).err().unwrap().to_string()
    };
    let options = |num_envs| ConnectOptions::new("", num_envs);
    assert!(refused(&options(2), &[]).starts_with("0 servers are given for 2 environments"));
    assert!(refused(&options(1), &[&first, &second]).starts_with("2 servers are given for 1 environments"));
    let text = refused(&options(2), &[&first, &second]);
    assert!(text.contains(&first) && text.contains(&second) && text.contains("different specs"), "{text}");

    let options = ConnectOptions { connect_timeout: Duration::from_secs(1), ..ConnectOptions::new("", 3) };
    let mut env = ShardedVecEnv::connect(&options, &[second]).unwrap();
    let mut actions = [0.5; 36];
    assert!(matches!(env.step(&actions), Err(EnvError::NeedsReset { env: 0 })));
    env.reset(&ResetRequest::default()).unwrap();
    actions[25] = f32::NAN;
    assert!(matches!(env.step(&actions), Err(EnvError::ActionNotFinite { env: 2, .. })));
    assert!(matches!(env.step(&actions[..12]), Err(EnvError::WrongLength { given: 12, expected: 36, .. })));
    actions[25] = 0.5;
    assert_eq!(env.step(&actions).unwrap().obs[0], 1.0, "nothing else was stepped");

    counter.shutdown();
    assert_eq!(env.step(&actions).unwrap().truncated, [true; 3]);
    let error = env.step(&actions).unwrap_err();
    let EnvError::Remote(error) = &error else { panic!("{error}") };
    assert!(
        matches!(error.downcast_ref(), Some(ClientError::NoServerLeft { waited_s }) if *waited_s >= 1.0),
        "{error}"
    );
    walk.shutdown();
}
