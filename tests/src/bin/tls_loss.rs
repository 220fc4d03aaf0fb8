//! Counts queries over TLS that end without a reply, with and without Zenoh's `express`.
//!
//! One query is sent at a time and none is repeated. The server is a process of its own.

use std::io::{Read, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_client::{ConnectOptions, Connection, Secret};
use twinstep_envs::base_spec;
use twinstep_model::{AutoresetMode, StepBatch, go2};
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::{PROTOCOL, convert, decode, encode, message, tensor};
use twinstep_tests::process::Process;
use twinstep_tests::security::{Failure, SecurityFolder};
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Querier, QueryTarget};
use zenoh::{Session, Wait};

/// Time after which a query counts as unanswered.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);
/// Joints in an action.
const ACTION_LEN: usize = 12;
/// Pause between the uncounted queries that check whether a broken link is up again.
const PAUSE: Duration = Duration::from_millis(20);
/// Key expression of the echo server.
const ECHO_KEY: &str = "echo";

/// Count the queries over TLS that end without a reply.
#[derive(Parser)]
struct Args {
    #[command(subcommand)]
    verb: Option<Role>,
    /// Number of round trips of each case.
    #[arg(long, default_value_t = 100_000, value_name = "N")]
    round_trips: usize,
    /// Number of environments in a message. May be given several times.
    #[arg(long, default_values_t = [64, 256, 1024], value_name = "N")]
    envs: Vec<usize>,
    /// Link protocol: tls, or tcp for comparison.
    #[arg(long, default_value = "tls")]
    protocol: String,
}

#[derive(Subcommand)]
enum Role {
    /// Echo server: replies to every query with as many bytes as a step reply until stdin closes.
    #[command(hide = true)]
    Echo {
        #[arg(long)]
        zenoh: PathBuf,
        #[arg(long)]
        listen: String,
        #[arg(long)]
        envs: usize,
        #[arg(long)]
        express: bool,
    },
}

/// Server and transport setting of a case.
#[derive(Clone, Copy, PartialEq)]
enum Case {
    /// Zenoh's default: a message may wait to be batched with others.
    Batched,
    /// Queries and replies are sent immediately.
    Express,
    /// `twinstep serve` unchanged, with the client's own queries.
    Twinstep,
}

impl Case {
    const ALL: [Case; 3] = [Case::Batched, Case::Express, Case::Twinstep];

    fn name(self) -> &'static str {
        match self {
            Case::Batched => "echo, batched",
            Case::Express => "echo, express",
            Case::Twinstep => "twinstep serve, express",
        }
    }
}

/// Result of the queries of a case.
struct Tally {
    /// Number of queries that ended without a reply and without an error.
    empty: usize,
    /// Number of queries that ended with an error, including Zenoh's timeout.
    failed: usize,
    /// Latency of the answered queries, in ascending order.
    latency: Vec<Duration>,
}

impl Tally {
    /// Returns a percentile of the latency of the answered queries [us].
    fn percentile(&self, per_cent: usize) -> u128 {
        let rank = self.latency.len().saturating_sub(1) * per_cent / 100;
        self.latency.get(rank).map_or(0, Duration::as_micros)
    }
}

fn main() -> Result<(), Failure> {
    let args = Args::parse();
    if let Some(Role::Echo { zenoh, listen, envs, express }) = &args.verb {
        return echo(zenoh, listen, *envs, *express);
    }
    zenoh::try_init_log_from_env();
    let folder = SecurityFolder::new()?;
    println!("| case, {} | envs | round trips | no reply | error | p50 [us] | p99 [us] |", args.protocol);
    println!("|---|---|---|---|---|---|---|");
    for &envs in &args.envs {
        for case in Case::ALL {
            let tally = measure(&args, &folder, case, envs)?;
            println!(
                "| {} | {envs} | {} | {} | {} | {} | {} |",
                case.name(),
                args.round_trips,
                tally.empty,
                tally.failed,
                tally.percentile(50),
                tally.percentile(99)
            );
        }
    }
    Ok(())
}

fn measure(args: &Args, folder: &SecurityFolder, case: Case, envs: usize) -> Result<Tally, Failure> {
    let server_config = folder.path("server-tls.json5").display().to_string();
    let mut arguments = vec!["--zenoh".to_owned(), server_config];
    arguments.extend(["--listen".to_owned(), format!("{}/127.0.0.1:0", args.protocol)]);
    arguments.extend(["--envs".to_owned(), envs.to_string()]);
    let own = std::env::current_exe()?;
    if case == Case::Twinstep {
        arguments.splice(0..0, ["serve", "--task", "counter", "--until-stdin-closes"].map(str::to_owned));
        let (_server, endpoint) = Process::listening(&own.with_file_name("twinstep"), &arguments)?;
        query_twinstep(args.round_trips, folder, &endpoint, envs)
    } else {
        arguments.insert(0, "echo".to_owned());
        if case != Case::Batched {
            arguments.push("--express".to_owned());
        }
        let (_server, endpoint) = Process::listening(&own, &arguments)?;
        query_echo(args.round_trips, folder, &endpoint, case, envs)
    }
}

fn query_echo(
    round_trips: usize,
    folder: &SecurityFolder,
    endpoint: &str,
    case: Case,
    envs: usize,
) -> Result<Tally, Failure> {
    let mut config = zenoh::Config::from_file(folder.path("client-tls.json5"))?;
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]"))?;
    let session = twinstep_session::open(config)?;
    let querier = declare_querier(&session, ECHO_KEY, case != Case::Batched)?;
    let actions = vec![0.1f32; envs * ACTION_LEN];
    let actions = tensor::as_bytes(&actions);
    let request = encode(&message::StepRequest {
        protocol: PROTOCOL,
        epoch: 1,
        seq: 1,
        actions,
        command: None,
        gait_command: None,
        for_tick: None,
    });
    run_queries(&querier, Secret::random(), round_trips, case, envs, |_| request.clone())
}

/// Steps a lease of `twinstep serve` without the client's repeats.
///
/// After a lost step, the next query has the same sequence number.
fn query_twinstep(round_trips: usize, folder: &SecurityFolder, endpoint: &str, envs: usize) -> Result<Tally, Failure> {
    let options =
        ConnectOptions { zenoh: Some(folder.path("client-tls.json5")), ..ConnectOptions::new(endpoint, envs) };
    let link = Connection::open(&options, Secret::random())?;
    let lease = message::LeaseRequest {
        protocol: PROTOCOL,
        client: link.client().to_owned(),
        num_envs: envs as u64,
        autoreset: AutoresetMode::NextStep,
        max_episode_steps: None,
        critic: false,
        spec_hash: None,
        reclaim: None,
    };
    let granted = link.request(&keys::lease(link.sid()), encode(&lease))?;
    let granted: message::LeaseReply = decode(&granted.to_bytes())?;
    let key = |method| keys::env(link.sid(), &granted.lease, method);
    let epoch = granted.epoch;
    let reset = message::ResetRequest { protocol: PROTOCOL, epoch, seq: 1, seeds: None, mask: None };
    link.request(&key(EnvMethod::Reset), encode(&reset))?;
    let actions = vec![0.1f32; envs * ACTION_LEN];
    let actions = tensor::as_bytes(&actions);
    let querier = declare_querier(link.session(), &key(EnvMethod::Step), true)?;
    run_queries(&querier, link.secret(), round_trips, Case::Twinstep, envs, |answered| {
        encode(&message::StepRequest {
            protocol: PROTOCOL,
            epoch,
            seq: 2 + answered as u64,
            actions,
            command: None,
            gait_command: None,
            for_tick: None,
        })
    })
}

fn declare_querier(session: &Session, key: &str, express: bool) -> Result<Querier<'static>, Failure> {
    let querier = session
        .declare_querier(key.to_owned())
        .target(QueryTarget::BestMatching)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Block)
        .express(express)
        .timeout(QUERY_TIMEOUT);
    querier.wait()
}

/// Sends queries one after another and counts those without a reply.
///
/// `request` receives the number of queries answered so far. After an unanswered query it waits until the link is up
/// again, so that a broken link counts once.
fn run_queries(
    querier: &Querier<'_>,
    secret: Secret,
    round_trips: usize,
    case: Case,
    envs: usize,
    request: impl Fn(usize) -> Vec<u8>,
) -> Result<Tally, Failure> {
    let template = "{msg} {wide_bar} {pos}/{len} {eta}";
    let bar = ProgressBar::new(round_trips as u64).with_style(ProgressStyle::with_template(template)?);
    bar.set_message(format!("{}, {envs} envs", case.name()));
    let mut tally = Tally { empty: 0, failed: 0, latency: Vec::with_capacity(round_trips) };
    let mut answered = 0;
    for round_trip in 0..round_trips {
        let since = Instant::now();
        let outcome = once(querier, secret, request(answered))?;
        let waited = since.elapsed();
        match &outcome {
            Outcome::Answer => {
                answered += 1;
                tally.latency.push(waited);
            }
            Outcome::Empty => tally.empty += 1,
            Outcome::Error(_) => tally.failed += 1,
        }
        if outcome != Outcome::Answer {
            let query = format!("{}, {envs} envs, query {round_trip}", case.name());
            bar.suspend(|| eprintln!("{query}: {outcome:?} after {} us", waited.as_micros()));
            while once(querier, secret, request(answered))? != Outcome::Answer {
                std::thread::sleep(PAUSE);
            }
            answered += 1;
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    tally.latency.sort();
    Ok(tally)
}

#[derive(Debug, PartialEq)]
enum Outcome {
    Answer,
    /// No reply and no error.
    Empty,
    Error(String),
}

fn once(querier: &Querier<'_>, secret: Secret, request: Vec<u8>) -> Result<Outcome, Failure> {
    let replies = querier.get().payload(request).attachment(secret.as_bytes()).wait()?;
    Ok(match replies.recv().map(zenoh::query::Reply::into_result) {
        Ok(Ok(_)) => Outcome::Answer,
        Ok(Err(error)) => Outcome::Error(String::from_utf8_lossy(&error.payload().to_bytes()).into_owned()),
        Err(_) => Outcome::Empty,
    })
}

fn echo(config: &std::path::Path, listen: &str, envs: usize, express: bool) -> Result<(), Failure> {
    let mut zenoh = zenoh::Config::from_file(config)?;
    zenoh.insert_json5("mode", "\"peer\"")?;
    zenoh.insert_json5("scouting/multicast/enabled", "false")?;
    zenoh.insert_json5("listen/endpoints", &format!("[\"{listen}\"]"))?;
    let session: Session = twinstep_session::open(zenoh)?;
    let queries = session.declare_queryable(ECHO_KEY).complete(true).wait()?;
    let spec = base_spec("walk", &go2(), Vec::new(), 20.0);
    let reply = ZBytes::from(convert::encode_step(&StepBatch::new(envs, &spec), 1, false));
    let endpoint = session.info().locators().wait().first().map(ToString::to_string).unwrap_or_default();
    println!("listening {endpoint}");
    std::io::stdout().flush()?;
    std::thread::spawn(move || {
        while let Ok(query) = queries.recv() {
            if let Err(error) = query.reply(query.key_expr(), reply.clone()).express(express).wait() {
                eprintln!("reply not sent: {error}");
            }
        }
    });
    while matches!(std::io::stdin().read(&mut [0; 64]), Ok(1..)) {}
    Ok(())
}
