//! Session of zenoh: explicit endpoints, no discovery, every limit set explicitly.

use std::io;
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use support::cli::Interrupted;
use support::sync::spawn;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh::{Config, Session, Wait};

use super::access_control::{self, AccessControl};
use super::credentials::{AUTHORITY_FILE, CERTIFICATE_FILE, Credentials, KEY_FILE};
use super::egress;
use super::endpoint::Endpoint;
use super::error::BusError;
use super::shutdown::Stop;

/// Timeout of one attempt to open a connection.
const OPEN_LIMIT: Duration = Duration::from_secs(3);
/// First and longest pause between two attempts to reconnect to the router.
const RETRY_FIRST: Duration = Duration::from_millis(100);
const RETRY_LONGEST: Duration = Duration::from_secs(1);
/// Batches of 64 KiB that zenoh queues before a `put` waits, for features and for sensor data. On a slow link that many
/// bytes may precede the newest message: an eighth of the size to which a socket's buffer grows.
const TENSOR_BATCHES: usize = 8;

/// Maximum number of sessions of a router: twice as many as a run of 64 vehicles needs.
const MAX_SESSIONS: usize = 256;
/// Maximum number of connections in the handshake.
const MAX_PENDING: usize = 64;

/// Timeout of a client for handing over one message: 8 MiB at 1 Mbit/s, with a margin. A hung router is detected much
/// sooner, by its silence.
pub(super) const LONGEST_MESSAGE: Duration = Duration::from_secs(120);
/// The same over QUIC: there a client is not notified that its router was killed, and a message in transit keeps zenoh
/// from reconnecting until this timeout. 8 MiB at 2.3 Mbit/s.
const LONGEST_SECURED: Duration = Duration::from_secs(30);
/// The same for a router, for one large message to one receiver on another host.
const LONGEST_DELIVERY: Duration = Duration::from_secs(5);

/// Role of a process in the star topology.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// The centre: routes for all others. One process of a run, usually the one that starts the others.
    Router,
    /// All other processes.
    Client,
}

/// Use of shared memory for the large messages of one machine. Without it they take the socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SharedMemory {
    /// Not used: messages of others that are in shared memory arrive over the socket.
    Off,
    /// Messages of others are received and routed there; own messages take the socket.
    Attached,
    /// As [`Self::Attached`], with a pool of so many bytes for own messages: at least three times those in flight.
    Pool(usize),
}

/// Options of a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusOptions {
    /// Router or client.
    pub role: Role,
    /// Endpoint at which a router listens or to which a client connects, for example `tcp/127.0.0.1:7447`.
    pub endpoint: Endpoint,
    /// Timeout of a client for reaching the router.
    pub connect_timeout: Duration,
    /// Shared memory for large messages between processes of one machine.
    pub shared_memory: SharedMemory,
    /// Maximum size of a message from outside, bytes; larger ones close their connection.
    pub max_message_bytes: usize,
    /// Timeout for handing over one message, after which the connection is closed. For a router: one large message to
    /// one receiver on another host, or a message for which its publisher waits ([`super::PublisherOptions::lossless`]).
    pub stall_limit: Duration,
    /// Keys: all traffic uses QUIC, and both ends present certificates of the same authority.
    pub credentials: Option<Credentials>,
    /// Access control of a router, by certificate; absent: everything is allowed.
    pub guard: Option<AccessControl>,
}

impl BusOptions {
    /// A router that listens at `listen`.
    pub fn router(listen: Endpoint) -> Self {
        Self::with_role(Role::Router, listen, LONGEST_DELIVERY)
    }

    /// A client of the router at `connect`.
    pub fn client(connect: Endpoint) -> Self {
        Self::with_role(Role::Client, connect, LONGEST_MESSAGE)
    }

    fn with_role(role: Role, endpoint: Endpoint, stall_limit: Duration) -> Self {
        Self {
            role,
            endpoint,
            connect_timeout: Duration::from_secs(10),
            shared_memory: SharedMemory::Off,
            // Twice a full feature map of OpenCOOD's size (256 x 48 x 176 cells of f32 at stride 4 are 8.7 MB) and
            // every cloud.
            max_message_bytes: 32 << 20,
            stall_limit,
            credentials: None,
            guard: None,
        }
    }

    /// The same with keys: the endpoint becomes a QUIC endpoint.
    #[must_use]
    pub fn with_credentials(mut self, credentials: Credentials) -> Self {
        self.endpoint = self.endpoint.secured();
        self.stall_limit = self.stall_limit.min(LONGEST_SECURED);
        self.credentials = Some(credentials);
        self
    }

    /// The same as a configuration for a separate `zenohd`.
    pub fn for_zenohd(&self) -> Value {
        let mut whole = json!({});
        for (key, value) in self.settings() {
            let place = key.split('/');
            *place.fold(&mut whole, |place, part| &mut place[part]) = value;
        }
        whole
    }

    /// The keys of zenoh's configuration that differ from its defaults, or on which this crate relies.
    fn settings(&self) -> Vec<(&'static str, Value)> {
        let own = vec![self.endpoint.for_zenoh()];
        let (mode, listen, connect) = match self.role {
            Role::Router => ("router", own, vec![]),
            Role::Client => ("client", vec![], own),
        };
        let retry = json!({
            "period_init_ms": millis(RETRY_FIRST),
            "period_max_ms": millis(RETRY_LONGEST),
            "period_increase_factor": 2.0,
        });
        let batches = json!(TENSOR_BATCHES);
        let transport = self.credentials.as_ref().map_or("tcp", |_| "quic");
        let is_attached = self.shared_memory != SharedMemory::Off;
        let mut settings = vec![
            ("mode", json!(mode)),
            ("listen/endpoints", json!(listen)),
            ("listen/timeout_ms", json!(0)),
            ("listen/exit_on_failure", json!(true)),
            ("connect/endpoints", json!(connect)),
            ("connect/timeout_ms", json!(millis(self.connect_timeout))),
            ("connect/exit_on_failure", json!(true)),
            ("connect/retry", retry),
            // A fleet of another user on the same network must not join this run.
            ("scouting/multicast/enabled", json!(false)),
            ("scouting/gossip/enabled", json!(false)),
            // Without discovery there is no reason to wait half a second.
            ("scouting/delay", json!(0)),
            // Capture times are in our own header; the router's clock is not used.
            ("timestamping/enabled", json!(false)),
            // It loses messages over 64 KiB without an error.
            ("transport/unicast/lowlatency", json!(false)),
            ("transport/unicast/qos/enabled", json!(true)),
            // A router that is delayed answers the next attempt; zenoh would wait 10 s for this one.
            ("transport/unicast/open_timeout", json!(millis(OPEN_LIMIT))),
            // Tensors: with zenoh's two batches the writing and the sending thread wait for each other after every 64
            // KiB, which costs a fifth of the time of 8 MiB.
            ("transport/link/tx/queue/size/data", batches.clone()),
            ("transport/link/tx/queue/size/data_low", batches.clone()),
            ("transport/link/tx/queue/size/real_time", batches),
            (
                "transport/link/rx/max_message_size",
                json!(self.max_message_bytes),
            ),
            ("transport/link/protocols", json!([transport])),
            ("transport/unicast/max_sessions", json!(MAX_SESSIONS)),
            ("transport/unicast/max_links", json!(1)),
            ("transport/unicast/accept_pending", json!(MAX_PENDING)),
            (
                "transport/link/tx/queue/congestion_control/block/wait_before_close",
                json!(u64::try_from(self.stall_limit.as_micros()).unwrap_or(u64::MAX)),
            ),
            ("transport/shared_memory/enabled", json!(is_attached)),
            // Publishers put their messages there themselves, and count those for which there is no room.
            (
                "transport/shared_memory/transport_optimization/enabled",
                json!(false),
            ),
        ];
        if self.role == Role::Router {
            settings.push(("low_pass_filter", access_control::size_limits()));
            settings.extend(egress::settings());
        }
        settings.extend(self.credentials.iter().flat_map(tls_settings));
        if let Some(guard) = &self.guard {
            settings.push(("access_control", guard.rules()));
            // Metrics of rejections; access control keeps other processes from reading them.
            settings.push((
                "adminspace",
                json!({"enabled": true, "permissions": {"read": true, "write": false}}),
            ));
        }
        settings
    }
}

fn millis(duration: Duration) -> u64 {
    u64::try_from(duration.as_millis()).unwrap_or(u64::MAX)
}

/// QUIC uses the handshake of TLS 1.3, and its settings.
fn tls_settings(credentials: &Credentials) -> Vec<(&'static str, Value)> {
    let [authority, certificate, key] =
        [AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE].map(|file| credentials.path(file));
    vec![
        ("transport/link/tls/root_ca_certificate", json!(authority)),
        ("transport/link/tls/enable_mtls", json!(true)),
        ("transport/link/tls/listen_certificate", json!(certificate)),
        ("transport/link/tls/listen_private_key", json!(key)),
        ("transport/link/tls/connect_certificate", json!(certificate)),
        ("transport/link/tls/connect_private_key", json!(key)),
        ("transport/link/tls/verify_name_on_connect", json!(true)),
        // An expired certificate ends the connections that it opened.
        ("transport/link/tls/close_link_on_expiration", json!(true)),
    ]
}

/// Opens a session, waiting until it listens (router) or is connected (client).
///
/// A client that loses its router later reconnects by itself, at first after 100 ms, then ever more slowly up to 1 s.
/// Inside tokio this needs the multi-thread runtime: zenoh panics on a current-thread one.
///
/// # Errors
/// [`BusError`] states the endpoint and the remedy.
pub fn open(options: &BusOptions) -> Result<Session, BusError> {
    let endpoint = options.endpoint.clone();
    if options.credentials.is_none() && endpoint.is_secured() {
        return Err(BusError::NoKeys(endpoint));
    }
    let config = config(options)?;
    let began = Instant::now();
    // Before zenoh tries, which would print a warning of its own first; it fails too if another process is faster.
    if options.role == Role::Router && port_in_use(&endpoint) {
        return Err(BusError::PortInUse(endpoint));
    }
    let opened = zenoh::open(config).wait();
    opened.map_err(|cause| match options.role {
        Role::Router if port_in_use(&endpoint) => BusError::PortInUse(endpoint),
        Role::Router => BusError::zenoh(format!("listening at {endpoint}"), &cause),
        Role::Client => BusError::Unreachable {
            endpoint,
            waited_s: began.elapsed().as_secs_f64(),
        },
    })
}

/// [`open`], or the end at once when `stop` is requested while a client waits for its router.
///
/// # Errors
/// [`BusError::Stopped`] after the request; else as [`open`].
pub fn open_unless(stop: &Stop, options: &BusOptions) -> Result<Session, BusError> {
    let (result, first) = mpsc::channel();
    stop.on_request({
        let result = result.clone();
        // The receiver is gone where the session was opened before.
        move || drop(result.send(None))
    });
    // zenoh cannot be interrupted: its thread is left behind, and ends with the process.
    let wanted = options.clone();
    let opening = spawn("open", move || drop(result.send(Some(open(&wanted)))));
    opening.map_err(BusError::thread("opening a session"))?;
    let (endpoint, source) = (options.endpoint.clone(), Interrupted);
    let stopped = BusError::Stopped { endpoint, source };
    first.recv().ok().flatten().unwrap_or(Err(stopped))
}

/// Delivers the messages on a key to `callback`, which runs on zenoh's receive thread.
pub(super) fn declare_subscriber(
    session: &Session,
    key: &str,
    callback: impl Fn(Sample) + Send + Sync + 'static,
) -> Result<Subscriber<()>, BusError> {
    let declared = session.declare_subscriber(key).callback(callback).wait();
    declared.map_err(|cause| BusError::zenoh(format!("subscribing to {key}"), &cause))
}

/// Address at which a router can listen now, with keys over QUIC; port 0 is replaced by a free port.
///
/// # Errors
/// The error of the system, for example [`io::ErrorKind::AddrInUse`].
pub fn free_address(endpoint: &Endpoint, has_keys: bool) -> io::Result<SocketAddr> {
    let address = endpoint.address();
    // QUIC takes a port of UDP.
    match has_keys || endpoint.is_secured() {
        true => UdpSocket::bind(address)?.local_addr(),
        false => TcpListener::bind(address)?.local_addr(),
    }
}

fn port_in_use(endpoint: &Endpoint) -> bool {
    free_address(endpoint, false).is_err_and(|error| error.kind() == io::ErrorKind::AddrInUse)
}

fn config(options: &BusOptions) -> Result<Config, BusError> {
    let mut config = Config::default();
    for (key, wanted) in options.settings() {
        let inserted = config.insert_json5(key, &wanted.to_string());
        inserted.map_err(|cause| refused(key, &wanted, &format!("rejected: {cause}")))?;
    }
    // zenoh accepts some keys and ignores them: the values are read back.
    for (key, wanted) in options.settings() {
        let found = config
            .get_json(key)
            .map_err(|cause| refused(key, &wanted, &format!("cannot be read back: {cause}")))?;
        if !serde_json::from_str::<Value>(&found).is_ok_and(|found| same(&found, &wanted)) {
            return Err(refused(key, &wanted, &format!("reads back as {found}")));
        }
    }
    Ok(config)
}

fn refused(key: &str, wanted: &Value, found: &str) -> BusError {
    BusError::Setting(format!("{key}: wanted {wanted}, {found}"))
}

/// Equality that treats `1` and `1.0` as the same, and compares only the keys that were set.
fn same(found: &Value, wanted: &Value) -> bool {
    match (found, wanted) {
        (Value::Number(found), Value::Number(wanted)) => found.as_f64() == wanted.as_f64(),
        (Value::Object(found), Value::Object(wanted)) => wanted
            .iter()
            .all(|(key, value)| found.get(key).is_some_and(|found| same(found, value))),
        (Value::Array(found), Value::Array(wanted)) => {
            found.len() == wanted.len()
                && found
                    .iter()
                    .zip(wanted)
                    .all(|(found, wanted)| same(found, wanted))
        }
        _ => found == wanted,
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    #[test]
    fn every_setting_reads_back() {
        let mut options = BusOptions::client(Endpoint::loopback(7447));
        config(&options).unwrap();
        options.shared_memory = SharedMemory::Pool(64 << 20);
        config(&options).unwrap();
        config(&BusOptions::router(Endpoint::loopback(7447))).unwrap();
    }

    #[test]
    fn a_secured_endpoint_requires_keys() {
        let endpoint = Endpoint::loopback(7447).secured();
        assert_eq!(endpoint.as_str(), "quic/127.0.0.1:7447");
        assert!(matches!(
            open(&BusOptions::client(endpoint)),
            Err(BusError::NoKeys(_))
        ));
    }

    #[test]
    fn a_request_ends_the_wait_for_a_router_at_once() {
        let nobody = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = nobody.local_addr().unwrap().port();
        drop(nobody);
        let options = BusOptions {
            connect_timeout: Duration::from_secs(60),
            ..BusOptions::client(Endpoint::loopback(port))
        };
        let stop = Stop::new();
        let waiting = thread::spawn({
            let stop = stop.clone();
            move || open_unless(&stop, &options).unwrap_err()
        });
        thread::sleep(Duration::from_millis(100));
        assert!(!waiting.is_finished());
        let began = Instant::now();
        stop.request();
        let error = waiting.join().unwrap();
        assert!(began.elapsed() < Duration::from_secs(10));
        assert!(matches!(error, BusError::Stopped { .. }), "{error}");
    }

    #[test]
    fn every_rule_reads_back() {
        let members = [
            "agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer", "ros2",
        ];
        let members = members.map(|name| name.parse().unwrap()).into();
        let guard = AccessControl {
            members,
            runs: protocol::RunScope::Any,
        };
        let options = BusOptions {
            guard: Some(guard),
            ..BusOptions::router(Endpoint::loopback(7447))
        };
        config(&options).unwrap();
        assert_eq!(
            options.for_zenohd()["transport"]["link"]["protocols"],
            json!(["tcp"])
        );
    }

    #[test]
    fn numbers_compare_by_value() {
        assert!(same(&json!({"a": 1, "b": 2}), &json!({"a": 1.0})));
        assert!(!same(&json!({"b": 2}), &json!({"a": 1.0})));
    }
}
