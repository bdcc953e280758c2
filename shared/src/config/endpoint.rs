//! Zenoh endpoints, such as `tls/10.0.0.1:7447`.

use std::net::IpAddr;

/// Returns true for `tcp/ADDRESS:PORT` and `tls/ADDRESS:PORT`.
#[must_use]
pub fn is_endpoint(text: &str) -> bool {
    parts(text).is_some_and(|(protocol, _)| ["tcp", "tls"].contains(&protocol))
}

/// Returns true if messages on this endpoint can cross a network unencrypted: any `tcp/` endpoint
/// that is not on loopback.
#[must_use]
pub fn is_plain(text: &str) -> bool {
    parts(text).is_some_and(|(protocol, host)| {
        let is_loopback = host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback());
        protocol == "tcp" && !is_loopback && host != "localhost"
    })
}

/// Splits an endpoint into protocol and host, without the port and Zenoh's options.
fn parts(text: &str) -> Option<(&str, &str)> {
    let (protocol, rest) = text.split_once('/')?;
    let address = rest.split(['?', '#']).next()?;
    let (host, _port) = address.rsplit_once(':')?;
    let inside = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
    Some((protocol, inside.unwrap_or(host)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_tcp_beyond_loopback_is_plain() {
        for endpoint in ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "tcp/learner:7447#iface=lo"] {
            assert!(is_endpoint(endpoint) && is_plain(endpoint), "{endpoint}");
        }
        for endpoint in
            ["tls/0.0.0.0:7447", "tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:7447"]
        {
            assert!(is_endpoint(endpoint) && !is_plain(endpoint), "{endpoint}");
        }
        assert!(is_plain("tcp/127.0.0.1.example.org:7447"));
        for other in ["10.0.0.1:7447", "udp/10.0.0.1:7447", "tcp/10.0.0.1"] {
            assert!(!is_endpoint(other), "{other}");
        }
    }
}
