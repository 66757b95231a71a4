//! Fingerprint of a data set: SHA-256 over its listing and the whole contents of its files.

use std::collections::BTreeSet;
use std::io;
use std::path::PathBuf;

use protocol::text::hex;
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use support::file_digests::FileDigests;
use support::provenance::Provenance;

use super::Scenario;

/// Provenance of a result that this program computes from `scenarios` and `files`; `commit` is that of its checkout.
///
/// # Errors
/// The first file that cannot be read, by name.
pub fn provenance<'a>(
    scenarios: impl IntoIterator<Item = &'a Scenario>,
    files: impl IntoIterator<Item = PathBuf>,
    commit: &str,
) -> io::Result<Provenance> {
    let digests = FileDigests::default();
    let data_sha256 = content_sha256(scenarios, None, &digests);
    let provenance = Provenance::collect(&[], data_sha256, files, commit, &digests)?;
    Ok(provenance.with_command())
}

/// SHA-256 over the listing of scenarios (names, agents, capture times) and the whole content of every file that their
/// frames are read from, in hexadecimal digits: independent of the path of the data set.
///
/// `variant` names the variant of the sweeps, see [`Scenario::lidar_variants`]. A file that cannot be read counts as
/// such: its reader reports it. Every file is read once, on all cores: a gigabyte takes about a second.
pub fn content_sha256<'a>(
    scenarios: impl IntoIterator<Item = &'a Scenario>,
    variant: Option<&str>,
    digests: &FileDigests,
) -> String {
    let mut hash = Sha256::new();
    for scenario in scenarios {
        hash.update(scenario.name.as_bytes());
        for agent in &scenario.agents {
            hash.update(format!("/{agent}"));
        }
        for tick in &scenario.ticks {
            hash.update(format!("\n{} {}", tick.stem, tick.capture_nanos));
        }
        let files: Vec<PathBuf> = files_of(scenario, variant).into_iter().collect();
        let digests: Vec<Option<[u8; 32]>> =
            // The results keep the order of the files, whichever is read first.
            files.par_iter().map(|file| digests.of(file).ok()).collect();
        for digest in digests {
            match digest {
                Some(digest) => hash.update(digest),
                // A mark instead of nothing: a file that becomes unreadable changes the hash.
                None => hash.update("\nunreadable"),
            }
        }
    }
    hex(&hash.finalize())
}

/// [`content_sha256`] of one scenario, whichever folder above it was opened.
pub fn scenario_sha256(scenario: &Scenario, digests: &FileDigests) -> String {
    let mut unnamed = scenario.clone();
    // The name depends on the folder that was opened.
    unnamed.name.clear();
    content_sha256([&unnamed], None, digests)
}

/// Every file that the frames of a scenario are read from; images and radar points are not evaluated.
fn files_of(scenario: &Scenario, variant: Option<&str>) -> BTreeSet<PathBuf> {
    let mut files = BTreeSet::new();
    for agent in &scenario.agents {
        files.extend(scenario.source.shared_files(agent));
        for tick in &scenario.ticks {
            files.insert(scenario.source.points_path(agent, tick, variant));
            files.extend(scenario.source.frame_files(agent, tick));
        }
    }
    files
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

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

    fn sha256(dataset: &Dataset) -> String {
        content_sha256(&dataset.scenarios, None, &FileDigests::default())
    }

    /// The bytes with one bit at `place` changed.
    fn flipped(bytes: &[u8], place: usize) -> Vec<u8> {
        let mut bytes = bytes.to_vec();
        bytes[place] ^= 1;
        bytes
    }

    #[test]
    fn any_byte_changes_the_hash_and_another_place_does_not() {
        let points: Vec<u8> = (0..5000u32).map(|k| (k % 251) as u8).collect();
        let [one, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let original = sha256(&scene(one.path(), &points));
        assert_eq!(sha256(&scene(other.path(), &points)), original);
        for (name, bytes) in [
            ("000070.pcd", flipped(&points, 3)),
            ("000070.pcd", flipped(&points, 2500)),
            ("000070.pcd", flipped(&points, 4990)),
            ("000070.pcd", points[..4000].to_vec()),
            ("000068.yaml", b"lidar_pose: [0, 0, 0, 0, 0, 0]".to_vec()),
        ] {
            let dataset = scene(one.path(), &points);
            fs::write(one.path().join("scene/4288").join(name), bytes).unwrap();
            assert_ne!(sha256(&dataset), original, "{name}");
        }
    }

    #[test]
    fn a_missing_file_changes_the_hash() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = scene(folder.path(), b"points");
        let whole = sha256(&dataset);
        fs::remove_file(folder.path().join("scene/4279/000068.pcd")).unwrap();
        assert_ne!(sha256(&dataset), whole);
    }
}
