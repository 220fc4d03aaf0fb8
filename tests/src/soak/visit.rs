//! One client of the soak test, from its connection to its end.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use rand::RngExt;
use twinstep_client::{ConnectOptions, Connection, LeaseHandle, RemoteVecEnv, Secret};
use twinstep_model::{ResetRequest, Stream, VecEnv};
use twinstep_protocol::message::HelloRequest;
use twinstep_protocol::{PROTOCOL, encode, keys};

use crate::process::Process;
use crate::proxy::Proxy;

/// Maximum time for a client process to lease and step, and for requests.
const TIMEOUT: Duration = Duration::from_mins(1);
/// Number of `hello` requests of a client that does not read the replies.
const UNREAD_REPLIES: usize = 300;

/// End of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum Fate {
    /// It closes its lease.
    Closes,
    /// It disconnects with a step in progress and does not close its lease.
    Disconnects,
    /// Its session ends. Another client reclaims the lease with id and secret, steps, and closes it.
    Returns,
    /// Its process is killed while it steps.
    Killed,
    /// Its process is killed. Another client reclaims the lease, steps, and closes it.
    KilledAndReturns,
    /// Its connection is cut, and it does not come back.
    Cut,
    /// Its connection is cut. It connects again, steps under the same lease, and closes it.
    CutAndReturns,
    /// It stops reading while the server sends replies, and never reads again: its connection is cut.
    Frozen,
    /// It stops reading, continues after a pause, steps, and closes its lease.
    FrozenAndReturns,
}

impl Fate {
    /// All fates.
    pub const ALL: [Fate; 9] = [
        Fate::Closes,
        Fate::Disconnects,
        Fate::Returns,
        Fate::Killed,
        Fate::KilledAndReturns,
        Fate::Cut,
        Fate::CutAndReturns,
        Fate::Frozen,
        Fate::FrozenAndReturns,
    ];

    /// Returns the name, as in `--only`.
    pub fn name(self) -> &'static str {
        match self {
            Fate::Closes => "closes",
            Fate::Disconnects => "disconnects",
            Fate::Returns => "returns",
            Fate::Killed => "killed",
            Fate::KilledAndReturns => "killed-and-returns",
            Fate::Cut => "cut",
            Fate::CutAndReturns => "cut-and-returns",
            Fate::Frozen => "frozen",
            Fate::FrozenAndReturns => "frozen-and-returns",
        }
    }

    /// Returns the description used in tables.
    pub fn description(self) -> &'static str {
        match self {
            Fate::Closes => "closes its lease",
            Fate::Disconnects => "disconnects during a step, without close",
            Fate::Returns => "disconnects; the lease is reclaimed",
            Fate::Killed => "process killed",
            Fate::KilledAndReturns => "process killed; the lease is reclaimed",
            Fate::Cut => "connection cut",
            Fate::CutAndReturns => "connection cut; connects again",
            Fate::Frozen => "stops reading, then connection cut",
            Fate::FrozenAndReturns => "stops reading, then continues",
        }
    }
}

/// What every client needs.
#[derive(Clone, Debug)]
pub struct Visitor {
    /// Endpoint of the server.
    pub endpoint: String,
    /// Program with the role `client`, see [`run_client`].
    pub program: PathBuf,
    /// Longest pause of a client that stops reading.
    pub max_pause: Duration,
}

impl Visitor {
    /// Runs one client. The error is the evidence that the server did not do what it must.
    pub fn visit(&self, fate: Fate, random: &mut Stream) -> Result<(), String> {
        let num_envs = random.random_range(1..=8);
        match fate {
            Fate::Closes => close(connected(&self.endpoint, num_envs, random)?),
            Fate::Disconnects => {
                let mut env = connected(&self.endpoint, num_envs, random)?;
                env.send(&actions(&env, random)).map_err(text)
            }
            Fate::Returns => {
                let env = connected(&self.endpoint, num_envs, random)?;
                let lease = env.ticket().clone();
                drop(env);
                self.reclaim(&lease, random)
            }
            Fate::Killed => self.kill(num_envs, random).map(drop),
            Fate::KilledAndReturns => {
                let lease = self.kill(num_envs, random)?;
                self.reclaim(&lease, random)
            }
            Fate::Cut | Fate::CutAndReturns => {
                let proxy = Proxy::start(&self.endpoint)?;
                let mut env = connected(&proxy.endpoint, num_envs, random)?;
                proxy.cut();
                if fate == Fate::Cut {
                    drop(proxy);
                    return Ok(());
                }
                step(&mut env, random)?;
                close(env)
            }
            Fate::Frozen | Fate::FrozenAndReturns => self.freeze(fate == Fate::FrozenAndReturns, num_envs, random),
        }
    }

    fn reclaim(&self, lease: &LeaseHandle, random: &mut Stream) -> Result<(), String> {
        let mut env = RemoteVecEnv::reclaim(&options(&self.endpoint, 1), lease).map_err(text)?;
        step(&mut env, random)?;
        close(env)
    }

    /// Starts a client process and kills it while it steps. Returns its lease.
    fn kill(&self, num_envs: usize, random: &mut Stream) -> Result<LeaseHandle, String> {
        let arguments = ["client".to_owned(), self.endpoint.clone(), num_envs.to_string()];
        let mut client = Process::start(&self.program, &arguments)?;
        let line = client.line(TIMEOUT).ok_or("a client process did not lease")?;
        std::thread::sleep(Duration::from_millis(random.random_range(0..100)));
        client.kill();
        parse_lease(&line).ok_or_else(|| format!("a client process wrote `{line}`"))
    }

    fn freeze(&self, returns: bool, num_envs: usize, random: &mut Stream) -> Result<(), String> {
        let proxy = Proxy::start(&self.endpoint)?;
        let mut env = connected(&proxy.endpoint, num_envs, random)?;
        let options = options(&proxy.endpoint, num_envs);
        let connection = Connection::open(&options, Secret::random()).map_err(text)?;
        let key = keys::hello(connection.sid());
        let pause = self.max_pause.mul_f64(random.random_range(0.1..1.0));
        proxy.hold_replies(pause);
        env.send(&actions(&env, random)).map_err(text)?;
        let hello = encode(&HelloRequest { protocol: PROTOCOL, client: "soak".to_owned() });
        let requests = (0..UNREAD_REPLIES).map(|_| connection.send(&key, hello.clone()));
        let unread = requests.collect::<Result<Vec<_>, _>>().map_err(text)?;
        std::thread::sleep(pause);
        drop(unread);
        if !returns {
            proxy.cut();
            return Ok(());
        }
        let since = Instant::now();
        let waited = |error| format!("{:.1} s after a pause of {pause:?}: {error}", since.elapsed().as_secs_f64());
        env.recv().map_err(|error| waited(text(error)))?;
        step(&mut env, random)?;
        close(env)
    }
}

/// Connects, resets and steps.
fn connected(endpoint: &str, num_envs: usize, random: &mut Stream) -> Result<RemoteVecEnv, String> {
    let mut env = RemoteVecEnv::connect(&options(endpoint, num_envs)).map_err(text)?;
    env.reset(&ResetRequest::seeded(random.random(), num_envs)).map_err(text)?;
    for _ in 0..random.random_range(1..10) {
        step(&mut env, random)?;
    }
    Ok(env)
}

fn options(endpoint: &str, num_envs: usize) -> ConnectOptions {
    ConnectOptions { connect_timeout: TIMEOUT, timeout: TIMEOUT, ..ConnectOptions::new(endpoint, num_envs) }
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string().replace('\n', " ")
}

fn actions(env: &RemoteVecEnv, random: &mut Stream) -> Vec<f32> {
    (0..env.num_envs() * env.spec().action_len()).map(|_| random.random_range(-1.0..=1.0)).collect()
}

fn step(env: &mut RemoteVecEnv, random: &mut Stream) -> Result<(), String> {
    let actions = actions(env, random);
    let batch = env.step(&actions).map_err(text)?;
    if batch.obs.iter().all(|number| number.is_finite()) {
        Ok(())
    } else {
        Err("an observation is not finite".to_owned())
    }
}

fn close(env: RemoteVecEnv) -> Result<(), String> {
    env.close().map_err(text)
}

/// Runs a client process: leases, prints `lease ID EPOCH SECRET`, and steps until it is killed.
pub fn run_client(endpoint: &str, num_envs: usize) -> Result<(), String> {
    let mut env = RemoteVecEnv::connect(&options(endpoint, num_envs)).map_err(text)?;
    env.reset(&ResetRequest::seeded(0, num_envs)).map_err(text)?;
    let LeaseHandle { lease, epoch, secret } = env.ticket();
    println!("lease {lease} {epoch} {}", secret.reveal());
    let actions = vec![0.1; num_envs * env.spec().action_len()];
    loop {
        env.step(&actions).map_err(text)?;
    }
}

fn parse_lease(line: &str) -> Option<LeaseHandle> {
    let mut words = line.strip_prefix("lease ")?.split(' ');
    let (lease, epoch, secret) = (words.next()?.to_owned(), words.next()?.parse().ok()?, words.next()?.parse().ok()?);
    Some(LeaseHandle { lease, epoch, secret })
}
