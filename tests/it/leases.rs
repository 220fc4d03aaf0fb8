//! Who holds a lease, for how long, and who takes it over.

use std::time::{Duration, Instant};

use twinstep_env_server::Server;
use twinstep_envs::TaskName;
use twinstep_protocol::ErrorCode;
use twinstep_protocol::message::LeaseRequest;

use crate::raw_client::{RawClient, steps_in};
use crate::remote::{config, start};

/// How long a test waits for what must happen: far longer than it takes.
const PATIENCE: Duration = Duration::from_secs(20);

fn start_counters(lease_grace_s: f64) -> (Server, String) {
    let mut config = config(TaskName::Counter);
    config.server.lease_grace_s = lease_grace_s;
    start(&config)
}

/// Asks again and again until `condition` holds.
fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    let since = Instant::now();
    while !condition() {
        assert!(since.elapsed() < PATIENCE, "{what}: not after {PATIENCE:?}");
    }
}

#[test]
fn numbers_of_environments_that_cannot_be_are_refused() {
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
fn clients_without_a_proper_id_are_refused() {
    let (server, endpoint) = start_counters(10.0);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    for id in [String::new(), "a/b".to_owned(), "*".to_owned(), "é".to_owned(), "c".repeat(65)] {
        let error = client.ask_lease(&LeaseRequest { client: id, ..client.lease_request(1) }).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (ErrorCode::OutOfRange, "client"));
    }
    server.shutdown();
}

#[test]
fn lease_asked_again_is_the_same_lease() {
    let (server, endpoint) = start_counters(10.0);
    let client = RawClient::connect(&endpoint, server.sid(), "c1");
    let lease = client.lease(3);
    assert_eq!(client.lease(3), lease);
    assert_eq!(client.ask_lease(&client.lease_request(4)).unwrap_err().code, ErrorCode::OutOfRange);
    assert_eq!(client.hello().free_envs, 61);
    server.shutdown();
}

#[test]
fn lost_client_is_followed_within_the_grace_and_forgotten_after_it() {
    let grace_s = 1.0;
    let (server, endpoint) = start_counters(grace_s);
    let first = RawClient::connect(&endpoint, server.sid(), "first");
    let lease = first.lease(1);
    first.reset(&lease, 1).unwrap();
    let last = first.step(&lease, 2).unwrap();
    let second = RawClient::connect(&endpoint, server.sid(), "second");
    first.vanish();
    wait_until("the first client is gone", || !second.sees("first"));

    let taken = second.reclaim(&lease.lease, lease.epoch).unwrap();
    assert_eq!((taken.epoch, taken.last_seq), (2, 2));
    assert_eq!(second.step(&taken, 2).unwrap(), last, "the last answer again, in case it was lost");
    assert_eq!(steps_in(&second.step(&taken, 3).unwrap()), 2.0, "it goes on where the first client was");

    let third = RawClient::connect(&endpoint, server.sid(), "third");
    let since = Instant::now();
    second.vanish();
    wait_until("the lease is freed", || third.hello().free_envs == 64);
    assert!(since.elapsed().as_secs_f64() >= grace_s, "freed before the grace had passed");
    assert_eq!(third.reclaim(&lease.lease, 2).unwrap_err().code, ErrorCode::LeaseLost);
    assert_eq!(third.step(&taken, 4).unwrap_err().code, ErrorCode::LeaseLost);
    server.shutdown();
}

#[test]
fn reclaim_sent_again_gets_its_answer_again() {
    let (server, endpoint) = start_counters(10.0);
    let first = RawClient::connect(&endpoint, server.sid(), "first");
    let lease = first.lease(1);
    let second = RawClient::connect(&endpoint, server.sid(), "second");
    let taken = second.reclaim(&lease.lease, 1).unwrap();
    assert_eq!(second.reclaim(&lease.lease, 1).unwrap(), taken);
    assert_eq!(
        first.reclaim(&lease.lease, 1).unwrap_err().code,
        ErrorCode::StaleEpoch,
        "only its new owner repeats it"
    );
    assert_eq!(first.reset(&lease, 1).unwrap_err().code, ErrorCode::StaleEpoch);
    second.reset(&taken, 1).unwrap();
    server.shutdown();
}

#[test]
fn reclaim_under_a_wrong_epoch_takes_nothing() {
    let grace_s = 0.3;
    let (server, endpoint) = start_counters(grace_s);
    let owner = RawClient::connect(&endpoint, server.sid(), "owner");
    let lease = owner.lease(1);
    let intruder = RawClient::without_token(&endpoint, server.sid(), "intruder");
    for epoch in [0, 2, u64::MAX] {
        assert_eq!(intruder.reclaim(&lease.lease, epoch).unwrap_err().code, ErrorCode::StaleEpoch, "epoch {epoch}");
    }
    // The owner is silent, as one that learns between two rollouts is: its token alone keeps the lease.
    let since = Instant::now();
    while since.elapsed().as_secs_f64() < 3.0 * grace_s {
        assert_eq!(intruder.hello().free_envs, 63, "the owner's lease was freed");
    }
    owner.reset(&lease, 1).unwrap();
    server.shutdown();
}

#[test]
fn client_that_never_shows_a_token_loses_its_lease_to_silence() {
    let (server, endpoint) = start_counters(0.3);
    let client = RawClient::without_token(&endpoint, server.sid(), "ghost");
    let lease = client.lease(1);
    client.reset(&lease, 1).unwrap();
    wait_until("the lease is freed", || client.hello().free_envs == 64);
    assert_eq!(client.step(&lease, 2).unwrap_err().code, ErrorCode::LeaseLost);
    server.shutdown();
}
