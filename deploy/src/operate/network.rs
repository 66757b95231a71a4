//! Router endpoint of a run: of a router of its own, or of one that runs already.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::time::Duration;

use bus::shutdown::{self, Overdue, Stop};
use bus::{BusError, BusOptions, Endpoint, RouterProbe, free_address, open_unless, process_id};
use protocol::{Key, KeyExpr, Principal, Role, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use zenoh::{Session, Wait};

use crate::operate::security::{self, RunKeys};
use crate::score::scorer_cav;

/// Longest time for closing the session.
const CLOSE_LIMIT: Duration = Duration::from_millis(500);

/// Network of the processes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Network {
    /// Address at which the router of this run listens; port 0 takes any free one.
    pub listen: String,
    /// Router that runs already (`zenohd`), for example `tcp/10.0.0.1:7447`; no router is started then.
    pub connect: Option<String>,
    /// Pool of shared memory of each process for its large messages to others of the same machine, MiB; 0: everything
    /// takes the socket. A router elsewhere has to be attached (`v2vloc router --shared-memory`).
    pub shared_memory_mib: usize,
    /// Longest time for handing one map or sweep to one receiver on another host, seconds, after which the router
    /// of this run closes that connection. A receiver behind a slow link needs more (8 MiB at 13 Mbit/s take 5 s).
    /// Other receivers do not wait for it.
    pub stall_limit_s: f64,
    /// Address at which the scorer serves its counters to Prometheus; the other processes take the ports after it, in
    /// the order in which they are started. Not served when absent.
    pub metrics: Option<SocketAddr>,
}

impl Default for Network {
    fn default() -> Self {
        Self {
            listen: "tcp/127.0.0.1:0".into(),
            connect: None,
            shared_memory_mib: 0,
            stall_limit_s: 5.0,
            metrics: None,
        }
    }
}

impl Network {
    /// Endpoint of the router of a run: the one that runs already, or a free address for one to start; with keys over
    /// QUIC.
    ///
    /// # Errors
    /// [`BusError`] when the port is in use or the endpoint is invalid.
    pub fn endpoint(&self, has_keys: bool) -> Result<Endpoint, BusError> {
        match &self.connect {
            Some(router) => router.parse(),
            None => free_endpoint(&self.listen, has_keys),
        }
    }
}

/// A session of the scorer, and the endpoint that the other processes connect to.
pub struct RouterEndpoint {
    /// The session of this process.
    pub session: Session,
    /// Endpoint that the other processes are given.
    pub endpoint: Endpoint,
}

impl RouterEndpoint {
    /// Connects to the router that listens at `endpoint`, with keys over QUIC, unless `stop` is requested first.
    ///
    /// # Errors
    /// [`BusError`] when no router answers or the keys do not fit.
    pub fn open(
        endpoint: &Endpoint,
        keys: Option<&RunKeys>,
        stop: &Stop,
    ) -> Result<Self, BusError> {
        let options = as_scorer(BusOptions::client(from_here(endpoint)?), keys)?;
        Ok(Self {
            session: open_unless(stop, &options)?,
            endpoint: options.endpoint,
        })
    }

    /// A probe of the router: a second session that receives the reports of the scorer. `None`, with a warning, if it
    /// cannot be opened.
    pub fn probe(&self, run: &RunId, keys: Option<&RunKeys>) -> Option<RouterProbe> {
        let options = BusOptions::client(self.endpoint.clone());
        let reports = Key::stats(run, &process_id(Role::Scorer, &scorer_cav()));
        let probe = as_scorer(options, keys)
            .and_then(|options| RouterProbe::of_key(&options, KeyExpr::one(&reports).as_str()));
        probe
            .inspect_err(|error| tracing::warn!("the router is not watched: {error}"))
            .ok()
    }

    /// Closes the session.
    ///
    /// # Errors
    /// [`Overdue`] when the session does not close in time.
    pub fn close(self) -> Result<(), Overdue> {
        shutdown::within(CLOSE_LIMIT, "the router", move || {
            if let Err(cause) = self.session.close().wait() {
                tracing::debug!("closing the router: {cause}");
            }
        })
    }
}

/// The same with the keys of the scorer, if there are keys.
fn as_scorer(options: BusOptions, keys: Option<&RunKeys>) -> Result<BusOptions, BusError> {
    let Some(keys) = keys else { return Ok(options) };
    let name = Principal::of_role(Role::Scorer).to_string();
    Ok(options.with_credentials(security::credentials(&keys.of_process(&name), &name)?))
}

/// Endpoint as processes of this host reach it: an unspecified listening address becomes the loopback, whose name
/// certificates carry.
pub(crate) fn from_here(endpoint: &Endpoint) -> Result<Endpoint, BusError> {
    let text = endpoint.as_str().replacen("/0.0.0.0:", "/127.0.0.1:", 1);
    text.replacen("/[::]:", "/[::1]:", 1).parse()
}

/// A listening address that is free at this moment; port 0 is replaced by a free port.
fn free_endpoint(listen: &str, has_keys: bool) -> Result<Endpoint, BusError> {
    let endpoint: Endpoint = listen.parse()?;
    match (free_address(&endpoint, has_keys), listen.strip_suffix(":0")) {
        // If another program takes the port in between, the router's log has the error.
        (Ok(free), Some(place)) => format!("{place}:{}", free.port()).parse(),
        (Err(error), _) if error.kind() == ErrorKind::AddrInUse => {
            Err(BusError::PortInUse(endpoint))
        }
        // What else is wrong with an address the router says.
        _ => Ok(endpoint),
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn port_zero_becomes_a_free_one() {
        for (listen, secured) in [
            ("tcp/127.0.0.1:0", false),
            ("tcp/127.0.0.1:0", true),
            ("quic/127.0.0.1:0", true),
        ] {
            let endpoint = free_endpoint(listen, secured).unwrap();
            assert!(!endpoint.as_str().ends_with(":0"), "{}", endpoint.as_str());
        }
        assert_eq!(
            free_endpoint("tcp/127.0.0.1:7447", false).unwrap().as_str(),
            "tcp/127.0.0.1:7447"
        );
    }

    #[test]
    fn an_unspecified_address_becomes_the_loopback() {
        for (listen, met) in [
            ("quic/0.0.0.0:7447", "quic/127.0.0.1:7447"),
            ("tcp/[::]:7447", "tcp/[::1]:7447"),
            ("tcp/10.0.0.1:7447", "tcp/10.0.0.1:7447"),
        ] {
            assert_eq!(from_here(&listen.parse().unwrap()).unwrap().as_str(), met);
        }
    }

    #[test]
    fn a_port_in_use_is_named() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let listen = format!("tcp/{}", taken.local_addr().unwrap());
        let network = Network {
            listen: listen.clone(),
            ..Network::default()
        };
        let error = network.endpoint(false).unwrap_err().to_string();
        assert!(
            error.contains(&listen) && error.contains("in use"),
            "{error}"
        );
    }
}
