//! File digests: SHA-256 of whole files, each read once.

use std::collections::HashMap;
use std::fs::{File, Metadata};
use std::io::{self, BufReader};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Mutex;

use protocol::text::hex;
use sha2::{Digest, Sha256};

use crate::sync::lock;

/// The file of this process, also where another one has taken its place since.
const THIS_PROGRAM: &str = "/proc/self/exe";
/// Bytes read at a time.
const CHUNK_BYTES: usize = 256 << 10;

/// Digests of the files of one run of a program. A file that was changed since it was read is read again; what tells
/// them apart (device, inode, size, times of change) is not kept beyond the run.
#[derive(Debug, Default)]
pub struct FileDigests {
    known: Mutex<HashMap<Version, [u8; 32]>>,
}

/// A file with one content, as far as the system states it.
#[derive(Debug, PartialEq, Eq, Hash)]
struct Version {
    device: u64,
    inode: u64,
    bytes: u64,
    /// Seconds and nanoseconds of the last change of the content, and of the content or its attributes.
    changed: [(i64, i64); 2],
}

impl Version {
    fn of(file: &Metadata) -> Self {
        Self {
            device: file.dev(),
            inode: file.ino(),
            bytes: file.len(),
            changed: [
                (file.mtime(), file.mtime_nsec()),
                (file.ctime(), file.ctime_nsec()),
            ],
        }
    }
}

impl FileDigests {
    /// SHA-256 of the whole content of a file.
    ///
    /// # Errors
    /// The error of the system, with the path; [`io::ErrorKind::InvalidInput`] for anything but a regular file, whose
    /// content may have no end.
    pub fn of(&self, path: &Path) -> io::Result<[u8; 32]> {
        self.read(path)
            .map_err(|error| io::Error::new(error.kind(), format!("{}: {error}", path.display())))
    }

    /// [`Self::of`] in hexadecimal digits, as `sha256sum` prints it.
    ///
    /// # Errors
    /// As [`Self::of`].
    pub fn sha256(&self, path: &Path) -> io::Result<String> {
        self.of(path).map(|digest| hex(&digest))
    }

    /// SHA-256 of the program that runs.
    ///
    /// # Errors
    /// As [`Self::of`].
    pub fn program_sha256(&self) -> io::Result<String> {
        self.sha256(Path::new(THIS_PROGRAM))
    }

    fn read(&self, path: &Path) -> io::Result<[u8; 32]> {
        let about = path.metadata()?;
        if !about.is_file() {
            let reason = "not a regular file";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        // Before the content: if the file changes while it is read, its next version is not known yet.
        let version = Version::of(&about);
        if let Some(digest) = lock(&self.known).get(&version) {
            return Ok(*digest);
        }
        // Without the lock: two threads may hash one file at the same time, with the same result.
        let mut hash = Sha256::new();
        let mut file = BufReader::with_capacity(CHUNK_BYTES, File::open(path)?);
        io::copy(&mut file, &mut hash)?;
        let digest = hash.finalize().into();
        lock(&self.known).insert(version, digest);
        Ok(digest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_changed_byte_changes_the_digest_within_one_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("weights");
        std::fs::write(&path, "weights").unwrap();
        let digests = FileDigests::default();
        let first = digests.sha256(&path).unwrap();
        // From `printf weights | sha256sum`.
        assert!(first.starts_with("9a129038d9a00aed"), "{first}");
        assert_eq!(digests.sha256(&path).unwrap(), first);
        std::fs::write(&path, "weightt").unwrap();
        assert_ne!(digests.sha256(&path).unwrap(), first);
    }

    #[test]
    fn a_file_that_cannot_be_read_to_an_end_is_refused_by_name() {
        let digests = FileDigests::default();
        for path in ["/nowhere/weights", "/dev/zero", "/proc"] {
            let error = digests.sha256(Path::new(path)).unwrap_err();
            assert!(error.to_string().starts_with(path), "{error}");
        }
        assert_eq!(digests.program_sha256().unwrap().len(), 64);
    }
}
