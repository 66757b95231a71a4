//! Endpoints of routers: `tcp/HOST:PORT` and `quic/HOST:PORT`.

use std::fmt;
use std::net::IpAddr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::BusError;

const TCP: &str = "tcp/";
const QUIC: &str = "quic/";

/// A checked zenoh endpoint: `tcp/HOST:PORT`, or `quic/HOST:PORT` if both ends have keys.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoint(String);

protocol::written_as_text!(Endpoint);

impl Endpoint {
    /// The endpoint on this machine's loopback at `port`.
    pub fn loopback(port: u16) -> Self {
        Self(format!("tcp/127.0.0.1:{port}"))
    }

    /// True if the address is one of the loopback.
    pub fn is_loopback(&self) -> bool {
        let host = self.address().rsplit_once(':').map_or("", |(host, _)| host);
        let ip = host
            .trim_start_matches('[')
            .trim_end_matches(']')
            .parse::<IpAddr>();
        host == "localhost" || ip.is_ok_and(|ip| ip.is_loopback())
    }

    /// The same address over QUIC with keys. A process with keys never falls back to plain TCP.
    pub fn secured(&self) -> Self {
        Self(format!("{QUIC}{}", self.address()))
    }

    /// True if the endpoint requires keys.
    pub fn is_secured(&self) -> bool {
        self.0.starts_with(QUIC)
    }

    /// The endpoint as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    /// The endpoint in zenoh's form. Over QUIC all messages use one stream and arrive in the order in which they were
    /// sent, as over TCP: with a stream per priority a flush would not cover messages of other priorities.
    pub(super) fn for_zenoh(&self) -> String {
        if self.is_secured() {
            format!("{}?multistream=0", self.0)
        } else {
            self.0.clone()
        }
    }

    /// `HOST:PORT`.
    pub(super) fn address(&self) -> &str {
        // Checked by the constructor.
        self.0.split_once('/').map_or("", |(_, address)| address)
    }
}

fn is_endpoint(text: &str) -> bool {
    let address = text.strip_prefix(TCP).or_else(|| text.strip_prefix(QUIC));
    // From the right: an IPv6 host has colons of its own.
    let Some((host, port)) = address.and_then(|address| address.rsplit_once(':')) else {
        return false;
    };
    let bracketed = host.starts_with('[') && host.ends_with(']');
    let is_clean = host.chars().all(|c| {
        c.is_ascii_alphanumeric() || ".-_".contains(c) || (bracketed && "[]:%".contains(c))
    });
    is_clean && !host.is_empty() && port.parse::<u16>().is_ok()
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::str::FromStr for Endpoint {
    type Err = BusError;

    /// Parses `tcp/HOST:PORT` or `quic/HOST:PORT`; IPv6 hosts are in brackets.
    ///
    /// # Errors
    /// [`BusError::Endpoint`] states the text that is not an endpoint.
    fn from_str(text: &str) -> Result<Self, BusError> {
        if !is_endpoint(text) {
            return Err(BusError::Endpoint(text.chars().take(100).collect()));
        }
        Ok(Self(text.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopbacks_are_recognised() {
        for text in [
            "tcp/127.0.0.1:1",
            "quic/127.1.2.3:1",
            "tcp/[::1]:1",
            "tcp/localhost:1",
        ] {
            assert!(text.parse::<Endpoint>().unwrap().is_loopback(), "{text}");
        }
        for text in [
            "tcp/0.0.0.0:1",
            "tcp/10.0.0.1:1",
            "tcp/[::]:1",
            "tcp/router.local:1",
        ] {
            assert!(!text.parse::<Endpoint>().unwrap().is_loopback(), "{text}");
        }
    }

    #[test]
    fn reads_endpoints() {
        for text in [
            "tcp/127.0.0.1:7447",
            "tcp/[::1]:7447",
            "tcp/router.local:1",
            "quic/router.local:1",
        ] {
            assert_eq!(text.parse::<Endpoint>().unwrap().as_str(), text);
        }
        for text in [
            "",
            "127.0.0.1:7447",
            "tcp/:1",
            "tcp/host",
            "tcp/host:70000",
            "udp/host:1",
            "tls/host:1",
            "tcp/a b:1",
            "tcp/::1:1",
        ] {
            let error = text.parse::<Endpoint>().unwrap_err();
            assert!(
                error.to_string().contains("tcp/HOST:PORT"),
                "{text}: {error}"
            );
        }
    }
}
