//! Roots of data sets that have index files: searched in the opened folder and a little below.

use std::fs;
use std::path::{Path, PathBuf};

/// Depth below the opened folder to which roots are searched.
const MAX_DEPTH: usize = 2;

/// The folders at or below `dir` that `is_root` accepts, in text order of their paths. The search does not go below a
/// root.
///
/// Folders that cannot be listed are skipped: the reader of their data reports them.
pub(super) fn find(dir: &Path, is_root: impl Fn(&Path) -> bool) -> Vec<PathBuf> {
    let mut level = vec![dir.to_owned()];
    let mut found = Vec::new();
    for _ in 0..=MAX_DEPTH {
        let (roots, others): (Vec<PathBuf>, Vec<PathBuf>) =
            level.into_iter().partition(|folder| is_root(folder));
        found.extend(roots);
        level = others.iter().flat_map(|folder| folders(folder)).collect();
    }
    found.sort_unstable();
    found
}

/// Folders that are not hidden, including targets of symbolic links. Files cost no system call each, however many there
/// are.
fn folders(dir: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten();
    let folders = entries.filter(|entry| {
        let is_hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
        !is_hidden
            && match entry.file_type() {
                Ok(kind) if kind.is_symlink() => entry.path().is_dir(),
                kind => kind.is_ok_and(|kind| kind.is_dir()),
            }
    });
    folders.map(|entry| entry.path()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn roots_are_found_a_little_below_and_not_below_roots() {
        let dir = tempfile::tempdir().unwrap();
        for name in [
            "b/mark",
            "a/c/mark",
            "a/c/d/mark",
            "a/x/y/z/mark",
            ".hidden/mark",
            "file",
        ] {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "").unwrap();
        }
        let found = find(dir.path(), |folder| folder.join("mark").is_file());
        assert_eq!(found, ["a/c", "b"].map(|name| dir.path().join(name)));
        assert_eq!(
            find(&dir.path().join("b"), |folder| folder
                .join("mark")
                .is_file()),
            [dir.path().join("b")]
        );
        assert!(find(&dir.path().join("none"), |_| false).is_empty());
    }
}
