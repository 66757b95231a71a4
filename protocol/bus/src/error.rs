//! What goes wrong on the bus, in words that say what to do.

use std::path::PathBuf;

use serde_json::Value;

use super::endpoint::Endpoint;

/// Why the bus could not be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// Not an endpoint.
    #[error("{0:?} is not an endpoint: tcp/HOST:PORT, for example tcp/127.0.0.1:7447, or quic/HOST:PORT with keys")]
    Endpoint(String),
    /// Keys that are not there, or not right.
    #[error("{}: {what}", path.display())]
    Keys {
        /// The file or folder.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// An endpoint where only those with keys speak.
    #[error("{0} takes keys: name their folder (--keys DIR; v2vloc keys makes them)")]
    NoKeys(Endpoint),
    /// zenoh refused or changed a setting.
    #[error("zenoh setting {key}: wanted {wanted}, {found}")]
    Setting {
        /// The key of the configuration.
        key: &'static str,
        /// The value that was asked for.
        wanted: Value,
        /// What zenoh made of it.
        found: String,
    },
    /// Another process listens there.
    #[error("cannot listen at {endpoint}: the port is in use; end the other process or choose another port")]
    PortInUse {
        /// Where.
        endpoint: Endpoint,
    },
    /// Nothing answers at the router's place.
    #[error(
        "no router at {endpoint} after {waited_s:.1} s; start it first (v2vloc up, or zenohd) or correct the endpoint{}",
        if endpoint.is_secured() { ". It may also have refused this certificate: its log says so" } else { "" }
    )]
    Unreachable {
        /// Where.
        endpoint: Endpoint,
        /// Seconds waited.
        waited_s: f64,
    },
    /// The system gives no thread.
    #[error("no thread for {what}: {cause}")]
    Thread {
        /// What it was wanted for.
        what: String,
        /// The system's words.
        cause: std::io::Error,
    },
    /// The metrics cannot be served there.
    #[error("cannot serve metrics at {address}: {cause}")]
    Metrics {
        /// Where.
        address: std::net::SocketAddr,
        /// The system's words.
        cause: std::io::Error,
    },
    /// Anything else that zenoh says.
    #[error("zenoh, {doing}: {cause}")]
    Zenoh {
        /// What was tried.
        doing: String,
        /// zenoh's words.
        cause: String,
    },
}

impl BusError {
    /// Whether a failure goes back to an endpoint or to keys that cannot be used: for exit codes, so that a supervisor does
    /// not start again what will fail again.
    #[must_use]
    pub fn is_behind(failure: &(dyn std::error::Error + 'static)) -> bool {
        let mut chain = std::iter::successors(Some(failure), |cause| cause.source());
        chain.any(|cause| cause.downcast_ref::<Self>().is_some_and(Self::is_bad_input))
    }

    /// Whether what was asked for is at fault, so that trying again changes nothing.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::Endpoint(_) | Self::Keys { .. } | Self::NoKeys(_))
    }

    pub(super) fn zenoh(doing: impl Into<String>, cause: &zenoh::Error) -> Self {
        Self::Zenoh { doing: doing.into(), cause: cause.to_string() }
    }
}
