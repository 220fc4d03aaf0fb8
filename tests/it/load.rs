//! Clients that load a server: one that reads no replies, and one with hundreds of leases.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{scope, sleep};
use std::time::{Duration, Instant};

use twinstep_protocol::message::{HelloRequest, LeaseReply};
use twinstep_protocol::{PROTOCOL, Secret, encode, keys};
use twinstep_tests::process::Process;
use twinstep_tests::proxy::Proxy;
use twinstep_tests::python::Programs;

use crate::raw_client::RawClient;

const LEASES: usize = 200;
/// Threads of a server with many leases: Zenoh's, those that answer requests, and one pool for the simulation.
const MAX_THREADS: usize = 100;
/// More than Zenoh has threads.
const SILENT_CLIENTS: usize = 8;
const UNREAD_REQUESTS: usize = 1500;
const UNDISTURBED: Duration = Duration::from_secs(2);
/// Time for which the silent client reads nothing.
const SILENCE: Duration = Duration::from_hours(1);
/// Longer than Zenoh waits for a client that does not read.
const AFTERWARDS: Duration = Duration::from_secs(7);
/// A server whose threads wait for the silent client answers nobody for seconds.
const LONGEST_STEP: Duration = Duration::from_secs(1);

#[test]
fn clients_that_read_no_replies_do_not_delay_the_steps_of_others() {
    let (_server, endpoint) = serve(&["--task", "counter"]);
    let bystander = RawClient::connect_to_only_server(&endpoint, "bystander");
    let lease = bystander.lease(1);
    bystander.reset(&lease, 1).unwrap();
    let mut next_seq = 2;
    let since = Instant::now();
    let undisturbed = durations_of_steps(&bystander, &lease, &mut next_seq, || since.elapsed() < UNDISTURBED);

    let silent = || {
        let proxy = Proxy::start(&endpoint).unwrap();
        let mut client = RawClient::connect_to_only_server(&proxy.endpoint, "silent");
        client.query_timeout = Duration::from_secs(20);
        client.hello();
        proxy.hold_replies(SILENCE);
        (proxy, client)
    };
    let silent: Vec<_> = (0..SILENT_CLIENTS).map(|_| silent()).collect();
    let is_finished = AtomicBool::new(false);
    let disturbed = scope(|scope| {
        let steps = scope
            .spawn(|| durations_of_steps(&bystander, &lease, &mut next_seq, || !is_finished.load(Ordering::Relaxed)));
        let request = encode(&HelloRequest { protocol: PROTOCOL, client: String::new() });
        // Most are answered, some are refused.
        let keys = [keys::hello(&bystander.sid), format!("twinstep/{}/nothing", bystander.sid)];
        let unread: Vec<_> = (0..UNREAD_REQUESTS * SILENT_CLIENTS)
            .map(|index| silent[index % SILENT_CLIENTS].1.send(&keys[usize::from(index % 10 == 9)], &request))
            .collect();
        sleep(AFTERWARDS);
        is_finished.store(true, Ordering::Relaxed);
        drop(unread);
        steps.join().unwrap()
    });
    let p99 = |durations: &[Duration]| durations[durations.len() * 99 / 100];
    // On a machine that is busy with other work, steps are slow without the silent client too.
    let limit = Duration::from_millis(50).max(5 * p99(&undisturbed));
    assert!(p99(&disturbed) < limit, "99th percentile: {:?}, before {:?}", p99(&disturbed), p99(&undisturbed));
    let longest = disturbed[disturbed.len() - 1];
    assert!(longest < LONGEST_STEP, "longest step: {longest:?}");
    bystander.hello();
    drop(silent);
}

/// Starts `twinstep serve`. Returns the process and its endpoint.
fn serve(arguments: &[&str]) -> (Process, String) {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    let all = [&["serve", "--listen", "tcp/127.0.0.1:0", "--envs", "200"], arguments].concat();
    let all: Vec<String> = all.into_iter().map(str::to_owned).collect();
    Process::listening(&programs.twinstep(), &all).unwrap()
}

/// Steps while `goes_on` and returns the durations of the steps, the longest last.
fn durations_of_steps(
    client: &RawClient,
    lease: &LeaseReply,
    next_seq: &mut u64,
    goes_on: impl Fn() -> bool,
) -> Vec<Duration> {
    let mut durations = Vec::new();
    while goes_on() {
        let since = Instant::now();
        client.step(lease, *next_seq).unwrap();
        durations.push(since.elapsed());
        *next_seq += 1;
        sleep(Duration::from_millis(1));
    }
    durations.sort();
    durations
}

#[test]
#[cfg(target_os = "linux")]
fn hundreds_of_leases_share_the_threads_of_the_server() {
    let (server, endpoint) = serve(&["--task", "walk"]);
    let mut client = RawClient::connect_to_only_server(&endpoint, "many");
    let leases: Vec<(Secret, LeaseReply)> = (0..LEASES)
        .map(|_| {
            client.secret = Secret::random();
            (client.secret, client.lease(1))
        })
        .collect();
    for (secret, lease) in &leases {
        client.secret = *secret;
        client.reset(lease, 1).unwrap();
        client.step(lease, 2).unwrap();
    }
    let threads = std::fs::read_dir(Path::new("/proc").join(server.id().to_string()).join("task")).unwrap().count();
    assert!(threads <= MAX_THREADS, "{threads} threads for {LEASES} leases");
    assert_eq!(client.hello().free_envs, 0);
}
