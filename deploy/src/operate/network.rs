//! Router endpoint of a run: a router inside this process, or one that runs elsewhere.

use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::time::Duration;

use bus::shutdown::{self, Overdue};
use bus::{
    BusError, BusOptions, Endpoint, ROUTER, RouterProbe, SharedMemory, open, present, process_id,
};
use protocol::{Key, KeyExpr, Principal, ProcessId, Role, RunId, RunScope};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use zenoh::{Session, Wait};

use crate::operate::security::{self, RunKeys};
use crate::operate::supervise::ProcessSpec;
use crate::score::scorer_cav;

/// Longest time for closing the session.
const CLOSE_LIMIT: Duration = Duration::from_millis(500);

/// Network of the processes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Network {
    /// Address at which the router inside this run listens; port 0 takes any free one.
    pub listen: String,
    /// Router that runs already (`zenohd`), for example `tcp/10.0.0.1:7447`; no router is started then.
    pub connect: Option<String>,
    /// Pool of shared memory of each process for its large messages to others of the same machine, MiB; 0: everything
    /// takes the socket. A router elsewhere has to be attached (`v2vloc router --shared-memory`).
    pub shared_memory_mib: usize,
    /// Longest time for handing one map or sweep to one receiver on another host, seconds, after which the router
    /// inside this run closes that connection. A receiver behind a slow link needs more (8 MiB at 13 Mbit/s take 5 s).
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

/// An open session, and the endpoint that the other processes connect to.
pub struct RouterEndpoint {
    /// The session of this process.
    pub session: Session,
    /// Endpoint that the other processes are given.
    pub endpoint: Endpoint,
    /// True if the router is in this process and enforces access control.
    pub is_guarded: bool,
}

impl RouterEndpoint {
    /// Opens the router of this run, or connects to the one that the scenario names; with keys over QUIC.
    ///
    /// # Errors
    /// [`BusError`] when the port is in use, no router answers, the endpoint is invalid or the keys do not fit.
    pub fn open(network: &Network, run: &RunId, keys: Option<&RunKeys>) -> Result<Self, BusError> {
        let options = match &network.connect {
            Some(router) => as_scorer(BusOptions::client(Endpoint::new(router)?), keys)?,
            None => {
                let mut options = BusOptions::router(with_port(&network.listen, keys.is_some())?);
                options.stall_limit = Duration::from_secs_f64(network.stall_limit_s);
                if network.shared_memory_mib > 0 {
                    options.shared_memory = SharedMemory::Attached;
                }
                let runs = RunScope::One(run.clone());
                match keys {
                    Some(keys) => security::guarded(options, &keys.of_process(ROUTER), runs)?,
                    None => options,
                }
            }
        };
        let session = open(&options)?;
        Ok(Self {
            session,
            endpoint: from_here(options.endpoint())?,
            is_guarded: options.guard.is_some(),
        })
    }

    /// A probe of the router: a second session that receives the reports of the scorer. `None`, with a warning, if it
    /// cannot be opened.
    pub fn probe(&self, run: &RunId, keys: Option<&RunKeys>) -> Option<RouterProbe> {
        let options = BusOptions::client(self.endpoint.clone());
        let reports = Key::stats(run, &process_id(Role::Scorer, &scorer_cav()));
        let probe = as_scorer(options, keys)
            .and_then(|options| RouterProbe::of_key(&options, &KeyExpr::one(&reports)));
        probe
            .inspect_err(|error| tracing::warn!("the router is not watched: {error}"))
            .ok()
    }

    /// Processes to start, and a scorer, that are present already on a shared router.
    ///
    /// # Errors
    /// [`BusError`] when the router does not answer.
    pub fn present(
        &self,
        network: &Network,
        run: &RunId,
        specs: &[ProcessSpec],
    ) -> Result<Vec<ProcessId>, BusError> {
        // A router of our own is new, so nobody can be present on it.
        if network.connect.is_none() {
            return Ok(Vec::new());
        }
        let scorer = process_id(Role::Scorer, &scorer_cav());
        let present = present(&self.session, KeyExpr::everyone_alive(run).as_str())?;
        let ours = present.into_iter().filter(|process| {
            *process == scorer || specs.iter().any(|spec| spec.name == process.as_str())
        });
        Ok(ours.collect())
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
    Endpoint::new(&text.replacen("/[::]:", "/[::1]:", 1))
}

/// The endpoint with port 0 replaced by a port that is free at this moment.
fn with_port(listen: &str, secured: bool) -> Result<Endpoint, BusError> {
    let Some(place) = listen.strip_suffix(":0") else {
        return Endpoint::new(listen);
    };
    let host = place.split_once('/').map_or(place, |(_, host)| host);
    // If another program takes the port in between, the router reports the error.
    let any = format!("{host}:0");
    // Free for the protocol in use: QUIC takes a port of UDP.
    let bound = match secured {
        true => UdpSocket::bind(any).and_then(|socket| socket.local_addr()),
        false => TcpListener::bind(any).and_then(|listener| listener.local_addr()),
    };
    let port = bound.as_ref().map_or(0, SocketAddr::port);
    Endpoint::new(&format!("{place}:{port}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_zero_becomes_a_free_one() {
        for (listen, secured) in [
            ("tcp/127.0.0.1:0", false),
            ("tcp/127.0.0.1:0", true),
            ("quic/127.0.0.1:0", true),
        ] {
            let endpoint = with_port(listen, secured).unwrap();
            assert!(!endpoint.as_str().ends_with(":0"), "{}", endpoint.as_str());
        }
        assert_eq!(
            with_port("tcp/127.0.0.1:7447", false).unwrap().as_str(),
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
            assert_eq!(
                from_here(&Endpoint::new(listen).unwrap()).unwrap().as_str(),
                met
            );
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
        let error = RouterEndpoint::open(&network, &"r1".parse().unwrap(), None)
            .err()
            .unwrap()
            .to_string();
        assert!(
            error.contains(&listen) && error.contains("in use"),
            "{error}"
        );
    }
}
