//! Links by name: published link models, and files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::config::{LinkConfig, LinkError};
use serde::de::IgnoredAny;
use support::bounded_file;
use support::config_file;
use support::file_error::{AtFile, FileError};

/// Every preset with a one-line description.
pub const PRESETS: [(&str, &str); 6] = [
    ("ideal", "everything arrives at once"),
    (
        "opencood-sim",
        "OpenCOOD's constant delay of 100 ms, in whole frames",
    ),
    (
        "opencood-real",
        "OpenCOOD's 27 Mbit/s, 10 ms and up to 100 ms of overhead, in whole frames of 100 ms",
    ),
    (
        "dsrc",
        "802.11p at 6 Mbit/s, one channel for all, loss by distance",
    ),
    (
        "c-v2x",
        "LTE sidelink (PC5 mode 4) at 8 Mbit/s, one channel for all, 20 ms",
    ),
    (
        "5g-uu",
        "5G over a base station: 50 Mbit/s up for each, 20 ms with a long tail",
    ),
];

/// The links of the presets, with their sources.
const LINKS: &str = include_str!("presets.yaml");
/// Largest file that is read, bytes.
const MAX_BYTES: u64 = 1 << 20;

impl LinkConfig {
    /// The link of a preset or a YAML file, and the folder at which paths in it start. Checked, except for its traces.
    ///
    /// # Errors
    /// [`LinkError`] with the file and its fault.
    pub fn open(name: &str) -> Result<(Self, PathBuf), LinkError> {
        if let Some(preset) = Self::preset(name) {
            // No preset refers to a file, so its folder is never used.
            return Ok((preset, PathBuf::from(".")));
        }
        let path = PathBuf::from(name);
        let text = bounded_file::read_text(&path, MAX_BYTES).map_err(|error| {
            let names = PRESETS.map(|(preset, _)| preset).join(", ");
            let problem = format_args!(
                "neither a preset of a link ({names}) nor a file that can be read: {error}"
            );
            FileError::new(&path, problem)
        })?;
        // As a link it would be one without limits, of comments alone too.
        if serde_saphyr::from_str::<Option<IgnoredAny>>(&text).is_ok_and(|link| link.is_none()) {
            return Err(FileError::new(&path, "empty; name the preset ideal instead").into());
        }
        let config: Self = config_file::parse(&text, &path)?;
        config.validate().map_err(LinkError::from).at(&path)?;
        let folder = path.parent().unwrap_or(Path::new(".")).to_path_buf();
        Ok((config, folder))
    }

    /// Every field with its value, as a file for [`Self::open`].
    pub fn to_yaml(&self) -> String {
        // Numbers, names and lists have a spelling in YAML.
        serde_saphyr::to_string(self).unwrap_or_default()
    }

    /// A published link model, by its name of [`PRESETS`].
    pub fn preset(name: &str) -> Option<Self> {
        let links = serde_saphyr::from_str::<BTreeMap<String, Self>>(LINKS);
        links.expect("a test reads every preset").remove(name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wrong_file_is_refused_with_its_field_and_value() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("link.yaml");
        let open = |text: &str| {
            std::fs::write(&path, text).unwrap();
            LinkConfig::open(&path.display().to_string())
        };
        for (text, part) in [
            ("", "link.yaml: empty"),
            ("# rate: 5\n", "link.yaml: empty"),
            ("latency: {constant_ms: 5ms}", "link.yaml:1: latency"),
            ("latency: {constant_ms: 5ms}", "constant_ms: 5ms"),
            ("latency: {constant_ms: -5}", "link: latency is -5"),
        ] {
            let message = open(text).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
        assert_eq!(open("{}").unwrap().0, LinkConfig::default());
    }

    #[test]
    fn every_preset_is_sound() {
        for (name, _) in PRESETS {
            let link = LinkConfig::preset(name).unwrap();
            link.validate().unwrap();
            assert_eq!(
                serde_saphyr::from_str::<LinkConfig>(&link.to_yaml()).unwrap(),
                link,
                "{}",
                link.to_yaml()
            );
        }
        assert_eq!(LinkConfig::preset("6g"), None);
        let message = LinkConfig::open("6g").unwrap_err().to_string();
        assert!(
            PRESETS.iter().all(|(name, _)| message.contains(name)),
            "{message}"
        );
    }
}
