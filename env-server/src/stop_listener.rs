//! Stops a robot over a connection of its own, beside Zenoh: a stop waits for no other request and for no link of a client.
//!
//! Each connection has a thread. Of too many, the oldest of the address that has most of them is closed: those who connect and
//! say nothing, or say it slowly, keep nobody else out.

use std::collections::{HashMap, VecDeque};
use std::io::{Read, Result, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::WebPkiClientVerifier;
use rustls::{RootCertStore, ServerConfig, ServerConnection, StreamOwned};
use twinstep_protocol::stop_channel::{Greeting, REFUSED, STOPPED, is_valid, rest_of_answer};

use crate::EnvFactory;

/// Time after which a connection is closed that says nothing.
const TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum number of connections.
const MAX_CONNECTIONS: usize = 64;

/// Who may stop the robot.
struct Access {
    /// Password of each user; `None` if everybody who connects may.
    users: Option<HashMap<String, String>>,
    tls: Option<Arc<ServerConfig>>,
}

/// A listening stop channel.
pub struct StopListener {
    address: SocketAddr,
    is_stopping: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl StopListener {
    /// Listens at the host of Zenoh's `endpoint`, at the port after `port`, which Zenoh has, with the users and certificates of
    /// `zenoh`. If the endpoint leaves the port to the system, so may this one: then only `hello` says where it listens.
    pub fn start(
        endpoint: &str,
        port: Option<u16>,
        zenoh: &zenoh::Config,
        factory: Arc<dyn EnvFactory>,
    ) -> Result<Self> {
        let (protocol, host) = protocol_and_host(endpoint);
        let next = port.and_then(|port| port.checked_add(1)).unwrap_or(0);
        let is_free = self::port(endpoint).is_none_or(|port| port == 0);
        let listener = match TcpListener::bind((host, next)) {
            Err(_) if is_free => TcpListener::bind((host, 0))?,
            result => result.map_err(|error| failed(format!("port {next}: {error}")))?,
        };
        let access = Arc::new(Access::new(protocol, zenoh)?);
        let (address, is_stopping) = (listener.local_addr()?, Arc::new(AtomicBool::new(false)));
        let stopping = Arc::clone(&is_stopping);
        let thread = std::thread::Builder::new().name("stop-listener".to_owned());
        let thread = thread.spawn(move || listen(&listener, &access, &factory, &stopping))?;
        Ok(Self { address, is_stopping, thread })
    }

    /// Returns the port.
    pub fn port(&self) -> u16 {
        self.address.port()
    }

    /// Ends the thread.
    pub fn end(self) {
        self.is_stopping.store(true, Ordering::Release);
        // Wakes it.
        let host = if self.address.ip().is_unspecified() { IpAddr::from([127, 0, 0, 1]) } else { self.address.ip() };
        if TcpStream::connect_timeout(&(host, self.address.port()).into(), TIMEOUT).is_ok() {
            let _ = self.thread.join();
        }
    }
}

fn listen(listener: &TcpListener, access: &Arc<Access>, factory: &Arc<dyn EnvFactory>, is_stopping: &AtomicBool) {
    let mut connections: VecDeque<(TcpStream, JoinHandle<()>)> = VecDeque::new();
    for stream in listener.incoming() {
        if is_stopping.load(Ordering::Acquire) {
            return;
        }
        connections.retain(|(_, thread)| !thread.is_finished());
        while connections.len() >= MAX_CONNECTIONS
            && let Some((stream, _)) = most_frequent(&connections).and_then(|index| connections.remove(index))
        {
            let _ = stream.shutdown(Shutdown::Both);
        }
        let Ok(stream) = stream else { continue };
        let Ok(kept) = stream.try_clone() else { continue };
        let (access, factory) = (Arc::clone(access), Arc::clone(factory));
        let serve = move || {
            if let Err(error) = serve(stream, &access, &factory) {
                tracing::debug!(%error, "a connection of the stop channel ended");
            }
        };
        match std::thread::Builder::new().name("stop".to_owned()).spawn(serve) {
            Ok(thread) => connections.push_back((kept, thread)),
            Err(error) => tracing::warn!(%error, "cannot start a thread of the stop channel"),
        }
    }
}

/// Returns the oldest connection of the address that has most of them.
fn most_frequent(connections: &VecDeque<(TcpStream, JoinHandle<()>)>) -> Option<usize> {
    let addresses: Vec<Option<IpAddr>> =
        connections.iter().map(|(stream, _)| stream.peer_addr().ok().map(|address| address.ip())).collect();
    oldest_of_most(&addresses)
}

/// Returns the first index of the entry that is there most often.
fn oldest_of_most<T: PartialEq>(entries: &[T]) -> Option<usize> {
    let count = |index: &usize| entries.iter().filter(|entry| **entry == entries[*index]).count();
    (0..entries.len()).rev().max_by_key(count)
}

/// Returns protocol and host of a Zenoh endpoint, such as `tcp/[::]:7447`.
fn protocol_and_host(endpoint: &str) -> (&str, &str) {
    let endpoint = endpoint.split(['?', '#']).next().unwrap_or(endpoint);
    let (protocol, address) = endpoint.split_once('/').unwrap_or(("tcp", endpoint));
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    (protocol, host.trim_matches(['[', ']']))
}

/// Returns the port of a Zenoh endpoint.
pub fn port(endpoint: &str) -> Option<u16> {
    let endpoint = endpoint.split(['?', '#']).next().unwrap_or(endpoint);
    endpoint.rsplit_once(':').and_then(|(_, port)| port.parse().ok())
}

fn serve(stream: TcpStream, access: &Access, factory: &Arc<dyn EnvFactory>) -> Result<()> {
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.set_write_timeout(Some(TIMEOUT))?;
    stream.set_nodelay(true)?;
    match &access.tls {
        Some(config) => {
            let connection = ServerConnection::new(Arc::clone(config)).map_err(failed)?;
            converse(&mut StreamOwned::new(connection, stream), access, factory)
        }
        None => converse(&mut &stream, access, factory),
    }
}

fn converse(stream: &mut (impl Read + Write), access: &Access, factory: &Arc<dyn EnvFactory>) -> Result<()> {
    let greeting = Greeting::random();
    stream.write_all(&greeting.encode())?;
    stream.flush()?;
    let mut first = [0];
    stream.read_exact(&mut first)?;
    let Some(len) = rest_of_answer(first[0]) else { return stream.write_all(&[REFUSED]) };
    let mut rest = vec![0; len];
    stream.read_exact(&mut rest)?;
    let password = |user: &str| match &access.users {
        Some(users) => users.get(user).cloned(),
        None => Some(String::new()),
    };
    // Without users every code is accepted: nobody else can connect.
    let is_stopped = (access.users.is_none() || is_valid(greeting, &rest, password)) && factory.stop();
    stream.write_all(&[if is_stopped { STOPPED } else { REFUSED }])?;
    stream.flush()
}

impl Access {
    fn new(protocol: &str, zenoh: &zenoh::Config) -> Result<Self> {
        let setting = |key: &str| {
            let json = zenoh.get_json(key).unwrap_or_default();
            serde_json::from_str::<Option<String>>(&json).ok().flatten().filter(|text| !text.is_empty())
        };
        let users = setting("transport/auth/usrpwd/dictionary_file").map(read_users).transpose()?;
        let is_encrypted = matches!(protocol, "tls" | "quic");
        let needs_certificate = zenoh.get_json("transport/link/tls/enable_mtls").is_ok_and(|value| value == "true");
        let tls =
            is_encrypted.then(|| tls_config(&|key| setting(&format!("transport/link/tls/{key}")), needs_certificate));
        Ok(Self { users, tls: tls.transpose()? })
    }
}

/// Reads lines `user:password`.
fn read_users(path: String) -> Result<HashMap<String, String>> {
    let text = std::fs::read_to_string(path)?;
    let users = text.lines().filter_map(|line| line.trim().split_once(':'));
    Ok(users.map(|(user, password)| (user.to_owned(), password.to_owned())).collect())
}

/// Returns the TLS settings of Zenoh's listener.
fn tls_config(setting: &dyn Fn(&str) -> Option<String>, needs_certificate: bool) -> Result<Arc<ServerConfig>> {
    let file = |key: &str| setting(key).ok_or_else(|| failed(format!("`transport/link/tls/{key}` is not set")));
    let certificates = |path: &Path| {
        let read = CertificateDer::pem_file_iter(path).map_err(failed)?;
        read.collect::<std::result::Result<Vec<_>, _>>().map_err(failed)
    };
    let own = certificates(file("listen_certificate")?.as_ref())?;
    let key = PrivateKeyDer::from_pem_file(file("listen_private_key")?).map_err(failed)?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ServerConfig::builder_with_provider(Arc::clone(&provider));
    let builder = builder.with_safe_default_protocol_versions().map_err(failed)?;
    let builder = if needs_certificate {
        let mut roots = RootCertStore::empty();
        for root in certificates(file("root_ca_certificate")?.as_ref())? {
            roots.add(root).map_err(failed)?;
        }
        let verifier = WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider).build();
        builder.with_client_cert_verifier(verifier.map_err(failed)?)
    } else {
        builder.with_no_client_auth()
    };
    builder.with_single_cert(own, key).map(Arc::new).map_err(failed)
}

/// Returns an error of TLS, of a file or of the other side.
fn failed(cause: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> std::io::Error {
    std::io::Error::other(cause)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoint_has_protocol_host_and_port() {
        for (endpoint, expected) in [
            ("tcp/0.0.0.0:7447", ("tcp", "0.0.0.0", Some(7447))),
            ("tls/[::]:7450", ("tls", "::", Some(7450))),
            ("tcp/robot.local:7447#iface=eth0", ("tcp", "robot.local", Some(7447))),
            ("tcp/localhost", ("tcp", "localhost", None)),
        ] {
            let (protocol, host) = protocol_and_host(endpoint);
            assert_eq!((protocol, host, port(endpoint)), expected);
        }
    }

    #[test]
    fn connection_of_who_has_most_is_closed_first_and_the_oldest_of_those() {
        assert_eq!(oldest_of_most(&["a", "b", "b", "c", "b"]), Some(1));
        assert_eq!(oldest_of_most(&["a", "b"]), Some(0));
        assert_eq!(oldest_of_most::<u8>(&[]), None);
    }
}
