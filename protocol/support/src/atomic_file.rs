//! Atomic file writes: a file appears complete or not at all.

use std::path::Path;
use std::{fs, io, process};

/// Writes a file under a temporary name and renames it when it is complete: readers never see a partial file, and the
/// previous file stays if this fails.
///
/// # Errors
/// The error of the system; no temporary file is left then.
pub fn write(path: &Path, contents: impl AsRef<[u8]>) -> io::Result<()> {
    // Two processes that write the same file use different temporary names.
    let unfinished = path.with_added_extension(format!("{}.unfinished", process::id()));
    let written = fs::write(&unfinished, contents).and_then(|()| fs::rename(&unfinished, path));
    if written.is_err() {
        let _ = fs::remove_file(&unfinished);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_as_a_whole_and_no_temporary_file_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        for text in ["a long text", "short"] {
            write(&path, text).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        // A folder cannot be replaced by a file.
        let taken = folder.path().join("taken");
        fs::create_dir(&taken).unwrap();
        write(&taken, "text").unwrap_err();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
