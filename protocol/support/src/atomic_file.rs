//! Files that are there as a whole or not at all.

use std::path::Path;
use std::{fs, io, process};

/// Writes a file that gets its name when all is in it: who reads it never sees half of it, and what had the name before
/// stays where this fails.
///
/// # Errors
/// What the system says; nothing is left beside the file then.
pub fn write(path: &Path, contents: impl AsRef<[u8]>) -> io::Result<()> {
    // Two processes that write the same file do not write into each other's.
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
    fn a_file_is_replaced_as_a_whole_and_nothing_stays_beside_it() {
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
