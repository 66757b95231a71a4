//! Reader of scenario files: errors name file, line and field.

use std::path::{Path, PathBuf};

use agent::config::AgentSettings;
use link::LinkConfig;
use support::config_file;
use support::file_error::{AtFile, FileError, Result};

use super::{FieldOverride, Scenario};

impl Scenario {
    /// Reads and checks a scenario. Relative paths are resolved against its folder.
    ///
    /// # Errors
    /// [`FileError`] names the file, the line or field, and what is wrong.
    pub fn load(path: &Path) -> Result<Self> {
        let scenario = Self::read(path)?;
        scenario.check(path)?;
        Ok(scenario)
    }

    /// The scenario as a file that [`Self::load`] reads.
    ///
    /// # Panics
    /// Never: every field has a spelling in YAML.
    pub(crate) fn to_yaml(&self) -> String {
        serde_saphyr::to_string(self).expect("plain structs, texts and numbers")
    }

    /// Reads a scenario without checking it: for callers that first fill in or replace some fields.
    ///
    /// # Errors
    /// [`FileError`] when the file cannot be read or is no scenario.
    pub fn read(path: &Path) -> Result<Self> {
        Self::read_with(path, &[])
    }

    /// The same with other values for some fields.
    ///
    /// # Errors
    /// As [`Self::read`]; also when a field that is set is not one of a scenario.
    pub fn read_with(path: &Path, overrides: &[FieldOverride]) -> Result<Self> {
        // Read as it is first: errors of the file have lines.
        let mut scenario: Self = config_file::read(path)?;
        for field in overrides {
            // One by one, so that an error names the field.
            scenario = (field.applied_to(&scenario))
                .map_err(|error| FileError::new(path, format_args!("--set {field}: {error}")))?;
        }
        let file = std::path::absolute(path).at(path)?;
        let folder = file.parent().unwrap_or(Path::new("/"));
        let security = scenario.security.iter_mut();
        let keys = security.flat_map(|security| &mut security.keys);
        // An empty path is one that is left out. Joined, it would name the folder of the file.
        for place in [&mut scenario.scene.dir, &mut scenario.models.weights]
            .into_iter()
            .chain(keys)
            .filter(|place| !place.as_os_str().is_empty())
        {
            *place = without_dots(&folder.join(&place));
        }
        scenario.agents = with_files(scenario.agents, path, folder)?;
        for own in scenario.vehicles.values_mut() {
            own.change(|settings| with_files(settings, path, folder))?;
        }
        if let Some(link) = &mut scenario.link
            && LinkConfig::preset(&link.model).is_none()
        {
            let model = without_dots(&folder.join(&link.model));
            link.model = model.to_string_lossy().into_owned();
        }
        Ok(scenario)
    }
}

/// Settings with their files found in `folder`, and the networks; errors name `path`.
fn with_files(settings: AgentSettings, path: &Path, folder: &Path) -> Result<AgentSettings> {
    let found = |file: &Path| without_dots(&folder.join(file));
    let pose = settings.pose.map_files(found);
    let pose = pose
        .with_networks()
        .map_err(|error| FileError::new(path, format_args!("agents.pose: {error}")))?;
    Ok(AgentSettings {
        pose,
        weights: settings.weights.map(|weights| found(&weights)),
        ..settings
    })
}

/// The path without `.` and `a/..`, for readable messages and resolved copies.
fn without_dots(path: &Path) -> PathBuf {
    use std::path::Component;
    let mut clean = PathBuf::new();
    for component in path.components() {
        match component {
            Component::CurDir => {}
            // Above the root there is nothing to drop.
            Component::ParentDir => {
                // The folder above a link is the one above its target.
                if clean.is_symlink() {
                    clean = clean.canonicalize().unwrap_or(clean);
                }
                clean.pop();
            }
            other => clean.push(other),
        }
    }
    clean
}

#[cfg(test)]
mod tests {
    use fusion::Method;
    use protocol::{CavId, Dtype};

    use localization::pose_source::{NoiseMode, NoisyPoseConfig, PoseSourceConfig};

    use super::*;

    const SMALL: &str = "scene: {dir: ../scene}\nmodels: {weights: w.safetensors}\n";

    fn parse(text: &str) -> Result<Scenario, FileError> {
        config_file::parse(text, Path::new("s.yaml"))
    }

    fn read_with_overrides(file: &Path, texts: &[&str]) -> Result<Scenario, FileError> {
        let overrides: Vec<FieldOverride> =
            texts.iter().map(|text| text.parse().unwrap()).collect();
        Scenario::read_with(file, &overrides)
    }

    /// A scenario in which one vehicle has this pose source.
    fn text_with_pose(pose: &str) -> String {
        format!(
            "scene: {{dir: .}}\nmodels: {{weights: s.yaml}}\nvehicles:\n  4288: {{pose: {{{pose}}}}}\n"
        )
    }

    #[test]
    fn scene_and_weights_are_enough() {
        let scenario = parse(SMALL).unwrap();
        assert_eq!(scenario.method, Method::MAX);
        assert_eq!(scenario.network.listen, "tcp/127.0.0.1:0");
        assert_eq!(scenario.scene.rate, 1.0);
    }

    #[test]
    fn fields_are_set_from_the_command_line_and_wrong_ones_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        std::fs::write(
            &file,
            format!("{SMALL}vehicles: {{4288: {{codec: {{dtype: i8}}}}}}\n"),
        )
        .unwrap();
        let overrides = [
            "scene.lockstep=true",
            "agents.codec.dtype=f32",
            "vehicles.4288.codec.zstd_level=3",
        ];
        let scenario = read_with_overrides(&file, &overrides).unwrap();
        assert!(scenario.scene.lockstep && scenario.agents.codec.dtype == Dtype::F32);
        let own = scenario.settings_of(&CavId::new("4288").unwrap()).codec;
        assert_eq!((own.dtype, own.zstd_level), (Dtype::I8, Some(3)));
        assert_eq!(
            scenario.scene.dir,
            without_dots(&folder.path().join("../scene"))
        );
        let error = read_with_overrides(&file, &["scene.lockstep=maybe"]).unwrap_err();
        let message = error.to_string();
        assert!(
            message.contains("s.yaml") && message.contains("--set scene.lockstep=\"maybe\""),
            "{message}"
        );
        let error = read_with_overrides(&file, &["scene.lock=true"]).unwrap_err();
        assert!(error.to_string().contains("unknown field `lock`"));
    }

    #[test]
    fn a_field_is_set_in_every_spelling_that_a_file_may_have() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        // Texts that are numbers in YAML; and options that are absent.
        let text = "scene: {dir: ../scene, scenario: 2021_08_21_17_30_41, intensity_scale: 255}\n\
                    models: {weights: w.safetensors}\nego: {id: 0100}\n";
        std::fs::write(&file, text).unwrap();
        let plain = Scenario::read(&file).unwrap();
        let mut expected = plain.clone();
        expected.scene.lockstep = true;
        let set = read_with_overrides(&file, &["scene.lockstep=true"]).unwrap();
        assert_eq!(set, expected);
        let id = |text| CavId::new(text).unwrap();
        assert_eq!(set.ego.id, Some(id("0100")));
        assert!(set.link.is_none() && set.record.is_none() && set.security.is_none());
        let set = read_with_overrides(
            &file,
            &[
                "scene.scenario=2021_08_21_17_30_42",
                "scene.agents=[0100, 1010]",
                "scene.intensity_scale=1",
                "ego.id=1010",
                "run=5",
                "vehicles.0100.weights=8",
            ],
        )
        .unwrap();
        assert_eq!(set.scene.scenario.as_deref(), Some("2021_08_21_17_30_42"));
        assert_eq!(set.scene.agents, [id("0100"), id("1010")]);
        assert_eq!(set.scene.intensity_scale.to_string(), "1");
        assert_eq!(set.ego.id, Some(id("1010")));
        assert_eq!(set.run.as_ref().map(|run| run.as_str()), Some("5"));
        assert_eq!(
            set.settings_of(&id("0100")).weights,
            Some(folder.path().join("8"))
        );
        assert_eq!(set.scene.dir, plain.scene.dir);
        let message = read_with_overrides(&file, &["scene.rate=[1]"])
            .unwrap_err()
            .to_string();
        assert!(message.contains("--set scene.rate=[1]: "), "{message}");
    }

    #[test]
    fn a_vehicle_overrides_single_fields() {
        let text = format!(
            "{SMALL}agents: {{codec: {{dtype: f32}}}}\nvehicles:\n  4288:\n    codec: {{dtype: i8, zstd_level: 3}}\n    pose: {{noisy: {{mode: fixed, position_std_m: 1.5}}}}\n"
        );
        let scenario = parse(&text).unwrap();
        let own = scenario.settings_of(&CavId::new("4288").unwrap());
        assert_eq!(
            (own.codec.dtype, own.codec.zstd_level),
            (Dtype::I8, Some(3))
        );
        let PoseSourceConfig::Noisy(noise) = own.pose else {
            panic!("{:?}", own.pose)
        };
        assert_eq!(
            (noise.mode, noise.position_std_m, noise.heading_std_deg),
            (NoiseMode::Fixed, 1.5, 0.2)
        );
        assert_eq!(
            scenario.settings_of(&CavId::new("4279").unwrap()),
            scenario.agents
        );
    }

    #[test]
    fn the_rate_of_feature_maps_is_set_for_all_or_for_one() {
        let text = format!(
            "{SMALL}agents: {{rate: {{bytes_per_second: 750000, watch_queue: true}}}}\nvehicles:\n  4288: {{rate: {{message_bytes: 75000}}}}\n"
        );
        let scenario = parse(&text).unwrap();
        for (cav, expected) in [
            ("4279", (None, Some(750_000), true)),
            ("4288", (Some(75_000), None, false)),
        ] {
            let rate = scenario.settings_of(&CavId::new(cav).unwrap()).rate;
            assert_eq!(
                (rate.message_bytes, rate.bytes_per_second, rate.watch_queue),
                expected
            );
        }
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
        let message = parse(&format!("{SMALL}agents: {{rate: {{bytes: 3}}}}\n"))
            .unwrap_err()
            .to_string();
        assert!(message.contains("bytes_per_second"), "{message}");
    }

    #[test]
    fn one_vehicle_may_find_its_pose_itself() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        std::fs::write(&file, text_with_pose("pgc: {encoder: e.safetensors}")).unwrap();
        let message = Scenario::load(&file).unwrap_err().to_string();
        assert!(message.contains("head"), "{message}");
        let text = text_with_pose("pgc: {encoder: e.safetensors, head: s.yaml}");
        std::fs::write(&file, text).unwrap();
        let message = Scenario::load(&file).unwrap_err().to_string();
        assert!(
            message.contains("agents.pose: ") && message.contains("e.safetensors"),
            "{message}"
        );
        std::fs::write(folder.path().join("e.safetensors"), b"").unwrap();
        let scenario = Scenario::load(&file).unwrap();
        let PoseSourceConfig::Pgc(pgc) = scenario.settings_of(&CavId::new("4288").unwrap()).pose
        else {
            panic!()
        };
        assert!(pgc.encoder.is_absolute() && pgc.head.exists());
        assert_eq!(
            scenario.settings_of(&CavId::new("4279").unwrap()).pose,
            PoseSourceConfig::Recorded
        );
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
        std::fs::write(&file, text_with_pose("baseline: {weights: e.safetensors}")).unwrap();
        assert_eq!(Scenario::load(&file).unwrap().poses()[1].name(), "baseline");
    }

    #[test]
    fn an_unknown_field_is_refused_with_file_line_and_field() {
        let message = parse(&format!("{SMALL}ego:\n  dedline_ms: 5\n"))
            .unwrap_err()
            .to_string();
        assert!(
            message.starts_with("s.yaml:4:") && message.contains("dedline_ms"),
            "{message}"
        );
        assert!(
            message.contains("deadline_ms"),
            "the message should name what is known: {message}"
        );
    }

    #[test]
    fn a_field_of_the_wrong_kind_is_refused_with_its_line() {
        let message = parse("scene:\n  dir: a\n  rate: fast\nmodels: {weights: w}\n")
            .unwrap_err()
            .to_string();
        assert!(message.starts_with("s.yaml:3:"), "{message}");
        let message = parse(&format!("{SMALL}method: magic\n"))
            .unwrap_err()
            .to_string();
        assert!(
            message.starts_with("s.yaml:3:") && message.contains("magic"),
            "{message}"
        );
    }

    #[test]
    fn values_that_make_no_sense_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        for (line, field) in [
            ("scene: {dir: ., rate: 0}", "scene.rate is 0"),
            ("scene: {dir: ., frames: 0}", "scene.frames is 0"),
            (
                "scene: {dir: .}\nagents: {pose: {noisy: {step_s: 0}}}",
                "noisy.step_s is 0",
            ),
            ("scene: {dir: nowhere}", "nowhere does not exist"),
            (
                "scene: {dir: .}\nnetwork: {listen: localhost}",
                "network.listen is localhost",
            ),
            (
                "scene: {dir: .}\nnetwork: {connect: quic/10.0.0.1:7447}",
                "network.connect is quic/10.0.0.1:7447",
            ),
            (
                "scene: {dir: .}\nnetwork: {metrics: \"127.0.0.1:0\"}",
                "network.metrics is 127.0.0.1:0",
            ),
            (
                "scene: {dir: .}\ntimeouts: {ready_s: 1e30}",
                "timeouts.ready_s is 1e30",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nrecord: {}",
                "record is given",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nnetwork: {metrics: \"127.0.0.1:9464\"}",
                "network.metrics is 127.0.0.1:9464",
            ),
            ("scene: {dir: ., agents: [a]}\nego: {id: b}", "ego.id is b"),
            (
                "scene: {dir: ., rate: 2}\nclock: stepped",
                "scene.rate is 2",
            ),
            (
                "scene: {dir: ., rate: 0.5}\nlink: {model: ideal}",
                "scene.rate is 0.5: must be 1 with link",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nagents: {rate: {watch_queue: true}}",
                "agents.rate.watch_queue is true: must be false with clock stepped",
            ),
            (
                "scene: {dir: ., lockstep: true}\nclock: stepped",
                "scene.lockstep is true",
            ),
            ("scene: {dir: .}\nstepped: {}", "stepped is given"),
            (
                "scene: {dir: ., loop: true}\nvehicles: {a: {pose: {cached: {file: s.yaml}}}}",
                "scene.loop is true: must be false with agents.pose cached",
            ),
            (
                "scene: {dir: .}\nvehicles: {a: {falsification: false_velocity}}",
                "agents.falsification is false_velocity: needs boxes",
            ),
            (
                "scene: {dir: .}\nvehicles: {a: {falsification: copied}}",
                "agents.falsification is copied: must be another",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nstepped: {processes: true}\nagents: {falsification: copied}",
                "agents.falsification is copied: must be another",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nstepped: {compute: {pose_ms: -1, map_ms: 0, fuse_ms: 0}}",
                "pose_ms is -1",
            ),
            (
                "scene: {dir: .}\nmodels: {weights: s.yaml, threads: 0}",
                "models.threads is 0: must be 1 to 256",
            ),
            (
                "scene: {dir: ., agents: [1, 2, 1]}",
                "scene.agents is \"1\": must name each vehicle once",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nmodels: {weights: s.yaml, device: cuda}",
                "models.device is cuda: must be cpu with clock stepped",
            ),
            (
                "scene: {dir: .}\nclock: stepped\nego: {pace: every_sweep}",
                "ego.pace is every_sweep: must be auto with clock stepped",
            ),
            (
                "scene: {dir: .}\nmodels: {weights: none.safetensors}",
                "none.safetensors does not exist",
            ),
        ] {
            let models = if line.contains("models") {
                ""
            } else {
                "models: {weights: s.yaml}\n"
            };
            std::fs::write(&file, format!("{line}\n{models}")).unwrap();
            let message = Scenario::load(&file).unwrap_err().to_string();
            assert!(
                message.contains(field) && message.contains("s.yaml"),
                "{line}: {message}"
            );
        }
        let copied = "scene: {dir: .}\nmodels: {weights: s.yaml}\nclock: stepped\nagents: {falsification: copied}";
        std::fs::write(&file, copied).unwrap();
        Scenario::load(&file).unwrap();
    }

    #[test]
    fn paths_are_taken_from_the_scenario_file() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("scenarios")).unwrap();
        std::fs::create_dir(folder.path().join("scene")).unwrap();
        let file = folder.path().join("scenarios/s.yaml");
        std::fs::write(folder.path().join("scenarios/w.safetensors"), b"").unwrap();
        std::fs::write(&file, SMALL).unwrap();
        let scenario = Scenario::load(&file).unwrap();
        assert!(scenario.scene.dir.is_absolute() && scenario.scene.dir.ends_with("scene"));
        assert!(scenario.models.weights.exists());
    }

    #[test]
    fn the_folder_above_a_link_is_the_one_above_its_target() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().canonicalize().unwrap();
        std::fs::create_dir_all(root.join("a/b")).unwrap();
        std::os::unix::fs::symlink(root.join("a/b"), root.join("link")).unwrap();
        assert_eq!(without_dots(&root.join("link/../c")), root.join("a/c"));
        assert_eq!(without_dots(&root.join("link/./c")), root.join("link/c"));
    }

    #[test]
    fn what_is_written_reads_back_the_same() {
        let mut scenario = parse(SMALL).unwrap();
        scenario.agents.pose = PoseSourceConfig::Noisy(NoisyPoseConfig::default());
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
    }

    #[test]
    fn the_samples_are_scenarios_and_state_the_defaults() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scenarios");
        let entries = std::fs::read_dir(&folder)
            .unwrap()
            .map(|entry| entry.unwrap().path());
        let samples: Vec<_> = entries
            .filter(|path| path.extension().is_some_and(|kind| kind == "yaml"))
            .collect();
        assert!(samples.len() >= 2, "{samples:?}");
        for sample in samples {
            Scenario::read(&sample).unwrap();
        }
        let demo = Scenario::read(&folder.join("demo.yaml")).unwrap();
        let mut plain = parse(SMALL).unwrap();
        (plain.scene.dir, plain.models.weights) =
            (demo.scene.dir.clone(), demo.models.weights.clone());
        plain.agents.codec.dtype = Dtype::F16;
        assert!(matches!(demo.agents.pose, PoseSourceConfig::Tracked(_)));
        plain.agents.pose = demo.agents.pose.clone();
        assert_eq!(demo, plain);
    }
}
