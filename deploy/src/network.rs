//! Where the processes of a run meet: a router inside this process, or one that runs elsewhere.

use std::net::TcpListener;

use sim_replay::bus::shutdown::{self, Overdue};
use sim_replay::bus::{BusError, BusOptions, Endpoint, open};
use zenoh::{Session, Wait};

use crate::scenario::Network;

/// How long closing the session may take.
const CLOSE_LIMIT: std::time::Duration = std::time::Duration::from_millis(500);

/// An open session, and the endpoint that the other processes connect to.
pub struct MeetingPlace {
    /// The session of this process.
    pub session: Session,
    /// What to tell the others.
    pub endpoint: Endpoint,
}

impl MeetingPlace {
    /// Opens the router of this run, or connects to the one that the scenario names.
    ///
    /// # Errors
    /// [`BusError`] when the port is in use, nothing answers there, or the endpoint is none.
    pub fn open(network: &Network) -> Result<Self, BusError> {
        if let Some(router) = &network.connect {
            let endpoint = Endpoint::new(router)?;
            return Ok(Self { session: open(&BusOptions::client(endpoint.clone()))?, endpoint });
        }
        let endpoint = with_port(&network.listen)?;
        Ok(Self { session: open(&BusOptions::router(endpoint.clone()))?, endpoint })
    }

    /// Closes the session.
    ///
    /// # Errors
    /// [`Overdue`] when the network does not let go.
    pub fn close(self) -> Result<(), Overdue> {
        shutdown::within(CLOSE_LIMIT, "the router", move || {
            if let Err(cause) = self.session.close().wait() {
                tracing::debug!("closing the router: {cause}");
            }
        })
    }
}

/// The endpoint with port 0 replaced by a port that is free right now.
fn with_port(listen: &str) -> Result<Endpoint, BusError> {
    let endpoint = |text: &str| Endpoint::new(text);
    let Some(host) = listen.strip_suffix(":0") else { return endpoint(listen) };
    let address = format!("{}:0", host.trim_start_matches("tcp/"));
    // Asking the system beats guessing; should another program take the port in between, the router says so.
    let port = TcpListener::bind(&address).and_then(|listener| listener.local_addr()).map(|address| address.port());
    endpoint(&format!("{host}:{}", port.unwrap_or(0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_zero_becomes_a_free_one() {
        let endpoint = with_port("tcp/127.0.0.1:0").unwrap();
        assert!(!endpoint.as_str().ends_with(":0"), "{}", endpoint.as_str());
        assert_eq!(with_port("tcp/127.0.0.1:7447").unwrap().as_str(), "tcp/127.0.0.1:7447");
    }

    #[test]
    fn a_port_in_use_is_named() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let listen = format!("tcp/{}", taken.local_addr().unwrap());
        let error =
            MeetingPlace::open(&Network { listen: listen.clone(), ..Network::default() }).err().unwrap().to_string();
        assert!(error.contains(&listen) && error.contains("in use"), "{error}");
    }
}
