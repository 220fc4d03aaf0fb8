//! A TCP proxy between a client and what it connects to, which can hold every message back for a while.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

/// Forwards every connection until the process ends.
pub struct Proxy {
    /// Where it listens.
    pub endpoint: String,
    held_until: Arc<Mutex<Instant>>,
}

impl Proxy {
    /// Listens on a free port for `target`, a Zenoh endpoint such as `tcp/127.0.0.1:7447`.
    pub fn start(target: &str) -> Result<Self, String> {
        let text = |error: std::io::Error| format!("proxy to {target}: {error}");
        let target = target.trim_start_matches("tcp/").to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").map_err(text)?;
        let endpoint = format!("tcp/{}", listener.local_addr().map_err(text)?);
        let held_until = Arc::new(Mutex::new(Instant::now()));
        let held = Arc::clone(&held_until);
        spawn(move || {
            for client in listener.incoming().flatten() {
                // Nobody there: closing the client's connection says so.
                let Ok(server) = TcpStream::connect(&target) else { continue };
                for (from, to) in [(client.try_clone(), server.try_clone()), (Ok(server), Ok(client))] {
                    let (Ok(from), Ok(to)) = (from, to) else { continue };
                    let held = Arc::clone(&held);
                    spawn(move || forward(from, to, &held));
                }
            }
        });
        Ok(Self { endpoint, held_until })
    }

    /// Holds every message back for `pause`, and returns when it is over.
    pub fn hold(&self, pause: Duration) {
        *self.held_until.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now() + pause;
        sleep(pause);
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, held_until: &Mutex<Instant>) {
    let mut buffer = vec![0; 65536];
    // Small messages must not wait for each other.
    let _ = to.set_nodelay(true);
    while let Ok(length @ 1..) = from.read(&mut buffer) {
        let left = held_until.lock().unwrap_or_else(PoisonError::into_inner).duration_since(Instant::now());
        sleep(left);
        if to.write_all(&buffer[..length]).is_err() {
            break;
        }
    }
    // Either end's close closes both.
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}
