//! The arguments that every process of a fleet shares.

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use protocol::{CavId, Role, RunId};
use tracing_subscriber::layer::{Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry};

use super::handshake_failures::HandshakeCounter;
use super::shutdown::Stop;
use super::{Bus, BusError, BusOptions, Credentials, Endpoint, Identity, InboxLimits, process_id};

/// How long a process may take to end after it was asked to: within the 5 s that a whole fleet has.
pub const STOP_LIMIT: Duration = Duration::from_secs(4);

/// Which run to join, where, and how to end.
#[derive(Debug, Clone, clap::Args)]
pub struct BusArgs {
    /// Name of the run: 1 to 32 characters of a-z, 0-9, '_' and '-'.
    #[arg(long)]
    pub run: RunId,
    /// The router to connect to, tcp/HOST:PORT.
    #[arg(long, default_value = "tcp/127.0.0.1:7447")]
    pub connect: Endpoint,
    /// Be the run's router oneself and listen here, tcp/HOST:PORT; no launcher or zenohd is needed then.
    #[arg(long, conflicts_with = "connect")]
    pub listen: Option<Endpoint>,
    /// Folder with the keys of this process (ca.pem, cert.pem, key.pem): connect over QUIC, show the certificate and
    /// take no router without one. `v2vloc keys` makes them.
    #[arg(long, value_name = "DIR")]
    pub keys: Option<PathBuf>,
    /// Seconds to go on trying to reach the router.
    #[arg(long, default_value_t = 10.0)]
    pub connect_timeout: f64,
    /// Shared memory for large messages between processes of one machine, MiB; 0: none, everything takes the socket.
    #[arg(long, default_value_t = 0)]
    pub shm_mib: usize,
    /// Largest message accepted from outside, MiB.
    #[arg(long, default_value_t = 32)]
    pub max_message_mib: usize,
    /// Serve counters and times of this process to Prometheus at http://HOST:PORT/metrics; port 0: any free one.
    #[arg(long, value_name = "HOST:PORT")]
    pub metrics: Option<SocketAddr>,
    /// End when standard input ends: for a supervisor that holds the other end of the pipe.
    #[arg(long)]
    pub supervised: bool,
}

impl BusArgs {
    /// The session that the arguments ask for.
    ///
    /// # Errors
    /// [`BusError::Keys`] when there is something wrong with those of `--keys`.
    pub fn options(&self) -> Result<BusOptions, BusError> {
        let mut options = match &self.listen {
            Some(listen) => BusOptions::router(listen.clone()),
            None => BusOptions::client(self.connect.clone()),
        };
        options.patience = Duration::try_from_secs_f64(self.connect_timeout).unwrap_or(Duration::ZERO);
        options.shared_memory_pool = Some(self.shm_mib << 20).filter(|bytes| *bytes > 0);
        options.max_message_bytes = self.max_message_mib.max(1) << 20;
        Ok(match &self.keys {
            Some(folder) => options.with_credentials(Credentials::read(folder)?),
            None => options,
        })
    }

    /// Joins the run in a role.
    ///
    /// # Errors
    /// [`BusError`] names the endpoint and what to do.
    pub fn join(&self, role: Role, cav: &CavId) -> Result<Bus, BusError> {
        let identity = Identity { run: self.run.clone(), process: process_id(role, cav), cav: cav.clone() };
        let options = self.options()?;
        if let Some(credentials) = &options.credentials {
            credentials.check_name(identity.process.as_str())?;
        }
        let mut bus = Bus::join(&options, identity)?;
        if let Some(address) = self.metrics {
            let address = bus.serve_metrics(address)?;
            tracing::info!("metrics at http://{address}/metrics");
        }
        Ok(bus)
    }

    /// A request to end that follows signals and, where asked for, the end of standard input, and that is enforced.
    ///
    /// # Errors
    /// When handlers or threads cannot be installed.
    pub fn stop(&self) -> std::io::Result<Stop> {
        let stop = Stop::new();
        stop.on_signals()?;
        if self.supervised {
            stop.on_end_of_input()?;
        }
        stop.enforce(STOP_LIMIT);
        Ok(stop)
    }
}

/// How much other vehicles may bring a process that listens to them.
#[derive(Debug, Clone, clap::Args)]
pub struct PeerArgs {
    /// Messages that each sender may bring a second; what is more is dropped unread (rate_limit in the ledger).
    #[arg(long, value_name = "N", default_value_t = InboxLimits::PEERS.messages_per_s, value_parser = above_zero)]
    pub peer_messages_per_s: f64,
    /// The same in MiB a second, on each of its streams.
    #[arg(long, value_name = "MIB", default_value_t = InboxLimits::PEERS.bytes_per_s / MIB, value_parser = above_zero)]
    pub peer_mib_per_s: f64,
    /// MiB that may wait to be decoded, of all senders together.
    #[arg(long, value_name = "MIB", default_value_t = InboxLimits::PEERS.waiting_bytes >> 20)]
    pub waiting_mib: usize,
}

const MIB: f64 = (1 << 20) as f64;

fn above_zero(text: &str) -> Result<f64, String> {
    let number: f64 = text.parse().map_err(|_| "not a number".to_owned())?;
    if number > 0.0 { Ok(number) } else { Err("must be above 0".to_owned()) }
}

impl PeerArgs {
    /// What an inbox takes.
    #[must_use]
    pub fn limits(&self) -> InboxLimits {
        InboxLimits {
            messages_per_s: self.peer_messages_per_s,
            bytes_per_s: self.peer_mib_per_s * MIB,
            waiting_bytes: self.waiting_mib.saturating_mul(1 << 20),
        }
    }
}

/// Sends the log to standard error: warnings, and what this program's own crates say at `info` and above, unless
/// `RUST_LOG` says otherwise. Handshakes that fail are counted ([`super::Refusals`]) and not each written down.
pub fn log_to_stderr() {
    const OURS: &str = "warn,zenoh_link_commons::quic=error,\
                        protocol=info,sim_replay=info,agent=info,ego_fuser=info,deploy=info";
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(OURS));
    // Colours are for terminals: a supervisor sends this into a file.
    let to_stderr =
        tracing_subscriber::fmt::layer().with_writer(std::io::stderr).with_ansi(std::io::stderr().is_terminal());
    // A second call, in tests, changes nothing.
    let _ = Registry::default().with(to_stderr.with_filter(filter)).with(HandshakeCounter).try_init();
}
