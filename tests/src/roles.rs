//! Roles of the processes of a test bed: server, client and router.

use std::io::Read;
use std::sync::Arc;
use std::time::Duration;

use twinstep_client::{ClientError, ConnectOptions, LeaseHandle, RemoteVecEnv};
use twinstep_env_server::{EnvFactory, EnvFactoryError, Server, ServerConfig};
use twinstep_envs::{Counter, CounterEnv};
use twinstep_model::{AutoresetMode, EnvError, EnvSpec, ResetRequest, StepBatch, VecEnv, go2};

use crate::step_oracle::{NUM_ENVS, StepOracle};

/// Role of one process of a test bed.
#[derive(clap::Subcommand, Clone, Debug)]
pub enum Role {
    /// A server whose steps take time, so that a fault can occur during a step.
    Server(ServerArgs),
    /// A client that steps counters and checks every observation.
    Client(ClientArgs),
    /// A Zenoh session in router mode.
    Router {
        /// Endpoint on which it listens.
        listen: String,
    },
}

/// Arguments of [`Role::Server`].
#[derive(clap::Args, Clone, Debug)]
pub struct ServerArgs {
    /// Endpoint on which it listens.
    pub listen: String,
    /// Endpoint of the router to which it connects.
    #[arg(long)]
    pub connect: Option<String>,
    /// Number of environments.
    #[arg(long, default_value_t = 64)]
    pub envs: usize,
    /// Duration of a step [ms].
    #[arg(long, default_value_t = 4)]
    pub step_ms: u64,
    /// Executes every N-th step twice: the fault that the checks must detect.
    #[arg(long)]
    pub duplicate_step_every: Option<u32>,
}

/// Arguments of [`Role::Client`].
#[derive(clap::Args, Clone, Debug)]
pub struct ClientArgs {
    /// Endpoint to which it connects.
    pub endpoint: String,
    /// Lease of the killed client, its epoch, its secret, and the last acknowledged steps, resets and action hash of each counter.
    #[arg(long, num_args = 3 + 3 * NUM_ENVS)]
    pub reclaim: Option<Vec<String>>,
}

impl Role {
    /// Runs the role until it is killed or stdin closes. Stdin closes when the process of the test bed exits.
    pub fn run(&self) -> Result<(), Box<dyn std::error::Error>> {
        std::thread::spawn(|| {
            while matches!(std::io::stdin().read(&mut [0; 64]), Ok(1..)) {}
            std::process::exit(0);
        });
        match self {
            Role::Server(arguments) => serve(arguments),
            Role::Client(arguments) => Ok(client(arguments)?),
            Role::Router { listen } => route(listen),
        }
    }
}

fn route(listen: &str) -> Result<(), Box<dyn std::error::Error>> {
    // The shipped file, so that it is tested with every fault.
    let mut config = zenoh::Config::from_json5(include_str!("../../examples/security/router.json5"))
        .map_err(|error| error.to_string())?;
    for (key, value) in
        [("listen/endpoints", format!("[\"{listen}\"]")), ("transport/link/tx/lease", "2000".to_owned())]
    {
        config.insert_json5(key, &value).map_err(|error| error.to_string())?;
    }
    let _session = twinstep_session::open(config).map_err(|error| error.to_string())?;
    println!("listening {listen}");
    wait_until_killed()
}

fn serve(arguments: &ServerArgs) -> Result<(), Box<dyn std::error::Error>> {
    let config = ServerConfig {
        listen: arguments.listen.clone(),
        connect: arguments.connect.iter().cloned().collect(),
        envs: arguments.envs,
        ..ServerConfig::default()
    };
    let server = Server::start(&config, Arc::new(SlowHost(arguments.clone())))?;
    println!("listening {}", server.endpoints().join(" "));
    wait_until_killed()
}

fn wait_until_killed() -> ! {
    loop {
        std::thread::park();
    }
}

struct SlowHost(ServerArgs);

struct SlowEnv {
    inner: CounterEnv,
    step: Duration,
    duplicate_step_every: Option<u32>,
    steps: u32,
}

impl EnvFactory for SlowHost {
    fn build(
        &self,
        num_envs: usize,
        autoreset: AutoresetMode,
        _: Option<u32>,
    ) -> Result<Box<dyn VecEnv>, EnvFactoryError> {
        let inner = CounterEnv::new(&go2(), num_envs, autoreset);
        let step = Duration::from_millis(self.0.step_ms);
        Ok(Box::new(SlowEnv { inner, step, duplicate_step_every: self.0.duplicate_step_every, steps: 0 }))
    }
}

impl VecEnv for SlowEnv {
    fn spec(&self) -> &EnvSpec {
        self.inner.spec()
    }

    fn num_envs(&self) -> usize {
        self.inner.num_envs()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.inner.autoreset()
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        self.inner.reset(request)
    }

    fn obs(&self) -> &[f32] {
        self.inner.obs()
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.steps += 1;
        if self.duplicate_step_every.is_some_and(|every| self.steps.is_multiple_of(every)) {
            self.inner.step(actions)?;
        }
        // Half of the time passes before and half after the execution, so that faults occur on both sides of it.
        std::thread::sleep(self.step / 2);
        let batch = self.inner.step(actions)?;
        std::thread::sleep(self.step / 2);
        Ok(batch)
    }
}

/// Steps until killed.
///
/// Prints `lease ID EPOCH`, `acked` with the counters of each step, `lost REASON` after the lease is lost, and
/// `violation` with the evidence.
fn client(arguments: &ClientArgs) -> Result<(), ClientError> {
    // Shorter than the suspension of the server, so that the client times out and repeats the request.
    let options = ConnectOptions {
        timeout: Duration::from_secs(2),
        connect_timeout: Duration::from_secs(20),
        ..ConnectOptions::new(&arguments.endpoint, NUM_ENVS)
    };
    let mut reclaimed = arguments.reclaim.as_deref().map(parse_reclaimed_state);
    loop {
        let (env, oracle) = match reclaimed.take() {
            Some((ticket, counters)) => {
                (RemoteVecEnv::reclaim(&options, &ticket)?, StepOracle::after_client_crash(counters))
            }
            None => match connect_and_reset(&options) {
                Ok(started) => started,
                Err(reason) => {
                    println!("lost {}", reason.replace('\n', " "));
                    continue;
                }
            },
        };
        let LeaseHandle { lease, epoch, secret } = env.ticket();
        println!("lease {lease} {epoch} {}", secret.reveal());
        match step_until_lost(env, oracle) {
            Ended::Lost(reason) => println!("lost {}", reason.replace('\n', " ")),
            Ended::Violation(evidence) => println!("violation {evidence}"),
        }
    }
}

fn connect_and_reset(options: &ConnectOptions) -> Result<(RemoteVecEnv, StepOracle), String> {
    let mut env = RemoteVecEnv::connect(options).map_err(|error| error.to_string())?;
    let mut oracle = StepOracle::after_first_reset();
    let obs = env.reset(&ResetRequest::default()).map_err(|error| error.to_string())?;
    oracle.settle(obs)?;
    Ok((env, oracle))
}

enum Ended {
    Lost(String),
    Violation(String),
}

fn step_until_lost(mut env: RemoteVecEnv, mut oracle: StepOracle) -> Ended {
    loop {
        let actions = oracle.actions();
        if let Err(error) = env.send(&actions) {
            return Ended::Lost(error.to_string());
        }
        let batch = loop {
            match env.recv().cloned() {
                Ok(batch) => break batch,
                Err(error) if is_timeout(&error) => println!("waiting {}", error.to_string().replace('\n', " ")),
                Err(error) => return Ended::Lost(error.to_string()),
            }
        };
        match oracle.observe(&actions, &batch.obs) {
            Ok(counters) => println!("acked {}", write_counters(&counters)),
            Err(evidence) => return Ended::Violation(evidence),
        }
    }
}

/// True if the request timed out. Whether it was executed is unknown, so the client receives again.
fn is_timeout(error: &EnvError) -> bool {
    let EnvError::Remote(error) = error else { return false };
    matches!(error.downcast_ref(), Some(ClientError::RequestTimeout { .. }))
}

fn write_counters(counters: &[Counter; NUM_ENVS]) -> String {
    let numbers = counters.iter().flat_map(|counter| [counter.steps, counter.resets, counter.action_hash]);
    numbers.map(|number| number.to_string()).collect::<Vec<_>>().join(" ")
}

fn parse_reclaimed_state(words: &[String]) -> (LeaseHandle, [Counter; NUM_ENVS]) {
    let number = |index: usize| words[index].parse::<u64>().expect("the test bed passes a printed line");
    let counter = |env: usize| Counter {
        steps: number(3 + 3 * env) as u32,
        resets: number(4 + 3 * env) as u32,
        action_hash: number(5 + 3 * env) as u32,
    };
    let secret = words[2].parse().expect("the test bed passes a printed line");
    (LeaseHandle { lease: words[0].clone(), epoch: number(1), secret }, std::array::from_fn(counter))
}
