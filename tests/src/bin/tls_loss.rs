//! Counts the queries that TLS leaves unanswered, with and without Zenoh's `express`: one query at a time, none repeated,
//! the server in a process of its own.

use std::io::{Read, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use twinstep_client::{ConnectOptions, Connection};
use twinstep_envs::OBS_LEN;
use twinstep_model::{AutoresetMode, StepBatch};
use twinstep_protocol::keys::{self, EnvMethod};
use twinstep_protocol::{PROTOCOL, convert, decode, encode, message, tensor};
use twinstep_tests::process::Process;
use twinstep_tests::security::{Failure, SecurityFolder};
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Querier, QueryTarget};
use zenoh::{Session, Wait};

/// After this long a query counts as unanswered.
const QUERY_TIMEOUT: Duration = Duration::from_secs(2);
/// Joints in an action.
const ACTION_LEN: usize = 12;
/// Pause between the uncounted queries that find out whether a broken link stands again.
const PAUSE: Duration = Duration::from_millis(20);
/// What the echoing server answers.
const ECHO_KEY: &str = "echo";

/// Count the queries over TLS that end without a reply.
#[derive(Parser)]
struct Args {
    #[command(subcommand)]
    verb: Option<Role>,
    /// Round trips of each case.
    #[arg(long, default_value_t = 100_000, value_name = "N")]
    round_trips: usize,
    /// Environments in a message; may be given several times.
    #[arg(long, default_values_t = [64, 256, 1024], value_name = "N")]
    envs: Vec<usize>,
    /// Link protocol: tls, or tcp for comparison.
    #[arg(long, default_value = "tls")]
    protocol: String,
}

#[derive(Subcommand)]
enum Role {
    /// The other end: answers every query with a reply of a step's length until stdin closes.
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

/// How queries and replies are sent.
#[derive(Clone, Copy, PartialEq)]
enum Way {
    /// Zenoh's default: a message may wait for others.
    Batched,
    /// Queries and replies do not wait.
    Express,
    /// `twinstep serve` as it is, and the client's own queries.
    Twinstep,
}

impl Way {
    const ALL: [Way; 3] = [Way::Batched, Way::Express, Way::Twinstep];

    fn name(self) -> &'static str {
        match self {
            Way::Batched => "echo, batched",
            Way::Express => "echo, express",
            Way::Twinstep => "twinstep serve, express",
        }
    }
}

/// What became of a case's queries.
struct Tally {
    /// Queries that ended without a reply and without an error.
    empty: usize,
    /// Queries that ended with an error, Zenoh's timeout among them.
    failed: usize,
    /// Of the answered queries, in rising order.
    latency: Vec<Duration>,
}

impl Tally {
    /// Latency that `per_cent` of the answered queries stay below [us].
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
    println!("| way, {} | envs | round trips | no reply | error | p50 [us] | p99 [us] |", args.protocol);
    println!("|---|---|---|---|---|---|---|");
    for &envs in &args.envs {
        for way in Way::ALL {
            let tally = measure(&args, &folder, way, envs)?;
            println!(
                "| {} | {envs} | {} | {} | {} | {} | {} |",
                way.name(),
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

fn measure(args: &Args, folder: &SecurityFolder, way: Way, envs: usize) -> Result<Tally, Failure> {
    let server_config = folder.path("server-tls.json5").display().to_string();
    let mut arguments = vec!["--zenoh".to_owned(), server_config];
    arguments.extend(["--listen".to_owned(), format!("{}/127.0.0.1:0", args.protocol)]);
    arguments.extend(["--envs".to_owned(), envs.to_string()]);
    let own = std::env::current_exe()?;
    if way == Way::Twinstep {
        arguments.splice(0..0, ["serve", "--task", "counter", "--until-stdin-closes"].map(str::to_owned));
        let (_server, endpoint) = Process::listening(&own.with_file_name("twinstep"), &arguments)?;
        ask_twinstep(args.round_trips, folder, &endpoint, envs)
    } else {
        arguments.insert(0, "echo".to_owned());
        if way != Way::Batched {
            arguments.push("--express".to_owned());
        }
        let (_server, endpoint) = Process::listening(&own, &arguments)?;
        ask_echo(args.round_trips, folder, &endpoint, way, envs)
    }
}

fn ask_echo(
    round_trips: usize,
    folder: &SecurityFolder,
    endpoint: &str,
    way: Way,
    envs: usize,
) -> Result<Tally, Failure> {
    let mut config = zenoh::Config::from_file(folder.path("client-tls.json5"))?;
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]"))?;
    let session = twinstep_session::open(config)?;
    let querier = session
        .declare_querier(ECHO_KEY)
        .target(QueryTarget::BestMatching)
        .consolidation(ConsolidationMode::None)
        .congestion_control(CongestionControl::Block)
        .express(way != Way::Batched)
        .timeout(QUERY_TIMEOUT)
        .wait()?;
    let actions = vec![0.1f32; envs * ACTION_LEN];
    let actions = tensor::as_bytes(&actions);
    let request = encode(&message::StepRequest { protocol: PROTOCOL, epoch: 1, seq: 1, actions });
    ask(&querier, round_trips, way, envs, |_| request.clone())
}

/// Steps a lease of `twinstep serve` without the client's repeats: a lost step's number is sent again as the next query.
fn ask_twinstep(round_trips: usize, folder: &SecurityFolder, endpoint: &str, envs: usize) -> Result<Tally, Failure> {
    let options =
        ConnectOptions { zenoh: Some(folder.path("client-tls.json5")), ..ConnectOptions::new(endpoint, envs) };
    let link = Connection::open(&options)?;
    let lease = message::LeaseRequest {
        protocol: PROTOCOL,
        client: link.client().to_owned(),
        num_envs: envs as u64,
        autoreset: AutoresetMode::NextStep,
        max_episode_steps: None,
        spec_hash: None,
        reclaim: None,
    };
    let granted = link.request(&link.querier(keys::lease(link.sid()))?, encode(&lease))?;
    let granted: message::LeaseReply = decode(&granted.to_bytes())?;
    let querier = |verb| link.querier(keys::env(link.sid(), &granted.lease, verb));
    let epoch = granted.epoch;
    let reset = message::ResetRequest { protocol: PROTOCOL, epoch, seq: 1, seeds: None, mask: None };
    link.request(&querier(EnvMethod::Reset)?, encode(&reset))?;
    let actions = vec![0.1f32; envs * ACTION_LEN];
    let actions = tensor::as_bytes(&actions);
    ask(&querier(EnvMethod::Step)?, round_trips, Way::Twinstep, envs, |answered| {
        encode(&message::StepRequest { protocol: PROTOCOL, epoch, seq: 2 + answered as u64, actions })
    })
}

/// Sends one query after the other; `request` is told how many were answered. After an unanswered one it waits until the
/// link stands again, so that a broken link counts once.
fn ask(
    querier: &Querier<'_>,
    round_trips: usize,
    way: Way,
    envs: usize,
    request: impl Fn(usize) -> Vec<u8>,
) -> Result<Tally, Failure> {
    let template = "{msg} {wide_bar} {pos}/{len} {eta}";
    let bar = ProgressBar::new(round_trips as u64).with_style(ProgressStyle::with_template(template)?);
    bar.set_message(format!("{}, {envs} envs", way.name()));
    let mut tally = Tally { empty: 0, failed: 0, latency: Vec::with_capacity(round_trips) };
    let mut answered = 0;
    for round_trip in 0..round_trips {
        let since = Instant::now();
        let outcome = once(querier, request(answered))?;
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
            let case = format!("{}, {envs} envs, query {round_trip}", way.name());
            bar.suspend(|| eprintln!("{case}: {outcome:?} after {} us", waited.as_micros()));
            while once(querier, request(answered))? != Outcome::Answer {
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
    /// Zero replies and no error.
    Empty,
    Error(String),
}

fn once(querier: &Querier<'_>, request: Vec<u8>) -> Result<Outcome, Failure> {
    let replies = querier.get().payload(request).wait()?;
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
    let reply = ZBytes::from(convert::encode_step(&StepBatch::new(envs, OBS_LEN), 1));
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
