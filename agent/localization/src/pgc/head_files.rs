//! Files of scene heads and their encoders, by path or by the name of a released one.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use perception::weights::{FileError, Weights};
use support::file_error::Result;
use support::shared_files;

use super::{CellEncoder, SceneHead, SceneHeadConfig};
use crate::registration::icp::surfel_map::SurfelMap;

/// Ending of weights files.
const ENDING: &str = "safetensors";
/// Name of the encoder beside its heads.
pub const ENCODER_FILE: &str = "pgc-encoder.safetensors";
/// Name of the weights in the folder of a training.
const TRAINED_FILE: &str = "weights.safetensors";
/// Name of the surfel map in the folder of a place.
pub const SURFELS_FILE: &str = "surfels.safetensors";
/// Beginnings of the names of released heads and surfel maps.
const HEAD_PREFIX: &str = "pgc-";
const SURFELS_PREFIX: &str = "surfels-";
/// Folders of released weights from the working directory.
const FROM_HERE: [&str; 2] = ["deploy/weights", "weights"];

/// The file of a head: a path, the folder of a training, or the name of a released one (`town1` or `pgc-town1`). A surfel
/// map stands in for a head: its file, or the folder of a place that has no head.
///
/// # Errors
/// [`FileError`] with the names of the released heads.
pub fn head_file(head: &Path) -> Result<PathBuf> {
    let surfels = head.join(SURFELS_FILE);
    if surfels.is_file() && !head.join(TRAINED_FILE).is_file() {
        return Ok(surfels);
    }
    released_file(head, "head", HEAD_PREFIX, TRAINED_FILE)
}

/// The file of a surfel map: a path, the folder that `agent map` wrote, or the name of a released one (`town1`, `town4`).
///
/// # Errors
/// [`FileError`] with the names of the released maps.
pub fn surfel_map_file(map: &Path) -> Result<PathBuf> {
    released_file(map, "surfel map", SURFELS_PREFIX, SURFELS_FILE)
}

/// The file at a path, `trained` in a folder, or the released file of a name with this prefix.
fn released_file(head: &Path, kind: &str, prefix: &str, trained: &str) -> Result<PathBuf> {
    if head.is_file() {
        return Ok(head.to_owned());
    }
    if head.is_dir() {
        return Ok(head.join(trained));
    }
    let folders = weights_folders();
    let name = head.display();
    let names = [prefix, ""].map(|prefix| format!("{prefix}{name}.{ENDING}"));
    let mut files = folders
        .iter()
        .flat_map(|folder| names.iter().map(move |name| folder.join(name)));
    files.find(|file| file.is_file()).ok_or_else(|| {
        let stems = (folders.iter().flat_map(|folder| files_in(folder)))
            .filter_map(|file| Some(file.file_stem()?.to_str()?.strip_prefix(prefix)?.to_owned()));
        // A folder may be reached by two paths.
        let released: BTreeSet<String> = stems.filter(|name| name != "encoder").collect();
        let released = match Vec::from_iter(released).join(", ") {
            none if none.is_empty() => "none is released in deploy/weights here or above".into(),
            names => format!("released are {names}"),
        };
        let problem = format_args!("no such file or released {kind}; {released}");
        FileError::new(head, problem)
    })
}

/// The file whose digest the metadata of a head names, of those beside it or released; without one
/// `pgc-encoder.safetensors` beside it.
fn encoder_of(head: &Path) -> Result<PathBuf> {
    let beside = Some(head.with_file_name(ENCODER_FILE)).filter(|file| file.is_file());
    match (named_encoder(head), beside) {
        (Ok(Ok(found)), _) => Ok(found),
        // The digests are compared, and an unreadable head is reported, when both are opened.
        (_, Some(beside)) => Ok(beside),
        (Ok(Err(sha256)), None) => {
            let problem = format_args!(
                "its encoder (SHA-256 {sha256}) is neither beside it nor among the released weights: --encoder FILE"
            );
            Err(FileError::new(head, problem))
        }
        (Err(error), None) => Err(error),
    }
}

/// The encoder that is given, or else that of the head, scene encoder or detector: the file whose digest its metadata
/// names, of those beside it or released; without one `pgc-encoder.safetensors` beside it. Empty for a surfel map in place
/// of a head, which has none.
///
/// # Errors
/// [`FileError`] when there is none, the head cannot be read, or one is given with a surfel map.
pub fn encoder_or_named(encoder: Option<&Path>, head: &Path) -> Result<PathBuf> {
    match (encoder, SurfelMap::is_in(head)) {
        (None, true) => Ok(PathBuf::new()),
        (None, false) => encoder_of(head),
        (Some(given), false) => Ok(given.to_owned()),
        (Some(given), true) => {
            let given = given.display();
            let problem = format_args!("a surfel map has no encoder, but {given} is given");
            Err(FileError::new(head, problem))
        }
    }
}

/// True for a word that may name a released head: a single component without an ending.
pub fn is_name(head: &Path) -> bool {
    head.components().count() == 1 && head.extension().is_none()
}

/// The file of a head and its configuration.
///
/// # Errors
/// [`FileError`] for a missing file, and for one of another kind.
pub fn head_config(head: &Path) -> Result<(Weights, SceneHeadConfig)> {
    let weights = Weights::load(head)?;
    weights.check_kind(SceneHead::KIND)?;
    let config = weights.config()?;
    Ok((weights, config))
}

/// The encoder that a head names, or its digest if no file has it.
fn named_encoder(head: &Path) -> Result<Result<PathBuf, String>> {
    let sha256 = head_config(head)?.1.encoder_sha256;
    let folders = head
        .parent()
        .map(Path::to_owned)
        .into_iter()
        .chain(weights_folders());
    let mut files: Vec<_> = folders.flat_map(|folder| files_in(&folder)).collect();
    files.retain(|file| file != head);
    // Files with an encoder's name first: each one is read and hashed until the digest fits.
    files.sort_by_key(|file| {
        let stem = file.file_stem().and_then(|stem| stem.to_str());
        !stem.is_some_and(|stem| stem.contains("encoder"))
    });
    let named = files.into_iter().find(|file| {
        Weights::load(file).is_ok_and(|weights| CellEncoder::sha256_of(&weights) == sha256)
    });
    Ok(named.ok_or(sha256))
}

/// The released encoder, for a new head.
pub fn released_encoder() -> Option<PathBuf> {
    let mut files = weights_folders()
        .into_iter()
        .map(|folder| folder.join(ENCODER_FILE));
    files.find(|file| file.is_file())
}

/// Folders of released weights that exist.
fn weights_folders() -> Vec<PathBuf> {
    let here = (FROM_HERE.into_iter().map(PathBuf::from)).filter(|folder| folder.is_dir());
    here.chain(shared_files::shared("weights")).collect()
}

/// Weights in a folder, in text order.
fn files_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|ending| ending == ENDING));
    files.sort_unstable();
    files
}

#[cfg(test)]
mod tests {
    use perception::weights::{KIND_KEY, Precision, save};
    use tch::Device;
    use tch::nn::VarStore;

    use super::*;

    #[test]
    fn a_surfel_map_in_place_of_a_head_takes_no_encoder() {
        let folder = tempfile::tempdir().unwrap();
        let map = folder.path().join(SURFELS_FILE);
        let about = [(KIND_KEY.to_owned(), "surfel_map".to_owned())].into();
        let nothing = VarStore::new(Device::Cpu);
        save(&map, &nothing, &about, Precision::Single).unwrap();
        assert_eq!(encoder_or_named(None, &map).unwrap(), Path::new(""));
        let given = Some(Path::new("e.safetensors"));
        let message = encoder_or_named(given, &map).unwrap_err().to_string();
        for file in [SURFELS_FILE, "e.safetensors"] {
            assert!(message.contains(file), "{message}");
        }
    }

    #[test]
    fn a_head_is_a_file_or_the_folder_of_a_training() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(TRAINED_FILE);
        std::fs::write(&file, "").unwrap();
        for head in [&file, &folder.path().to_owned()] {
            assert_eq!(head_file(head).unwrap(), file);
        }
        let message = head_file(Path::new("town-that-nobody-drove"))
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("town-that-nobody-drove: no such file or released head"),
            "{message}"
        );
    }

    #[test]
    fn the_encoder_beside_a_head_comes_first() {
        let folder = tempfile::tempdir().unwrap();
        let head = folder.path().join("a.safetensors");
        std::fs::write(folder.path().join(ENCODER_FILE), "").unwrap();
        assert_eq!(encoder_of(&head).unwrap(), folder.path().join(ENCODER_FILE));
    }
}
