//! Atomic file writes: a file appears complete or not at all, and stays after a power cut.

use std::fs::{File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use tempfile::NamedTempFile;

/// Ending of files that are not complete.
const UNFINISHED: &str = ".unfinished";

/// Writes a file under a temporary name, and renames it when its bytes are on the disk: readers never see a partial file,
/// the previous file stays if this fails, and the new one stays after a power cut.
///
/// # Errors
/// The error of the system; no temporary file is left then.
pub fn write(path: &Path, contents: impl AsRef<[u8]>) -> io::Result<()> {
    let file = unfinished(path, contents.as_ref())?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    // Only then is the new name on the disk.
    File::open(folder_of(path))?.sync_all()
}

/// [`write()`] for a file that is written again within seconds: it may be lost in a power cut, and waits for no disk.
///
/// # Errors
/// As [`write()`].
pub fn write_volatile(path: &Path, contents: impl AsRef<[u8]>) -> io::Result<()> {
    unfinished(path, contents.as_ref())?.persist(path)?;
    Ok(())
}

/// A temporary file beside `path`, under a name that no other process or host has.
fn unfinished(path: &Path, contents: &[u8]) -> io::Result<NamedTempFile> {
    let mut prefix = path.file_name().unwrap_or_default().to_owned();
    prefix.push(".");
    let mut file = tempfile::Builder::new()
        .prefix(&prefix)
        .suffix(UNFINISHED)
        // The permissions of any other new file, less those that the user's mask excludes.
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(folder_of(path))?;
    file.write_all(contents)?;
    Ok(file)
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn a_file_is_replaced_as_a_whole_and_no_temporary_file_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        for text in ["a long text", "short"] {
            write(&path, text).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        write_volatile(&path, "state").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "state");
        // A folder cannot be replaced by a file.
        let taken = folder.path().join("taken");
        fs::create_dir(&taken).unwrap();
        write(&taken, "text").unwrap_err();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    #[test]
    fn a_new_file_has_the_permissions_of_other_new_files() {
        let folder = tempfile::tempdir().unwrap();
        let (atomic, plain) = (folder.path().join("atomic"), folder.path().join("plain"));
        write(&atomic, "").unwrap();
        fs::write(&plain, "").unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&atomic), mode(&plain));
    }
}
