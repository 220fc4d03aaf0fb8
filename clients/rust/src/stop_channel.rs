//! Stops a robot over its stop channel, beside Zenoh.

use std::io::{Read, Result, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};
use twinstep_protocol::stop_channel::{GREETING_BYTES, Greeting, STOPPED, answer};

/// Time in which a robot answers.
const TIMEOUT: Duration = Duration::from_secs(1);

/// Damps the motors of the robot whose Zenoh endpoint is `endpoint`, with user and certificates of the Zenoh file.
///
/// `port` is that of `hello`. Default: the port after that of the endpoint.
pub fn stop_robot(endpoint: &str, port: Option<u16>, zenoh: Option<&Path>) -> Result<()> {
    let (protocol, address) = endpoint.split_once('/').unwrap_or(("tcp", endpoint));
    let (host, zenoh_port) = address.rsplit_once(':').ok_or_else(|| failed("the endpoint has no port"))?;
    let next = zenoh_port.parse().ok().and_then(|port: u16| port.checked_add(1));
    let port = port.or(next).ok_or_else(|| failed("the endpoint has no port"))?;
    let host = host.trim_matches(['[', ']']);
    let config = zenoh
        .map_or_else(|| Ok(zenoh::Config::default()), zenoh::Config::from_file)
        .map_err(|error| failed(error.to_string()))?;
    let setting = |key: &str| {
        let json = config.get_json(key).unwrap_or_default();
        serde_json::from_str::<Option<String>>(&json).ok().flatten()
    };
    let address = (host, port).to_socket_addrs()?.next().ok_or_else(|| failed("the host has no address"))?;
    let stream = TcpStream::connect_timeout(&address, TIMEOUT)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.set_write_timeout(Some(TIMEOUT))?;
    stream.set_nodelay(true)?;
    let user = setting("transport/auth/usrpwd/user").unwrap_or_default();
    let password = setting("transport/auth/usrpwd/password").unwrap_or_default();
    if matches!(protocol, "tls" | "quic") {
        let name = ServerName::try_from(host.to_owned()).map_err(failed)?;
        let config = tls_config(&|key| setting(&format!("transport/link/tls/{key}")))?;
        let connection = ClientConnection::new(config, name).map_err(failed)?;
        converse(&mut StreamOwned::new(connection, stream), &user, &password)
    } else {
        converse(&mut &stream, &user, &password)
    }
}

fn converse(stream: &mut (impl Read + Write), user: &str, password: &str) -> Result<()> {
    let mut greeting = [0; GREETING_BYTES];
    stream.read_exact(&mut greeting)?;
    let greeting = Greeting::decode(&greeting).ok_or_else(|| failed("no robot listens at this port"))?;
    let answer = answer(greeting, user, password).ok_or_else(|| failed("the user's name is too long"))?;
    stream.write_all(&answer)?;
    stream.flush()?;
    let mut result = [0];
    stream.read_exact(&mut result)?;
    if result[0] == STOPPED { Ok(()) } else { Err(failed("the robot refuses user or password")) }
}

fn tls_config(setting: &dyn Fn(&str) -> Option<String>) -> Result<Arc<ClientConfig>> {
    let certificates = |path: String| {
        let read = CertificateDer::pem_file_iter(path).map_err(failed)?;
        read.collect::<std::result::Result<Vec<_>, _>>().map_err(failed)
    };
    let mut roots = RootCertStore::empty();
    for root in setting("root_ca_certificate").map_or_else(|| Ok(Vec::new()), certificates)? {
        roots.add(root).map_err(failed)?;
    }
    let builder = ClientConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()));
    let builder = builder.with_safe_default_protocol_versions().map_err(failed)?.with_root_certificates(roots);
    let config = match (setting("connect_certificate"), setting("connect_private_key")) {
        (Some(certificate), Some(key)) => {
            let key = PrivateKeyDer::from_pem_file(key).map_err(failed)?;
            builder.with_client_auth_cert(certificates(certificate)?, key).map_err(failed)?
        }
        _ => builder.with_no_client_auth(),
    };
    Ok(Arc::new(config))
}

/// Returns an error of TLS, of a file or of the other side.
fn failed(cause: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> std::io::Error {
    std::io::Error::other(cause)
}
