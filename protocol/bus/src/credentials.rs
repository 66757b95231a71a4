//! Keys and certificates: who a process is, in a form that its peers can check.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use protocol::Principal;
use x509_parser::pem::parse_x509_pem;

use super::BusError;

/// The authority that everybody trusts.
pub const AUTHORITY_FILE: &str = "ca.pem";
/// The certificate of this process.
pub const CERTIFICATE_FILE: &str = "cert.pem";
/// Its private key.
pub const KEY_FILE: &str = "key.pem";
/// The router's list of those it lets in, one name a line.
pub const MEMBERS_FILE: &str = "members";
/// The name in a router's certificate.
pub const ROUTER: &str = "router";

/// A certificate that ends sooner than this is worth a warning when a process starts.
const SOON: Duration = Duration::from_secs(3 * 24 * 3600);

/// A folder with `ca.pem`, `cert.pem` and `key.pem`, looked through once: what is wrong with it is said here, in words,
/// and not by a handshake that fails.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Credentials {
    folder: PathBuf,
    name: String,
}

impl Credentials {
    /// Reads the folder.
    ///
    /// # Errors
    /// [`BusError::Keys`] names the file and what is wrong with it: missing, no certificate, expired.
    pub fn read(folder: &Path) -> Result<Self, BusError> {
        let folder = std::path::absolute(folder).map_err(|cause| bad(folder, &cause))?;
        for file in [AUTHORITY_FILE, KEY_FILE] {
            readable(&folder.join(file))?;
        }
        let key = folder.join(KEY_FILE);
        let mode = fs::metadata(&key).map_err(|cause| bad(&key, &cause))?.permissions().mode();
        if mode & 0o077 != 0 {
            tracing::warn!("{}: others on this machine can read this key (mode {:03o})", key.display(), mode & 0o777);
        }
        let name = name_of(&folder.join(CERTIFICATE_FILE), SystemTime::now())?;
        Ok(Self { folder, name })
    }

    /// The common name of the certificate.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether this is the certificate of that process.
    ///
    /// # Errors
    /// [`BusError::Keys`] names both.
    pub fn check_name(&self, wanted: &str) -> Result<(), BusError> {
        if self.name == wanted {
            return Ok(());
        }
        let certificate = self.folder.join(CERTIFICATE_FILE);
        Err(bad(&certificate, &format!("this is the certificate of {}, and {wanted} needs its own", self.name)))
    }

    /// Path of one of the files, as zenoh wants it.
    pub(super) fn path(&self, file: &str) -> String {
        self.folder.join(file).to_string_lossy().into_owned()
    }

    /// Those a router lets in.
    ///
    /// # Errors
    /// [`BusError::Keys`] names the line that names nobody.
    pub fn members(&self) -> Result<Vec<Principal>, BusError> {
        let path = self.folder.join(MEMBERS_FILE);
        let text = readable(&path)?;
        let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        lines.map(|line| line.parse().map_err(|cause: protocol::PrincipalError| bad(&path, &cause))).collect()
    }
}

fn bad(path: &Path, what: &impl ToString) -> BusError {
    BusError::Keys { path: path.to_path_buf(), what: what.to_string() }
}

fn readable(path: &Path) -> Result<String, BusError> {
    fs::read_to_string(path).map_err(|cause| bad(path, &cause))
}

/// Common name of a certificate that holds at this moment.
fn name_of(path: &Path, now: SystemTime) -> Result<String, BusError> {
    let text = readable(path)?;
    let (_, pem) = parse_x509_pem(text.as_bytes()).map_err(|cause| bad(path, &cause))?;
    let certificate = pem.parse_x509().map_err(|cause| bad(path, &cause))?;
    let name = certificate.subject().iter_common_name().next().and_then(|name| name.as_str().ok());
    let name = name.ok_or_else(|| bad(path, &"this certificate names nobody"))?.to_owned();
    let validity = certificate.validity();
    let now = i64::try_from(now.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()).unwrap_or(i64::MAX);
    let (from, until) = (validity.not_before, validity.not_after);
    if now > until.timestamp() {
        return Err(bad(path, &format!("the certificate of {name} expired on {until}")));
    }
    if now < from.timestamp() {
        return Err(bad(path, &format!("the certificate of {name} holds from {from} on only: is the clock right?")));
    }
    if until.timestamp() - now < SOON.as_secs().cast_signed() {
        tracing::info!("the certificate of {name} expires on {until}");
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_missing_or_no_certificate_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let says = |text: &str| {
            let error = Credentials::read(folder.path()).unwrap_err().to_string();
            assert!(error.contains(text), "{error}");
        };
        says("ca.pem");
        fs::write(folder.path().join("ca.pem"), "").unwrap();
        says("key.pem");
        fs::write(folder.path().join("key.pem"), "").unwrap();
        says("cert.pem");
        fs::write(folder.path().join("cert.pem"), "no certificate").unwrap();
        says("cert.pem");
    }

    #[test]
    fn members_are_parties() {
        let folder = tempfile::tempdir().unwrap();
        let credentials = Credentials { folder: folder.path().into(), name: ROUTER.into() };
        assert!(credentials.members().unwrap_err().to_string().contains("members"));
        fs::write(folder.path().join("members"), "agent-1\n\nreplay\n").unwrap();
        let members = credentials.members().unwrap();
        assert_eq!(members.iter().map(ToString::to_string).collect::<Vec<_>>(), ["agent-1", "replay"]);
        fs::write(folder.path().join("members"), "agent-*\n").unwrap();
        assert!(credentials.members().is_err());
    }
}
