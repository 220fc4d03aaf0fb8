//! A TCP proxy between a client and its endpoint that can delay all messages.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

/// A proxy that forwards every connection until the process exits.
pub struct Proxy {
    /// Endpoint on which it listens.
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
                // If the target does not accept, the client's connection is closed.
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

    /// Delays all messages for `pause` and returns after it.
    pub fn hold(&self, pause: Duration) {
        *self.held_until.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now() + pause;
        sleep(pause);
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, held_until: &Mutex<Instant>) {
    let mut buffer = vec![0; 65536];
    // Nagle's algorithm would delay small messages.
    let _ = to.set_nodelay(true);
    while let Ok(length @ 1..) = from.read(&mut buffer) {
        let delay = held_until.lock().unwrap_or_else(PoisonError::into_inner).duration_since(Instant::now());
        sleep(delay);
        if to.write_all(&buffer[..length]).is_err() {
            break;
        }
    }
    // If one end closes, both directions are closed.
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}
