//! A test authority, and certificates for the processes of a fleet.
//!
//! ```text
//! KEYS/authority.key        signs further certificates; belongs on no vehicle
//! KEYS/agent-4279/ca.pem    certificate of the authority
//!                 cert.pem  certificate of this process: its common name is the name of the folder
//!                 key.pem   private key, readable for its owner only
//! KEYS/router/members       in addition to the three files: the processes that the router admits
//! ```
//!
//! A host gets the folders of its own processes and nothing else.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::net::IpAddr;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use bus::{AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, MEMBERS_FILE, ROUTER};
use protocol::{CavId, Principal, Role};
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose, SanType, date_time_ymd,
};
use support::atomic_file;
use support::bounded_file::{self, MAX_TEXT_BYTES};
use support::file_error::{AtFile, FileError};

/// File name of the authority's key.
const AUTHORITY_KEY: &str = "authority.key";
const AUTHORITY_NAME: &str = "v2vloc test authority";
const DAY: Duration = Duration::from_secs(24 * 3600);
/// Certificates hold from a little before they are made: clocks differ.
const LEEWAY: Duration = Duration::from_secs(600);

/// Plan of the keys to make.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyPlan {
    /// Folder; an existing authority in it signs.
    pub folder: PathBuf,
    /// Processes that get keys, in addition to the router.
    pub principals: Vec<Principal>,
    /// Names and addresses of the router.
    pub hosts: Vec<String>,
    /// Lifetime of the certificates.
    pub lifetime: Duration,
    /// True if existing certificates are replaced.
    pub replace: bool,
}

impl KeyPlan {
    /// Certificates for `principals` of a fleet on this machine, valid for `days` days.
    pub fn new(folder: &Path, principals: Vec<Principal>, days: u32) -> Self {
        let hosts = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into();
        Self {
            folder: folder.to_path_buf(),
            principals,
            hosts,
            lifetime: DAY * days,
            replace: false,
        }
    }

    /// File of a process's certificate.
    fn certificate(&self, name: &str) -> PathBuf {
        self.folder.join(name).join(CERTIFICATE_FILE)
    }
}

/// Processes of a fleet that get keys: those of its vehicles, and those that are of no vehicle.
pub fn principals_of(agents: &[CavId], egos: &[CavId]) -> [Vec<Principal>; 2] {
    use Role::{Agent, Ego, Link, Recorder, Replay, Ros2, Scorer, Viewer};
    let agents = agents.iter().map(|cav| (Agent, cav));
    let egos = egos.iter().flat_map(|cav| [(Ego, cav), (Link, cav)]);
    let processes = agents.chain(egos);
    let of_vehicles = processes.map(|(role, cav)| Principal::new(role, cav));
    let others = [Replay, Scorer, Recorder, Viewer, Ros2].map(Principal::of_role);
    [of_vehicles.collect(), others.into()]
}

/// Reason why no keys could be made.
#[derive(Debug, thiserror::Error)]
pub enum KeyFileError {
    /// The file system refuses a file or folder.
    #[error(transparent)]
    File(#[from] FileError),
    /// Existing keys are not overwritten without `--force`.
    #[error("{} is there already; --force replaces it; the old one stays valid until it expires", .0.display())]
    There(PathBuf),
    /// A host name or a key that cannot be used.
    #[error("{what}: {cause}")]
    Unusable {
        /// Host name or file.
        what: String,
        /// Error of the certificate library.
        cause: rcgen::Error,
    },
}

/// Makes the keys of the plan; returns every file that it wrote.
///
/// # Errors
/// [`KeyFileError`]; files that were written before it stay.
pub fn make(plan: &KeyPlan) -> Result<Vec<PathBuf>, KeyFileError> {
    let mut store = KeyStore {
        plan,
        written: Vec::new(),
    };
    let names = plan.principals.iter().map(ToString::to_string);
    // All are checked before any is written, so that a refusal changes nothing.
    if !plan.replace
        && let Some(taken) = names.clone().find(|name| plan.certificate(name).exists())
    {
        return Err(KeyFileError::There(plan.certificate(&taken)));
    }
    let authority = store.authority()?;
    let router = (plan.replace || !plan.certificate(ROUTER).exists()).then(|| ROUTER.to_owned());
    for name in names.chain(router) {
        store.certify(&authority, &name)?;
    }
    store.enlist()?;
    Ok(store.written)
}

/// The authority: its certificate as text, and its signer.
type Authority = (String, Issuer<'static, KeyPair>);

struct KeyStore<'a> {
    plan: &'a KeyPlan,
    written: Vec<PathBuf>,
}

impl KeyStore<'_> {
    /// Loads the authority of the folder, or creates one.
    fn authority(&mut self) -> Result<Authority, KeyFileError> {
        let folder = &self.plan.folder;
        make_folder(folder)?;
        let (key_path, pem_path) = (folder.join(AUTHORITY_KEY), folder.join(AUTHORITY_FILE));
        let unusable = unusable(key_path.display().to_string());
        // An existing one stays valid for as long as the certificates that it signs.
        let mut params = params(AUTHORITY_NAME, self.plan.lifetime.max(DAY * 3650))?;
        // Path length 0: what it signs cannot sign further certificates.
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let (pem, key) = if key_path.exists() {
            let key = KeyPair::from_pem(&read(&key_path)?).map_err(&unusable)?;
            (read(&pem_path)?, key)
        } else {
            let key = KeyPair::generate().map_err(&unusable)?;
            let pem = params.self_signed(&key).map_err(&unusable)?.pem();
            self.write(pem_path, &pem, 0o644)?;
            // Written last: if it exists, the certificate does.
            self.write(key_path.clone(), &key.serialize_pem(), 0o600)?;
            (pem, key)
        };
        Ok((pem, Issuer::new(params, key)))
    }

    fn certify(&mut self, (pem, issuer): &Authority, name: &str) -> Result<(), KeyFileError> {
        let folder = &self.plan.folder.join(name);
        let unusable = unusable(format!("a certificate for {name}"));
        let mut params = params(name, self.plan.lifetime)?;
        params.use_authority_key_identifier_extension = true;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        // Any process can be the router of its run (--listen); only the one of that name is addressed by host name.
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        if name == ROUTER {
            let usages = &mut params.extended_key_usages;
            usages.push(ExtendedKeyUsagePurpose::ServerAuth);
            let hosts = self.plan.hosts.iter().map(|host| alternative(host));
            params.subject_alt_names = hosts.collect::<Result<_, _>>()?;
        }
        let key = KeyPair::generate().map_err(&unusable)?;
        let certificate = params.signed_by(&key, issuer).map_err(&unusable)?;
        make_folder(folder)?;
        let path = folder.join(CERTIFICATE_FILE);
        // One that is replaced does not fit the new key.
        let _ = fs::remove_file(&path);
        self.write(folder.join(AUTHORITY_FILE), pem, 0o644)?;
        self.write(folder.join(KEY_FILE), &key.serialize_pem(), 0o600)?;
        // Written last: if it exists, the other files do.
        self.write(path, &certificate.pem(), 0o644)
    }

    /// Writes the router's list of every process in the folder, including earlier ones.
    fn enlist(&mut self) -> Result<(), KeyFileError> {
        let folder = &self.plan.folder;
        let mut members = Vec::new();
        for entry in fs::read_dir(folder).at(folder)? {
            let entry = entry.at(folder)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if entry.path().join(CERTIFICATE_FILE).exists() && name.parse::<Principal>().is_ok() {
                members.push(name + "\n");
            }
        }
        members.sort();
        let path = folder.join(ROUTER).join(MEMBERS_FILE);
        self.write(path, &members.concat(), 0o644)
    }

    /// Atomic write: leaves neither half a file nor a moment in which others can read a key.
    fn write(&mut self, path: PathBuf, text: &str, mode: u32) -> Result<(), KeyFileError> {
        let begun = path.with_extension("new");
        // A file that an interrupted write has left would stop create_new.
        let _ = fs::remove_file(&begun);
        let mut options = OpenOptions::new();
        options.write(true).create_new(true).mode(mode);
        let written = options.open(&begun).and_then(|mut file| {
            file.write_all(text.as_bytes())?;
            file.sync_all()?;
            fs::rename(&begun, &path)?;
            atomic_file::sync_name(&path)
        });
        written.at(&path)?;
        self.written.push(path);
        Ok(())
    }
}

fn unusable(what: String) -> impl Fn(rcgen::Error) -> KeyFileError {
    move |cause| KeyFileError::Unusable {
        what: what.clone(),
        cause,
    }
}

fn make_folder(path: &Path) -> Result<(), FileError> {
    atomic_file::create_folder_by(fs::DirBuilder::new().mode(0o700), path).at(path)
}

fn read(path: &Path) -> Result<String, FileError> {
    bounded_file::read_text(path, MAX_TEXT_BYTES).at(path)
}

fn params(name: &str, lifetime: Duration) -> Result<CertificateParams, KeyFileError> {
    let mut params = CertificateParams::new(Vec::new()).map_err(unusable(name.to_owned()))?;
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    let now = UNIX_EPOCH.elapsed().unwrap_or_default();
    let epoch = date_time_ymd(1970, 1, 1);
    params.not_before = epoch + now.saturating_sub(LEEWAY);
    params.not_after = epoch + now + lifetime;
    Ok(params)
}

/// A name or an address in a router's certificate.
fn alternative(host: &str) -> Result<SanType, KeyFileError> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return Ok(SanType::IpAddress(address));
    }
    let name = host.try_into().map(SanType::DnsName);
    name.map_err(unusable(format!("host {host:?}")))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use bus::Credentials;

    use super::*;

    fn principals(names: &[&str]) -> Vec<Principal> {
        names.iter().map(|name| name.parse().unwrap()).collect()
    }

    fn certificate_of(name: &str, folder: &Path) -> Vec<u8> {
        fs::read(folder.join(name).join(CERTIFICATE_FILE)).unwrap()
    }

    #[test]
    fn everybody_gets_a_certificate_and_a_key_of_his_own() {
        let folder = tempfile::tempdir().unwrap();
        let plan = KeyPlan::new(
            &folder.path().join("keys"),
            principals(&["agent-1", "replay"]),
            1,
        );
        let written = make(&plan).unwrap();
        assert_eq!(written.len(), 2 + 3 * 3 + 1, "{written:?}");
        for name in ["agent-1", "replay", "router"] {
            let credentials = Credentials::read(&plan.folder.join(name)).unwrap();
            assert_eq!(credentials.name(), name);
            assert!(credentials.check_name("agent-2").is_err());
            let mode = fs::metadata(plan.folder.join(name).join(KEY_FILE))
                .unwrap()
                .permissions()
                .mode();
            assert_eq!(mode & 0o777, 0o600, "{name}");
        }
        assert_eq!(
            fs::metadata(plan.folder.join(AUTHORITY_KEY))
                .unwrap()
                .permissions()
                .mode()
                & 0o777,
            0o600
        );
        let members = Credentials::read(&plan.folder.join("router"))
            .unwrap()
            .members()
            .unwrap();
        assert_eq!(members, principals(&["agent-1", "replay"]));
    }

    #[test]
    fn existing_keys_stay_without_force() {
        let folder = tempfile::tempdir().unwrap();
        let plan = KeyPlan::new(folder.path(), principals(&["agent-1"]), 1);
        make(&plan).unwrap();
        let certificates = ["agent-1", "router"].map(|name| certificate_of(name, folder.path()));
        assert!(matches!(make(&plan), Err(KeyFileError::There(_))));
        // A vehicle that is added later is signed by the same authority.
        make(&KeyPlan {
            principals: principals(&["agent-2"]),
            ..plan.clone()
        })
        .unwrap();
        assert_eq!(
            ["agent-1", "router"].map(|name| certificate_of(name, folder.path())),
            certificates
        );
        let members = fs::read_to_string(folder.path().join("router/members")).unwrap();
        assert_eq!(members, "agent-1\nagent-2\n");
        make(&KeyPlan {
            replace: true,
            ..plan
        })
        .unwrap();
        assert_ne!(certificate_of("agent-1", folder.path()), certificates[0]);
    }

    #[test]
    fn a_call_that_was_interrupted_is_made_good_by_the_next() {
        let folder = tempfile::tempdir().unwrap();
        let plan = KeyPlan::new(folder.path(), principals(&["agent-1"]), 1);
        // Folders in the way of the authority's certificate, and of one that is replaced.
        for (obstacle, replace) in [("ca.new", false), ("agent-1/cert.new", true)] {
            let obstacle = folder.path().join(obstacle);
            fs::create_dir(&obstacle).unwrap();
            let plan_of_call = KeyPlan {
                replace,
                ..plan.clone()
            };
            make(&plan_of_call).unwrap_err();
            fs::remove_dir(&obstacle).unwrap();
            make(&plan).unwrap();
            Credentials::read(&folder.path().join("agent-1")).unwrap();
        }
    }

    #[test]
    fn an_expired_certificate_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let plan = KeyPlan {
            lifetime: Duration::ZERO,
            ..KeyPlan::new(folder.path(), principals(&["agent-1"]), 1)
        };
        make(&plan).unwrap();
        std::thread::sleep(Duration::from_millis(1100));
        let error = Credentials::read(&folder.path().join("agent-1"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("agent-1 expired"), "{error}");
    }

    #[test]
    fn a_host_that_is_none_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let hosts = vec!["router.local".into(), "näher".into()];
        let plan = KeyPlan {
            hosts,
            ..KeyPlan::new(folder.path(), Vec::new(), 1)
        };
        assert!(make(&plan).unwrap_err().to_string().contains("näher"));
    }
}
