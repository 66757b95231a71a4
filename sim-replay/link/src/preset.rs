//! Links by name: published link models, and files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::config::{LinkConfig, LinkError};
use protocol::config::FieldError;
use support::bounded_file;
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
        let names = PRESETS.map(|(preset, _)| preset);
        if names.contains(&name) {
            // No preset refers to a file, so its folder is never used.
            return Ok((Self::preset(name)?, PathBuf::from(".")));
        }
        let path = PathBuf::from(name);
        let text = bounded_file::read_text(&path, MAX_BYTES).map_err(|error| {
            let names = names.join(", ");
            let problem = format_args!(
                "neither a preset of a link ({names}) nor a file that can be read: {error}"
            );
            FileError::new(&path, problem)
        })?;
        let config: Self = serde_saphyr::from_str(&text).at(&path)?;
        let checked = config.validate().map_err(LinkError::from);
        checked.map_err(|error| error.in_file(name))?;
        let folder = path.parent().unwrap_or(Path::new(".")).to_path_buf();
        Ok((config, folder))
    }

    /// Every field with its value, as a file for [`Self::open`].
    pub fn to_yaml(&self) -> String {
        // Numbers, names and lists have a spelling in YAML.
        serde_saphyr::to_string(self).unwrap_or_default()
    }

    /// A published link model, by name.
    ///
    /// # Errors
    /// [`LinkError::Value`] lists the available names.
    pub fn preset(name: &str) -> Result<Self, LinkError> {
        let links = serde_saphyr::from_str::<BTreeMap<String, Self>>(LINKS);
        let mut links = links.expect("a test reads every preset");
        links.remove(name).ok_or_else(|| {
            let known = PRESETS.map(|(name, _)| name).join(", ");
            let name: String = name.chars().take(40).collect();
            FieldError::new("preset", name, format!("unknown, there are {known}")).into()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let message = LinkConfig::preset("6g").unwrap_err().to_string();
        assert!(
            PRESETS.iter().all(|(name, _)| message.contains(name)),
            "{message}"
        );
    }
}
