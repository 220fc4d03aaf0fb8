//! Clients that harm a server: they do not read, run long rollouts, send what is too large.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use twinstep_client::{ConnectOptions, Connection, RemoteVecEnv};
use twinstep_model::{ResetRequest, VecEnv};
use twinstep_policy::{BehaviourPolicy, Mlp, Normaliser};
use twinstep_protocol::message::HelloRequest;
use twinstep_protocol::{PROTOCOL, Secret, encode, keys};
use zenoh::Wait;

use super::stops::freeze;
use super::{Row, memory_mib, quantile};
use crate::process::Process;

/// Clients that stop reading at the same time.
const SILENT_CLIENTS: usize = 12;
/// Time for which they do not read.
const SILENCE: Duration = Duration::from_secs(5);

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

fn serve(program: &Path, more: &[&str]) -> Result<(Process, String), String> {
    let own = ["serve", "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes"];
    let arguments: Vec<String> = own.iter().chain(more).map(ToString::to_string).collect();
    Process::listening(program, &arguments)
}

fn client(endpoint: &str, num_envs: usize) -> Result<RemoteVecEnv, String> {
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(endpoint, num_envs)).map_err(text)?;
    env.reset(&ResetRequest::default()).map_err(text)?;
    Ok(env)
}

/// Steps while `goes_on`; returns the time of each step [ms].
fn steps(env: &mut RemoteVecEnv, goes_on: impl Fn() -> bool) -> Result<Vec<f64>, String> {
    let actions = vec![0.0; env.num_envs() * env.spec().action_len()];
    let mut times = Vec::new();
    while goes_on() {
        let start = Instant::now();
        env.step(&actions).map_err(text)?;
        times.push(1e3 * start.elapsed().as_secs_f64());
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(times)
}

fn describe(times: &mut [f64]) -> (f64, f64, String) {
    let (p50, p99, worst) = (quantile(times, 0.5), quantile(times, 0.99), quantile(times, 1.0));
    (p99, worst, format!("{} steps: median {p50:.2}, 99 % {p99:.2}, worst {worst:.1} ms", times.len()))
}

/// Clients stop reading and return for `minutes`, while another one steps.
pub fn silent_clients(program: &Path, minutes: f64) -> Result<Row, String> {
    let (server, endpoint) = serve(program, &["--task", "counter", "--envs", "200"])?;
    let mut bystander = client(&endpoint, 1)?;
    let has_ended = AtomicBool::new(false);
    let (mut samples, mut visits) = (Vec::new(), 0_usize);
    let times = std::thread::scope(|scope| {
        let stepping = scope.spawn(|| steps(&mut bystander, || !has_ended.load(Ordering::Acquire)));
        let start = Instant::now();
        let mut result = Ok(());
        while start.elapsed().as_secs_f64() < 60.0 * minutes && result.is_ok() {
            let silent: Result<Vec<_>, String> = (0..SILENT_CLIENTS).map(|_| freeze(&endpoint)).collect();
            let kept = lowest_memory(server.id(), SILENCE);
            result = silent.map(|silent| visits += silent.len());
            samples.push((visits as f64, kept));
        }
        has_ended.store(true, Ordering::Release);
        let times = stepping.join().unwrap_or_else(|_| Err("the bystander panicked".to_owned()));
        result.and(times)
    });
    let mut times = times?;
    let (p99, worst, text) = describe(&mut times);
    // The first visits fill what the allocator keeps; what it keeps of the later ones would grow without end.
    let (first_half, second_half) = samples.split_at(samples.len() / 2);
    let (first, _) = slope(first_half);
    let (slope, upper) = slope(second_half);
    Ok(Row {
        what: format!("{SILENT_CLIENTS} clients that stop reading and return, {visits} visits in {minutes} min"),
        found: format!(
            "{text}; memory in the first half {first:.0} B a client, in the second half {slope:.0} B, upper 95 % bound {upper:.0} B"
        ),
        is_met: p99 <= 20.0 && worst <= 200.0 && upper <= 200.0,
    })
}

/// Returns the lowest memory of a process within `time` [MiB]: buffers of messages that are under way come and go.
fn lowest_memory(id: u32, time: Duration) -> f64 {
    let (since, mut lowest) = (Instant::now(), f64::INFINITY);
    while since.elapsed() < time {
        lowest = lowest.min(memory_mib(id));
        std::thread::sleep(Duration::from_millis(50));
    }
    lowest
}

/// Slope of memory [B per client] by least squares, and its upper 95 % bound.
fn slope(samples: &[(f64, f64)]) -> (f64, f64) {
    let n = samples.len() as f64;
    let mean = |value: fn(&(f64, f64)) -> f64| samples.iter().map(value).sum::<f64>() / n;
    let (x, y) = (mean(|sample| sample.0), mean(|sample| sample.1));
    let sxx: f64 = samples.iter().map(|sample| (sample.0 - x).powi(2)).sum();
    let sxy: f64 = samples.iter().map(|sample| (sample.0 - x) * (sample.1 - y)).sum();
    let slope = sxy / sxx;
    let residual: f64 = samples.iter().map(|sample| (sample.1 - y - slope * (sample.0 - x)).powi(2)).sum();
    let error = (residual / (n - 2.0).max(1.0) / sxx).sqrt();
    (slope * 1_048_576.0, (slope + 2.0 * error) * 1_048_576.0)
}

/// One client runs rollouts of the largest size on all environments but one, another steps and says `hello`.
pub fn rollouts(program: &Path, seconds: f64) -> Result<Row, String> {
    let (_server, endpoint) = serve(program, &["--envs", "1025"])?;
    let mut bystander = client(&endpoint, 1)?;
    let mut runner = client(&endpoint, 1024)?;
    let sizes = [bystander.spec().obs_len(), 512, 256, 128, bystander.spec().action_len()];
    let spec = bystander.spec().clone();
    let normaliser = Normaliser::from_mean_and_std(&vec![0.0; sizes[0]], &vec![1.0; sizes[0]]);
    let policy = BehaviourPolicy::new(Mlp::zeros(&sizes), normaliser, vec![-1.0; spec.action_len()]);
    let has_ended = AtomicBool::new(false);
    let hello = Connection::open(&ConnectOptions::new(&endpoint, 1), Secret::random()).map_err(text)?;
    let (rollouts, times, hellos) = std::thread::scope(|scope| {
        let running = scope.spawn(|| {
            let (mut trajectory, mut rollouts) = (twinstep_model::Trajectory::default(), 0);
            while !has_ended.load(Ordering::Acquire) {
                let steps = runner.max_rollout_steps() as usize;
                runner.rollout(&policy, rollouts, steps, &mut trajectory).map_err(text)?;
                rollouts += 1;
            }
            Ok::<_, String>(rollouts)
        });
        let greeting = scope.spawn(|| {
            let mut times = Vec::new();
            while !has_ended.load(Ordering::Acquire) {
                let start = Instant::now();
                let request = encode(&HelloRequest { protocol: PROTOCOL, client: String::new() });
                hello.request(&keys::hello(hello.sid()), request).map_err(text)?;
                times.push(1e3 * start.elapsed().as_secs_f64());
                std::thread::sleep(Duration::from_millis(20));
            }
            Ok::<_, String>(times)
        });
        let since = Instant::now();
        let times = steps(&mut bystander, || since.elapsed().as_secs_f64() < seconds);
        has_ended.store(true, Ordering::Release);
        (running.join(), times, greeting.join())
    });
    let panicked = |_| "a client panicked".to_owned();
    let (rollouts, mut times, mut hellos) = (rollouts.map_err(panicked)??, times?, hellos.map_err(panicked)??);
    let (p99, _, text) = describe(&mut times);
    let (hello_p99, hello_worst) = (quantile(&mut hellos, 0.99), quantile(&mut hellos, 1.0));
    Ok(Row {
        what: format!("one client with {rollouts} rollouts of 128 steps of 1024 robots, in {seconds} s"),
        found: format!(
            "another client, {text}; {} hello: 99 % {hello_p99:.1}, worst {hello_worst:.1} ms",
            hellos.len()
        ),
        is_met: p99 <= 50.0 && hello_p99 <= 50.0,
    })
}

/// A client without a lease sends large attachments, parameters, keys and payloads.
pub fn oversized(program: &Path) -> Result<Row, String> {
    let (server, endpoint) = serve(program, &["--task", "counter", "--envs", "8"])?;
    let connection = Connection::open(&ConnectOptions::new(&endpoint, 1), Secret::random()).map_err(text)?;
    // One of each first: buffers that are kept are not the client's.
    let before = memory_mib(server.id());
    let large = vec![7_u8; 3 << 20];
    let mut peak = before;
    for round in 0..100 {
        let hello = keys::hello(connection.sid());
        let key = if round % 2 == 0 { hello } else { format!("twinstep/{}/nothing", connection.sid()) };
        let send =
            connection.session().get(key.as_str()).attachment(large.clone()).timeout(Duration::from_secs(2)).wait();
        send.map_err(text).map(drop)?;
        let send = connection.session().get(key.as_str()).payload(large.clone()).timeout(Duration::from_secs(2)).wait();
        send.map_err(text).map(drop)?;
        peak = peak.max(memory_mib(server.id()));
    }
    std::thread::sleep(Duration::from_secs(3));
    let after = memory_mib(server.id());
    Ok(Row {
        what: "600 MiB of attachments and payloads without a lease".to_owned(),
        found: format!(
            "the server's memory: {before:.0} MiB before, at most {peak:.0} meanwhile, {after:.0} after 3 s"
        ),
        is_met: peak - before < 32.0,
    })
}
