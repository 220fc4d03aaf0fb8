//! The Zenoh session of a client: its configuration, and why it cannot be opened.

use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use zenoh::Session;

use crate::error::Reachability;
use crate::{ClientError, ConnectOptions};

/// Pause between two attempts.
const RETRY_PERIOD: Duration = Duration::from_millis(200);
/// Timeout of the test whether a port accepts connections.
const PROBE_TIMEOUT: Duration = Duration::from_secs(1);

/// Opens a session, and tries again until `options.connect_timeout`.
pub fn open(options: &ConnectOptions) -> Result<Session, ClientError> {
    let since = Instant::now();
    loop {
        let config = zenoh_config(options)?;
        match twinstep_session::open(config) {
            Ok(session) => return Ok(session),
            Err(error) if since.elapsed() >= options.connect_timeout => {
                return Err(ClientError::NoServer {
                    endpoint: options.endpoint.clone(),
                    waited_s: since.elapsed().as_secs_f64(),
                    reason: twinstep_session::reason(&error),
                    reachability: reachability(&options.endpoint),
                });
            }
            Err(_) => std::thread::sleep(RETRY_PERIOD),
        }
    }
}

/// Returns how far a connection to the endpoint comes.
///
/// Distinguishes a server that rejects this client from an absent server and a wrong address.
fn reachability(endpoint: &str) -> Reachability {
    let (protocol, address) = endpoint.split_once('/').unwrap_or(("", endpoint));
    let address = address.split(['?', '#']).next().unwrap_or_default();
    if protocol.starts_with("unixsock") {
        let is_open = std::os::unix::net::UnixStream::connect(address).is_ok();
        return if is_open { Reachability::Open } else { Reachability::Closed };
    }
    if address.rsplit_once(':').is_none_or(|(_, port)| port.parse::<u16>().is_err()) {
        return Reachability::NoPort;
    }
    let Ok(mut addresses) = address.to_socket_addrs() else { return Reachability::UnknownHost };
    let is_open = addresses.any(|address| TcpStream::connect_timeout(&address, PROBE_TIMEOUT).is_ok());
    if is_open { Reachability::Open } else { Reachability::Closed }
}

fn zenoh_config(options: &ConnectOptions) -> Result<zenoh::Config, ClientError> {
    let invalid = |reason: String| ClientError::Config { path: options.zenoh.clone(), reason };
    let mut config = match &options.zenoh {
        Some(path) => zenoh::Config::from_file(path).map_err(|error| invalid(twinstep_session::reason(&error)))?,
        None => zenoh::Config::default(),
    };
    let endpoints = serde_json::json!([options.endpoint]).to_string();
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", endpoints.as_str()),
        ("scouting/multicast/enabled", "false"),
        ("transport/link/tx/lease", "2000"),
        // A step of 4096 robots is sent in twelve fragments. With Zenoh's default queue of two, the writing thread
        // waits for the sending thread after every second fragment. With its default buffer, the receiver allocates
        // each one.
        ("transport/link/tx/queue/size/data", "16"),
        ("transport/link/rx/buffer_size", "2097152"),
        // The connection to a restarted server or router is restored within 1 s instead of Zenoh's 4 s.
        ("connect/retry", "{period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2}"),
        ("transport/shared_memory/enabled", if options.shared_memory { "true" } else { "false" }),
    ] {
        config
            .insert_json5(key, value)
            .map_err(|error| invalid(format!("`{key}` = {value}: {}", twinstep_session::reason(&error))))?;
    }
    Ok(config)
}
