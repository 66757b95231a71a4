//! Opening the bus: explicit endpoints, no discovery, every limit set on purpose.

use std::net::{TcpListener, UdpSocket};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use zenoh::{Config, Session, Wait};

use super::access_control::{self, AccessControl};
use super::credentials::{AUTHORITY_FILE, CERTIFICATE_FILE, Credentials, KEY_FILE};
use super::endpoint::Endpoint;
use super::error::BusError;

/// How long one attempt to open a connection may take.
const OPEN_LIMIT: Duration = Duration::from_secs(3);
/// First and longest pause between two attempts to reach the router again.
const RETRY_FIRST: Duration = Duration::from_millis(100);
const RETRY_LONGEST: Duration = Duration::from_secs(1);
/// Batches of 64 KiB that zenoh takes before a `put` waits, for features and for sensor data. On a slow link that much may
/// lie before the newest message: an eighth of what a socket's buffer grows to anyway.
const TENSOR_BATCHES: usize = 8;

/// Sessions that a router has at once: twice as many as a run of 64 vehicles needs.
const MAX_SESSIONS: usize = 256;
/// Connections that may be in the middle of introducing themselves.
const MAX_STRANGERS: usize = 64;

/// How long a client may take to hand over one message: 8 MiB at 1 Mbit/s, and then some. A router that hangs is noticed
/// much sooner, by its silence.
pub(super) const LONGEST_MESSAGE: Duration = Duration::from_secs(120);
/// The same over QUIC: there nobody tells a client that its router was killed, and a message under way keeps zenoh from
/// connecting anew until this has passed. 8 MiB at 2.3 Mbit/s.
const LONGEST_SECURED: Duration = Duration::from_secs(30);
/// The same for a router, whose other messages of the same sender wait meanwhile.
const LONGEST_DELIVERY: Duration = Duration::from_secs(5);

/// Which end of the star a process is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Role {
    /// The middle: routes for all others. One process of a run, usually the one that starts the others.
    Router {
        /// Where it listens, for example `tcp/127.0.0.1:7447`.
        listen: Endpoint,
    },
    /// Everyone else.
    Client {
        /// The router's endpoint.
        connect: Endpoint,
    },
}

/// How to open a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusOptions {
    /// Router or client, and where.
    pub role: Role,
    /// How long a client tries to reach the router before it gives up.
    pub patience: Duration,
    /// Bytes of shared memory for large messages on one machine; `None` keeps everything on the socket, which is what
    /// experiments with an emulated link need. At least three times the bytes of all maps under way at once.
    pub shared_memory_pool: Option<usize>,
    /// Largest message accepted from outside, in bytes; larger ones close the connection they came on.
    pub max_message_bytes: usize,
    /// How long handing over one message may take before the connection is closed. Meanwhile a router delivers nothing
    /// else that the same sender sends, so this bounds what one stuck receiver costs the others.
    pub stall_limit: Duration,
    /// Keys: all traffic goes over QUIC, and both ends show certificates of the same authority.
    pub credentials: Option<Credentials>,
    /// What a router lets through, by certificate; everything when absent.
    pub guard: Option<AccessControl>,
}

impl BusOptions {
    /// A router that listens at `listen`.
    #[must_use]
    pub fn router(listen: Endpoint) -> Self {
        Self::with_role(Role::Router { listen }, LONGEST_DELIVERY)
    }

    /// A client of the router at `connect`.
    #[must_use]
    pub fn client(connect: Endpoint) -> Self {
        Self::with_role(Role::Client { connect }, LONGEST_MESSAGE)
    }

    fn with_role(role: Role, stall_limit: Duration) -> Self {
        Self {
            role,
            patience: Duration::from_secs(10),
            shared_memory_pool: None,
            // Twice a full map of OpenCOOD's size (256 x 48 x 176 cells of f32 at stride 4 are 8.7 MB) and every cloud.
            max_message_bytes: 32 << 20,
            stall_limit,
            credentials: None,
            guard: None,
        }
    }

    /// The same with keys: the endpoint is one of QUIC from here on.
    #[must_use]
    pub fn with_credentials(mut self, credentials: Credentials) -> Self {
        let (Role::Router { listen: endpoint } | Role::Client { connect: endpoint }) = &mut self.role;
        *endpoint = endpoint.secured();
        self.stall_limit = self.stall_limit.min(LONGEST_SECURED);
        self.credentials = Some(credentials);
        self
    }

    /// The same as a router that lets nothing through but what `guard` says.
    #[must_use]
    pub fn with_access_control(self, guard: AccessControl) -> Self {
        Self { guard: Some(guard), ..self }
    }

    /// Where this end listens or connects.
    #[must_use]
    pub fn endpoint(&self) -> &Endpoint {
        let (Role::Router { listen: endpoint } | Role::Client { connect: endpoint }) = &self.role;
        endpoint
    }

    /// The same as a configuration for a `zenohd` of its own.
    #[must_use]
    pub fn for_zenohd(&self) -> Value {
        let mut whole = json!({});
        for (key, value) in self.settings() {
            let mut place = &mut whole;
            for part in key.split('/') {
                place = &mut place[part];
            }
            *place = value;
        }
        whole
    }

    /// The keys of zenoh's configuration that differ from its defaults, or on which this crate relies.
    fn settings(&self) -> Vec<(&'static str, Value)> {
        let (mode, listen, connect) = match &self.role {
            Role::Router { listen } => ("router", vec![listen.for_zenoh()], vec![]),
            Role::Client { connect } => ("client", vec![], vec![connect.for_zenoh()]),
        };
        let millis = |duration: Duration| u64::try_from(duration.as_millis()).unwrap_or(u64::MAX);
        let mut settings = vec![
            ("mode", json!(mode)),
            ("listen/endpoints", json!(listen)),
            ("listen/timeout_ms", json!(0)),
            ("listen/exit_on_failure", json!(true)),
            ("connect/endpoints", json!(connect)),
            ("connect/timeout_ms", json!(millis(self.patience))),
            ("connect/exit_on_failure", json!(true)),
            (
                "connect/retry",
                json!({
                    "period_init_ms": millis(RETRY_FIRST),
                    "period_max_ms": millis(RETRY_LONGEST),
                    "period_increase_factor": 2.0,
                }),
            ),
            // A neighbour's fleet on the same network must not leak into this run.
            ("scouting/multicast/enabled", json!(false)),
            ("scouting/gossip/enabled", json!(false)),
            // With nobody to discover there is nothing to wait half a second for.
            ("scouting/delay", json!(0)),
            // Capture times stand in our own header; the router's clock has no say.
            ("timestamping/enabled", json!(false)),
            // It loses messages over 64 KiB without a word.
            ("transport/unicast/lowlatency", json!(false)),
            ("transport/unicast/qos/enabled", json!(true)),
            // A router that is held up just then answers the next attempt; zenoh would wait 10 s for this one.
            ("transport/unicast/open_timeout", json!(millis(OPEN_LIMIT))),
            // Tensors: with zenoh's two batches the thread that writes a message and the one that sends it wait for each
            // other after every 64 KiB, which costs a fifth of the time that 8 MiB take.
            ("transport/link/tx/queue/size/data", json!(TENSOR_BATCHES)),
            ("transport/link/tx/queue/size/data_low", json!(TENSOR_BATCHES)),
            ("transport/link/rx/max_message_size", json!(self.max_message_bytes)),
            ("transport/link/protocols", json!([if self.credentials.is_some() { "quic" } else { "tcp" }])),
            ("transport/unicast/max_sessions", json!(MAX_SESSIONS)),
            ("transport/unicast/max_links", json!(1)),
            ("transport/unicast/accept_pending", json!(MAX_STRANGERS)),
            (
                "transport/link/tx/queue/congestion_control/block/wait_before_close",
                json!(u64::try_from(self.stall_limit.as_micros()).unwrap_or(u64::MAX)),
            ),
            ("transport/shared_memory/enabled", json!(self.shared_memory_pool.is_some())),
            ("transport/shared_memory/transport_optimization/enabled", json!(self.shared_memory_pool.is_some())),
            (
                "transport/shared_memory/transport_optimization/pool_size",
                json!(self.shared_memory_pool.unwrap_or(16 << 20)),
            ),
        ];
        if matches!(self.role, Role::Router { .. }) {
            settings.push(("low_pass_filter", access_control::size_limits()));
        }
        settings.extend(self.credentials.iter().flat_map(tls_settings));
        if let Some(guard) = &self.guard {
            settings.push(("access_control", guard.rules()));
            // Where it says what it refused; the guard lets nobody else read there.
            settings.push(("adminspace", json!({"enabled": true, "permissions": {"read": true, "write": false}})));
        }
        settings
    }
}

/// QUIC's handshake is that of TLS 1.3, and so are its settings.
fn tls_settings(credentials: &Credentials) -> Vec<(&'static str, Value)> {
    let path = |file| json!(credentials.path(file));
    vec![
        ("transport/link/tls/root_ca_certificate", path(AUTHORITY_FILE)),
        ("transport/link/tls/enable_mtls", json!(true)),
        ("transport/link/tls/listen_certificate", path(CERTIFICATE_FILE)),
        ("transport/link/tls/listen_private_key", path(KEY_FILE)),
        ("transport/link/tls/connect_certificate", path(CERTIFICATE_FILE)),
        ("transport/link/tls/connect_private_key", path(KEY_FILE)),
        ("transport/link/tls/verify_name_on_connect", json!(true)),
        // A certificate that has run out ends the connections that it opened.
        ("transport/link/tls/close_link_on_expiration", json!(true)),
    ]
}

/// Opens a session, waiting until it listens (router) or is connected (client).
///
/// A client that loses its router later reconnects by itself, at first after 100 ms, then ever more slowly up to 1 s.
/// Inside tokio this needs the multi-thread runtime: zenoh panics on a current-thread one.
///
/// # Errors
/// [`BusError`] names the endpoint and what to do.
pub fn open(options: &BusOptions) -> Result<Session, BusError> {
    if options.credentials.is_none() && options.endpoint().is_secured() {
        return Err(BusError::NoKeys(options.endpoint().clone()));
    }
    let config = config(options)?;
    let began = Instant::now();
    zenoh::open(config).wait().map_err(|cause| match &options.role {
        // Asked only after zenoh has failed, so the answer cannot race with a successful start.
        Role::Router { listen } if port_in_use(listen) => BusError::PortInUse { endpoint: listen.clone() },
        Role::Router { listen } => BusError::zenoh(format!("listening at {listen}"), &cause),
        Role::Client { connect } => {
            BusError::Unreachable { endpoint: connect.clone(), waited_s: began.elapsed().as_secs_f64() }
        }
    })
}

fn port_in_use(endpoint: &Endpoint) -> bool {
    let address = endpoint.address();
    let bound =
        if endpoint.is_secured() { UdpSocket::bind(address).map(drop) } else { TcpListener::bind(address).map(drop) };
    bound.is_err_and(|error| error.kind() == std::io::ErrorKind::AddrInUse)
}

fn config(options: &BusOptions) -> Result<Config, BusError> {
    let mut config = Config::default();
    for (key, wanted) in options.settings() {
        config.insert_json5(key, &wanted.to_string()).map_err(|cause| BusError::Setting {
            key,
            wanted: wanted.clone(),
            found: format!("refused: {cause}"),
        })?;
    }
    // zenoh accepts some keys and ignores them: what counts is what can be read back.
    for (key, wanted) in options.settings() {
        let found = config.get_json(key).map_err(|cause| BusError::Setting {
            key,
            wanted: wanted.clone(),
            found: format!("cannot be read back: {cause}"),
        })?;
        if !serde_json::from_str::<Value>(&found).is_ok_and(|found| same(&found, &wanted)) {
            return Err(BusError::Setting { key, wanted, found: format!("reads back as {found}") });
        }
    }
    Ok(config)
}

/// Equality that takes `1` and `1.0` for the same, and looks only at the keys that were set.
fn same(found: &Value, wanted: &Value) -> bool {
    match (found, wanted) {
        (Value::Number(found), Value::Number(wanted)) => found.as_f64() == wanted.as_f64(),
        (Value::Object(found), Value::Object(wanted)) => {
            wanted.iter().all(|(key, value)| found.get(key).is_some_and(|found| same(found, value)))
        }
        (Value::Array(found), Value::Array(wanted)) => {
            found.len() == wanted.len() && found.iter().zip(wanted).all(|(found, wanted)| same(found, wanted))
        }
        _ => found == wanted,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_setting_reads_back() {
        let mut options = BusOptions::client(Endpoint::loopback(7447));
        config(&options).unwrap();
        options.shared_memory_pool = Some(64 << 20);
        config(&options).unwrap();
        config(&BusOptions::router(Endpoint::loopback(7447))).unwrap();
    }

    #[test]
    fn without_keys_nobody_goes_where_keys_are_asked_for() {
        let endpoint = Endpoint::loopback(7447).secured();
        assert_eq!(endpoint.as_str(), "quic/127.0.0.1:7447");
        assert!(matches!(open(&BusOptions::client(endpoint)), Err(BusError::NoKeys(_))));
    }

    #[test]
    fn every_rule_reads_back() {
        let members = ["agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer"];
        let members = members.map(|name| name.parse().unwrap()).into();
        let guard = AccessControl { members, runs: protocol::RunScope::Any };
        let options = BusOptions::router(Endpoint::loopback(7447)).with_access_control(guard);
        config(&options).unwrap();
        assert_eq!(options.for_zenohd()["transport"]["link"]["protocols"], json!(["tcp"]));
    }

    #[test]
    fn numbers_compare_by_value() {
        assert!(same(&json!({"a": 1, "b": 2}), &json!({"a": 1.0})));
        assert!(!same(&json!({"b": 2}), &json!({"a": 1.0})));
    }
}
