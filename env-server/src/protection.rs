//! Who can reach a robot.

use std::net::IpAddr;

use crate::ServerConfig;

/// Protocols that check passwords, and those that check certificates too.
const PROTOCOLS: [&str; 3] = ["tcp", "tls", "quic"];
const WITH_CERTIFICATES: [&str; 2] = ["tls", "quic"];

/// An endpoint at which others could command a robot.
pub struct Exposed {
    /// Key of the config file.
    pub field: &'static str,
    /// The endpoint.
    pub endpoint: String,
    /// What is missing.
    pub reason: &'static str,
}

/// Checks each endpoint: only this machine, or somebody with a password or a certificate, can command a robot.
pub fn check_protection(config: &ServerConfig, zenoh: &zenoh::Config) -> Result<(), Exposed> {
    let setting = |key: &str| zenoh.get_json(key).unwrap_or_default();
    let has_users = !matches!(setting("transport/auth/usrpwd/dictionary_file").as_str(), "" | "null");
    let has_certificates = setting("transport/link/tls/enable_mtls") == "true";
    let endpoints = std::iter::once(("listen", &config.listen)).chain(config.connect.iter().map(|to| ("connect", to)));
    for (field, endpoint) in endpoints {
        // Passwords are asked for by who accepts a connection: a router may let everybody in.
        if let Some(reason) = exposure(endpoint, has_users && field == "listen", has_certificates) {
            return Err(Exposed { field, endpoint: endpoint.clone(), reason });
        }
    }
    Ok(())
}

/// Returns why others could command the robot at an endpoint, or `None` if they cannot.
fn exposure(endpoint: &str, has_users: bool, has_certificates: bool) -> Option<&'static str> {
    let (protocol, address) = endpoint.split_once('/').unwrap_or(("", endpoint));
    if !PROTOCOLS.contains(&protocol) {
        return Some("this protocol has no protection for a robot: use tcp/, tls/ or quic/");
    }
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
    let is_loopback = host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback());
    if is_loopback || has_users || (has_certificates && WITH_CERTIFICATES.contains(&protocol)) {
        return None;
    }
    Some(
        "everybody in this network could move the robot: use a loopback address, or set users and passwords, or tls/ with \
         client certificates in a Zenoh file (`--zenoh`, examples/security)",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoint_is_protected_by_what_its_own_protocol_checks() {
        for (endpoint, users, certificates, is_protected) in [
            ("tcp/127.0.0.1:7447", false, false, true),
            ("tcp/[::1]:7447", false, false, true),
            ("tcp/localhost:7447", false, false, true),
            ("tcp/0.0.0.0:7447", false, false, false),
            ("tcp/0.0.0.0:7447", false, true, false),
            ("tcp/0.0.0.0:7447", true, false, true),
            ("tls/0.0.0.0:7447", false, false, false),
            ("tls/0.0.0.0:7447", false, true, true),
            ("quic/192.168.1.4:7447", false, true, true),
            ("tcp/localhost.example.com:7447", false, false, false),
            ("udp/127.0.0.1:7447", true, true, false),
            ("serial//dev/ttyS0", true, true, false),
            ("127.0.0.1:7447", true, true, false),
        ] {
            assert_eq!(exposure(endpoint, users, certificates).is_none(), is_protected, "{endpoint}");
        }
    }
}
