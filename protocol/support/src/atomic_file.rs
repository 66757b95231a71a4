//! Atomic file writes: a file appears complete or not at all, and stays after a power cut.

use std::fs::{DirBuilder, File, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use tempfile::NamedTempFile;

/// Ending of files that are not complete.
const UNFINISHED: &str = ".unfinished";

/// The operations of a file system that a file is written with. Tests have one that forgets what is not synced.
trait Disk {
    /// A file that has no final name yet; removed when dropped.
    type File;

    /// Begins a file beside `path`, under a name that no other process or host has.
    fn begin(&mut self, path: &Path) -> io::Result<Self::File>;
    fn append(&mut self, file: &mut Self::File, bytes: &[u8]) -> io::Result<()>;
    /// Returns when the content of the file is on the disk.
    fn sync(&mut self, file: &Self::File) -> io::Result<()>;
    fn rename(&mut self, file: Self::File, path: &Path) -> io::Result<()>;
    /// Returns when the names in the folder are on the disk.
    fn sync_folder(&mut self, folder: &Path) -> io::Result<()>;
}

/// The file system of the machine.
struct System;

impl Disk for System {
    type File = NamedTempFile;

    fn begin(&mut self, path: &Path) -> io::Result<NamedTempFile> {
        let mut prefix = path.file_name().unwrap_or_default().to_owned();
        prefix.push(".");
        tempfile::Builder::new()
            .prefix(&prefix)
            .suffix(UNFINISHED)
            // The permissions of any other new file, less those that the user's mask excludes.
            .permissions(Permissions::from_mode(0o666))
            // In the same folder: only within one file system a rename is atomic.
            .tempfile_in(folder_of(path))
    }

    fn append(&mut self, file: &mut NamedTempFile, bytes: &[u8]) -> io::Result<()> {
        file.write_all(bytes)
    }

    fn sync(&mut self, file: &NamedTempFile) -> io::Result<()> {
        file.as_file().sync_all()
    }

    fn rename(&mut self, file: NamedTempFile, path: &Path) -> io::Result<()> {
        Ok(file.persist(path).map(drop)?)
    }

    fn sync_folder(&mut self, folder: &Path) -> io::Result<()> {
        File::open(folder)?.sync_all()
    }
}

/// Writes a file under a temporary name, and renames it when its bytes are on the disk: readers never see a partial file,
/// the previous file stays if this fails, and the new one stays after a power cut.
///
/// # Errors
/// The error of the system; no temporary file is left then.
pub fn write(path: &Path, contents: impl AsRef<[u8]>) -> io::Result<()> {
    write_to(&mut System, path, contents.as_ref())
}

/// [`write()`] for a file that is written again within seconds: it may be lost in a power cut, and waits for no disk.
///
/// # Errors
/// As [`write()`].
pub fn write_volatile(path: &Path, contents: impl AsRef<[u8]>) -> io::Result<()> {
    write_volatile_to(&mut System, path, contents.as_ref())
}

/// Keeps a file, or a folder with all its files, that was written in place: returns when it and its name are on the disk.
///
/// # Errors
/// The error of the system.
pub fn sync(path: &Path) -> io::Result<()> {
    let file = File::open(path)?;
    if file.metadata()?.is_dir() {
        // The whole file system at once, instead of each file below the folder.
        rustix::fs::syncfs(&file)?;
    }
    file.sync_all()?;
    sync_name(path)
}

/// Creates a folder and those above it; returns when the names of the new ones are on the disk. Without that a file that
/// is synced in a new folder may be lost with the folder.
///
/// # Errors
/// The error of the system.
pub fn create_folder(path: &Path) -> io::Result<()> {
    create_folder_by(&mut DirBuilder::new(), path)
}

/// [`create_folder()`] with the permissions of a builder.
///
/// # Errors
/// The error of the system.
pub fn create_folder_by(builder: &mut DirBuilder, path: &Path) -> io::Result<()> {
    let new: Vec<&Path> = path
        .ancestors()
        .take_while(|folder| !folder.as_os_str().is_empty() && !folder.exists())
        .collect();
    builder.recursive(true).create(path)?;
    new.into_iter().rev().try_for_each(sync_name)
}

/// Returns when the name of `path` is on the disk.
///
/// # Errors
/// The error of the system.
pub fn sync_name(path: &Path) -> io::Result<()> {
    System.sync_folder(folder_of(path))
}

fn write_to(disk: &mut impl Disk, path: &Path, contents: &[u8]) -> io::Result<()> {
    let mut file = disk.begin(path)?;
    disk.append(&mut file, contents)?;
    disk.sync(&file)?;
    disk.rename(file, path)?;
    // Only then is the new name on the disk.
    disk.sync_folder(folder_of(path))
}

fn write_volatile_to(disk: &mut impl Disk, path: &Path, contents: &[u8]) -> io::Result<()> {
    let mut file = disk.begin(path)?;
    disk.append(&mut file, contents)?;
    disk.rename(file, path)
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs;
    use std::path::PathBuf;

    use super::*;
    use crate::random::SplitMix64;

    /// A file: its bytes, and how many of them are on the disk in any case.
    #[derive(Clone, Default)]
    struct Content {
        bytes: Vec<u8>,
        synced: usize,
    }

    /// A file system whose power is cut after some operations. Then content that was not synced is a random part of
    /// itself, and of the renames since the last sync of the folder a random number has happened.
    struct Forgetful {
        random: SplitMix64,
        operations_left: usize,
        files: Vec<Content>,
        names: BTreeMap<PathBuf, usize>,
        renames: Vec<(PathBuf, usize)>,
    }

    impl Forgetful {
        fn new(seed: u64) -> Self {
            let mut random = SplitMix64::new(seed);
            Self {
                operations_left: random.below(60),
                random,
                files: Vec::new(),
                names: BTreeMap::new(),
                renames: Vec::new(),
            }
        }

        fn operate(&mut self) -> io::Result<()> {
            self.operations_left = self
                .operations_left
                .checked_sub(1)
                .ok_or_else(|| io::Error::other("the power is cut"))?;
            Ok(())
        }

        /// Files by name after the cut.
        fn restart(&mut self) -> BTreeMap<PathBuf, Vec<u8>> {
            let happened = self.random.below(self.renames.len() + 1);
            self.names.extend(self.renames.drain(..).take(happened));
            let mut left = BTreeMap::new();
            for (path, place) in &self.names {
                let Content { mut bytes, synced } = self.files[*place].clone();
                bytes.truncate(synced + self.random.below(bytes.len() - synced + 1));
                left.insert(path.clone(), bytes);
            }
            left
        }
    }

    impl Disk for Forgetful {
        type File = usize;

        fn begin(&mut self, _: &Path) -> io::Result<usize> {
            self.operate()?;
            self.files.push(Content::default());
            Ok(self.files.len() - 1)
        }

        fn append(&mut self, file: &mut usize, bytes: &[u8]) -> io::Result<()> {
            self.operate()?;
            self.files[*file].bytes.extend(bytes);
            Ok(())
        }

        fn sync(&mut self, file: &usize) -> io::Result<()> {
            self.operate()?;
            let file = &mut self.files[*file];
            file.synced = file.bytes.len();
            Ok(())
        }

        fn rename(&mut self, file: usize, path: &Path) -> io::Result<()> {
            self.operate()?;
            self.renames.push((path.to_owned(), file));
            Ok(())
        }

        fn sync_folder(&mut self, _: &Path) -> io::Result<()> {
            self.operate()?;
            self.names.extend(self.renames.drain(..));
            Ok(())
        }
    }

    /// Files that are lost or damaged after the cut of this seed: of each name the last version that was reported as
    /// written, or a newer one as a whole, has to be there.
    fn losses(
        seed: u64,
        write: impl Fn(&mut Forgetful, &Path, &[u8]) -> io::Result<()>,
    ) -> (usize, usize) {
        let mut disk = Forgetful::new(seed);
        let mut names = SplitMix64::derived(seed, &[1]);
        let mut versions = [const { Vec::<Vec<u8>>::new() }; 3];
        let mut reported = [0; 3];
        loop {
            let name = names.below(3);
            let version = format!(
                "{seed} {} {}",
                versions[name].len(),
                "x".repeat(names.below(40))
            );
            versions[name].push(version.into_bytes());
            let path = PathBuf::from(format!("runs/{name}"));
            match write(&mut disk, &path, versions[name].last().unwrap()) {
                Ok(()) => reported[name] = versions[name].len(),
                Err(_) => break,
            }
        }
        let left = disk.restart();
        let lost = (0..3).filter(|name: &usize| {
            let found = left.get(Path::new(&format!("runs/{name}")));
            let oldest = reported[*name].saturating_sub(1);
            match found {
                Some(found) => !versions[*name][oldest..].contains(found),
                None => reported[*name] > 0,
            }
        });
        (lost.count(), reported.iter().sum())
    }

    /// Writes without syncing the name of the file.
    fn write_without_folder(disk: &mut Forgetful, path: &Path, contents: &[u8]) -> io::Result<()> {
        let mut file = disk.begin(path)?;
        disk.append(&mut file, contents)?;
        disk.sync(&file)?;
        disk.rename(file, path)
    }

    #[test]
    fn what_was_reported_as_written_survives_200_power_cuts() {
        let mut written = 0;
        for seed in 0..200 {
            let (lost, reported) = losses(seed, write_to);
            assert_eq!(lost, 0, "seed {seed}");
            written += reported;
        }
        assert!(
            written > 500,
            "{written} files were written before the cuts"
        );
        // The same cuts find what is not synced, or renamed before it is.
        let volatile = (0..200).filter(|seed| losses(*seed, write_volatile_to).0 > 0);
        assert!(volatile.count() > 100);
        let no_folder = (0..200).filter(|seed| losses(*seed, write_without_folder).0 > 0);
        assert!(no_folder.count() > 100);
    }

    #[test]
    fn a_file_and_a_folder_written_in_place_can_be_kept() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("a"), "a").unwrap();
        sync(&folder.path().join("a")).unwrap();
        sync(folder.path()).unwrap();
        assert!(sync(&folder.path().join("b")).is_err());
    }

    #[test]
    fn a_folder_is_created_with_those_above_it() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("a/b/c");
        for _ in 0..2 {
            create_folder(&folder).unwrap();
            assert!(folder.is_dir());
        }
        let file = root.path().join("file");
        fs::write(&file, "").unwrap();
        assert!(create_folder(&file.join("d")).is_err());
    }

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
        let [atomic, plain] =
            [atomic, plain].map(|path| fs::metadata(path).unwrap().permissions().mode());
        assert_eq!(atomic, plain);
    }
}
