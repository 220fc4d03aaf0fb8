//! Forged packets at the DDS sockets of a robot that stands: random ones, and ones in the name of the robot's own writers.

use std::net::UdpSocket;
use std::path::Path;
use std::time::{Duration, Instant};

use rand::{Rng, RngExt};
use twinstep_model::{Stream, stream};

use super::probe::Probe;
use super::{Row, in_state, memory_mib};

/// Packets that are sent without a pause.
const BURST: usize = 50;
/// Size of the header of a packet [bytes].
const HEADER: usize = 20;

/// Sends `count` packets to every UDP socket of the robot's process and of its watchdog.
pub fn run(program: &Path, count: usize, seed: u64) -> Result<Vec<Row>, String> {
    let mut pair = in_state(program, "ready")?;
    let id = pair.robot.id();
    let ports = udp_ports(&with_children(id));
    let prefix = writer_of_states(pair.domain)?;
    let probe = Probe::start(pair.domain)?;
    std::thread::sleep(Duration::from_millis(500));
    let socket = UdpSocket::bind("127.0.0.1:0").map_err(|error| error.to_string())?;
    let (memory_before, start) = (memory_mib(id), Instant::now());
    let mut random = stream(seed, "safety::packets", 0);
    for index in 0..count {
        let packet = packet(&prefix, &mut random);
        let port = ports[index % ports.len()];
        let _ = socket.send_to(&packet, ("127.0.0.1", port));
        if index % BURST == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    let end = Instant::now();
    std::thread::sleep(Duration::from_millis(500));
    probe.end();
    let (gap, late) = probe.gaps(start, end);
    let (memory, state) = (memory_mib(id), pair.state().to_owned());
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    let excess = (ms(gap) - 2.0 - ms(late)).max(0.0);
    Ok(vec![Row {
        what: format!("{count} packets at {} sockets, in {:.0} s", ports.len(), (end - start).as_secs_f64()),
        found: format!(
            "longest time between two commands {:.1} ms, sleeping thread {:.1} ms late, {excess:.1} ms in excess of 2 ms and it; \
             memory {memory_before:.0} to {memory:.0} MiB; state afterwards `{state}`",
            ms(gap),
            ms(late)
        ),
        is_met: excess <= 5.0 && memory - memory_before < 20.0 && state == "ready",
    }])
}

/// Returns a process and its children.
fn with_children(id: u32) -> Vec<u32> {
    let children = std::fs::read_to_string(format!("/proc/{id}/task/{id}/children")).unwrap_or_default();
    let mut all = vec![id];
    all.extend(children.split_whitespace().filter_map(|id| id.parse::<u32>().ok()));
    all
}

/// Returns the UDP ports of processes.
pub fn udp_ports(ids: &[u32]) -> Vec<u16> {
    let table = std::fs::read_to_string("/proc/net/udp").unwrap_or_default();
    let sockets: Vec<String> = ids
        .iter()
        .filter_map(|id| std::fs::read_dir(format!("/proc/{id}/fd")).ok())
        .flatten()
        .filter_map(|fd| Some(std::fs::read_link(fd.ok()?.path()).ok()?.display().to_string()))
        .collect();
    let port = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let socket = format!("socket:[{}]", words.get(9)?);
        let port = u16::from_str_radix(words.get(1)?.split_once(':')?.1, 16).ok()?;
        sockets.contains(&socket).then_some(port)
    };
    table.lines().filter_map(port).collect()
}

/// Returns the id of the writer of the robot's states, as everybody on the network sees it.
pub fn writer_of_states(domain: u16) -> Result<[u8; 16], String> {
    use twinstep_robot::dds::{Dds, LOW_STATE};
    let dds = Dds::join(domain, [127, 0, 0, 1].into()).map_err(|error| error.to_string())?;
    let reader = dds.reader(LOW_STATE, std::thread::current()).map_err(|error| error.to_string())?;
    let since = Instant::now();
    while since.elapsed() < Duration::from_secs(10) {
        if let Some((_, writer)) = reader.take_with_writer() {
            return Ok(writer);
        }
        std::thread::park_timeout(Duration::from_millis(50));
    }
    Err("no state arrives".to_owned())
}

/// Returns a packet: HEARTBEAT, GAP, ACKNACK, DATA_FRAG or DATA with numbers of any size, or random bytes. Most are in the name of
/// the writer, to any reader.
fn packet(writer: &[u8; 16], random: &mut Stream) -> Vec<u8> {
    let mut bytes = b"RTPS\x02\x04\x01\x12".to_vec();
    if random.random_bool(0.9) {
        bytes.extend(&writer[..12]);
    } else {
        (0..12).for_each(|_| bytes.push(random.next_u32() as u8));
    }
    debug_assert_eq!(bytes.len(), HEADER);
    // Built-in writers: participants, publications, subscriptions.
    let ids = [[0, 1, 0, 0xc2], [0, 0, 3, 0xc2], [0, 0, 4, 0xc2], [writer[12], writer[13], writer[14], writer[15]]];
    let id = ids[random.random_range(0..ids.len())];
    let mut number = || {
        let large = [0, 1, 2, 255, 256, 257, 1 << 20, 1 << 31, 1 << 40, 1 << 60, (1 << 62) + 1, i64::MAX, -1];
        let value = large[random.random_range(0..large.len())].wrapping_add(random.random_range(0..3));
        [((value >> 32) as u32).to_le_bytes(), (value as u32).to_le_bytes()].concat()
    };
    let [one, other] = [number(), number()];
    let kind = random.random_range(0..6);
    let (code, body) = match kind {
        0 => (0x07, [&[0; 4], &id[..], &one, &other, &random.next_u32().to_le_bytes()].concat()),
        1 => (0x08, [&[0; 4], &id[..], &one, &other, &[0; 4]].concat()),
        2 => (0x06, [&[0; 4], &id[..], &one, &256_u32.to_le_bytes(), &[255; 32], &[1, 0, 0, 0]].concat()),
        3 => {
            let sizes: [u32; 3] = [random.next_u32(), 1 << 30, 60_000];
            let size = sizes[random.random_range(0..3)].to_le_bytes();
            let fragment = [&[1, 0, 0, 0][..], &[1, 0], &1024_u16.to_le_bytes(), &size].concat();
            (0x16, [&[0, 0, 28, 0], &[0; 4], &id[..], &one, &fragment, &[7; 64]].concat())
        }
        4 => (0x15, [&[0, 0, 16, 0], &[0; 4], &id[..], &one, &[0, 1, 0, 0], &[9; 40]].concat()),
        _ => (random.next_u32() as u8, (0..random.random_range(0..200)).map(|_| random.next_u32() as u8).collect()),
    };
    bytes.extend([code, 0b101]);
    bytes.extend((body.len() as u16).to_le_bytes());
    bytes.extend(body);
    bytes
}
