//! Stops of a standing robot by key, client, signal and remote control, while something keeps its process busy.

use std::io::Write;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use twinstep_client::{ConnectOptions, Connection, stop_robot};
use twinstep_protocol::message::{HelloReply, HelloRequest};
use twinstep_protocol::{PROTOCOL, Secret, decode, encode, keys};

use super::probe::Probe;
use super::{Row, pair, quantile};
use crate::process::Process;
use crate::proxy::Proxy;
use crate::robot_pair::next_domain;

/// How the robot is stopped.
const WAYS: [&str; 4] = ["key", "client", "signal", "remote"];
/// What else happens.
const LOADS: [&str; 6] =
    ["nothing", "terminal stalled", "8 frozen clients", "disk full", "300 page connections", "CPU load of 8"];
/// Requests of a client that reads no replies.
const UNREAD_REQUESTS: usize = 2000;
/// Port of the next robot at a terminal. A robot that was stopped keeps its port while it damps.
static NEXT_PORT: AtomicU16 = AtomicU16::new(17470);
/// Time from the freeze of the clients to the stop: their links are being closed.
const FREEZE: Duration = Duration::from_millis(2100);

/// Makes `repeats` stops for each way and load.
pub fn run(program: &Path, repeats: usize, progress: &dyn Fn(&str)) -> Vec<Row> {
    let (mut rows, mut all) = (Vec::new(), Vec::new());
    for way in WAYS {
        for load in LOADS {
            let (mut delays, mut failures) = (Vec::new(), Vec::new());
            for _ in 0..repeats {
                match case(program, way, load) {
                    Ok(delay) => delays.push(delay),
                    Err(error) => failures.push(error),
                }
            }
            let row = row(way, load, &delays, &failures);
            progress(&row.line());
            rows.push(row);
            all.extend(delays.iter().map(|(delay, late): &(f64, f64)| (delay - late).max(0.0)));
        }
    }
    let (p99, worst) = (quantile(&mut all, 0.99), quantile(&mut all, 1.0));
    rows.push(Row {
        what: format!("all {} stops", all.len()),
        found: format!("in excess of the sleeping thread 99 % {p99:.1}, worst {worst:.1} ms"),
        is_met: p99 <= 20.0 && worst <= 60.0,
    });
    rows
}

/// `delays`: time from the stop to the damping, and lateness of a sleeping thread meanwhile [ms].
fn row(way: &str, load: &str, delays: &[(f64, f64)], failures: &[String]) -> Row {
    let mut excess: Vec<f64> = delays.iter().map(|(delay, late)| (delay - late).max(0.0)).collect();
    let worst_of = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let (delay, late) =
        (worst_of(&mut delays.iter().map(|case| case.0)), worst_of(&mut delays.iter().map(|case| case.1)));
    let (p50, worst) = (quantile(&mut excess, 0.5), quantile(&mut excess, 1.0));
    let failed =
        if failures.is_empty() { String::new() } else { format!("; {} failed: {}", failures.len(), failures[0]) };
    Row {
        what: format!("stop by {way}, {load}"),
        found: format!(
            "{} stops, worst {delay:.1} ms, sleeping thread {late:.1} ms late; in excess median {p50:.1}, worst {worst:.1} ms{failed}",
            delays.len()
        ),
        is_met: !delays.is_empty() && failures.is_empty() && worst <= 60.0,
    }
}

fn case(program: &Path, way: &str, load: &str) -> Result<(f64, f64), String> {
    let needs_terminal = way == "key" || load == "terminal stalled";
    if needs_terminal { at_terminal(program, way, load) } else { at_pipe(program, way, load) }
}

fn at_pipe(program: &Path, way: &str, load: &str) -> Result<(f64, f64), String> {
    let mut more = vec![];
    if load == "300 page connections" {
        more.extend(["--view", "127.0.0.1:7493"]);
    }
    if load == "disk full" {
        let _ = std::fs::remove_file("/tmp/twinstep-safety-disk/run.mcap");
        more.extend(["--record", "/tmp/twinstep-safety-disk/run.mcap"]);
    }
    let _disk = if load == "disk full" { Some(SmallDisk::mount()?) } else { None };
    let mut pair = pair(program, &more)?;
    pair.wait_for("observe", Duration::from_secs(20))?;
    pair.insist("arm")?;
    pair.insist("stand")?;
    pair.wait_for("ready", Duration::from_secs(15))?;
    let endpoint = pair.endpoint.clone();
    let (id, stop_port) = (pair.robot.id(), stop_port(&endpoint)?);
    measure(pair.domain, way, load, &endpoint, id, &mut |way| match way {
        "remote" => pair.inject("remote L2+B").map(drop),
        "signal" => pair.robot.signal("INT"),
        _ => stop_robot(&endpoint, stop_port, None).map_err(|error| error.to_string()),
    })
}

/// Returns the port of the stop channel, as `hello` says.
fn stop_port(endpoint: &str) -> Result<Option<u16>, String> {
    let connection =
        Connection::open(&ConnectOptions::new(endpoint, 1), Secret::random()).map_err(|error| error.to_string())?;
    let request = encode(&HelloRequest { protocol: PROTOCOL, client: String::new() });
    let reply = connection.request(&keys::hello(connection.sid()), request).map_err(|error| error.to_string())?;
    let hello: HelloReply = decode(&reply.to_bytes()).map_err(|error| error.to_string())?;
    Ok(hello.real_time.and_then(|real_time| real_time.stop_port))
}

/// A robot whose operator has a screen, in a terminal of `script`.
fn at_terminal(program: &Path, way: &str, load: &str) -> Result<(f64, f64), String> {
    let domain = next_domain();
    let arguments = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain.to_string()];
    let mut fake = Process::start(program, &arguments.map(str::to_owned))?;
    fake.line(Duration::from_secs(20)).ok_or("no fake robot")?;
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let page = if load == "300 page connections" { "--view 127.0.0.1:7493" } else { "" };
    let _disk = if load == "disk full" { Some(SmallDisk::mount()?) } else { None };
    let record = if load == "disk full" { "--record /tmp/twinstep-safety-disk/run.mcap" } else { "" };
    let endpoint = format!("tcp/127.0.0.1:{}", NEXT_PORT.fetch_add(2, Ordering::Relaxed));
    let line = format!(
        "exec {} robot --interface 127.0.0.1 --domain {domain} --listen {endpoint} {page} {record} 2>{}",
        program.display(),
        folder.path().join("log").display()
    );
    let mut terminal = Terminal::start(&line)?;
    let probe = Probe::start(domain)?;
    let since = Instant::now();
    // Nothing is read from the screen; the commands show what the robot does.
    while probe
        .last_holding()
        .is_none_or(|at| at.elapsed() > Duration::from_millis(50) || since.elapsed() < Duration::from_secs(7))
    {
        if since.elapsed() > Duration::from_secs(25) {
            let log = std::fs::read_to_string(folder.path().join("log")).unwrap_or_default();
            let last: Vec<&str> = log.lines().rev().take(3).collect();
            return Err(format!("the robot does not stand; its last messages: {}", last.join(" / ")));
        }
        terminal.press(b"as")?;
        std::thread::sleep(Duration::from_millis(400));
    }
    probe.end();
    std::thread::sleep(Duration::from_millis(2500));
    if load == "terminal stalled" {
        terminal.stall();
        terminal.press(b"\x13")?;
        std::thread::sleep(Duration::from_millis(1500));
    }
    let id = terminal.robot_id()?;
    measure(domain, way, load, &endpoint, id, &mut |way| match way {
        "key" => terminal.press(b" "),
        "remote" => fake.write_line("remote L2+B"),
        "signal" => {
            Command::new("kill").args(["-INT", &id.to_string()]).status().map(drop).map_err(|error| error.to_string())
        }
        _ => stop_robot(&endpoint, None, None).map_err(|error| error.to_string()),
    })
}

/// Stops the robot under a load. Returns the time to the damping, and the lateness of a sleeping thread meanwhile [ms].
fn measure(
    domain: u16,
    way: &str,
    load: &str,
    endpoint: &str,
    _id: u32,
    stop: &mut dyn FnMut(&str) -> Result<(), String>,
) -> Result<(f64, f64), String> {
    let probe = Probe::start(domain)?;
    let since = Instant::now();
    while probe.count_since(since) < 50 {
        if since.elapsed() > Duration::from_secs(5) {
            return Err("the probe receives no commands".to_owned());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let _load = Load::start(load, endpoint)?;
    if probe.last_holding().is_none_or(|at| at.elapsed() > Duration::from_millis(100)) {
        return Err(format!("the robot does not stand any more under `{load}`"));
    }
    let sent = Instant::now();
    stop(way)?;
    std::thread::sleep(Duration::from_millis(700));
    probe.end();
    let (damping, _) = probe.damping_after(sent).ok_or("no damping command arrived")?;
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    Ok((ms(damping - sent), ms(probe.lateness(sent, damping))))
}

/// What keeps the process busy, until the value is dropped.
#[derive(Default)]
struct Load {
    children: Vec<Child>,
    streams: Vec<TcpStream>,
    clients: Vec<(Proxy, Connection)>,
}

impl Load {
    fn start(load: &str, endpoint: &str) -> Result<Self, String> {
        let mut this = Self::default();
        match load {
            "CPU load of 8" => {
                let burn = || Command::new("sh").args(["-c", "while :; do :; done"]).stdin(Stdio::null()).spawn();
                this.children = (0..8).filter_map(|_| burn().ok()).collect();
                std::thread::sleep(Duration::from_millis(500));
            }
            "300 page connections" => {
                this.streams = (0..300).filter_map(|_| TcpStream::connect("127.0.0.1:7493").ok()).collect();
                std::thread::sleep(Duration::from_millis(300));
            }
            "8 frozen clients" => {
                this.clients = (0..8).map(|_| freeze(endpoint)).collect::<Result<_, _>>()?;
                std::thread::sleep(FREEZE);
            }
            _ => {}
        }
        Ok(this)
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        for child in &mut self.children {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// Connects a client that sends `hello` and reads nothing.
pub fn freeze(endpoint: &str) -> Result<(Proxy, Connection), String> {
    let proxy = Proxy::start(endpoint)?;
    let options = ConnectOptions::new(&proxy.endpoint, 1);
    let connection = Connection::open(&options, Secret::random()).map_err(|error| error.to_string())?;
    proxy.hold_replies(Duration::from_hours(1));
    let hello = encode(&HelloRequest { protocol: PROTOCOL, client: String::new() });
    let key = keys::hello(connection.sid());
    let unread: Vec<_> = (0..UNREAD_REQUESTS).map(|_| connection.send(&key, hello.clone())).collect();
    drop(unread);
    Ok((proxy, connection))
}

/// A file system of 1 MiB. Needs root.
struct SmallDisk;

impl SmallDisk {
    fn mount() -> Result<Self, String> {
        let folder = "/tmp/twinstep-safety-disk";
        std::fs::create_dir_all(folder).map_err(|error| error.to_string())?;
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", "size=1m", "tmpfs", folder]).status();
        if mounted.is_ok_and(|status| status.success()) {
            Ok(Self)
        } else {
            Err("no small disk: run as root".to_owned())
        }
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").args(["-l", "/tmp/twinstep-safety-disk"]).status();
    }
}

/// A terminal of the program `script`, with a command in it.
struct Terminal {
    child: Child,
    is_read: std::sync::Arc<std::sync::atomic::AtomicBool>,
}

impl Terminal {
    fn start(line: &str) -> Result<Self, String> {
        let mut child = Command::new("script")
            .args(["-qfc", line, "/dev/null"])
            .env("TERM", "xterm")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|error| error.to_string())?;
        let mut output = child.stdout.take().ok_or("no output")?;
        let is_read = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(true));
        let reads = std::sync::Arc::clone(&is_read);
        std::thread::spawn(move || {
            let mut buffer = [0; 4096];
            while reads.load(Ordering::Acquire) {
                if !matches!(std::io::Read::read(&mut output, &mut buffer), Ok(1..)) {
                    return;
                }
            }
            // The pipe stays open, and nobody reads it.
            std::mem::forget(output);
        });
        Ok(Self { child, is_read })
    }

    fn press(&mut self, keys: &[u8]) -> Result<(), String> {
        let input = self.child.stdin.as_mut().ok_or("no input")?;
        input.write_all(keys).and_then(|()| input.flush()).map_err(|error| error.to_string())
    }

    /// Ends the reading of what the terminal shows.
    fn stall(&self) {
        self.is_read.store(false, Ordering::Release);
    }

    fn robot_id(&self) -> Result<u32, String> {
        let output = Command::new("pgrep").args(["-P", &self.child.id().to_string()]).output();
        let output = output.map_err(|error| error.to_string())?;
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        text.lines()
            .next()
            .and_then(|id| id.trim().parse().ok())
            .ok_or_else(|| "the robot's process is not found".to_owned())
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        if let Ok(id) = self.robot_id() {
            let _ = Command::new("kill").args(["-KILL", &id.to_string()]).status();
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
