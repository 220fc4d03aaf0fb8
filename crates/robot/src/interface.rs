//! The network interface to the robot.

use std::net::IpAddr;

/// The interface cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InterfaceError {
    /// There is no such interface.
    #[error("`--interface` = {name} does not exist; there are: {known}. The robot's network is 192.168.123.0/24")]
    Unknown {
        /// Name or address that was given.
        name: String,
        /// Names and addresses of all interfaces.
        known: String,
    },
    /// The interface has no IPv4 address.
    #[error(
        "`--interface` = {name} has no IPv4 address: connect the cable and set one in the robot's network, such as \
         192.168.123.222/24"
    )]
    NoAddress {
        /// Name of the interface.
        name: String,
    },
}

/// Returns the IPv4 address of the interface with this name or address.
pub fn interface_address(name: &str) -> Result<IpAddr, InterfaceError> {
    let interfaces: Vec<(String, Vec<IpAddr>)> = netdev::get_interfaces()
        .into_iter()
        .map(|interface| (interface.name, interface.ipv4.iter().map(|net| IpAddr::V4(net.addr())).collect()))
        .collect();
    find(name, &interfaces)
}

fn find(name: &str, interfaces: &[(String, Vec<IpAddr>)]) -> Result<IpAddr, InterfaceError> {
    let address: Option<IpAddr> = name.parse().ok();
    let found = interfaces
        .iter()
        .find(|(own, addresses)| own == name || address.is_some_and(|address| addresses.contains(&address)));
    let Some((_, addresses)) = found else {
        let text = |(name, addresses): &(String, Vec<IpAddr>)| {
            let addresses: Vec<String> = addresses.iter().map(ToString::to_string).collect();
            format!("{name} ({})", if addresses.is_empty() { "no address".to_owned() } else { addresses.join(", ") })
        };
        let known = interfaces.iter().map(text).collect::<Vec<_>>().join(", ");
        return Err(InterfaceError::Unknown { name: name.to_owned(), known });
    };
    address.or(addresses.first().copied()).ok_or_else(|| InterfaceError::NoAddress { name: name.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interface_is_found_by_name_and_by_address() {
        let address: IpAddr = "192.168.123.222".parse().expect("an address");
        let interfaces = [
            ("lo".to_owned(), vec!["127.0.0.1".parse().expect("an address")]),
            ("eth0".to_owned(), vec![address]),
            ("wlan0".to_owned(), vec![]),
        ];
        assert_eq!(find("eth0", &interfaces), Ok(address));
        assert_eq!(find("192.168.123.222", &interfaces), Ok(address));
        assert_eq!(find("wlan0", &interfaces), Err(InterfaceError::NoAddress { name: "wlan0".to_owned() }));
        let unknown = find("eth9", &interfaces).expect_err("no such interface").to_string();
        assert!(
            unknown.contains("eth9") && unknown.contains("eth0 (192.168.123.222), wlan0 (no address)"),
            "{unknown}"
        );
        assert!(find("10.0.0.1", &interfaces).is_err());
    }

    #[test]
    fn loopback_of_this_machine_is_found() {
        assert!(interface_address("127.0.0.1").expect("every machine has one").is_loopback());
    }
}
