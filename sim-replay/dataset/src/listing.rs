//! Fingerprints of a data set: SHA-256 over its listing and its contents.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use protocol::CavId;
use protocol::text::hex;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::{Scenario, Tick};
use support::bounded_file;

/// Bytes hashed at the beginning and at the end of a point cloud: its header, and points that differ from sweep to
/// sweep.
const EDGE_BYTES: usize = 1024;
/// Largest file of annotations that is hashed, bytes: the limit of the readers.
const MAX_ANNOTATION_BYTES: u64 = 32 << 20;

/// SHA-256 over names, agents and capture times, in hexadecimal digits: independent of the path of the data set. No
/// file is opened; see [`content_sha256`] for the contents.
#[cfg(test)]
fn listing_sha256<'a>(scenarios: impl IntoIterator<Item = &'a Scenario>) -> String {
    let mut hash = Sha256::new();
    scenarios
        .into_iter()
        .for_each(|scenario| list(scenario, &mut hash));
    digits(hash)
}

/// SHA-256 over the listing and the contents of its files, in hexadecimal digits, for model cards.
///
/// Of every frame's points: the size of the file, its first and its last kilobyte. Of every frame's annotations: the
/// whole file, or the pose if one file serves all frames. Points that change between the two kilobytes without changing
/// the size are not detected; a data set that was generated, converted or copied again with other settings is. It takes
/// some tens of microseconds per frame: reading whole clouds would take minutes before a training starts.
#[must_use]
pub fn content_sha256<'a>(scenarios: impl IntoIterator<Item = &'a Scenario>) -> String {
    let mut hash = Sha256::new();
    for scenario in scenarios {
        list(scenario, &mut hash);
        let frames: Vec<(&CavId, &Tick)> = scenario
            .agents
            .iter()
            .flat_map(|agent| scenario.ticks.iter().map(move |tick| (agent, tick)))
            .collect();
        let digests: Vec<[u8; 32]> = frames
            .into_par_iter()
            .map(|(agent, tick)| frame_digest(scenario, agent, tick))
            .collect();
        digests.iter().for_each(|digest| hash.update(digest));
    }
    digits(hash)
}

fn list(scenario: &Scenario, hash: &mut Sha256) {
    hash.update(scenario.name.as_bytes());
    scenario
        .agents
        .iter()
        .for_each(|agent| hash.update(format!("/{agent}")));
    scenario
        .ticks
        .iter()
        .for_each(|tick| hash.update(format!("\n{} {}", tick.stem, tick.capture_nanos)));
}

/// Hash of a frame. A file that cannot be read, or is too large for any reader, is hashed as such: its reader reports
/// it.
fn frame_digest(scenario: &Scenario, agent: &CavId, tick: &Tick) -> [u8; 32] {
    let mut hash = Sha256::new();
    let points = scenario.source.points_path(agent, tick, None);
    if edges(&points, &mut hash).is_err() {
        hash.update("\nno points");
    }
    match scenario.source.annotation_path(agent, tick) {
        Some(path) => match bounded_file::read(&path, MAX_ANNOTATION_BYTES) {
            Ok(text) => hash.update(text),
            Err(_) => hash.update("\nno annotations"),
        },
        None => {
            let pose = scenario
                .source
                .frame(agent, tick)
                .ok()
                .and_then(|frame| frame.world_from_lidar);
            hash.update(format!("\n{pose:?}"));
        }
    }
    hash.finalize().into()
}

/// Size, beginning and end of a file.
fn edges(path: &Path, hash: &mut Sha256) -> io::Result<()> {
    let mut file = File::open(path)?;
    let size = file.metadata()?.len();
    hash.update(size.to_le_bytes());
    let mut edge = Vec::with_capacity(EDGE_BYTES);
    (&mut file).take(EDGE_BYTES as u64).read_to_end(&mut edge)?;
    hash.update(&edge);
    file.seek(SeekFrom::Start(size.saturating_sub(EDGE_BYTES as u64)))?;
    edge.clear();
    file.take(EDGE_BYTES as u64).read_to_end(&mut edge)?;
    hash.update(&edge);
    Ok(())
}

fn digits(hash: Sha256) -> String {
    hex(&hash.finalize())
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;

    use super::*;
    use crate::Dataset;

    /// Two agents at two ticks; `points` is each cloud.
    fn scene(folder: &Path, points: &[u8]) -> Dataset {
        for agent in ["4279", "4288"] {
            let path = folder.join("scene").join(agent);
            fs::create_dir_all(&path).unwrap();
            for tick in ["000068", "000070"] {
                fs::write(path.join(format!("{tick}.yaml")), "").unwrap();
                fs::write(path.join(format!("{tick}.pcd")), points).unwrap();
            }
        }
        crate::open(&folder.join("scene")).unwrap()
    }

    #[test]
    fn the_hash_of_the_listing_is_of_names_agents_and_times() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = scene(folder.path(), b"");
        let scenario = &dataset.scenarios[0];
        assert_eq!((scenario.agents.len(), scenario.ticks.len()), (2, 2));
        let [first, second] = [0, 1].map(|tick| scenario.ticks[tick].capture_nanos);
        let text = format!("scene/4279/4288\n000068 {first}\n000070 {second}");
        let expected = hex(&Sha256::digest(text));
        assert_eq!(listing_sha256(&dataset.scenarios), expected);
    }

    #[test]
    fn the_hash_of_the_contents_follows_points_and_annotations_and_not_the_place() {
        let points: Vec<u8> = (0..5000u32).map(|k| (k % 251) as u8).collect();
        let [one, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let hash = |folder: &Path, points: &[u8]| content_sha256(&scene(folder, points).scenarios);
        let original = hash(one.path(), &points);
        assert_eq!(hash(other.path(), &points), original);
        let changed = |name: &str, bytes: &[u8]| {
            let dataset = scene(one.path(), &points);
            let path: PathBuf = one.path().join("scene/4288").join(name);
            fs::write(path, bytes).unwrap();
            content_sha256(&dataset.scenarios)
        };
        let with = |place: usize| {
            let mut bytes = points.clone();
            bytes[place] ^= 1;
            bytes
        };
        assert_ne!(changed("000070.pcd", &with(3)), original, "the beginning");
        assert_ne!(changed("000070.pcd", &with(4990)), original, "the end");
        assert_ne!(changed("000070.pcd", &points[..4000]), original, "the size");
        assert_ne!(
            changed("000068.yaml", b"lidar_pose: [0, 0, 0, 0, 0, 0]"),
            original,
            "a pose"
        );
        assert_eq!(
            changed("000070.pcd", &with(2500)),
            original,
            "the middle of a cloud is not read"
        );
        assert_eq!(
            listing_sha256(&scene(one.path(), &points).scenarios),
            listing_sha256(&scene(other.path(), b"").scenarios)
        );
    }

    #[test]
    fn a_file_that_went_missing_changes_the_hash() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = scene(folder.path(), b"points");
        let whole = content_sha256(&dataset.scenarios);
        fs::remove_file(folder.path().join("scene/4279/000068.pcd")).unwrap();
        assert_ne!(content_sha256(&dataset.scenarios), whole);
    }

    #[test]
    fn annotations_that_no_reader_takes_count_as_missing() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = scene(folder.path(), b"points");
        let path = folder.path().join("scene/4279/000068.yaml");
        File::create(&path)
            .unwrap()
            .set_len(MAX_ANNOTATION_BYTES + 1)
            .unwrap();
        let huge = content_sha256(&dataset.scenarios);
        fs::remove_file(path).unwrap();
        assert_eq!(content_sha256(&dataset.scenarios), huge);
    }
}
