//! The shipped security files: who gets in, who does not, and what those are told.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use twinstep_client::{ClientError, ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{Config, Server, ServerError, SimEnvFactory};
use twinstep_envs::TaskName;
use twinstep_model::{ResetRequest, VecEnv};
use twinstep_tests::security::SecurityFolder;

/// A server with the Zenoh configuration `zenoh` and a lease grace of 0: a client it does not see loses its environments.
fn serve(protocol: &str, zenoh: &Path) -> (Server, String) {
    let mut config = Config::default();
    config.task.name = TaskName::Counter;
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

/// Connects, steps for longer than the server takes to free what it thinks is lost, and closes.
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

fn refused(endpoint: &str, zenoh: Option<PathBuf>) -> String {
    let error = connect(endpoint, zenoh).err().expect("refused");
    assert!(matches!(error, ClientError::NoServer { .. }), "{error:?}");
    error.to_string()
}

#[test]
fn user_with_the_password_steps() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-users.json5"));
    steps(&endpoint, Some(folder.path("client-user.json5")));
    server.shutdown();
}

#[test]
fn wrong_password_unknown_user_and_no_password_are_refused() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-users.json5"));
    let wrong_password = folder.edited("client-user.json5", "change-me-1", "change-me-2").unwrap();
    let text = refused(&endpoint, Some(wrong_password));
    for said in [
        "no server answers at tcp/127.0.0.1:",
        "not a Zenoh server, or it rejects this client",
        "twinstep serve --zenoh",
        "TWINSTEP_LOG",
    ] {
        assert!(text.contains(said), "{text}");
    }
    assert!(!text.contains(".rs:"), "{text}");
    refused(&endpoint, Some(folder.edited("client-user.json5", "alice", "mallory").unwrap()));
    refused(&endpoint, None);
    server.shutdown();
}

#[test]
fn user_file_without_users_does_not_open_the_server() {
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
fn refusals_with_a_reason_pass_access_control() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-acl.json5"));
    let mut env = connect(&endpoint, Some(folder.path("client-user.json5"))).unwrap();
    let error = env.step(&[0.0; 48]).unwrap_err().to_string();
    assert!(error.contains("reset"), "{error}");
    server.shutdown();
}

#[test]
fn allowed_user_steps_and_is_seen_by_the_server() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-acl.json5"));
    steps(&endpoint, Some(folder.path("client-user.json5")));
    server.shutdown();
}

#[test]
fn user_without_a_policy_sees_no_server_and_is_told_both_reasons() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tcp", &folder.path("server-acl.json5"));
    folder.edited("client-user.json5", "alice", "bob").unwrap();
    let bob = folder.edited("edited-client-user.json5", "change-me-1", "change-me-2").unwrap();
    let error = connect(&endpoint, Some(bob)).err().expect("refused");
    assert!(matches!(error, ClientError::NoServerVisible { .. }), "{error:?}");
    let text = error.to_string();
    for said in ["no server is visible", "no server is running", "access control", "TWINSTEP_LOG"] {
        assert!(text.contains(said), "{text}");
    }
    server.shutdown();
}

#[test]
fn steps_go_through_tls() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tls", &folder.path("server-tls.json5"));
    assert!(endpoint.starts_with("tls/"));
    steps(&endpoint, Some(folder.path("client-tls.json5")));
    server.shutdown();
}

#[test]
fn client_that_trusts_another_authority_refuses_the_server() {
    let (folder, other) = (SecurityFolder::new().unwrap(), SecurityFolder::new().unwrap());
    let (server, endpoint) = serve("tls", &folder.path("server-tls.json5"));
    let text = refused(&endpoint, Some(other.path("client-tls.json5")));
    assert!(text.contains("certificate"), "{text}");
    refused(&endpoint, None);
    server.shutdown();
}

#[test]
fn mutual_tls_lets_in_whoever_has_a_certificate_of_the_authority() {
    let (folder, other) = (SecurityFolder::new().unwrap(), SecurityFolder::new().unwrap());
    let (server, endpoint) = serve("tls", &folder.uncommented("server-tls.json5").unwrap());
    steps(&endpoint, Some(folder.uncommented("client-tls.json5").unwrap()));
    assert!(connect(&endpoint, Some(folder.path("client-tls.json5"))).is_err(), "no certificate");
    // Trusts the server, but its own certificate is another authority's.
    std::fs::copy(folder.path("ca.pem"), other.path("ca.pem")).unwrap();
    let foreign = other.uncommented("client-tls.json5").unwrap();
    assert!(connect(&endpoint, Some(foreign)).is_err(), "a foreign certificate");
    steps(&endpoint, Some(folder.uncommented("client-tls.json5").unwrap()));
    server.shutdown();
}

#[test]
fn password_goes_through_tls() {
    let folder = SecurityFolder::new().unwrap();
    let (server, endpoint) = serve("tls", &folder.uncommented("server-users.json5").unwrap());
    steps(&endpoint, Some(folder.uncommented("client-user.json5").unwrap()));
    refused(&endpoint, Some(folder.path("client-tls.json5")));
    server.shutdown();
}

#[test]
fn access_control_by_certificate_name_lets_its_owner_step() {
    let folder = SecurityFolder::new().unwrap();
    let by_name = folder.edited("server-acl.json5", "usernames: [\"alice\"],", "").unwrap();
    let by_name = folder.uncommented(by_name.file_name().unwrap().to_str().unwrap()).unwrap();
    // The certificate stands in the password's place.
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
