//! Errors of the bus, each with its remedy.

use std::fmt::Display;
use std::io::ErrorKind;

use support::cli::Interrupted;

use super::endpoint::Endpoint;

/// Result of an operation on the bus: a [`BusError`] if nothing else is named.
pub type Result<T, E = BusError> = std::result::Result<T, E>;

/// Error of opening or using the bus.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// Not an endpoint.
    #[error(
        "{0:?} is not an endpoint: tcp/HOST:PORT, for example tcp/127.0.0.1:7447, or quic/HOST:PORT with keys"
    )]
    Endpoint(String),
    /// Keys that are missing or invalid: the file or folder, and a description of the error.
    #[error("{0}")]
    Keys(String),
    /// An endpoint that requires keys.
    #[error("{0} requires keys: give their folder (--keys DIR; v2vloc keys creates them)")]
    NoKeys(Endpoint),
    /// zenoh refused or changed a setting: its key, the value requested and the one that zenoh has set.
    #[error("zenoh setting {0}")]
    Setting(String),
    /// Another process uses the port of the router's endpoint.
    #[error(
        "cannot listen at {0}: the port is in use; end the other process or choose another port"
    )]
    PortInUse(Endpoint),
    /// No router answers at the endpoint.
    #[error(
        "no router at {endpoint} after {waited_s:.1} s; start it first (v2vloc up, or zenohd) or correct the endpoint{}",
        if endpoint.is_secured() { ". It may also have rejected this certificate: see its log" } else { "" }
    )]
    Unreachable {
        /// Endpoint of the router.
        endpoint: Endpoint,
        /// Seconds waited.
        waited_s: f64,
    },
    /// The process was asked to end while it waited for the router.
    #[error("stopped while waiting for a router at {endpoint}")]
    Stopped {
        /// Endpoint of the router.
        endpoint: Endpoint,
        /// Gives the process the exit code of an end on request.
        source: Interrupted,
    },
    /// Another process has the name, in this run; receivers would reject the messages of both.
    #[error("{0} already; end it first, or choose another name")]
    NameTaken(String),
    /// The system cannot start a thread: its purpose and the error of the system.
    #[error("no thread for {0}")]
    Thread(String),
    /// The system has too little shared memory: the size of the pool, or of the pools of several processes, and the free
    /// memory.
    #[error("{0} are free in /dev/shm; every process has a pool of its own")]
    SharedMemory(String),
    /// The metrics cannot be served at the address.
    #[error("cannot serve metrics at {address}: {cause}")]
    Metrics {
        /// Address of the metrics.
        address: std::net::SocketAddr,
        /// Error of the system.
        cause: std::io::Error,
    },
    /// Any other error of zenoh: the operation that failed and the error text of zenoh.
    #[error("zenoh, {0}")]
    Zenoh(String),
}

impl BusError {
    /// True if the cause of a failure is an endpoint or keys that cannot be used: for exit codes, so that a supervisor
    /// does not restart a process that will fail again.
    pub fn is_behind(failure: &(dyn std::error::Error + 'static)) -> bool {
        let mut chain = std::iter::successors(Some(failure), |cause| cause.source());
        chain.any(|cause| cause.downcast_ref::<Self>().is_some_and(Self::is_bad_input))
    }

    /// True if the input is at fault, so that a retry has no effect.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Metrics { cause, .. } => matches!(
                cause.kind(),
                ErrorKind::AddrInUse | ErrorKind::AddrNotAvailable | ErrorKind::PermissionDenied
            ),
            Self::Endpoint(_)
            | Self::PortInUse(_)
            | Self::Keys { .. }
            | Self::NoKeys(_)
            | Self::SharedMemory { .. }
            | Self::NameTaken { .. } => true,
            _ => false,
        }
    }

    /// The error of a thread that cannot be spawned.
    pub fn thread(what: impl Display) -> impl FnOnce(std::io::Error) -> Self {
        move |cause| Self::Thread(format!("{what}: {cause}"))
    }

    /// An error of zenoh during an operation.
    pub fn zenoh(doing: impl Display, cause: &zenoh::Error) -> Self {
        Self::Zenoh(format!("{doing}: {cause}"))
    }
}
