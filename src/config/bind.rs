//! The address to listen on, as people write it.

use std::net::{IpAddr, SocketAddr, ToSocketAddrs};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serializer};

use super::{DEFAULT_ADMIN_PORT, DEFAULT_PORT};

/// Reads `HOST:PORT` or `HOST`. Errors: text that is neither, or a host name that cannot be resolved.
pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<SocketAddr, D::Error> {
    let text = String::deserialize(deserializer)?;
    resolve(&text, DEFAULT_PORT).ok_or_else(|| D::Error::custom("not HOST:PORT"))
}

/// The text for no address.
const OFF: &str = "off";

/// Reads `HOST:PORT`, `HOST` or `off`. Errors: other text, or a host name that cannot be resolved.
pub(super) fn deserialize_or_off<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<SocketAddr>, D::Error> {
    let text = String::deserialize(deserializer)?;
    if text == OFF {
        return Ok(None);
    }
    let address = resolve(&text, DEFAULT_ADMIN_PORT);
    Ok(Some(
        address.ok_or_else(|| D::Error::custom("neither HOST:PORT nor off"))?,
    ))
}

/// Writes what [`deserialize_or_off`] reads.
#[expect(clippy::ref_option, reason = "serde passes a reference to the field")]
pub(super) fn serialize_or_off<S: Serializer>(address: &Option<SocketAddr>, serializer: S) -> Result<S::Ok, S::Error> {
    match address {
        Some(address) => serializer.collect_str(address),
        None => serializer.serialize_str(OFF),
    }
}

/// The address of a host name or an IP address, with or without a port. Of several addresses, the first IPv4 address:
/// clients that know only 127.0.0.1 then reach `localhost` too.
fn resolve(text: &str, default_port: u16) -> Option<SocketAddr> {
    if let Ok(ip) = text.parse::<IpAddr>() {
        return Some(SocketAddr::new(ip, default_port));
    }
    let found = if text.contains(':') {
        text.to_socket_addrs()
    } else {
        (text, default_port).to_socket_addrs()
    };
    let addresses: Vec<SocketAddr> = found.ok()?.collect();
    let first_ipv4 = addresses.iter().find(|address| address.is_ipv4());
    first_ipv4.or_else(|| addresses.first()).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_is_an_address_or_a_name_with_or_without_port() {
        for (text, address) in [
            ("127.0.0.1:9000", "127.0.0.1:9000"),
            ("localhost:9000", "127.0.0.1:9000"),
            ("0.0.0.0", "0.0.0.0:8642"),
            ("::1", "[::1]:8642"),
            ("[::1]:9000", "[::1]:9000"),
        ] {
            assert_eq!(resolve(text, DEFAULT_PORT), Some(address.parse().unwrap()), "{text}");
        }
    }

    #[test]
    fn what_is_no_host_and_port_is_refused() {
        for text in ["", "localhost:http", "localhost:99999", ":8642:"] {
            assert_eq!(resolve(text, DEFAULT_PORT), None, "{text}");
        }
    }
}
