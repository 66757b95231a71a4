//! Reads scenario files: where a field is wrong, the message names file, line and field.

use std::path::{Path, PathBuf};

use link::PRESETS;

use super::{Scenario, ScenarioError};

/// Largest scenario file, bytes.
const MAX_BYTES: u64 = 1 << 20;

impl Scenario {
    /// Reads and checks a scenario. Relative paths in it are taken from its folder and come back absolute.
    ///
    /// # Errors
    /// [`ScenarioError`] names the file, the line or field, and what is wrong.
    pub fn load(path: &Path) -> Result<Self, ScenarioError> {
        let scenario = Self::read(path)?;
        scenario.check(path)?;
        Ok(scenario)
    }

    /// The scenario as a file that [`Self::load`] reads.
    ///
    /// # Panics
    /// Never: every field has a spelling in YAML.
    #[must_use]
    pub fn to_yaml(&self) -> String {
        serde_saphyr::to_string(self).expect("plain structs, texts and numbers")
    }

    /// Reads a scenario without checking it: for callers that fill in or replace some of it first.
    ///
    /// # Errors
    /// [`ScenarioError`] when the file cannot be read or is no scenario.
    pub fn read(path: &Path) -> Result<Self, ScenarioError> {
        let unreadable = |source| ScenarioError::Read { path: path.into(), source };
        let size = std::fs::metadata(path).map_err(unreadable)?.len();
        if size > MAX_BYTES {
            return Err(unreadable(std::io::Error::other(format!("{size} bytes, more than {MAX_BYTES}"))));
        }
        let text = std::fs::read_to_string(path).map_err(unreadable)?;
        let mut scenario = Self::parse(&text, path)?;
        let folder = std::path::absolute(path).map_err(unreadable)?;
        let folder = folder.parent().unwrap_or(Path::new("/"));
        let Scenario { scene, models, link, security, .. } = &mut scenario;
        let keys = security.iter_mut().flat_map(|security| &mut security.keys);
        let localizer = models.localizer.iter_mut().flat_map(|models| [&mut models.encoder, &mut models.head]);
        let networks = localizer.chain(&mut models.end_to_end);
        let is_preset = |air: &Path| PRESETS.iter().any(|(name, _)| Path::new(name) == air);
        let air = link.iter_mut().map(|link| &mut link.air).filter(|air| !is_preset(air));
        for place in [&mut scene.dir, &mut models.weights].into_iter().chain(networks).chain(air).chain(keys) {
            *place = without_dots(&folder.join(&place));
        }
        Ok(scenario)
    }

    fn parse(text: &str, path: &Path) -> Result<Self, ScenarioError> {
        serde_saphyr::from_str(text).map_err(|error| ScenarioError::Syntax {
            path: path.into(),
            line: error.location().map(|location| location.line()),
            reason: first_line(&error.without_snippet().to_string()),
        })
    }
}

/// The path with `.` and `a/..` taken out, so that messages and the resolved copy read well.
fn without_dots(path: &Path) -> PathBuf {
    use std::path::Component;
    let mut clean = PathBuf::new();
    for component in path.components() {
        match component {
            Component::CurDir => {}
            Component::ParentDir => {
                clean.pop();
            }
            other => clean.push(other),
        }
    }
    clean
}

fn first_line(text: &str) -> String {
    text.lines().next().unwrap_or_default().trim().to_owned()
}

#[cfg(test)]
mod tests {
    use fusion::Method;
    use protocol::{CavId, Dtype};

    use super::super::{NoiseMode, PoseSource};
    use super::*;

    const SMALL: &str = "scene: {dir: ../scene}\nmodels: {weights: w.safetensors}\n";

    fn parse(text: &str) -> Result<Scenario, ScenarioError> {
        Scenario::parse(text, Path::new("s.yaml"))
    }

    #[test]
    fn scene_and_weights_are_enough() {
        let scenario = parse(SMALL).unwrap();
        assert_eq!(scenario.method, Method::MAX);
        assert_eq!(scenario.network.listen, "tcp/127.0.0.1:0");
        assert_eq!(scenario.scene.rate, 1.0);
    }

    #[test]
    fn a_vehicle_overrides_single_fields() {
        let text = format!(
            "{SMALL}agents: {{codec: {{dtype: f32}}}}\nvehicles:\n  4288:\n    codec: {{dtype: i8, zstd_level: 3}}\n    pose: {{noisy: {{mode: fixed, std_m: 1.5}}}}\n"
        );
        let scenario = parse(&text).unwrap();
        let own = scenario.settings_of(&CavId::new("4288").unwrap());
        assert_eq!((own.codec.dtype, own.codec.zstd_level), (Dtype::I8, Some(3)));
        let PoseSource::Noisy(noise) = own.pose else { panic!("{:?}", own.pose) };
        assert_eq!((noise.mode, noise.std_m, noise.std_deg), (NoiseMode::Fixed, 1.5, 0.2));
        assert_eq!(scenario.settings_of(&CavId::new("4279").unwrap()), scenario.agents);
    }

    #[test]
    fn what_maps_are_fitted_to_is_said_for_all_or_for_one() {
        let text = format!(
            "{SMALL}agents: {{rate: {{bytes_per_second: 750000, watch_queue: true}}}}\nvehicles:\n  4288: {{rate: {{message_bytes: 75000}}}}\n"
        );
        let scenario = parse(&text).unwrap();
        let rate_of = |cav| scenario.settings_of(&CavId::new(cav).unwrap()).rate;
        let rate = rate_of("4279");
        assert_eq!((rate.message_bytes, rate.bytes_per_second, rate.watch_queue), (None, Some(750_000), true));
        let rate = rate_of("4288");
        assert_eq!((rate.message_bytes, rate.bytes_per_second, rate.watch_queue), (Some(75_000), None, false));
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
        let message = parse(&format!("{SMALL}agents: {{rate: {{bytes: 3}}}}\n")).unwrap_err().to_string();
        assert!(message.contains("bytes_per_second"), "{message}");
    }

    #[test]
    fn one_vehicle_may_find_its_pose_itself() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        let text = |models: &str| {
            format!("scene: {{dir: .}}\nmodels: {{weights: s.yaml{models}}}\nvehicles:\n  4288: {{pose: pgc}}\n")
        };
        std::fs::write(&file, text("")).unwrap();
        let message = Scenario::load(&file).unwrap_err().to_string();
        assert!(message.contains("models.localizer is left out"), "{message}");
        std::fs::write(&file, text(", localizer: {encoder: e.safetensors, head: s.yaml}")).unwrap();
        let message = Scenario::load(&file).unwrap_err().to_string();
        assert!(message.contains("models.localizer.encoder: ") && message.contains("e.safetensors"), "{message}");
        std::fs::write(folder.path().join("e.safetensors"), b"").unwrap();
        let scenario = Scenario::load(&file).unwrap();
        assert!(scenario.models.localizer.as_ref().unwrap().encoder.is_absolute());
        assert_eq!(scenario.settings_of(&CavId::new("4288").unwrap()).pose, PoseSource::Pgc);
        assert_eq!(scenario.settings_of(&CavId::new("4279").unwrap()).pose, PoseSource::Recorded);
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
    }

    #[test]
    fn a_pose_by_a_network_trained_end_to_end_needs_its_weights() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        let text = |more: &str| {
            format!("scene: {{dir: .}}\nmodels: {{weights: s.yaml{more}}}\nagents: {{pose: end_to_end}}\n")
        };
        std::fs::write(&file, text("")).unwrap();
        let message = Scenario::load(&file).unwrap_err().to_string();
        assert!(message.contains("models.end_to_end is left out"), "{message}");
        std::fs::write(&file, text(", end_to_end: w.safetensors")).unwrap();
        let message = Scenario::load(&file).unwrap_err().to_string();
        assert!(message.contains("models.end_to_end: ") && message.contains("w.safetensors"), "{message}");
        std::fs::write(folder.path().join("w.safetensors"), b"").unwrap();
        let scenario = Scenario::load(&file).unwrap();
        assert!(scenario.models.end_to_end.as_ref().unwrap().is_absolute() && !scenario.uses_localizer());
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
    }

    #[test]
    fn an_unknown_field_is_refused_with_file_line_and_field() {
        let message = parse(&format!("{SMALL}ego:\n  dedline_ms: 5\n")).unwrap_err().to_string();
        assert!(message.starts_with("s.yaml:4:") && message.contains("dedline_ms"), "{message}");
        assert!(message.contains("deadline_ms"), "the message should name what is known: {message}");
    }

    #[test]
    fn a_field_of_the_wrong_kind_is_refused_with_its_line() {
        let message = parse("scene:\n  dir: a\n  rate: fast\nmodels: {weights: w}\n").unwrap_err().to_string();
        assert!(message.starts_with("s.yaml:3:"), "{message}");
        let message = parse(&format!("{SMALL}method: magic\n")).unwrap_err().to_string();
        assert!(message.starts_with("s.yaml:3:") && message.contains("magic"), "{message}");
    }

    #[test]
    fn values_that_make_no_sense_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        for (line, field) in [
            ("scene: {dir: ., rate: 0}", "scene.rate is 0"),
            ("scene: {dir: ., frames: 0}", "scene.frames is 0"),
            ("scene: {dir: nowhere}", "nowhere does not exist"),
            ("scene: {dir: .}\nnetwork: {listen: localhost}", "network.listen is localhost"),
            ("scene: {dir: .}\nnetwork: {connect: quic/10.0.0.1:7447}", "network.connect is quic/10.0.0.1:7447"),
            ("scene: {dir: .}\nnetwork: {metrics: \"127.0.0.1:0\"}", "network.metrics is 127.0.0.1:0"),
            ("scene: {dir: .}\ntimeouts: {ready_s: 1e30}", "timeouts.ready_s is 1000000"),
            ("scene: {dir: .}\nclock: stepped\nrecord: {}", "record is given"),
            (
                "scene: {dir: .}\nclock: stepped\nnetwork: {metrics: \"127.0.0.1:9464\"}",
                "network.metrics is 127.0.0.1:9464",
            ),
            ("scene: {dir: ., agents: [a]}\nego: {id: b}", "ego.id is b"),
            ("scene: {dir: ., rate: 2}\nclock: stepped", "scene.rate is 2"),
            ("scene: {dir: ., lockstep: true}\nclock: stepped", "scene.lockstep is true"),
            ("scene: {dir: .}\nstepped: {}", "stepped is given"),
            (
                "scene: {dir: .}\nclock: stepped\nstepped: {compute: {pose_ms: -1, map_ms: 0, fuse_ms: 0}}",
                "pose_ms is -1",
            ),
            ("scene: {dir: .}\nmodels: {weights: none.safetensors}", "none.safetensors does not exist"),
        ] {
            let models = if line.contains("models") { "" } else { "models: {weights: s.yaml}\n" };
            std::fs::write(&file, format!("{line}\n{models}")).unwrap();
            let message = Scenario::load(&file).unwrap_err().to_string();
            assert!(message.contains(field) && message.contains("s.yaml"), "{line}: {message}");
        }
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
    fn what_is_written_reads_back_the_same() {
        let mut scenario = parse(SMALL).unwrap();
        scenario.agents.pose = PoseSource::Noisy(super::super::PoseNoise::default());
        assert_eq!(parse(&scenario.to_yaml()).unwrap(), scenario);
    }

    #[test]
    fn the_samples_are_scenarios_and_say_what_the_defaults_are() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios");
        let samples: Vec<_> = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        assert!(samples.len() >= 2, "{samples:?}");
        for sample in samples {
            Scenario::read(&sample).unwrap();
        }
        let demo = Scenario::read(&folder.join("demo.yaml")).unwrap();
        let mut plain = parse(SMALL).unwrap();
        (plain.scene.dir, plain.models.weights) = (demo.scene.dir.clone(), demo.models.weights.clone());
        plain.agents.codec.dtype = Dtype::F16;
        assert!(demo.models.localizer.is_some());
        (plain.agents.pose, plain.models.localizer) = (PoseSource::Pgc, demo.models.localizer.clone());
        assert_eq!(demo, plain);
    }
}
