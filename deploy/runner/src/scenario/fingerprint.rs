//! Provenance of a run: hashes of its programs, weights and scene.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use localization::pose_source::{PgcConfig, PoseSourceConfig, TrackedPoseConfig};
use protocol::text::hex;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Provenance of a run, part of the `scenario.yaml` of a run folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// Version of the programs.
    pub version: String,
    /// SHA-256 over the executables of the program folder.
    pub program_sha256: String,
    /// SHA-256 of the weights file.
    pub weights_sha256: String,
    /// SHA-256 of the localizer's encoder and of its head, if a vehicle localizes itself.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub localizer_sha256: Option<[String; 2]>,
    /// SHA-256 of the baseline's weights, if a vehicle localizes itself with it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baseline_sha256: Option<String>,
    /// SHA-256 over names and contents of the scenario's point clouds and annotations; images do not count.
    pub scene_sha256: String,
    /// Number of files that `scene_sha256` covers.
    pub scene_files: usize,
}

impl Provenance {
    /// Hashes programs, weights and scene. Reads the whole scene: seconds for gigabytes.
    ///
    /// # Errors
    /// The first file that cannot be read, by name.
    pub fn collect(
        programs: &[PathBuf],
        weights: &Path,
        poses: &[PoseSourceConfig],
        scene: &Path,
    ) -> io::Result<Self> {
        let scene_files = scene_files(scene)?;
        let (mut localizer_sha256, mut baseline_sha256) = (None, None);
        for pose in poses {
            match pose {
                PoseSourceConfig::Pgc(PgcConfig { encoder, head, .. })
                | PoseSourceConfig::Tracked(TrackedPoseConfig { encoder, head, .. }) => {
                    localizer_sha256 = Some([hash_file(encoder)?.1, hash_file(head)?.1]);
                }
                PoseSourceConfig::Baseline(network) => {
                    baseline_sha256 = Some(hash_file(&network.weights)?.1)
                }
                PoseSourceConfig::Recorded
                | PoseSourceConfig::Noisy(_)
                | PoseSourceConfig::Cached(_) => {}
            }
        }
        Ok(Self {
            version: env!("CARGO_PKG_VERSION").into(),
            program_sha256: hash_all(
                programs
                    .first()
                    .and_then(|path| path.parent())
                    .unwrap_or(scene),
                programs,
            )?,
            weights_sha256: hash_file(weights)?.1,
            localizer_sha256,
            baseline_sha256,
            scene_sha256: hash_all(scene, &scene_files)?,
            scene_files: scene_files.len(),
        })
    }
}

/// Files of a scene that a run reads: all but images, in the order of names.
fn scene_files(scene: &Path) -> io::Result<Vec<PathBuf>> {
    if scene.is_file() {
        return Ok(vec![scene.to_path_buf()]);
    }
    let mut files = Vec::new();
    let mut folders = vec![scene.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).map_err(|error| named(error, &folder))? {
            let path = entry?.path();
            let is_image = path
                .extension()
                .is_some_and(|kind| kind == "png" || kind == "jpg");
            if path.is_dir() {
                folders.push(path);
            } else if !is_image {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

/// One hash over many files: name below `root`, length and content of each. The path of `root` does not count.
fn hash_all(root: &Path, files: &[PathBuf]) -> io::Result<String> {
    let mut all = Sha256::new();
    for path in files {
        let (length, hash) = hash_file(path)?;
        all.update(format!(
            "{} {length} {hash}\n",
            path.strip_prefix(root).unwrap_or(path).display()
        ));
    }
    Ok(hex(&all.finalize()))
}

/// Length and hash of a file, as `sha256sum` prints it.
pub(crate) fn hash_file(path: &Path) -> io::Result<(u64, String)> {
    let mut file = File::open(path).map_err(|error| named(error, path))?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    let mut length = 0;
    loop {
        match file.read(&mut buffer).map_err(|error| named(error, path))? {
            0 => return Ok((length, hex(&hash.finalize()))),
            count => {
                length += count as u64;
                hash.update(&buffer[..count]);
            }
        }
    }
}

fn named(error: io::Error, path: &Path) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use localization::pose_source::{BaselinePoseConfig, PgcConfig};

    use super::*;

    fn scene(folder: &Path, point: &str) -> PathBuf {
        let agent = folder.join("scene/4279");
        std::fs::create_dir_all(&agent).unwrap();
        std::fs::write(agent.join("000069.pcd"), point).unwrap();
        std::fs::write(agent.join("000069.yaml"), "a: 1").unwrap();
        std::fs::write(agent.join("000069_camera0.png"), point).unwrap();
        folder.join("scene")
    }

    #[test]
    fn a_changed_point_changes_the_hash_and_a_moved_folder_does_not() {
        let [one, two, three] = [(); 3].map(|()| tempfile::tempdir().unwrap());
        let weights = one.path().join("w.safetensors");
        std::fs::write(&weights, b"weights").unwrap();
        let file = || weights.clone();
        let poses = [
            PoseSourceConfig::Pgc(PgcConfig {
                encoder: file(),
                head: file(),
                ..Default::default()
            }),
            PoseSourceConfig::Baseline(BaselinePoseConfig {
                weights: file(),
                ..Default::default()
            }),
        ];
        let collect = |scene: &Path| {
            Provenance::collect(std::slice::from_ref(&weights), &weights, &poses, scene).unwrap()
        };
        let first = collect(&scene(one.path(), "0 0 0"));
        assert_eq!(first.scene_files, 2, "images do not count");
        // From `printf weights | sha256sum`.
        assert!(
            first.weights_sha256.starts_with("9a129038d9a00aed"),
            "{}",
            first.weights_sha256
        );
        assert_eq!(
            first.localizer_sha256.as_ref().unwrap()[1],
            first.weights_sha256
        );
        assert_eq!(first.baseline_sha256.as_ref(), Some(&first.weights_sha256));
        assert_eq!(first, collect(&scene(two.path(), "0 0 0")));
        assert_ne!(
            first.scene_sha256,
            collect(&scene(three.path(), "0 0 1")).scene_sha256
        );
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = Provenance::collect(&[], Path::new("/nowhere/w"), &[], Path::new("/nowhere"))
            .unwrap_err();
        assert!(error.to_string().starts_with("/nowhere"), "{error}");
    }
}
