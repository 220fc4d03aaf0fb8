//! A TCP proxy between a client and its endpoint that can delay messages and close connections.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{sleep, spawn};
use std::time::{Duration, Instant};

use socket2::{Domain, Socket, Type};

/// Size of the receive buffer of a connection to the target [bytes].
const RECEIVE_BUFFER: usize = 256 << 10;

/// Time after which a paused direction checks whether it may continue.
const TICK: Duration = Duration::from_millis(20);

/// A proxy that forwards every connection until it is dropped.
pub struct Proxy {
    /// Endpoint on which it listens.
    pub endpoint: String,
    state: Arc<State>,
}

struct State {
    held_until: Mutex<Instant>,
    replies_held_until: Mutex<Instant>,
    /// Both ends of the open connections.
    connections: Mutex<Vec<TcpStream>>,
    is_closed: AtomicBool,
}

impl Proxy {
    /// Listens on a free port for `target`, a Zenoh endpoint such as `tcp/127.0.0.1:7447`.
    pub fn start(target: &str) -> Result<Self, String> {
        let text = |error: std::io::Error| format!("proxy to {target}: {error}");
        let target = target.trim_start_matches("tcp/").to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").map_err(text)?;
        let endpoint = format!("tcp/{}", listener.local_addr().map_err(text)?);
        let state = Arc::new(State {
            held_until: Mutex::new(Instant::now()),
            replies_held_until: Mutex::new(Instant::now()),
            connections: Mutex::default(),
            is_closed: AtomicBool::new(false),
        });
        let shared = Arc::clone(&state);
        spawn(move || {
            for client in listener.incoming().flatten() {
                if shared.is_closed.load(Ordering::Acquire) {
                    break;
                }
                // If the target does not accept, the client's connection is closed.
                if let Ok(server) = open(&target) {
                    connect(&client, &server, &shared);
                }
            }
        });
        Ok(Self { endpoint, state })
    }

    /// Delays all messages for `pause` and returns after it.
    pub fn hold(&self, pause: Duration) {
        *lock(&self.state.held_until) = Instant::now() + pause;
        sleep(pause);
    }

    /// Delays messages to the client for `pause`, as if it did not read, and returns at once.
    pub fn hold_replies(&self, pause: Duration) {
        *lock(&self.state.replies_held_until) = Instant::now() + pause;
    }

    /// Closes all connections. A client may connect again.
    pub fn cut(&self) {
        for connection in lock(&self.state.connections).drain(..) {
            // Fails if the other end was faster.
            let _ = connection.shutdown(Shutdown::Both);
        }
        *lock(&self.state.replies_held_until) = Instant::now();
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.state.is_closed.store(true, Ordering::Release);
        self.cut();
        // Wakes the thread that accepts connections.
        let _ = TcpStream::connect(self.endpoint.trim_start_matches("tcp/"));
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Connects with a small receive buffer, so that a target whose messages are not read notices it soon.
fn open(target: &str) -> std::io::Result<TcpStream> {
    let address: SocketAddr = target.parse().map_err(std::io::Error::other)?;
    let socket = Socket::new(Domain::for_address(address), Type::STREAM, None)?;
    socket.set_recv_buffer_size(RECEIVE_BUFFER)?;
    socket.connect(&address.into())?;
    Ok(socket.into())
}

/// Forwards both directions of a connection.
fn connect(client: &TcpStream, server: &TcpStream, state: &Arc<State>) {
    let copies = || Some([client.try_clone().ok()?, server.try_clone().ok()?]);
    let (Some([client, server]), Some([from_client, from_server]), Some(both)) = (copies(), copies(), copies()) else {
        return;
    };
    lock(&state.connections).extend(both);
    for (from, to, is_reply) in [(from_client, server, false), (from_server, client, true)] {
        let state = Arc::clone(state);
        spawn(move || forward(from, to, &state, is_reply));
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream, state: &State, is_reply: bool) {
    let mut buffer = vec![0; 65536];
    // Nagle's algorithm would delay small messages.
    let _ = to.set_nodelay(true);
    while let Ok(length @ 1..) = from.read(&mut buffer) {
        // The end of a pause can come earlier than it was set to.
        while Instant::now() < held_until(state, is_reply) {
            sleep(held_until(state, is_reply).duration_since(Instant::now()).min(TICK));
        }
        if to.write_all(&buffer[..length]).is_err() {
            break;
        }
    }
    // If one end closes, both directions are closed.
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}

fn held_until(state: &State, is_reply: bool) -> Instant {
    let held = *lock(&state.held_until);
    if is_reply { held.max(*lock(&state.replies_held_until)) } else { held }
}
