//! The arguments that every process of a fleet shares.

use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use protocol::{CavId, Role, RunId};
use tracing_subscriber::EnvFilter;

use super::shutdown::Stop;
use super::{Bus, BusError, BusOptions, Credentials, Endpoint, Identity, process_id};

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
    /// Folder with the keys of this process (ca.pem, cert.pem, key.pem): connect over TLS, show the certificate and take
    /// no router without one. `v2vloc keys` makes them.
    #[arg(long, value_name = "DIR")]
    pub tls: Option<PathBuf>,
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
    /// [`BusError::Keys`] when there is something wrong with those of `--tls`.
    pub fn options(&self) -> Result<BusOptions, BusError> {
        let mut options = match &self.listen {
            Some(listen) => BusOptions::router(listen.clone()),
            None => BusOptions::client(self.connect.clone()),
        };
        options.patience = Duration::try_from_secs_f64(self.connect_timeout).unwrap_or(Duration::ZERO);
        options.shared_memory_pool = Some(self.shm_mib << 20).filter(|bytes| *bytes > 0);
        options.max_message_bytes = self.max_message_mib.max(1) << 20;
        Ok(match &self.tls {
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

/// Sends the log to standard error: warnings, and what this program's own crates say at `info` and above, unless
/// `RUST_LOG` says otherwise.
pub fn log_to_stderr() {
    const OURS: &str = "warn,protocol=info,sim_replay=info,agent=info,ego_fuser=info,deploy=info";
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(OURS));
    // Colours are for terminals: a supervisor sends this into a file.
    let to_stderr = tracing_subscriber::fmt().with_writer(std::io::stderr).with_ansi(std::io::stderr().is_terminal());
    // A second call, in tests, changes nothing.
    let _ = to_stderr.with_env_filter(filter).try_init();
}
