//! Folders and files, with the path in every error.

use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use std::{fs, io};

use super::{ReadError, Result};
use support::bounded_file;

/// The mark with which some editors begin a text in UTF-8.
pub(super) const BYTE_ORDER_MARK: &[u8] = "\u{feff}".as_bytes();

/// A folder's entries that are not hidden, in text order.
#[derive(Debug, Default)]
pub(super) struct Listing {
    /// Names of folders.
    pub(super) folders: Vec<String>,
    /// Names of files.
    pub(super) files: Vec<String>,
}

/// Lists a folder. Names that are not UTF-8 are left out; so are dangling links, which count as missing files.
pub(super) fn list(dir: &Path) -> Result<Listing> {
    let mut listing = Listing::default();
    for entry in fs::read_dir(dir).map_err(|error| ReadError::io(dir, error))? {
        let entry = entry.map_err(|error| ReadError::io(dir, error))?;
        let name = entry.file_name().into_string();
        let Some(name) = name.ok().filter(|name| !name.starts_with('.')) else {
            continue;
        };
        // Data often lies behind symbolic links, so these are followed.
        let kind = entry.file_type().ok().filter(|kind| !kind.is_symlink());
        match kind.or_else(|| Some(fs::metadata(entry.path()).ok()?.file_type())) {
            Some(kind) if kind.is_dir() => listing.folders.push(name),
            Some(_) => listing.files.push(name),
            None => {}
        }
    }
    listing.folders.sort_unstable();
    listing.files.sort_unstable();
    Ok(listing)
}

/// Natural order of names: numbers in them count as numbers, so `9` comes before `10`.
pub(super) fn natural_order(first: &str, second: &str) -> Ordering {
    parts(first)
        .cmp(parts(second))
        // `7` and `07` are the same number: the shorter name comes first.
        .then_with(|| first.len().cmp(&second.len()))
}

/// Texts and numbers of a name: a number by its length without zeros in front, and its digits.
fn parts(name: &str) -> impl Iterator<Item = (usize, &[u8])> {
    let bytes = name.as_bytes();
    let parts = bytes.chunk_by(|a, b| a.is_ascii_digit() == b.is_ascii_digit());
    parts.map(|part| match part.first() {
        Some(b'0'..=b'9') => {
            // Compared by length and digits, not parsed: a number of any length is in order.
            let zeros = part.iter().take_while(|&&digit| digit == b'0').count();
            (part.len() - zeros, part.get(zeros..).unwrap_or_default())
        }
        // Digits come before letters in text order too.
        _ => (usize::MAX, part),
    })
}

/// The folders below one with their contents; one that cannot be listed is left out.
pub(super) fn list_below(
    dir: &Path,
    listing: &Listing,
    problems: &mut Vec<ReadError>,
) -> Vec<(PathBuf, Listing)> {
    let mut below = Vec::with_capacity(listing.folders.len());
    for path in listing.folders.iter().map(|folder| dir.join(folder)) {
        match list(&path) {
            Ok(listing) => below.push((path, listing)),
            Err(error) => problems.push(error),
        }
    }
    below
}

/// Folders of data in text order, each once: a link beside a folder leads to the same frames. The folder itself is kept,
/// or the first of several links.
pub(super) fn each_once(mut found: Vec<PathBuf>, problems: &mut Vec<ReadError>) -> Vec<PathBuf> {
    let target = |dir: &Path| dir.canonicalize().unwrap_or_else(|_| dir.to_owned());
    let is_link = |dir: &Path| target(dir).file_name() != dir.file_name();
    found.sort_by_cached_key(|dir| (target(dir), is_link(dir), dir.clone()));
    found.dedup_by(|again, first| {
        let is_same = target(again) == target(first);
        let reason = format!("leads to the frames of {}: left out", first.display());
        problems.extend(is_same.then(|| ReadError::malformed(again, reason)));
        is_same
    });
    found.sort_unstable();
    found
}

/// Reads a file of at most `max_bytes`.
pub(super) fn read_limited(path: &Path, max_bytes: u64) -> Result<Vec<u8>> {
    bounded_file::read(path, max_bytes).map_err(|error| match error.kind() {
        io::ErrorKind::FileTooLarge => ReadError::malformed(path, error.to_string()),
        _ => ReadError::io(path, error),
    })
}

/// Reads a text file of at most `max_bytes`, without its byte order mark. Bytes that are no UTF-8 become replacement
/// characters, which no number contains.
pub(super) fn read_text(path: &Path, max_bytes: u64) -> Result<String> {
    let mut bytes = read_limited(path, max_bytes)?;
    if bytes.starts_with(BYTE_ORDER_MARK) {
        bytes.drain(..BYTE_ORDER_MARK.len());
    }
    Ok(String::from_utf8(bytes)
        .unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned()))
}

/// True if a folder has a file whose name ends in `suffix`.
pub(super) fn holds(dir: &Path, suffix: &str) -> bool {
    list(dir).is_ok_and(|listing| listing.files.iter().any(|name| name.ends_with(suffix)))
}

/// The stems of the files that end in `suffix`, in the order given.
pub(super) fn stems<'a>(files: &'a [String], suffix: &'a str) -> impl Iterator<Item = &'a str> {
    let names = files.iter();
    names.filter_map(move |name| name.strip_suffix(suffix))
}

/// Paths of a folder: as given, absolute, and canonical. `.` or `00` shows little of the folders above; a symbolic link
/// may lead to other ones.
pub(super) fn names_of(dir: &Path) -> impl Iterator<Item = PathBuf> {
    let others = [std::path::absolute(dir), dir.canonicalize()].into_iter();
    let names = std::iter::once(dir.to_owned()).chain(others.flatten());
    names.filter(|name| name.file_name().is_some())
}

/// The folders above one, by its [`names_of`].
pub(super) fn above(dir: &Path) -> impl Iterator<Item = PathBuf> {
    names_of(dir).filter_map(|name| name.parent().map(Path::to_owned))
}

/// The name of a path below `root`, or the folder's own name where they are the same.
pub(super) fn name_below(root: &Path, dir: &Path) -> String {
    let name = match dir.strip_prefix(root) {
        Ok(below) if !below.as_os_str().is_empty() => below.to_string_lossy().into_owned(),
        _ => own_name(dir),
    };
    name.replace('\\', "/")
}

/// The folder's own name, where `.` or a link leads to it too.
pub(super) fn own_name(dir: &Path) -> String {
    last_name(&dir.canonicalize().unwrap_or_default())
}

/// The last part of a path.
pub(super) fn last_name(dir: &Path) -> String {
    let name = dir.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn listings_are_sorted_and_leave_hidden_entries_out() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["b.yaml", "a.yaml", ".hidden"] {
            fs::write(dir.path().join(name), "").unwrap();
        }
        fs::create_dir(dir.path().join("4279")).unwrap();
        let listing = list(dir.path()).unwrap();
        assert_eq!(
            (listing.files, listing.folders),
            (vec!["a.yaml".into(), "b.yaml".into()], vec!["4279".into()])
        );
    }

    #[test]
    fn numbers_in_names_are_ordered_as_numbers() {
        let mut names = ["10", "a_10", "9", "a_9", "a", "009", "1_b", "1_a"];
        names.sort_by(|first, second| natural_order(first, second));
        assert_eq!(names, ["1_a", "1_b", "9", "009", "10", "a", "a_9", "a_10"]);
    }

    #[test]
    fn links_are_followed_and_those_to_nothing_are_not_there() {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("4279")).unwrap();
        fs::write(dir.path().join("a.yaml"), "").unwrap();
        for (target, name) in [
            (dir.path().join("4279"), "4288"),
            (dir.path().join("a.yaml"), "b.yaml"),
            ("/nowhere.png".into(), "a_camera0.png"),
            ("loop".into(), "loop"),
        ] {
            std::os::unix::fs::symlink(target, dir.path().join(name)).unwrap();
        }
        let listing = list(dir.path()).unwrap();
        assert_eq!(
            (listing.files, listing.folders),
            (
                vec!["a.yaml".into(), "b.yaml".into()],
                vec!["4279".into(), "4288".into()]
            )
        );
    }

    #[test]
    fn a_folder_and_the_links_to_it_are_one() {
        let dir = tempfile::tempdir().unwrap();
        let [latest, scene, newest] =
            ["latest", "scene", "newest"].map(|name| dir.path().join(name));
        fs::create_dir(&scene).unwrap();
        for link in [&latest, &newest] {
            std::os::unix::fs::symlink("scene", link).unwrap();
        }
        let mut problems = Vec::new();
        let found = vec![latest.clone(), newest, scene.clone()];
        assert_eq!(
            each_once(found, &mut problems),
            std::slice::from_ref(&scene)
        );
        let expected = format!(
            "{}: leads to the frames of {}: left out",
            latest.display(),
            scene.display()
        );
        assert_eq!((problems.len(), problems[0].to_string()), (2, expected));
        let alone = each_once(vec![latest.clone()], &mut Vec::new());
        assert_eq!(alone, [latest], "a link without its folder");
    }

    #[test]
    fn a_file_that_is_too_large_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        fs::write(&path, [0; 11]).unwrap();
        assert_eq!(read_limited(&path, 11).unwrap().len(), 11);
        assert!(
            read_limited(&path, 10)
                .unwrap_err()
                .to_string()
                .ends_with("a: larger than 10 bytes, the most that is read")
        );
        assert!(matches!(
            read_limited(&dir.path().join("b"), 10),
            Err(ReadError::Io { .. })
        ));
    }

    #[test]
    fn a_scenario_is_named_by_its_path_below_the_root() {
        assert_eq!(
            name_below(Path::new("/data"), Path::new("/data/test/one")),
            "test/one"
        );
        let dir = tempfile::tempdir().unwrap();
        let own = dir.path().file_name().unwrap().to_string_lossy();
        assert_eq!(name_below(dir.path(), dir.path()), own);
    }
}
