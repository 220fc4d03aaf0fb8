//! A second interface of this computer, with a cable to another network namespace: as a robot's computer has one to the office.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use twinstep_robot::dds::{Dds, LOW_STATE};

use super::pair;
use crate::process::Process;

const NAMESPACE: &str = "twinstep-other";
/// Address of this computer at the interface, and of the computer at the other end of the cable.
const ADDRESSES: [&str; 2] = ["10.177.0.1", "10.177.0.2"];
/// States of the robot at the other end that have to reach this computer before the case counts.
const STATES: usize = 100;
/// Time in which they do.
const TIMEOUT: Duration = Duration::from_secs(20);
/// Time for which the robot then stands beside them.
const TOGETHER: Duration = Duration::from_secs(3);

/// The interface. Removed on drop.
struct OtherInterface;

impl OtherInterface {
    fn create() -> Result<Self, String> {
        let [own, other] = ADDRESSES.map(|address| format!("{address}/24"));
        let _ = ip(&format!("netns del {NAMESPACE}"));
        ip(&format!("netns add {NAMESPACE}"))?;
        let interface = Self;
        ip(&format!("link add tw0 type veth peer name tw1 netns {NAMESPACE}"))?;
        ip(&format!("addr add {own} dev tw0"))?;
        ip("link set tw0 up")?;
        ip(&format!("-n {NAMESPACE} addr add {other} dev tw1"))?;
        ip(&format!("-n {NAMESPACE} link set lo up"))?;
        ip(&format!("-n {NAMESPACE} link set tw1 up"))?;
        Ok(interface)
    }
}

impl Drop for OtherInterface {
    fn drop(&mut self) {
        // The pair of interfaces goes with it.
        let _ = ip(&format!("netns del {NAMESPACE}"));
    }
}

fn ip(arguments: &str) -> Result<(), String> {
    let run = Command::new("ip").args(arguments.split(' ')).stderr(Stdio::null()).status();
    match run {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(format!("`ip {arguments}`: {status}; it needs root")),
        Err(error) => Err(format!("`ip {arguments}`: {error}")),
    }
}

/// A robot at another interface, whose states reach this computer, is no second robot: it is not seen, and gets no commands. Returns
/// the number that it executed.
pub fn robot_at_other_interface(program: &Path) -> Result<f64, String> {
    let _interface = OtherInterface::create()?;
    let mut pair = pair(program, &[])?;
    pair.wait_for("observe", Duration::from_secs(20))?;
    let domain = pair.domain.to_string();
    let fake = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain, "--interface", ADDRESSES[1]];
    let program = program.to_str().ok_or("the path of the program is no text")?;
    let arguments = [&["netns", "exec", NAMESPACE, program][..], &fake].concat();
    let mut second = Process::start(Path::new("ip"), &arguments.iter().map(ToString::to_string).collect::<Vec<_>>())?;
    second.line(TIMEOUT).ok_or("no second robot")?;
    // This participant of the same computer joins the multicast groups at the interface: they are delivered to all sockets.
    states_arrive(pair.domain)?;
    pair.insist("arm")?;
    pair.insist("stand")?;
    pair.wait_for("ready", Duration::from_secs(15))?;
    std::thread::sleep(TOGETHER);
    if pair.state() != "ready" {
        return Err(pair.state().to_owned());
    }
    second.write_line("statistics")?;
    let answer = second.line(Duration::from_secs(5)).ok_or("the second robot does not answer")?;
    let statistics: serde_json::Value = serde_json::from_str(&answer).map_err(|error| error.to_string())?;
    statistics["accepted"].as_f64().ok_or(answer)
}

/// Waits until the states of the other robot arrive at this computer, and goes on receiving them.
fn states_arrive(domain: u16) -> Result<(), String> {
    let address = ADDRESSES[0].parse().map_err(|_| "no address")?;
    let dds = Dds::join(domain, address).map_err(|error| error.to_string())?;
    let reader = dds.reader(LOW_STATE, std::thread::current()).map_err(|error| error.to_string())?;
    let (since, mut states) = (Instant::now(), 0);
    while states < STATES {
        if since.elapsed() > TIMEOUT {
            return Err(format!("{states} states of the other robot reached this computer"));
        }
        while reader.take_with_writer().is_some() {
            states += 1;
        }
        std::thread::park_timeout(Duration::from_millis(10));
    }
    std::thread::spawn(move || {
        std::thread::sleep(Duration::from_secs(60));
        drop((dds, reader));
    });
    Ok(())
}
