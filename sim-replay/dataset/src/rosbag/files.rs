//! Files of a bag: one file, or those that `metadata.yaml` lists, unpacked where they are compressed.

use std::borrow::Cow;
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use support::bounded_file;
use tempfile::TempPath;

use crate::files::list;
use crate::yaml::{self, YamlField};
use crate::{ReadError, Result};

/// Name of the file that describes a bag in its folder.
const METADATA: &str = "metadata.yaml";
/// Key of a bag's description.
const INFORMATION: &str = "rosbag2_bagfile_information";
/// Ending of compressed files.
const COMPRESSED: &str = ".zstd";
/// Bytes by which zstd data begin.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// Bytes of a description that are searched for its key.
const HEAD_BYTES: u64 = 4096;

/// Storage of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum BagKind {
    /// MCAP.
    Mcap,
    /// SQLite 3.
    Sqlite,
    /// A bag of ROS 1, which is not read.
    Ros1,
}

impl BagKind {
    /// The storage of a file, compressed or not, by the ending of its name.
    pub(super) fn of(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_str()?;
        let (_, ending) = name
            .strip_suffix(COMPRESSED)
            .unwrap_or(name)
            .rsplit_once('.')?;
        match ending {
            "mcap" => Some(Self::Mcap),
            "db3" => Some(Self::Sqlite),
            "bag" => Some(Self::Ros1),
            _ => None,
        }
    }
}

/// True for a file of a bag, and for a folder with one.
pub(crate) fn is_bag(path: &Path) -> bool {
    if path.is_file() {
        return BagKind::of(path).is_some();
    }
    is_described(path) || !in_folder(path).is_empty()
}

/// The description in the folder of a bag, if there is one.
pub(super) fn description(path: &Path) -> Option<PathBuf> {
    Some(path.join(METADATA)).filter(|file| file.is_file())
}

/// True for a folder with the description of a bag.
fn is_described(dir: &Path) -> bool {
    let mut head = Vec::new();
    let read = bounded_file::open(&dir.join(METADATA))
        .and_then(|file| file.take(HEAD_BYTES).read_to_end(&mut head));
    read.is_ok() && String::from_utf8_lossy(&head).contains(INFORMATION)
}

/// The files of bags in a folder.
fn in_folder(dir: &Path) -> Vec<PathBuf> {
    let names = list(dir).map(|listing| listing.files).unwrap_or_default();
    let paths = names.iter().map(|name| dir.join(name));
    paths.filter(|path| BagKind::of(path).is_some()).collect()
}

/// The files of the bag at a path, in order. Those that its description lists and that do not exist, and the reverse, are
/// problems.
pub(super) fn files_of(path: &Path, problems: &mut Vec<ReadError>) -> Result<Vec<PathBuf>> {
    if path.is_file() {
        return Ok(vec![path.to_owned()]);
    }
    let found = in_folder(path);
    if !is_described(path) {
        let folders = list(path)?.folders.len();
        if folders > 0 {
            let reason = format!("{folders} folders beside the file of a bag: left out");
            problems.push(ReadError::malformed(path, reason));
        }
        return match found.len() {
            1 => Ok(found),
            count => {
                let reason = format!(
                    "{count} files of bags and no {METADATA} that lists those of one bag: open one of them, or write it with \
                     `ros2 bag reindex`"
                );
                Err(ReadError::malformed(path, reason))
            }
        };
    }
    let listed = listed(path)?;
    for file in found.iter().filter(|file| !listed.contains(file)) {
        let reason = format!("not listed in {METADATA}: left out");
        problems.push(ReadError::malformed(file, reason));
    }
    let (there, missing): (Vec<PathBuf>, Vec<PathBuf>) =
        listed.into_iter().partition(|file| file.is_file());
    for file in missing {
        let reason = format!("does not exist, but {METADATA} lists it: left out");
        problems.push(ReadError::malformed(&file, reason));
    }
    if there.is_empty() {
        let reason = "none of the files that it lists exists";
        return Err(ReadError::malformed(&path.join(METADATA), reason));
    }
    Ok(there)
}

/// The files that the description lists.
fn listed(dir: &Path) -> Result<Vec<PathBuf>> {
    let path = dir.join(METADATA);
    let node = yaml::read(&path)?;
    let root = YamlField::root(&path, &node);
    let names = root
        .required(INFORMATION)?
        .required("relative_file_paths")?;
    let items = names.items()?;
    let files = items.iter().map(|name| {
        let name = Path::new(name.text()?);
        // Descriptions before version 4 begin with the folder's own name. What is outside of the folder is not read.
        let own = name
            .file_name()
            .ok_or_else(|| names.expected("names of files"))?;
        Ok(dir.join(own))
    });
    files.collect()
}

/// An unpacked copy of a compressed file, which exists as long as the value.
pub(super) fn unpacked(path: &Path) -> Result<Option<TempPath>> {
    let is_compressed = path.to_str().is_some_and(|name| name.ends_with(COMPRESSED));
    let copy = is_compressed.then(|| unpacked_copy(path)).transpose();
    copy.map_err(|error| ReadError::malformed(path, format!("cannot be unpacked: {error}")))
}

fn unpacked_copy(path: &Path) -> io::Result<TempPath> {
    let file = bounded_file::open(path)?;
    let size = file.metadata()?.len();
    let mut copy = tempfile::NamedTempFile::new()?;
    unpack(file, size, copy.as_file_mut())?;
    Ok(copy.into_temp_path())
}

/// Unpacks `size` bytes of zstd.
fn unpack(packed: impl Read, size: u64, unpacked: &mut impl Write) -> io::Result<()> {
    let most = bounded_file::most_unpacked(size);
    // One byte more than allowed shows that there is more.
    let mut bytes = zstd::stream::Decoder::new(packed)?.take(most.saturating_add(1));
    if io::copy(&mut bytes, unpacked)? > most {
        return Err(io::Error::other(format!(
            "unpacks to more than {most} bytes, the most that is read of its size"
        )));
    }
    Ok(())
}

/// A message as it was published, unpacked if it is compressed by itself: a message in CDR never begins as zstd does.
pub(super) fn unpacked_message(data: &[u8]) -> io::Result<Cow<'_, [u8]>> {
    if !data.starts_with(&ZSTD_MAGIC) {
        return Ok(Cow::Borrowed(data));
    }
    let mut message = Vec::new();
    unpack(data, data.len() as u64, &mut message)?;
    Ok(Cow::Owned(message))
}
