//! Routers that require keys, and sessions with and without them.

use std::path::{Path, PathBuf};
use std::time::Duration;

use bus::{
    self, AccessControl, Bus, BusError, BusOptions, Credentials, Endpoint, Identity, RejectionLog,
    RouterRejection,
};
use deploy::operate::keys::{KeyPlan, make};
use protocol::{CavId, Principal, RunId, RunScope};
use zenoh::{Config, Session, Wait};

use crate::bus::free_port;

/// Keys of an authority of its own, for these processes of a fleet.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn keys_for(folder: &Path, principals: &[&str]) -> PathBuf {
    let principals = principals
        .iter()
        .map(|name| name.parse::<Principal>().expect("a principal"))
        .collect();
    make(&KeyPlan::new(folder, principals, 1)).expect("a writable folder");
    folder.to_path_buf()
}

/// Long enough for a connection on loopback; timeout of a refused one.
pub const TRIED_FOR: Duration = Duration::from_secs(2);

/// A session over QUIC that shows the given certificate or none, without the checks of the bus. It tries once.
///
/// # Errors
/// zenoh's error, when the router refuses it.
///
/// # Panics
/// When zenoh rejects a setting.
pub fn unauthorised_peer(
    router: &Endpoint,
    authority: &Path,
    own: Option<&Path>,
) -> Result<Session, String> {
    let quoted = |path: &Path| format!("{:?}", path.to_str().unwrap());
    let mut settings = vec![
        ("mode", r#""client""#.to_owned()),
        ("connect/endpoints", format!(r#"["{}"]"#, router)),
        ("connect/timeout_ms", "0".to_owned()),
        ("connect/exit_on_failure", "true".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        (
            "transport/link/tls/root_ca_certificate",
            quoted(&authority.join("ca.pem")),
        ),
        ("transport/link/tls/enable_mtls", own.is_some().to_string()),
    ];
    if let Some(own) = own {
        settings.push((
            "transport/link/tls/connect_certificate",
            quoted(&own.join("cert.pem")),
        ));
        settings.push((
            "transport/link/tls/connect_private_key",
            quoted(&own.join("key.pem")),
        ));
    }
    let mut config = Config::default();
    settings
        .iter()
        .for_each(|(key, value)| config.insert_json5(key, value).unwrap());
    zenoh::open(config)
        .wait()
        .map_err(|cause| cause.to_string())
}

/// A router that admits the holders of keys of `folder`, each restricted to its own topics in the run `test`.
pub struct GuardedRouter {
    /// Endpoint at which it listens.
    pub endpoint: Endpoint,
    /// Its session.
    pub session: Session,
    keys: PathBuf,
}

impl GuardedRouter {
    /// Opens one on a free port.
    ///
    /// # Panics
    /// When there is none.
    #[must_use]
    pub fn open(keys: &Path) -> Self {
        let credentials = Credentials::read(&keys.join("router")).expect("keys of a router");
        let runs = RunScope::One(RunId::new("test").expect("an identifier"));
        let guard = AccessControl {
            members: credentials.members().expect("a list"),
            runs,
        };
        // Another process may take the port between the two calls.
        let opened = (0..20).find_map(|_| {
            let options = BusOptions::router(Endpoint::loopback(free_port()));
            let mut options = options.with_credentials(credentials.clone());
            options.guard = Some(guard.clone());
            bus::open(&options)
                .ok()
                .map(|session| (options.endpoint.clone(), session))
        });
        let (endpoint, session) = opened.expect("a free port on loopback");
        Self {
            endpoint,
            session,
            keys: keys.to_path_buf(),
        }
    }

    /// Options of a client with the keys of `holder`.
    ///
    /// # Panics
    /// When it has none.
    #[must_use]
    pub fn options(&self, holder: &str) -> BusOptions {
        let credentials = Credentials::read(&self.keys.join(holder)).expect("keys");
        let mut options = BusOptions::client(self.endpoint.clone()).with_credentials(credentials);
        options.connect_timeout = Duration::from_secs(20);
        options
    }

    /// A process of the run `test` with the keys of `holder` that claims to be `process`, of vehicle `cav`.
    ///
    /// # Errors
    /// [`BusError`] when the router refuses it.
    ///
    /// # Panics
    /// When there are no such keys.
    pub fn join_as(&self, holder: &str, process: &str, cav: &str) -> Result<Bus, BusError> {
        let identity = Identity {
            run: RunId::new("test").expect("an identifier"),
            process: process.parse().expect("an identifier"),
            cav: CavId::new(cav).expect("an identifier"),
        };
        Bus::join(&self.options(holder), identity)
    }

    /// An honest process.
    ///
    /// # Panics
    /// When the router refuses it.
    #[must_use]
    pub fn join(&self, principal: &str) -> Bus {
        let known: Principal = principal.parse().expect("a principal");
        self.join_as(principal, principal, known.cav.as_str())
            .expect("the router takes those with keys")
    }

    /// Number of messages of one kind that it has refused to a peer so far.
    #[must_use]
    pub fn refused(&self, peer: &str, message: &str) -> u64 {
        let mut refusals = RejectionLog::of(&self.endpoint);
        refusals.update(&self.session);
        let is_it = |refusal: &RouterRejection| refusal.peer == peer && refusal.message == message;
        refusals
            .counts()
            .iter()
            .filter(|(refusal, _)| is_it(refusal))
            .map(|(_, count)| count)
            .sum()
    }
}
