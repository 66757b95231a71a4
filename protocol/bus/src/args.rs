//! Configuration shared by all processes of a fleet: connection to the run, and limits on received messages.

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use protocol::config::{FieldError, above_zero, within};
use protocol::{CavId, Role, RunId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use support::output::{Verbosity, verbosity};
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry};

use super::handshake_failures::HandshakeCounter;
use super::shutdown::Stop;
use super::{
    Bus, BusError, BusOptions, Credentials, Endpoint, Identity, InboxLimits, SharedMemory,
    process_id,
};

/// Connection of a process to the router of its run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Bus")]
pub struct BusConfig {
    /// Router to connect to, tcp/HOST:PORT, or quic/HOST:PORT with keys.
    #[arg(long)]
    pub connect: Endpoint,
    /// Act as the run's router and listen here, tcp/HOST:PORT; no launcher or zenohd is needed then.
    #[arg(long, conflicts_with = "connect")]
    pub listen: Option<Endpoint>,
    /// Folder with the keys of this process (ca.pem, cert.pem, key.pem): connect over QUIC, present the certificate and
    /// reject a router without one. `v2vloc keys` creates them.
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,
    /// Maximum time of trying to reach the router, seconds.
    #[arg(long, value_name = "S")]
    pub connect_timeout_s: f64,
    /// Pool of shared memory for the large messages of this process to others of the same machine, MiB; 0: none, all
    /// messages use the socket. The router has to be attached to shared memory.
    #[arg(long, value_name = "MIB")]
    pub shared_memory_mib: usize,
    /// Largest message accepted from outside, MiB.
    #[arg(long, value_name = "MIB")]
    pub max_message_mib: usize,
    /// Serve counters and stage durations of this process to Prometheus at http://HOST:PORT/metrics; port 0: any free
    /// port.
    #[arg(long, value_name = "HOST:PORT")]
    pub metrics: Option<SocketAddr>,
    /// End at the end of standard input: for a supervisor that holds the other end of the pipe.
    #[arg(long)]
    pub supervised: bool,
}

impl Default for BusConfig {
    fn default() -> Self {
        Self {
            connect: Endpoint::loopback(7447),
            listen: None,
            keys: None,
            connect_timeout_s: 10.0,
            shared_memory_mib: 0,
            max_message_mib: 32,
            metrics: None,
            supervised: false,
        }
    }
}

impl BusConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] for the first value that is not allowed.
    pub fn validate(&self) -> Result<(), FieldError> {
        within("bus.connect_timeout_s", self.connect_timeout_s, 0.0, 1e6)?;
        within("bus.max_message_mib", self.max_message_mib, 1, 1 << 20)?;
        within("bus.shared_memory_mib", self.shared_memory_mib, 0, 1 << 20)
    }

    /// Options of the session for this configuration.
    ///
    /// # Errors
    /// [`BusError::Keys`] when the files of `keys` are invalid.
    pub fn options(&self) -> Result<BusOptions, BusError> {
        let mut options = match &self.listen {
            Some(listen) => BusOptions::router(listen.clone()),
            None => BusOptions::client(self.connect.clone()),
        };
        options.connect_timeout =
            Duration::try_from_secs_f64(self.connect_timeout_s).unwrap_or(Duration::ZERO);
        options.shared_memory = self.shared_memory();
        options.max_message_bytes = self.max_message_mib << 20;
        Ok(match &self.keys {
            Some(folder) => options.with_credentials(Credentials::read(folder)?),
            None => options,
        })
    }

    /// Use of shared memory. It needs a router on this machine's loopback: to others zenoh hands large messages over in
    /// a way that leaves shared memory out.
    fn shared_memory(&self) -> SharedMemory {
        match self.shared_memory_mib {
            0 => SharedMemory::Off,
            _ if !self.listen.as_ref().unwrap_or(&self.connect).is_loopback() => {
                tracing::warn!("no shared memory: the router is not at an address of the loopback");
                SharedMemory::Off
            }
            mib => SharedMemory::Pool(mib << 20),
        }
    }

    /// Joins `run` in a role; a request to stop ends the wait for the router.
    ///
    /// # Errors
    /// [`BusError`] states the endpoint and the remedy.
    pub fn join(&self, stop: &Stop, run: &RunId, role: Role, cav: &CavId) -> Result<Bus, BusError> {
        let identity = Identity::new(run.clone(), process_id(role, cav), cav.clone());
        let options = self.options()?;
        // Checked here: the router would deny the messages of another name, one by one.
        if let Some(credentials) = &options.credentials {
            credentials.check_name(identity.process.as_str())?;
        }
        let mut bus = Bus::join_unless(stop, &options, identity)?;
        // The instance before of a supervised process may not have left yet.
        if !self.supervised {
            bus.check_name(role, stop)?;
        }
        if let Some(address) = self.metrics {
            let address = bus.serve_metrics(address, Vec::new())?;
            tracing::info!("metrics at http://{address}/metrics");
        }
        Ok(bus)
    }

    /// A stop request that follows signals and, if configured, the end of standard input, and that is enforced.
    ///
    /// # Errors
    /// When handlers or threads cannot be installed.
    pub fn stop(&self) -> std::io::Result<Stop> {
        Stop::of_process(self.supervised)
    }
}

/// Limits on messages of other vehicles to a process that subscribes to them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Limits on received messages")]
pub struct InboxConfig {
    /// Messages per second of one sender; messages beyond are dropped unread (`rate_limit` in the ledger).
    #[arg(id = "inbox_messages_per_s", long = "inbox-messages-per-s")]
    #[arg(value_name = "N")]
    pub messages_per_s: f64,
    /// MiB per second of one sender, on each of its streams.
    #[arg(id = "inbox_mib_per_s", long = "inbox-mib-per-s", value_name = "MIB")]
    pub mib_per_s: f64,
    /// MiB that may wait to be decoded, of all senders together.
    #[arg(id = "inbox_waiting_mib", long = "inbox-waiting-mib")]
    #[arg(value_name = "MIB")]
    pub waiting_mib: usize,
}

const MIB: f64 = (1 << 20) as f64;

impl Default for InboxConfig {
    fn default() -> Self {
        let peers = InboxLimits::PEERS;
        Self {
            messages_per_s: peers.messages_per_s,
            mib_per_s: peers.bytes_per_s / MIB,
            waiting_mib: peers.waiting_bytes >> 20,
        }
    }
}

impl InboxConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`FieldError`] for the first value that is not allowed.
    pub fn validate(&self) -> Result<(), FieldError> {
        above_zero("inbox.messages_per_s", self.messages_per_s)?;
        above_zero("inbox.mib_per_s", self.mib_per_s)
    }

    /// The limits in bytes.
    pub fn limits(&self) -> InboxLimits {
        InboxLimits {
            messages_per_s: self.messages_per_s,
            bytes_per_s: self.mib_per_s * MIB,
            waiting_bytes: self.waiting_mib.saturating_mul(1 << 20),
        }
    }
}

/// Writes the log to standard error: warnings, and messages of this program's own crates at `info` and above, or what
/// `-v` or `-q` asked for, unless `RUST_LOG` sets another filter. Failed handshakes are counted ([`super::RejectionLog`]) and not logged one by one.
pub fn log_to_stderr() {
    let ours = match verbosity() {
        Verbosity::Quiet => "error".to_owned(),
        Verbosity::Usual => ours_at("info"),
        Verbosity::Debug => ours_at("debug") + ",bus=debug",
        Verbosity::Trace => ours_at("trace") + ",bus=trace",
    };
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(ours));
    // Colours are for terminals: a supervisor redirects the log into a file.
    let to_stderr = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    // A second call, in tests, changes nothing.
    let _ = Registry::default()
        .with(to_stderr.with_filter(filter))
        .with(HandshakeCounter)
        .try_init();
}

/// Filter with the project's own crates at a level.
fn ours_at(level: &str) -> String {
    let crates = ["protocol", "sim_replay", "agent", "ego_fuser", "deploy"];
    let ours = crates.map(|name| format!(",{name}={level}")).concat();
    // A router that does not answer is an error of ours, which names the endpoint and the remedy.
    format!("warn,zenoh_link_commons::quic=error,zenoh::net::runtime::orchestrator=error{ours}")
}
