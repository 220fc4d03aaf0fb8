//! A TCP proxy between a client and its endpoint that can delay all messages, or stop those to the client.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

use socket2::{Domain, Socket, Type};

/// Size of the receive buffer of a connection to the target [bytes].
const RECEIVE_BUFFER: usize = 256 << 10;

/// A proxy that forwards every connection until the process exits.
pub struct Proxy {
    /// Endpoint on which it listens.
    pub endpoint: String,
    held_until: Arc<Mutex<Instant>>,
    replies_stopped: Arc<AtomicBool>,
}

impl Proxy {
    /// Listens on a free port for `target`, a Zenoh endpoint such as `tcp/127.0.0.1:7447`.
    pub fn start(target: &str) -> Result<Self, String> {
        let text = |error: std::io::Error| format!("proxy to {target}: {error}");
        let target = target.trim_start_matches("tcp/").to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").map_err(text)?;
        let endpoint = format!("tcp/{}", listener.local_addr().map_err(text)?);
        let held_until = Arc::new(Mutex::new(Instant::now()));
        let replies_stopped = Arc::new(AtomicBool::new(false));
        let (held, stopped) = (Arc::clone(&held_until), Arc::clone(&replies_stopped));
        spawn(move || {
            for client in listener.incoming().flatten() {
                // If the target does not accept, the client's connection is closed.
                let Ok(server) = connect(&target) else { continue };
                let never = Arc::new(AtomicBool::new(false));
                let both =
                    [(client.try_clone(), server.try_clone(), never), (Ok(server), Ok(client), Arc::clone(&stopped))];
                for (from, to, stopped) in both {
                    let (Ok(from), Ok(to)) = (from, to) else { continue };
                    let held = Arc::clone(&held);
                    spawn(move || forward(from, to, &held, &stopped));
                }
            }
        });
        Ok(Self { endpoint, held_until, replies_stopped })
    }

    /// Delays all messages for `pause` and returns after it.
    pub fn hold(&self, pause: Duration) {
        *self.held_until.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now() + pause;
        sleep(pause);
    }

    /// From now on reads nothing from the target, like a client that reads no replies. Requests are still forwarded.
    pub fn stop_replies(&self) {
        self.replies_stopped.store(true, Ordering::Relaxed);
    }
}

/// Connects with a small receive buffer, so that a target whose messages are not read notices it soon.
fn connect(target: &str) -> std::io::Result<TcpStream> {
    let address: SocketAddr = target.parse().map_err(std::io::Error::other)?;
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
    socket.set_recv_buffer_size(RECEIVE_BUFFER)?;
    socket.connect(&address.into())?;
    Ok(socket.into())
}

fn forward(mut from: TcpStream, mut to: TcpStream, held_until: &Mutex<Instant>, stopped: &AtomicBool) {
    let mut buffer = vec![0; 65536];
    // Nagle's algorithm would delay small messages.
    let _ = to.set_nodelay(true);
    while let Ok(length @ 1..) = from.read(&mut buffer) {
        let delay = held_until.lock().unwrap_or_else(PoisonError::into_inner).duration_since(Instant::now());
        sleep(delay);
        while stopped.load(Ordering::Relaxed) {
            sleep(Duration::from_millis(10));
        }
        if to.write_all(&buffer[..length]).is_err() {
            break;
        }
    }
    // If one end closes, both directions are closed.
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}
