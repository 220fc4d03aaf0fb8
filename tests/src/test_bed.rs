//! A server, a client and perhaps a router between them, and what faults do to them.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use twinstep_client::{ClientError, ConnectOptions, RemoteVecEnv};
use twinstep_model::Stream;

use crate::fault::{Fault, moment};
use crate::process::Process;
use crate::proxy::Proxy;
use crate::repeats;

/// How long a lane may take to go on after a fault.
const RECOVERY_TIMEOUT: Duration = Duration::from_secs(30);
/// How long the news of a server may take through the router.
const DISCOVERY_TIMEOUT: Duration = Duration::from_secs(3);
/// Steps after which a lane counts as going on.
const PROGRESS: usize = 3;

/// The processes of one lane.
pub struct TestBed {
    router: Option<Process>,
    server: Process,
    client: Process,
    /// Where the server listens.
    listen: String,
    /// Where other clients connect, and the server too if it is a router.
    endpoint: String,
    /// Where the client connects, on its way to `endpoint`.
    proxy: Proxy,
    plan: TestBedConfig,
    /// The client's lease and epoch.
    lease: [String; 2],
    /// Counters after the last acknowledged step, as the client printed them.
    acknowledged: Vec<String>,
    /// Steps that the client acknowledged.
    pub steps: u64,
    /// The longest time from a fault's end to the third step after it.
    pub slowest: Duration,
}

/// What the processes of a lane run.
#[derive(Clone, Debug)]
pub struct TestBedConfig {
    /// The program with the roles of [`crate::roles`].
    pub program: PathBuf,
    /// Further arguments of the server.
    pub server: Vec<String>,
    /// Program and first arguments of another client, which prints the same lines and does not reclaim.
    pub client: Option<Vec<String>>,
}

impl TestBedConfig {
    fn start_client(&self, endpoint: &str, reclaimed_state: &[String]) -> Result<Process, String> {
        let own = vec![self.program.display().to_string(), "client".to_owned()];
        let mut words = self.client.clone().unwrap_or(own);
        words.push(endpoint.to_owned());
        words.extend_from_slice(reclaimed_state);
        Process::start(Path::new(&words[0]), &words[1..])
    }
}

/// Whether the lease must outlive a fault.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Lease {
    GoesOn,
    IsNew,
}

impl TestBed {
    /// Starts the processes and waits until the client steps.
    pub fn start(plan: &TestBedConfig, with_router: bool) -> Result<Self, String> {
        let program = &plan.program;
        let listen = free_endpoint()?;
        let endpoint = if with_router { free_endpoint()? } else { listen.clone() };
        let router = if with_router { Some(start_router(program, &endpoint)?) } else { None };
        let server = start_server(program, &listen, router.as_ref().map(|_| endpoint.as_str()), &plan.server)?;
        let proxy = Proxy::start(&endpoint)?;
        let client = plan.start_client(&proxy.endpoint, &[])?;
        let mut lane = Self {
            router,
            server,
            client,
            listen,
            endpoint,
            proxy,
            plan: plan.clone(),
            lease: Default::default(),
            acknowledged: Vec::new(),
            steps: 0,
            slowest: Duration::ZERO,
        };
        lane.wait_for_progress(Lease::IsNew)?;
        // Starting is no fault.
        lane.slowest = Duration::ZERO;
        Ok(lane)
    }

    /// Whether there is a router to kill.
    pub fn has_router(&self) -> bool {
        self.router.is_some()
    }

    /// Does `fault`, and waits until the lane goes on as it must; the error is the evidence that it does not.
    pub fn inject(&mut self, fault: Fault, random: &mut Stream) -> Result<(), String> {
        std::thread::sleep(moment(random, 0..40));
        match fault {
            Fault::ServerKilled => self.kill_server(),
            Fault::ClientKilled => self.kill_client(),
            Fault::RouterKilled => self.kill_router(moment(random, 0..800)),
            Fault::ClientFrozen => {
                freeze(&self.client, moment(random, 50..3000))?;
                self.wait_for_progress(Lease::GoesOn)
            }
            Fault::ServerFrozen => {
                freeze(&self.server, moment(random, 2500..4000))?;
                self.wait_for_progress(Lease::GoesOn)
            }
            Fault::MessagesDelayed => {
                self.proxy.hold(moment(random, 50..3000));
                self.wait_for_progress(Lease::GoesOn)
            }
            Fault::RequestRepeated => {
                repeats::three_times(&self.endpoint)?;
                self.wait_for_progress(Lease::GoesOn)
            }
            Fault::SecondServer => self.start_second_server(),
        }
    }

    fn router_endpoint(&self) -> Option<&str> {
        self.router.as_ref().map(|_| self.endpoint.as_str())
    }

    fn kill_server(&mut self) -> Result<(), String> {
        self.server.kill();
        self.server = start_server(&self.plan.program, &self.listen, self.router_endpoint(), &self.plan.server)?;
        self.wait_for_progress(Lease::IsNew)
    }

    fn kill_client(&mut self) -> Result<(), String> {
        for line in self.client.kill() {
            self.note(&line)?;
        }
        if self.plan.client.is_some() {
            self.client = self.plan.start_client(&self.proxy.endpoint, &[])?;
            return self.wait_for_progress(Lease::IsNew);
        }
        let [lease, epoch] = self.lease.clone();
        let mut heritage = vec!["--inherit".to_owned(), lease, epoch];
        heritage.extend(self.acknowledged.iter().cloned());
        self.client = self.plan.start_client(&self.proxy.endpoint, &heritage)?;
        self.wait_for_progress(Lease::GoesOn)
    }

    fn kill_router(&mut self, pause: Duration) -> Result<(), String> {
        let Some(router) = &mut self.router else { return Err("this lane has no router".to_owned()) };
        router.kill();
        std::thread::sleep(pause);
        self.router = Some(start_router(&self.plan.program, &self.endpoint)?);
        self.wait_for_progress(Lease::GoesOn)
    }

    /// Behind a router both servers are visible, and a new client must not choose blindly. At one endpoint the second
    /// cannot even start.
    fn start_second_server(&mut self) -> Result<(), String> {
        if self.has_router() {
            let _second = start_server(&self.plan.program, &free_endpoint()?, self.router_endpoint(), &[])?;
            let options = ConnectOptions {
                connect_timeout: Duration::from_millis(500),
                ..ConnectOptions::new(&self.endpoint, 1)
            };
            let since = Instant::now();
            loop {
                match RemoteVecEnv::connect(&options) {
                    Err(ClientError::AmbiguousRobot { .. }) => return self.wait_for_progress(Lease::GoesOn),
                    Err(error) => return Err(format!("two servers: {error}")),
                    // The router may not have heard of the second server yet.
                    Ok(_) if since.elapsed() < DISCOVERY_TIMEOUT => {}
                    Ok(_) => return Err("a client chose one of two servers".to_owned()),
                }
            }
        } else {
            let mut second = Process::start(&self.plan.program, &["server".to_owned(), self.listen.clone()])?;
            match second.exit_code(RECOVERY_TIMEOUT) {
                Some(0) | None => Err("a second server started at the same endpoint".to_owned()),
                Some(_) => self.wait_for_progress(Lease::GoesOn),
            }
        }
    }

    /// Waits until the client steps again, under the same lease or a new one.
    fn wait_for_progress(&mut self, lease: Lease) -> Result<(), String> {
        // What was printed before the fault's end says nothing about after it.
        let (before, since) = (self.lease[0].clone(), Instant::now());
        for line in self.client.lines_so_far() {
            self.note(&line)?;
        }
        let mut progress = 0;
        while progress < PROGRESS {
            let left = RECOVERY_TIMEOUT.saturating_sub(since.elapsed());
            let Some(line) = self.client.line(left) else {
                return Err(format!("the client does not go on after {:.1} s", since.elapsed().as_secs_f64()));
            };
            self.note(&line)?;
            let is_in_its_lease = lease == Lease::GoesOn || self.lease[0] != before;
            progress += usize::from(line.starts_with("acked") && is_in_its_lease);
        }
        if lease == Lease::GoesOn && self.lease[0] != before {
            return Err("the lease was lost, and its counters with it".to_owned());
        }
        self.slowest = self.slowest.max(since.elapsed());
        Ok(())
    }

    fn note(&mut self, line: &str) -> Result<(), String> {
        let mut words = line.split(' ').map(str::to_owned);
        match words.next().as_deref() {
            Some("lease") => self.lease = [words.next().unwrap_or_default(), words.next().unwrap_or_default()],
            Some("acked") => {
                self.acknowledged = words.collect();
                self.steps += 1;
            }
            Some("violation") => return Err(line.to_owned()),
            _ => {}
        }
        Ok(())
    }
}

fn freeze(process: &Process, pause: Duration) -> Result<(), String> {
    process.freeze()?;
    std::thread::sleep(pause);
    process.thaw()
}

fn free_endpoint() -> Result<String, String> {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").map_err(|error| error.to_string())?;
    Ok(format!("tcp/{}", listener.local_addr().map_err(|error| error.to_string())?))
}

fn start_router(program: &Path, listen: &str) -> Result<Process, String> {
    start(program, &["router".to_owned(), listen.to_owned()])
}

fn start_server(program: &Path, listen: &str, router: Option<&str>, extra: &[String]) -> Result<Process, String> {
    let mut arguments = vec!["server".to_owned(), listen.to_owned()];
    if let Some(router) = router {
        arguments.extend(["--connect".to_owned(), router.to_owned()]);
    }
    arguments.extend_from_slice(extra);
    start(program, &arguments)
}

/// Starts a process that says when it listens. A port may stay taken for a moment after its owner's death.
fn start(program: &Path, arguments: &[String]) -> Result<Process, String> {
    let since = Instant::now();
    while since.elapsed() < RECOVERY_TIMEOUT {
        let process = Process::start(program, arguments)?;
        if process.line(RECOVERY_TIMEOUT).is_some_and(|line| line.starts_with("listening")) {
            return Ok(process);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err(format!("`{}` does not start", arguments.join(" ")))
}
