//! Several servers behind one router: `twinstep list`, and the choice of a server.

use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use twinstep_client::{ClientError, ConnectOptions, Discovery, RemoteVecEnv};
use twinstep_env_server::Server;
use twinstep_envs::TaskConfig;
use twinstep_model::{ResetRequest, VecEnv};
use twinstep_tests::process::Process;
use twinstep_tests::python::Programs;
use twinstep_tests::test_bed::{free_endpoint, start_router};

use crate::remote::{config, start};

const FAULTS: &str = env!("CARGO_BIN_EXE_faults");

pub fn router() -> (Process, String) {
    let endpoint = free_endpoint().unwrap();
    (start_router(Path::new(FAULTS), &endpoint).unwrap(), endpoint)
}

fn behind(router: &str, task: TaskConfig, envs: usize, name: &str) -> Server {
    let mut config = config(task);
    config.server.connect = vec![router.to_owned()];
    config.server.envs = envs;
    config.server.name = Some(name.to_owned());
    start(&config).0
}

/// Waits until the router knows this number of servers.
pub fn wait_for(endpoint: &str, servers: usize) {
    let discovery = Discovery::open(&ConnectOptions::new(endpoint, 1)).unwrap();
    let since = Instant::now();
    while discovery.servers().len() < servers {
        assert!(since.elapsed() < Duration::from_secs(20), "fewer than {servers} servers are visible");
    }
}

#[test]
fn client_takes_the_server_with_the_most_free_environments() {
    let (_router, endpoint) = router();
    let small = behind(&endpoint, TaskConfig::Counter, 4, "go2");
    let large = behind(&endpoint, TaskConfig::Counter, 6, "go2");
    wait_for(&endpoint, 2);
    let mut found = Vec::new();
    let _leases: Vec<RemoteVecEnv> = [5, 4]
        .map(|num_envs| {
            let env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, num_envs)).unwrap();
            found.push(env.num_envs());
            env
        })
        .into();
    assert_eq!(found, [5, 4]);
    small.shutdown();
    large.shutdown();
}

#[test]
fn client_does_not_choose_between_different_robots_or_tasks() {
    let (_router, endpoint) = router();
    let options = ConnectOptions { connect_timeout: Duration::from_secs(1), ..ConnectOptions::new(&endpoint, 1) };
    let servers = [("go2", TaskConfig::Counter), ("spot", TaskConfig::Counter), ("go2", TaskConfig::default())]
        .map(|(name, task)| behind(&endpoint, task, 4, name));
    wait_for(&endpoint, 3);
    for robot in [None, Some("go2".to_owned())] {
        let error = RemoteVecEnv::connect(&ConnectOptions { robot, ..options.clone() }).err().unwrap();
        assert!(matches!(&error, ClientError::AmbiguousRobot { visible, .. } if visible.len() == 3), "{error}");
    }
    RemoteVecEnv::connect(&ConnectOptions { robot: Some("spot".to_owned()), ..options }).unwrap();
    servers.into_iter().for_each(Server::shutdown);
}

#[test]
fn list_shows_task_free_environments_and_load_of_each_server() {
    let program = Programs::beside(FAULTS).unwrap().twinstep();
    let list = |endpoint: &str, more: &[&str]| {
        let output = Command::new(&program).args(["list", endpoint]).args(more).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let output = Command::new(&program).args(["list", &free_endpoint().unwrap()]).output().unwrap();
    let error = String::from_utf8(output.stderr).unwrap();
    assert!(error.starts_with("error: no server answers") && error.lines().count() == 2, "{error}");
    assert_eq!(output.status.code(), Some(1));
    let (_router, endpoint) = router();
    assert!(list(&endpoint, &[]).contains("no server is visible"));
    let idle = behind(&endpoint, TaskConfig::default(), 8, "idle");
    let busy = behind(&endpoint, TaskConfig::Counter, 4, "busy");
    wait_for(&endpoint, 2);
    let mut env =
        RemoteVecEnv::connect(&ConnectOptions { robot: Some("busy".to_owned()), ..ConnectOptions::new(&endpoint, 3) })
            .unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    let is_listed = AtomicBool::new(false);
    let text = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_listed.load(Ordering::Relaxed) {
                env.step(&[0.1; 36]).unwrap();
            }
        });
        let text = list(&endpoint, &["--json", "--interval-s", "0.3"]);
        is_listed.store(true, Ordering::Relaxed);
        text
    });
    let rows: serde_json::Value = serde_json::from_str(&text).unwrap();
    let entry = |row: usize, name: &str| &rows[row][name];
    assert_eq!((entry(0, "robot"), entry(0, "task")), (&"busy".into(), &"counter".into()), "{text}");
    assert_eq!((entry(0, "free_envs"), entry(0, "max_envs")), (&1.into(), &4.into()), "{text}");
    assert!(entry(0, "env_steps_per_s").as_f64().unwrap() > 0.0, "{text}");
    assert_eq!((entry(1, "robot"), entry(1, "task")), (&"idle".into(), &"walk".into()), "{text}");
    assert_eq!(entry(1, "env_steps_per_s").as_f64(), Some(0.0), "{text}");
    assert!(list(&endpoint, &["--interval-s", "0.1"]).contains("8 of 8"));
    idle.shutdown();
    busy.shutdown();
}
