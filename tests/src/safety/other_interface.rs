//! A second interface of this computer, with a cable to another network namespace: as a robot's computer has one to the office.

use std::net::UdpSocket;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use twinstep_robot::dds::{Dds, LOW_STATE};

use super::in_state;
use super::packets::udp_ports;

const NAMESPACE: &str = "twinstep-other";
/// Address of this computer at the interface, and of the computer at the other end of the cable.
const ADDRESSES: [&str; 2] = ["10.177.0.1", "10.177.0.2"];
/// Time in which a state is looked at.
const TAKEN: Duration = Duration::from_secs(1);

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

/// An old state in the name of the robot changes nothing if it comes from another interface. From the robot's own interface it is a
/// fault: the tick jumps. Returns the time to that fault [ms].
pub fn state_from_other_interface(program: &Path) -> Result<f64, String> {
    let _interface = OtherInterface::create()?;
    let mut pair = in_state(program, "ready")?;
    let packet = state_packet(pair.domain)?;
    let file = tempfile::NamedTempFile::new().map_err(|error| error.to_string())?;
    std::fs::write(file.path(), &packet).map_err(|error| error.to_string())?;
    let ports = udp_ports(&[pair.robot.id()]);
    std::thread::sleep(TAKEN);
    for port in &ports {
        let send = format!("cat {} > /dev/udp/{}/{port}", file.path().display(), ADDRESSES[0]);
        let sent = Command::new("ip").args(["netns", "exec", NAMESPACE, "bash", "-c", &send]).status();
        if !sent.is_ok_and(|status| status.success()) {
            return Err(format!("`{send}` failed"));
        }
    }
    std::thread::sleep(TAKEN);
    if pair.state() != "ready" {
        return Err(format!("after a state from another interface: {}", pair.state()));
    }
    let socket = UdpSocket::bind("127.0.0.1:0").map_err(|error| error.to_string())?;
    let since = Instant::now();
    for port in ports {
        socket.send_to(&packet, ("127.0.0.1", port)).map_err(|error| error.to_string())?;
    }
    pair.wait_for("fault", TAKEN).map_err(|error| format!("a state from the own interface has no effect: {error}"))?;
    Ok(1e3 * since.elapsed().as_secs_f64())
}

/// Returns a packet with a state that the robot sends now, with a sequence number that it reaches much later.
fn state_packet(domain: u16) -> Result<Vec<u8>, String> {
    let dds = Dds::join(domain, [127, 0, 0, 1].into()).map_err(|error| error.to_string())?;
    let reader = dds.reader(LOW_STATE, std::thread::current()).map_err(|error| error.to_string())?;
    let since = Instant::now();
    while since.elapsed() < Duration::from_secs(10) {
        if let Some((payload, writer)) = reader.take_with_writer() {
            let sequence = [0_u32.to_le_bytes(), 1_000_000_u32.to_le_bytes()].concat();
            let body = [&[0, 0, 16, 0][..], &[0; 4], &writer[12..], &sequence, &payload].concat();
            // Header, then DATA in little-endian order with a payload, to any reader.
            let length = (body.len() as u16).to_le_bytes();
            return Ok([&b"RTPS\x02\x04\x01\x12"[..], &writer[..12], &[0x15, 0b101], &length, &body].concat());
        }
        std::thread::park_timeout(Duration::from_millis(50));
    }
    Err("no state arrives".to_owned())
}
