//! Packets in the name of the robot's writers, and the copies of other crates that withstand them.

use std::net::UdpSocket;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use twinstep_tests::python::{Programs, root};
use twinstep_tests::robot_pair::RobotPair;
use twinstep_tests::safety::memory_mib;
use twinstep_tests::safety::packets::{udp_ports, writer_of_states};

/// Ids of the writers of publications and of subscriptions, which every participant has, and of no built-in writer.
const BUILT_IN: [[u8; 4]; 2] = [[0, 0, 3, 0xc2], [0, 0, 4, 0xc2]];

/// Returns a packet of `writer` with one submessage.
fn packet(prefix: &[u8], code: u8, body: &[u8]) -> Vec<u8> {
    let mut bytes = [b"RTPS\x02\x04\x01\x12", prefix].concat();
    bytes.extend([code, 0b101]);
    bytes.extend((body.len() as u16).to_le_bytes());
    bytes.extend(body);
    bytes
}

fn number(value: i64) -> Vec<u8> {
    [((value >> 32) as u32).to_le_bytes(), (value as u32).to_le_bytes()].concat()
}

/// Returns HEARTBEAT, GAP and DATA_FRAG with ranges and sizes that would cost gigabytes.
fn attacks(writer: &[u8; 16]) -> Vec<Vec<u8>> {
    let own: [u8; 4] = writer[12..].try_into().unwrap();
    let mut packets = Vec::new();
    for id in [BUILT_IN[0], BUILT_IN[1], own] {
        for last in [100_000_000, 1_000_000_000_000_000, i64::MAX] {
            packets.push(packet(
                &writer[..12],
                7,
                &[&[0; 4], &id[..], &number(1), &number(last), &[9, 9, 9, 9]].concat(),
            ));
            packets.push(packet(&writer[..12], 8, &[&[0; 4], &id[..], &number(2), &number(last), &[0; 4]].concat()));
        }
        let fragment = [&[1, 0, 0, 0, 1, 0][..], &1024_u16.to_le_bytes(), &u32::MAX.to_le_bytes()].concat();
        for sequence in 1..40 {
            let head = [&[0, 0, 28, 0], &[0; 4], &id[..], &number(sequence)].concat();
            packets.push(packet(&writer[..12], 0x16, &[head, fragment.clone(), vec![7; 64]].concat()));
        }
    }
    packets
}

#[test]
fn robot_stands_on_through_packets_that_claim_endless_ranges() {
    let program = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap().twinstep();
    let mut pair = (0..3)
        .find_map(|_| {
            let mut pair = RobotPair::start(&program, &[], &[]).ok()?;
            pair.stand().ok().map(|()| pair)
        })
        .expect("one of three attempts");
    let writer = writer_of_states(pair.domain).unwrap();
    let ports = udp_ports(&[pair.robot.id()]);
    assert!(ports.len() >= 4, "{ports:?}");
    let before = memory_mib(pair.robot.id());
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    for packet in attacks(&writer) {
        for port in &ports {
            socket.send_to(&packet, ("127.0.0.1", *port)).unwrap();
        }
    }
    std::thread::sleep(Duration::from_secs(2));
    assert!(pair.state().starts_with("ready"), "{}", pair.state());
    let statistics = pair.ask("statistics").unwrap();
    assert!(statistics["largest_gap_ms"].as_u64().unwrap() < 100, "{statistics}");
    let after = memory_mib(pair.robot.id());
    assert!(after - before < 40.0, "{before} MiB before, {after} MiB after");
}

/// Runs git in `folder`.
fn git(folder: &Path, arguments: &[&str]) -> Result<(), String> {
    let output = Command::new("git").current_dir(folder).args(arguments).output().map_err(|error| error.to_string())?;
    if output.status.success() { Ok(()) } else { Err(String::from_utf8_lossy(&output.stderr).into_owned()) }
}

#[test]
fn copies_of_other_crates_differ_from_the_originals_by_their_patches() {
    for name in ["rustdds", "zenoh-link-tcp", "zenoh-link-tls"] {
        let folder = root().join("third_party").join(name);
        let copy = tempfile::tempdir().unwrap();
        let status = Command::new("cp").arg("-r").arg(folder.join("src")).arg(copy.path()).status().unwrap();
        assert!(status.success());
        let patches = std::fs::read_dir(folder.join("patches")).unwrap();
        let mut patches: Vec<_> = patches.map(|entry| entry.unwrap().path()).collect();
        patches.sort();
        // The last one was made last.
        for patch in patches.iter().rev() {
            let undone = git(copy.path(), &["apply", "-R", patch.to_str().unwrap()]);
            assert_eq!(undone, Ok(()), "{} does not describe third_party/{name}", patch.display());
        }
    }
}
