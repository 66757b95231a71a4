//! Files that a result is made of, besides programs and data.

use std::path::{Path, PathBuf};

use agent::config::AgentSettings;
use fusion::Method;
use link::LinkConfig;

/// Files that a method reads beside the data: its weights, its TorchScript module, those of the vehicles' pose sources and
/// networks, and the trace of the link, whose paths are relative to a folder.
pub(crate) fn files_of<'a>(
    method: Method,
    weights: PathBuf,
    vehicles: impl IntoIterator<Item = &'a AgentSettings>,
    link: Option<(&LinkConfig, &Path)>,
) -> Vec<PathBuf> {
    let mut files = vec![weights];
    files.extend(method.script_file().map(Path::to_owned));
    for settings in vehicles {
        files.extend(settings.pose.files());
        files.extend(settings.weights.clone());
    }
    files.extend(link.and_then(|(link, folder)| Some(folder.join(link.trace_file()?))));
    files
}

#[cfg(test)]
mod tests {
    use link::{CapacityConfig, TraceConfig};
    use localization::pose_source::{
        BaselinePoseConfig, CachedPoseConfig, NoiseMode, NoisyPoseConfig, PgcConfig,
        PoseSourceConfig,
    };

    use support::file_digests::FileDigests;
    use support::provenance::Provenance;

    use super::*;

    /// Files of the vehicles, of the method and of the link.
    const NAMES: [&str; 10] = [
        "weights",
        "own weights",
        "script.pt",
        "encoder",
        "town1",
        "town4",
        "baseline",
        "poses",
        "errors",
        "trace.csv",
    ];

    fn pgc(folder: &Path, head: &str) -> PoseSourceConfig {
        PoseSourceConfig::Pgc(PgcConfig {
            encoder: folder.join("encoder"),
            head: folder.join(head),
            ..Default::default()
        })
    }

    /// Two heads of one encoder, a baseline, a table of poses and one of errors; one vehicle has a network of its own.
    fn vehicles(folder: &Path) -> Vec<AgentSettings> {
        let poses = vec![
            pgc(folder, "town1"),
            pgc(folder, "town4"),
            PoseSourceConfig::Baseline(BaselinePoseConfig {
                weights: folder.join("baseline"),
                ..Default::default()
            }),
            PoseSourceConfig::Cached(CachedPoseConfig {
                file: folder.join("poses"),
                ..Default::default()
            }),
            PoseSourceConfig::Noisy(NoisyPoseConfig {
                mode: NoiseMode::Replayed,
                table: Some(folder.join("errors")),
                ..Default::default()
            }),
        ];
        let mut vehicles: Vec<AgentSettings> = poses
            .into_iter()
            .map(|pose| AgentSettings {
                pose,
                ..AgentSettings::default()
            })
            .collect();
        vehicles[1].weights = Some(folder.join("own weights"));
        vehicles
    }

    /// Key of a result that is made of all files in the folder.
    fn key(folder: &Path) -> String {
        let method = format!("script:{}", folder.join("script.pt").display());
        let trace = TraceConfig::new(Path::new("trace.csv"));
        let link = LinkConfig {
            capacity: CapacityConfig::Trace(trace),
            ..LinkConfig::default()
        };
        let files = files_of(
            method.parse().unwrap(),
            folder.join("weights"),
            &vehicles(folder),
            Some((&link, folder)),
        );
        let digests = FileDigests::default();
        let provenance = Provenance::collect(&[], "data".into(), files, "commit", &digests);
        let provenance = provenance.unwrap();
        assert_eq!(provenance.files_sha256.len(), NAMES.len());
        provenance.key("settings")
    }

    #[test]
    fn a_flipped_byte_of_any_file_changes_the_key_and_a_moved_folder_does_not() {
        let [one, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        for folder in [&one, &other] {
            for name in NAMES {
                std::fs::write(folder.path().join(name), name).unwrap();
            }
        }
        let original = key(one.path());
        assert_eq!(key(other.path()), original);
        for name in NAMES {
            let path = one.path().join(name);
            let mut flipped = name.as_bytes().to_vec();
            flipped[0] ^= 1;
            std::fs::write(&path, flipped).unwrap();
            assert_ne!(key(one.path()), original, "{name}");
            std::fs::write(&path, name).unwrap();
        }
    }

    #[test]
    fn a_missing_file_is_named() {
        let digests = FileDigests::default();
        let missing = [PathBuf::from("/nowhere/w")];
        let found = Provenance::collect(&[], String::new(), missing, "commit", &digests);
        let error = found.unwrap_err();
        assert!(error.to_string().starts_with("/nowhere/w"), "{error}");
    }
}
