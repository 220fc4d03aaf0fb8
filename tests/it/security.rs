//! The shipped security files: which clients are accepted, which are rejected, and with which errors.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use twinstep_client::{ClientError, ConnectOptions, RemoteVecEnv, RobotWatch};
use twinstep_env_server::{Config, Server, ServerError, SimEnvFactory};
use twinstep_envs::TaskConfig;
use twinstep_model::{ResetRequest, VecEnv};
use twinstep_tests::python::{python, root, run};
use twinstep_tests::security::SecurityFolder;

/// Starts a server with the Zenoh configuration `zenoh` and a lease grace period of 0.
///
/// A client whose liveliness token is not visible to the server then loses its environments.
fn serve(protocol: &str, zenoh: &Path) -> (Server, String) {
    let mut config = Config { task: TaskConfig::Counter, ..Config::default() };
    config.server.listen = format!("{protocol}/127.0.0.1:0");
    config.server.zenoh = Some(zenoh.to_owned());
    config.server.lease_grace_s = 0.0;
    let server = Server::start(&config.server, Arc::new(SimEnvFactory::new(config.clone()).unwrap())).unwrap();
    let endpoint = server.endpoints().into_iter().find(|endpoint| endpoint.contains("127.0.0.1")).unwrap();
    (server, endpoint)
}

fn connect(endpoint: &str, zenoh: Option<PathBuf>) -> Result<RemoteVecEnv, ClientError> {
    let connect_timeout = Duration::from_millis(300);
    RemoteVecEnv::connect(&ConnectOptions { zenoh, connect_timeout, ..ConnectOptions::new(endpoint, 4) })
}

/// Connects, steps for longer than the server needs to expire the lease of a lost client, and closes.
fn steps(endpoint: &str, zenoh: Option<PathBuf>) {
    let mut env = connect(endpoint, zenoh).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    let since = std::time::Instant::now();
    let mut count = 0.0;
    while count < 500.0 || since.elapsed() < Duration::from_millis(300) {
        count += 1.0;
        assert_eq!(env.step(&[0.5; 48]).unwrap().obs[0], count);
    }
    env.close().unwrap();
}

fn rejected(endpoint: &str, zenoh: Option<PathBuf>) -> String {
    let error = connect(endpoint, zenoh).err().expect("rejected");
    assert!(matches!(error, ClientError::NoServer { .. }), "{error:?}");
    error.to_string()
}

#[test]
fn user_with_the_password_is_accepted() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-users.json5"));
    steps(&endpoint, Some(folder.path("client-user.json5")));
    server.shutdown();
}

#[test]
fn wrong_password_unknown_user_and_no_password_are_rejected() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-users.json5"));
    let wrong_password = folder.edited("client-user.json5", "change-me-1", "change-me-2").unwrap();
    let text = rejected(&endpoint, Some(wrong_password));
    for part in [
        "no server answers at tcp/127.0.0.1:",
        "not a Zenoh server, or it rejects this client",
        "twinstep serve --zenoh",
        "TWINSTEP_LOG",
    ] {
        assert!(text.contains(part), "{text}");
    }
    assert!(!text.contains(".rs:"), "{text}");
    rejected(&endpoint, Some(folder.edited("client-user.json5", "alice", "mallory").unwrap()));
    rejected(&endpoint, None);
    server.shutdown();
}

#[test]
fn server_does_not_start_with_an_empty_user_file() {
    let folder = SecurityFolder::new().unwrap();
    folder.write("users.txt", "\n").unwrap();
    let mut config = Config::default();
    config.server.listen = "tcp/127.0.0.1:0".to_owned();
    config.server.zenoh = Some(folder.path("server-users.json5"));
    let error = Server::start(&config.server, Arc::new(SimEnvFactory::new(config.clone()).unwrap())).err().unwrap();
    assert!(matches!(error, ServerError::ZenohConfig { .. }), "{error:?}");
    assert!(error.to_string().contains("is empty, so Zenoh would accept every client"), "{error}");
}

#[test]
fn error_replies_pass_access_control() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-acl.json5"));
    let mut env = connect(&endpoint, Some(folder.path("client-user.json5"))).unwrap();
    let error = env.step(&[0.0; 48]).unwrap_err().to_string();
    assert!(error.contains("reset"), "{error}");
    server.shutdown();
}

#[test]
fn allowed_user_steps_and_its_liveliness_token_is_visible() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-acl.json5"));
    steps(&endpoint, Some(folder.path("client-user.json5")));
    server.shutdown();
}

#[test]
fn scene_is_seen_only_by_a_user_who_may_look() {
    let folder = SecurityFolder::new().unwrap();
    let scene = |file: &Path| {
        let (server, endpoint) = serve("tcp", file);
        let publisher = server.frame_publisher().unwrap();
        let is_over = AtomicBool::new(false);
        let scene = std::thread::scope(|scope| {
            scope.spawn(|| {
                while !is_over.load(Ordering::Acquire) {
                    if publisher.is_scene_wanted() {
                        publisher.send_scene(b"a scene");
                    }
                    std::thread::sleep(Duration::from_millis(20));
                }
            });
            let zenoh = Some(folder.path("client-user.json5"));
            let connect_timeout = Duration::from_secs(2);
            let options = ConnectOptions { zenoh, connect_timeout, ..ConnectOptions::new(&endpoint, 1) };
            let scene = RobotWatch::open(&options).unwrap().scene();
            is_over.store(true, Ordering::Release);
            scene
        });
        drop(publisher);
        server.shutdown();
        scene
    };
    assert_eq!(scene(&folder.path("server-acl.json5")).unwrap(), b"a scene");
    let blind = folder.edited("server-acl.json5", "\"look\", \"see_robots\"", "").unwrap();
    let error = scene(&blind).unwrap_err();
    assert!(matches!(error, ClientError::NoScene { .. }) && error.to_string().contains("access control"), "{error}");
}

#[test]
fn error_of_a_user_without_a_policy_names_both_possible_reasons() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-acl.json5"));
    folder.edited("client-user.json5", "alice", "bob").unwrap();
    let bob = folder.edited("edited-client-user.json5", "change-me-1", "change-me-2").unwrap();
    let error = connect(&endpoint, Some(bob)).err().expect("rejected");
    assert!(matches!(error, ClientError::NoServerVisible { .. }), "{error:?}");
    let text = error.to_string();
    for part in ["no server is visible", "no server is running", "access control", "TWINSTEP_LOG"] {
        assert!(text.contains(part), "{text}");
    }
    server.shutdown();
}

#[test]
fn client_steps_over_tls() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tls", &folder.path("server-tls.json5"));
    assert!(endpoint.starts_with("tls/"));
    steps(&endpoint, Some(folder.path("client-tls.json5")));
    server.shutdown();
}

#[test]
fn client_steps_over_quic_with_the_files_of_tls() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("quic", &folder.path("server-tls.json5"));
    assert!(endpoint.starts_with("quic/"));
    steps(&endpoint, Some(folder.path("client-tls.json5")));
    rejected(&endpoint, None);
    server.shutdown();
}

const PYTHON_STEPS: &str = "
import sys
import numpy as np
import twinstep
env = twinstep.Go2VectorEnv(256, task='counter', endpoint=sys.argv[1], zenoh_config=sys.argv[2])
env.reset()
for count in range(1, 201):
    observation = env.step(np.full((256, 12), 0.5, np.float32))[0]
    assert (observation[:, 0] == count).all(), (count, observation[:, 0])
env.close()
";

#[test]
fn python_client_steps_over_quic() {
    let Some(python) = python(&crate::python::target()).unwrap() else { return };
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("quic", &folder.path("server-tls.json5"));
    let mut client = Command::new(python);
    client.args(["-c", PYTHON_STEPS, &endpoint]).arg(folder.path("client-tls.json5"));
    run(client.env("PYTHONPATH", root().join("clients/python/src"))).unwrap_or_else(|printed| panic!("{printed}"));
    server.shutdown();
}

#[test]
fn client_that_trusts_another_authority_rejects_the_server() {
    let (folder, other) = (SecurityFolder::new().unwrap(), SecurityFolder::new().unwrap());
    let (server, endpoint) = serve("tls", &folder.path("server-tls.json5"));
    let text = rejected(&endpoint, Some(other.path("client-tls.json5")));
    assert!(text.contains("certificate"), "{text}");
    rejected(&endpoint, None);
    server.shutdown();
}

#[test]
fn mutual_tls_accepts_only_certificates_of_the_authority() {
    let (folder, other) = (SecurityFolder::new().unwrap(), SecurityFolder::new().unwrap());
    let (server, endpoint) = serve("tls", &folder.uncommented("server-tls.json5").unwrap());
    steps(&endpoint, Some(folder.uncommented("client-tls.json5").unwrap()));
    assert!(connect(&endpoint, Some(folder.path("client-tls.json5"))).is_err(), "no certificate");
    // This client trusts the server, but another authority issued its own certificate.
    std::fs::copy(folder.path("ca.pem"), other.path("ca.pem")).unwrap();
    let foreign = other.uncommented("client-tls.json5").unwrap();
    assert!(connect(&endpoint, Some(foreign)).is_err(), "a certificate of another authority");
    steps(&endpoint, Some(folder.uncommented("client-tls.json5").unwrap()));
    server.shutdown();
}

#[test]
fn password_is_checked_over_tls() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tls", &folder.uncommented("server-users.json5").unwrap());
    steps(&endpoint, Some(folder.uncommented("client-user.json5").unwrap()));
    rejected(&endpoint, Some(folder.path("client-tls.json5")));
    server.shutdown();
}

#[test]
fn access_control_by_certificate_name_accepts_its_owner() {
    let folder = SecurityFolder::new().unwrap();
    let by_name = folder.edited("server-acl.json5", "usernames: [\"alice\"],", "").unwrap();
    let by_name = folder.uncommented(by_name.file_name().unwrap().to_str().unwrap()).unwrap();
    // The certificate replaces the password.
    let tls = std::fs::read_to_string(folder.uncommented("server-tls.json5").unwrap()).unwrap();
    let access = std::fs::read_to_string(by_name).unwrap();
    let access = access.split_once("access_control: {").unwrap().1;
    let zenoh = folder.write(
        "by-name.json5",
        &format!("{}, access_control: {{{access}", tls.trim_end().strip_suffix(",\n}").unwrap()),
    );
    let (server, endpoint) = serve("tls", &zenoh.unwrap());
    steps(&endpoint, Some(folder.uncommented("client-tls.json5").unwrap()));
    server.shutdown();
}
