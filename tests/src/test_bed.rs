//! A test bed: a server, a client and optionally a router between them, into which faults are injected.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use twinstep_model::Stream;

use crate::fault::{Fault, moment};
use crate::process::Process;
use crate::proxy::Proxy;
use crate::repeats;
use crate::stranger;

/// Maximum time for a test bed to continue after a fault.
const RECOVERY_TIMEOUT: Duration = Duration::from_secs(30);
/// Number of acknowledged steps after which a test bed counts as running again.
const PROGRESS: usize = 3;

/// The processes of one test bed.
pub struct TestBed {
    router: Option<Process>,
    server: Process,
    client: Process,
    /// Endpoint of the server.
    listen: String,
    /// Endpoint for other clients: the router's if there is one, the server's otherwise.
    endpoint: String,
    /// Proxy between the client and `endpoint`.
    proxy: Proxy,
    plan: TestBedConfig,
    /// Id, epoch and secret of the client's lease.
    lease: [String; 3],
    /// Counters after the last acknowledged step, as printed by the client.
    acknowledged: Vec<String>,
    /// Number of steps that the client acknowledged.
    pub steps: u64,
    /// Longest time from the end of a fault to the third step after it.
    pub slowest: Duration,
}

/// Commands of the processes of a test bed.
#[derive(Clone, Debug)]
pub struct TestBedConfig {
    /// Program with the roles of [`crate::roles`].
    pub program: PathBuf,
    /// Additional arguments of the server.
    pub server: Vec<String>,
    /// Program and first arguments of another client. It prints the same lines and does not reclaim leases.
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

/// Lease that is expected after a fault.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Lease {
    Same,
    New,
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
        let mut test_bed = Self {
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
        test_bed.wait_for_progress(Lease::New)?;
        // The time of the start is not a recovery time.
        test_bed.slowest = Duration::ZERO;
        Ok(test_bed)
    }

    /// True if the test bed has a router.
    pub fn has_router(&self) -> bool {
        self.router.is_some()
    }

    /// Injects `fault` and waits until the test bed continues as required. The error is the evidence of a failure.
    pub fn inject(&mut self, fault: Fault, random: &mut Stream) -> Result<(), String> {
        std::thread::sleep(moment(random, 0..40));
        match fault {
            Fault::ServerKilled => self.kill_server(),
            Fault::ClientKilled => self.kill_client(),
            Fault::RouterKilled => self.kill_router(moment(random, 0..800)),
            Fault::ClientFrozen => {
                freeze(&self.client, moment(random, 50..3000))?;
                self.wait_for_progress(Lease::Same)
            }
            Fault::ServerFrozen => {
                freeze(&self.server, moment(random, 2500..4000))?;
                self.wait_for_progress(Lease::Same)
            }
            Fault::MessagesDelayed => {
                self.proxy.hold(moment(random, 50..3000));
                self.wait_for_progress(Lease::Same)
            }
            Fault::RequestRepeated => {
                repeats::three_times(&self.endpoint)?;
                self.wait_for_progress(Lease::Same)
            }
            Fault::SecondServer => self.start_second_server(),
            Fault::LeaseAttacked => {
                let epoch = self.lease[1].parse().map_err(|_| format!("epoch {}", self.lease[1]))?;
                stranger::use_foreign_lease(&self.endpoint, &self.lease[0], epoch, self.steps)?;
                self.wait_for_progress(Lease::Same)
            }
            Fault::RepliesUnread => {
                stranger::read_nothing(&self.endpoint)?;
                self.wait_for_progress(Lease::Same)
            }
        }
    }

    fn router_endpoint(&self) -> Option<&str> {
        self.router.as_ref().map(|_| self.endpoint.as_str())
    }

    fn kill_server(&mut self) -> Result<(), String> {
        self.server.kill();
        self.server = start_server(&self.plan.program, &self.listen, self.router_endpoint(), &self.plan.server)?;
        self.wait_for_progress(Lease::New)
    }

    fn kill_client(&mut self) -> Result<(), String> {
        for line in self.client.kill() {
            self.record_line(&line)?;
        }
        if self.plan.client.is_some() {
            self.client = self.plan.start_client(&self.proxy.endpoint, &[])?;
            return self.wait_for_progress(Lease::New);
        }
        let [lease, epoch, secret] = self.lease.clone();
        let mut reclaimed_state = vec!["--reclaim".to_owned(), lease, epoch, secret];
        reclaimed_state.extend(self.acknowledged.iter().cloned());
        self.client = self.plan.start_client(&self.proxy.endpoint, &reclaimed_state)?;
        self.wait_for_progress(Lease::Same)
    }

    fn kill_router(&mut self, pause: Duration) -> Result<(), String> {
        let Some(router) = &mut self.router else { return Err("this test bed has no router".to_owned()) };
        router.kill();
        std::thread::sleep(pause);
        self.router = Some(start_router(&self.plan.program, &self.endpoint)?);
        self.wait_for_progress(Lease::Same)
    }

    /// Starts a second server and checks that it has no effect on the client.
    ///
    /// Behind a router a new client uses one of the two. At the same endpoint the second server cannot start.
    fn start_second_server(&mut self) -> Result<(), String> {
        if self.has_router() {
            let _second = start_server(&self.plan.program, &free_endpoint()?, self.router_endpoint(), &[])?;
            repeats::three_times(&self.endpoint)?;
            self.wait_for_progress(Lease::Same)
        } else {
            let mut second = Process::start(&self.plan.program, &["server".to_owned(), self.listen.clone()])?;
            match second.exit_code(RECOVERY_TIMEOUT) {
                Some(0) | None => Err("a second server started at the same endpoint".to_owned()),
                Some(_) => self.wait_for_progress(Lease::Same),
            }
        }
    }

    /// Waits until the client steps again, under the same lease or a new one.
    fn wait_for_progress(&mut self, lease: Lease) -> Result<(), String> {
        // Lines printed before the end of the fault do not count as progress.
        let (before, since) = (self.lease[0].clone(), Instant::now());
        for line in self.client.lines_so_far() {
            self.record_line(&line)?;
        }
        let mut progress = 0;
        while progress < PROGRESS {
            let timeout = RECOVERY_TIMEOUT.saturating_sub(since.elapsed());
            let Some(line) = self.client.line(timeout) else {
                return Err(format!("the client did not continue within {:.1} s", since.elapsed().as_secs_f64()));
            };
            self.record_line(&line)?;
            let has_expected_lease = lease == Lease::Same || self.lease[0] != before;
            progress += usize::from(line.starts_with("acked") && has_expected_lease);
        }
        if lease == Lease::Same && self.lease[0] != before {
            return Err("the lease and its counters were lost".to_owned());
        }
        self.slowest = self.slowest.max(since.elapsed());
        Ok(())
    }

    fn record_line(&mut self, line: &str) -> Result<(), String> {
        let mut words = line.split(' ').map(str::to_owned);
        match words.next().as_deref() {
            Some("lease") => self.lease = std::array::from_fn(|_| words.next().unwrap_or_default()),
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

/// Returns an endpoint on this machine with a free port.
pub fn free_endpoint() -> Result<String, String> {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").map_err(|error| error.to_string())?;
    Ok(format!("tcp/{}", listener.local_addr().map_err(|error| error.to_string())?))
}

/// Starts a router that listens at `listen`.
pub fn start_router(program: &Path, listen: &str) -> Result<Process, String> {
    start(program, &["router".to_owned(), listen.to_owned()])
}

/// Starts a server of counters that listens at `listen`.
pub fn start_server(program: &Path, listen: &str, router: Option<&str>, extra: &[String]) -> Result<Process, String> {
    let mut arguments = vec!["server".to_owned(), listen.to_owned()];
    if let Some(router) = router {
        arguments.extend(["--connect".to_owned(), router.to_owned()]);
    }
    arguments.extend_from_slice(extra);
    start(program, &arguments)
}

/// Starts a process and waits until it prints `listening`.
///
/// Retries, because a port may remain in use for a short time after its process was killed.
fn start(program: &Path, arguments: &[String]) -> Result<Process, String> {
    let since = Instant::now();
    while since.elapsed() < RECOVERY_TIMEOUT {
        let process = Process::start(program, arguments)?;
        if process.line(RECOVERY_TIMEOUT).is_some_and(|line| line.starts_with("listening")) {
            return Ok(process);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err(format!("`{}` did not start", arguments.join(" ")))
}
