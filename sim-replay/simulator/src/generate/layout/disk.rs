//! File system access of scene writers, with the path in every error.

use std::path::{Component, Path, PathBuf};
use std::{fs, io};

use super::SceneHeader;
use crate::generate::error::SynthError;
use dataset::UNFINISHED;
use support::atomic_file;
use support::file_error::{AtFile, FileError, check_folder};

/// The result of changing a file or folder on the disk, with its path in the error.
pub(crate) fn written<T>(path: &Path, result: io::Result<T>) -> Result<T, SynthError> {
    result.at(path).map_err(SynthError::Write)
}

/// Writes text or bytes.
pub(crate) fn write_file(path: &Path, bytes: impl AsRef<[u8]>) -> Result<(), SynthError> {
    written(path, fs::write(path, bytes))
}

/// Makes a folder and those above it.
pub(crate) fn make_folder(path: &Path) -> Result<(), SynthError> {
    check_folder(path)?;
    written(path, fs::create_dir_all(path))
}

/// Creates a folder; an existing one is removed with its contents.
pub(super) fn make_fresh_folder(path: &Path) -> Result<(), SynthError> {
    remove_folder(path)?;
    make_folder(path)
}

/// Removes a folder with all it holds, if there is one.
pub(crate) fn remove_folder(path: &Path) -> Result<(), SynthError> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(SynthError::Write(FileError::new(path, error)))
        }
        Ok(()) | Err(_) => Ok(()),
    }
}

/// The folder of a scene below `root`; no name leads outside `root`.
pub(crate) fn scene_path(root: &Path, name: &str) -> PathBuf {
    let parts = Path::new(name)
        .components()
        .filter(|part| matches!(part, Component::Normal(_)));
    root.join(parts.collect::<PathBuf>())
}

/// Writes the origin of a scene, in a file that no reader takes for a frame.
pub(super) fn write_origin(folder: &Path, scene: &SceneHeader) -> Result<(), SynthError> {
    let name = format!("{}.origin.txt", flat_name(&scene.name));
    write_file(&folder.join(name), &scene.origin)
}

/// The name of a scene as one part of a path.
fn flat_name(name: &str) -> String {
    let text = name.replace(
        |letter: char| !letter.is_alphanumeric() && !matches!(letter, '.' | '-' | '_'),
        "_",
    );
    // A leading dot would hide the file.
    text.trim_start_matches('.').to_owned()
}

/// Marker file of a folder that is being written. It stays after an interrupted run, and the reader reports it.
#[derive(Debug)]
pub(crate) struct Unfinished(PathBuf);

impl Unfinished {
    /// Marks a folder, which exists.
    pub(crate) fn mark(folder: &Path) -> Result<Self, SynthError> {
        let mark = folder.join(UNFINISHED);
        let text = "This folder is being written, or the run that wrote it was interrupted.\n";
        // On the disk before the files that it speaks of.
        written(&mark, atomic_file::write(&mark, text))?;
        Ok(Self(mark))
    }

    /// Removes the marker: all files are written.
    pub(crate) fn clear(self) -> Result<(), SynthError> {
        written(&self.0, fs::remove_file(&self.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_stays_below_the_root() {
        assert_eq!(
            scene_path(Path::new("out"), "test/a"),
            Path::new("out/test/a")
        );
        assert_eq!(
            scene_path(Path::new("out"), "/../x/./y"),
            Path::new("out/x/y")
        );
        assert_eq!(flat_name("../test/a b"), "_test_a_b");
    }

    #[test]
    fn a_fresh_folder_is_empty() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("a/b");
        for _ in 0..2 {
            make_fresh_folder(&folder).unwrap();
            assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
            write_file(&folder.join("old"), "x").unwrap();
        }
    }

    #[test]
    fn a_file_in_place_of_a_folder_is_an_error_of_the_options() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("base.yaml");
        write_file(&file, "x").unwrap();
        let error = make_folder(&file).unwrap_err();
        assert!(
            matches!(&error, SynthError::File(of) if of.problem.contains("must be a folder")),
            "{error}"
        );
    }

    #[test]
    fn an_error_names_the_path() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("missing/file");
        let message = write_file(&path, "x").unwrap_err().to_string();
        assert!(
            message.starts_with(&*path.to_string_lossy()) && message.contains("No such file"),
            "{message}"
        );
    }
}
