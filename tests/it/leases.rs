//! Ownership, expiry and reclaiming of leases.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use twinstep_env_server::Server;
use twinstep_envs::TaskConfig;
use twinstep_protocol::keys::EnvMethod;
use twinstep_protocol::message::{LeaseReply, LeaseRequest};
use twinstep_protocol::{ErrorCode, ErrorReply, Secret, keys};
use twinstep_tests::python::Programs;

use crate::raw_client::{RawClient, step_bytes, steps_in};
use crate::remote::{config, start};

/// Maximum wait for a condition, much longer than needed.
const TIMEOUT: Duration = Duration::from_secs(20);

fn start_counters(lease_grace_s: f64) -> (Server, String) {
    let mut config = config(TaskConfig::Counter);
    config.server.lease_grace_s = lease_grace_s;
    start(&config)
}

/// Polls until `condition` holds. Fails after [`TIMEOUT`].
fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let since = Instant::now();
    while !condition() {
        assert!(since.elapsed() < TIMEOUT, "not within {TIMEOUT:?}: {what}");
    }
}

#[test]
fn invalid_numbers_of_environments_are_rejected() {
    let (server, endpoint) = start_counters(10.0);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    for (num_envs, expected) in [
        (0, ErrorCode::OutOfRange),
        (65, ErrorCode::TooManyEnvs),
        (1_000_000_000, ErrorCode::TooManyEnvs),
        (u64::MAX, ErrorCode::TooManyEnvs),
    ] {
        let error = client.ask_lease(&client.lease_request(num_envs)).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (expected, "num_envs"), "{num_envs}");
    }
    assert_eq!(client.hello().free_envs, 64);
    server.shutdown();
}

#[test]
fn clients_with_an_invalid_id_are_rejected() {
    let (server, endpoint) = start_counters(10.0);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    for id in [String::new(), "a/b".to_owned(), "*".to_owned(), "é".to_owned(), "c".repeat(65)] {
        let error = client.ask_lease(&LeaseRequest { client: id, ..client.lease_request(1) }).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "client"));
    }
    server.shutdown();
}

#[test]
fn repeated_lease_request_returns_the_same_lease() {
    let (server, endpoint) = start_counters(10.0);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(3);
    assert_eq!(client.lease(3), lease);
    assert_eq!(client.ask_lease(&client.lease_request(4)).unwrap_err().code, ErrorCode::OutOfRange);
    assert_eq!(client.hello().free_envs, 61);
    server.shutdown();
}

/// Returns the text of a refusal, without the id of the lease.
fn refusal(error: &ErrorReply, lease: &str) -> String {
    assert_eq!(error.code, ErrorCode::LeaseLost, "{error}");
    format!("{} {error}", error.field).replace(lease, "…")
}

#[test]
fn lease_cannot_be_used_or_taken_over_without_its_secret() {
    let (server, endpoint) = start_counters(10.0);
    let victim = RawClient::connect(&endpoint, server.sid(), "victim");
    let lease = victim.lease(2);
    victim.reset(&lease, 1).unwrap();
    let step = victim.step(&lease, 2).unwrap();
    // The intruder knows everything but the secret: the client id, the lease, its epoch and sequence number.
    let intruder = RawClient::without_token(&endpoint, server.sid(), "victim");
    let own = intruder.lease(2);
    assert_ne!(own.lease, lease.lease, "the same client id got the victim's lease");
    let unknown = LeaseReply { lease: "0123456789abcdef".to_owned(), ..lease.clone() };
    let expected = refusal(&intruder.step(&unknown, 2).unwrap_err(), &unknown.lease);
    for verb in EnvMethod::ALL {
        for seq in [2, 3] {
            let error = intruder.ask_env(&lease, verb, &step_bytes(&lease, seq)).unwrap_err();
            assert_eq!(refusal(&error, &lease.lease), expected, "{verb:?}: a refusal says that the lease exists");
        }
    }
    assert_eq!(refusal(&intruder.reclaim(&lease.lease, 1).unwrap_err(), &lease.lease), expected);
    assert_eq!(refusal(&intruder.reclaim(&unknown.lease, 1).unwrap_err(), &unknown.lease), expected);
    assert_eq!(victim.step(&lease, 2).unwrap(), step, "the intruder changed the stored reply");
    assert_eq!(steps_in(&victim.step(&lease, 3).unwrap()), 2.0, "the intruder stepped the victim's robots");
    server.shutdown();
}

#[test]
fn requests_without_the_secret_do_not_fill_the_mailbox_of_a_lease() {
    let (server, endpoint) = start_counters(10.0);
    let victim = RawClient::connect(&endpoint, server.sid(), "victim");
    let lease = victim.lease(64);
    victim.reset(&lease, 1).unwrap();
    let intruder = RawClient::without_token(&endpoint, server.sid(), "intruder");
    let key = keys::env(server.sid(), &lease.lease, EnvMethod::Step);
    for seq in 2..200 {
        let unread: Vec<_> = (0..40).map(|_| intruder.send(&key, &step_bytes(&lease, seq))).collect();
        assert_eq!(steps_in(&victim.step(&lease, seq).unwrap()), (seq - 1) as f32, "`busy` or stolen");
        drop(unread);
    }
    server.shutdown();
}

#[test]
fn client_cannot_lease_more_than_its_share() {
    let mut config = config(TaskConfig::Counter);
    config.server.max_envs_per_client = Some(5);
    let (server, endpoint) = start(&config);
    let mut client = RawClient::connect(&endpoint, server.sid(), "c1");
    assert_eq!(client.hello().max_envs_per_client, 5);
    assert_eq!(client.ask_lease(&client.lease_request(6)).unwrap_err().code, ErrorCode::TooManyEnvs);
    client.lease(3);
    client.secret = Secret::random();
    let error = client.ask_lease(&client.lease_request(3)).unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (ErrorCode::TooManyEnvs, "num_envs"));
    client.lease(2);
    assert_eq!(client.hello().free_envs, 59);
    server.shutdown();
}

#[test]
fn idle_lease_of_a_connected_client_is_released() {
    let mut config = config(TaskConfig::Counter);
    config.server.lease_idle_s = Some(1.0);
    let (server, endpoint) = start(&config);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(1);
    client.reset(&lease, 1).unwrap();
    let since = Instant::now();
    for seq in 2.. {
        if since.elapsed() > Duration::from_millis(1500) {
            break;
        }
        client.step(&lease, seq).expect("a lease in use is kept");
        std::thread::sleep(Duration::from_millis(20));
    }
    wait_until("the idle lease is released", || client.hello().free_envs == 64);
    assert_eq!(client.reset(&lease, 1).unwrap_err().code, ErrorCode::LeaseLost);
    server.shutdown();
}

#[test]
fn token_of_somebody_else_does_not_end_a_lease() {
    let grace_s = 0.3;
    let (server, endpoint) = start_counters(grace_s);
    let owner = RawClient::connect(&endpoint, server.sid(), "owner");
    let lease = owner.lease(1);
    // Client ids are visible, so anybody can declare and withdraw the owner's token.
    RawClient::connect(&endpoint, server.sid(), "owner").vanish();
    let since = Instant::now();
    while since.elapsed().as_secs_f64() < 4.0 * grace_s {
        assert_eq!(owner.hello().free_envs, 63, "the owner's lease expired");
    }
    owner.reset(&lease, 1).unwrap();
    server.shutdown();
}

#[test]
fn lease_of_a_lost_client_can_be_reclaimed_within_the_grace_period_only() {
    let grace_s = 1.0;
    let (server, endpoint) = start_counters(grace_s);
    let first = RawClient::connect(&endpoint, server.sid(), "first");
    let lease = first.lease(1);
    first.reset(&lease, 1).unwrap();
    let last = first.step(&lease, 2).unwrap();
    let mut second = RawClient::connect(&endpoint, server.sid(), "second");
    second.secret = first.secret;
    first.vanish();
    wait_until("the first client is disconnected", || !second.sees("first"));

    let reclaimed = second.reclaim(&lease.lease, lease.epoch).unwrap();
    assert_eq!((reclaimed.epoch, reclaimed.last_seq), (2, 2));
    assert_eq!(second.step(&reclaimed, 2).unwrap(), last, "the last reply can be requested again");
    assert_eq!(steps_in(&second.step(&reclaimed, 3).unwrap()), 2.0, "the environments continue from their state");

    let mut third = RawClient::connect(&endpoint, server.sid(), "third");
    third.secret = second.secret;
    let since = Instant::now();
    second.vanish();
    wait_until("the lease has expired", || third.hello().free_envs == 64);
    assert!(since.elapsed().as_secs_f64() >= grace_s, "the lease expired before the end of the grace period");
    assert_eq!(third.reclaim(&lease.lease, 2).unwrap_err().code, ErrorCode::LeaseLost);
    assert_eq!(third.step(&reclaimed, 4).unwrap_err().code, ErrorCode::LeaseLost);
    server.shutdown();
}

#[test]
fn repeated_reclaim_returns_the_same_reply() {
    let (server, endpoint) = start_counters(10.0);
    let first = RawClient::connect(&endpoint, server.sid(), "first");
    let lease = first.lease(1);
    let mut second = RawClient::connect(&endpoint, server.sid(), "second");
    second.secret = first.secret;
    let reclaimed = second.reclaim(&lease.lease, 1).unwrap();
    assert_eq!(second.reclaim(&lease.lease, 1).unwrap(), reclaimed);
    assert_eq!(
        first.reclaim(&lease.lease, 1).unwrap_err().code,
        ErrorCode::StaleEpoch,
        "only the new owner may repeat the request"
    );
    assert_eq!(first.reset(&lease, 1).unwrap_err().code, ErrorCode::StaleEpoch);
    second.reset(&reclaimed, 1).unwrap();
    server.shutdown();
}

#[test]
fn reclaim_with_a_wrong_epoch_has_no_effect() {
    let grace_s = 0.3;
    let (server, endpoint) = start_counters(grace_s);
    let owner = RawClient::connect(&endpoint, server.sid(), "owner");
    let lease = owner.lease(1);
    let mut intruder = RawClient::without_token(&endpoint, server.sid(), "intruder");
    intruder.secret = owner.secret;
    for epoch in [0, 2, u64::MAX] {
        assert_eq!(intruder.reclaim(&lease.lease, epoch).unwrap_err().code, ErrorCode::StaleEpoch, "epoch {epoch}");
    }
    // The owner sends nothing, as during learning between two rollouts. Its liveliness token alone keeps the lease.
    let since = Instant::now();
    while since.elapsed().as_secs_f64() < 3.0 * grace_s {
        assert_eq!(intruder.hello().free_envs, 63, "the owner's lease expired");
    }
    owner.reset(&lease, 1).unwrap();
    server.shutdown();
}

#[test]
fn lease_of_a_client_without_liveliness_token_expires() {
    let (server, endpoint) = start_counters(0.3);
    let client = RawClient::without_token(&endpoint, server.sid(), "ghost");
    let lease = client.lease(1);
    client.reset(&lease, 1).unwrap();
    wait_until("the lease has expired", || client.hello().free_envs == 64);
    assert_eq!(client.step(&lease, 2).unwrap_err().code, ErrorCode::LeaseLost);
    server.shutdown();
}

#[test]
fn server_ends_with_the_program_that_started_it_although_its_stdin_is_open() {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    // The shell is the program; its stdin, which the server inherits, stays open here as in a forked child.
    let serve = "serve --task counter --envs 1 --listen tcp/127.0.0.1:0 --until-stdin-closes";
    let commands = format!("exec 3<&0; {} {serve} <&3 & wait", program.display());
    let mut shell =
        Command::new("sh").args(["-c", &commands]).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let _stdin = shell.stdin.take();
    let mut lines = BufReader::new(shell.stdout.take().unwrap()).lines();
    assert!(lines.next().unwrap().unwrap().starts_with("listening"));
    shell.kill().unwrap();
    shell.wait().unwrap();
    let (sender, has_ended) = std::sync::mpsc::channel();
    std::thread::spawn(move || sender.send(lines.count()));
    assert!(has_ended.recv_timeout(Duration::from_secs(10)).is_ok(), "the server lives on");
}
