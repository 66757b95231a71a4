//! Credentials: keys and certificates that authenticate a process to its peers.

use std::fmt::Display;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use protocol::Principal;
use support::bounded_file::{self, MAX_TEXT_BYTES};
use x509_parser::pem::parse_x509_pem;

use super::BusError;

/// Certificate of the authority that all processes trust.
pub const AUTHORITY_FILE: &str = "ca.pem";
/// Certificate of this process.
pub const CERTIFICATE_FILE: &str = "cert.pem";
/// Private key of this process.
pub const KEY_FILE: &str = "key.pem";
/// The router's list of admitted principals, one name per line.
pub const MEMBERS_FILE: &str = "members";
/// Common name of a router's certificate.
pub const ROUTER: &str = "router";

/// Remaining validity below which a warning is logged at the start of a process.
const SOON: Duration = Duration::from_secs(3 * 24 * 3600);

/// A folder with `ca.pem`, `cert.pem` and `key.pem`, checked once: errors are reported here, with their cause, and not
/// by a handshake that fails.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Credentials {
    folder: PathBuf,
    name: String,
}

impl Credentials {
    /// Reads the folder.
    ///
    /// # Errors
    /// [`BusError::Keys`] states the file and its error: missing, no certificate, expired.
    pub fn read(folder: &Path) -> Result<Self, BusError> {
        let folder = std::path::absolute(folder).map_err(|cause| bad(folder, &cause))?;
        for file in [AUTHORITY_FILE, KEY_FILE] {
            readable(&folder.join(file))?;
        }
        let key = folder.join(KEY_FILE);
        let metadata = fs::metadata(&key).map_err(|cause| bad(&key, &cause))?;
        let mode = metadata.permissions().mode();
        if mode & 0o077 != 0 {
            let (key, mode) = (key.display(), mode & 0o777);
            tracing::warn!("{key}: others on this machine can read this key (mode {mode:03o})");
        }
        let name = name_of(&folder.join(CERTIFICATE_FILE), SystemTime::now())?;
        Ok(Self { folder, name })
    }

    /// The common name of the certificate.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Checks that this is the certificate of that process.
    ///
    /// # Errors
    /// [`BusError::Keys`] states both names.
    pub fn check_name(&self, wanted: &str) -> Result<(), BusError> {
        let name = self.name();
        if name == wanted {
            return Ok(());
        }
        let certificate = self.folder.join(CERTIFICATE_FILE);
        let what = format!("this is the certificate of {name}, and {wanted} needs its own");
        Err(bad(&certificate, &what))
    }

    /// Path of one of the files, as text for zenoh.
    pub(super) fn path(&self, file: &str) -> String {
        self.folder.join(file).to_string_lossy().into_owned()
    }

    /// Principals that a router admits.
    ///
    /// # Errors
    /// [`BusError::Keys`] states the line that names no principal.
    pub fn members(&self) -> Result<Vec<Principal>, BusError> {
        let path = self.folder.join(MEMBERS_FILE);
        let text = readable(&path)?;
        let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
        lines
            .map(|line| line.parse::<Principal>().map_err(|what| bad(&path, &what)))
            .collect()
    }
}

fn bad(path: &Path, what: &impl Display) -> BusError {
    BusError::Keys(format!("{}: {what}", path.display()))
}

fn readable(path: &Path) -> Result<String, BusError> {
    bounded_file::read_text(path, MAX_TEXT_BYTES).map_err(|cause| bad(path, &cause))
}

/// Common name of a certificate that is valid at this time.
fn name_of(path: &Path, now: SystemTime) -> Result<String, BusError> {
    let text = readable(path)?;
    let (_, pem) = parse_x509_pem(text.as_bytes()).map_err(|cause| bad(path, &cause))?;
    let certificate = pem.parse_x509().map_err(|cause| bad(path, &cause))?;
    let mut names = certificate.subject().iter_common_name();
    let name = names.next().and_then(|name| name.as_str().ok());
    let name = name
        .ok_or_else(|| bad(path, &"this certificate has no common name"))?
        .to_owned();
    let validity = certificate.validity();
    // A clock before 1970 counts as 1970: the certificate is not valid yet then.
    let now = i64::try_from(now.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs())
        .unwrap_or(i64::MAX);
    let (from, until) = (validity.not_before, validity.not_after);
    if now > until.timestamp() {
        let what = format!("the certificate of {name} expired on {until}");
        return Err(bad(path, &what));
    }
    if now < from.timestamp() {
        let what =
            format!("the certificate of {name} holds from {from} on only: is the clock right?");
        return Err(bad(path, &what));
    }
    if until.timestamp() - now < SOON.as_secs().cast_signed() {
        tracing::info!("the certificate of {name} expires on {until}");
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn expect_error(folder: &Path, file: &str) {
        let error = Credentials::read(folder).unwrap_err().to_string();
        assert!(error.contains(file), "{error}");
    }

    #[test]
    fn errors_state_the_missing_or_invalid_file() {
        let folder = tempfile::tempdir().unwrap();
        expect_error(folder.path(), "ca.pem");
        fs::write(folder.path().join("ca.pem"), "").unwrap();
        expect_error(folder.path(), "key.pem");
        fs::write(folder.path().join("key.pem"), "").unwrap();
        expect_error(folder.path(), "cert.pem");
        fs::write(folder.path().join("cert.pem"), "no certificate").unwrap();
        expect_error(folder.path(), "cert.pem");
    }

    #[test]
    fn members_are_principals() {
        let folder = tempfile::tempdir().unwrap();
        let credentials = Credentials {
            folder: folder.path().into(),
            name: ROUTER.into(),
        };
        assert!(
            credentials
                .members()
                .unwrap_err()
                .to_string()
                .contains("members")
        );
        fs::write(folder.path().join("members"), "agent-1\n\nreplay\n").unwrap();
        let members = credentials.members().unwrap();
        assert_eq!(
            members.iter().map(ToString::to_string).collect::<Vec<_>>(),
            ["agent-1", "replay"]
        );
        fs::write(folder.path().join("members"), "agent-*\n").unwrap();
        assert!(credentials.members().is_err());
    }
}
