//! Links by name: published link models, and files.

use std::path::{Path, PathBuf};

use super::config::{
    CapacityConfig, LatencyModel, LinkConfig, LinkError, LossModel, LossUnit, Medium, QueueConfig,
};
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
        let shaped = |bandwidth_mbps: f64, burst_bytes| CapacityConfig::TokenBucket {
            bandwidth_mbps,
            burst_bytes,
        };
        let radio = QueueConfig {
            bytes: 1 << 20,
            keep_last: true,
            ..QueueConfig::default()
        };
        Ok(match name {
            "ideal" => Self::default(),
            // OpenCOOD's `wild_setting`, async_mode `sim`: async_overhead 100 ms.
            "opencood-sim" => Self {
                latency: LatencyModel::ConstantMs(100.0),
                floor_ms: 100.0,
                ..Self::default()
            },
            // The same, async_mode `real`: transmission_speed 27 Mbit/s, backbone_delay 10 ms, U(0, async_overhead).
            "opencood-real" => Self {
                latency: LatencyModel::BySize {
                    overhead_ms: 100.0,
                    bandwidth_mbps: 27.0,
                    fixed_ms: 10.0,
                },
                floor_ms: 100.0,
                ..Self::default()
            },
            // IEEE 802.11p: 6 Mbit/s is the default rate of the 10 MHz safety channel (Jiang, Chen and Delgrossi 2008).
            // Packet delivery falls from about one below 100 m to a half near 300 m in urban measurements (Bai and
            // Krishnan 2006 and later ones agree on the order of magnitude).
            "dsrc" => Self {
                medium: Medium::Shared,
                capacity: shaped(6.0, 0),
                queue: radio,
                latency: LatencyModel::UniformMs([1.0, 5.0]),
                keep_order: true,
                loss: LossModel::Distance(vec![[50.0, 0.0], [100.0, 0.001], [300.0, 0.02]]),
                loss_unit: LossUnit::Fragment,
                ..Self::default()
            },
            // 3GPP TR 36.885: a 10 MHz sidelink carries about 8 Mbit/s at the usual modulation; semi-persistent
            // scheduling selects resources within 20 to 100 ms, here its lower end.
            "c-v2x" => Self {
                medium: Medium::Shared,
                capacity: shaped(8.0, 0),
                queue: radio,
                latency: LatencyModel::UniformMs([5.0, 35.0]),
                keep_order: true,
                loss: LossModel::Distance(vec![[100.0, 0.0], [200.0, 0.001], [400.0, 0.01]]),
                loss_unit: LossUnit::Fragment,
                ..Self::default()
            },
            // 3GPP TR 22.886 requires 50 Mbit/s and more per vehicle for extended sensors; measured round trips of
            // public 5G networks are near 20 ms with a long tail (Narayanan et al. 2021).
            "5g-uu" => Self {
                capacity: shaped(50.0, 64 << 10),
                queue: radio,
                latency: LatencyModel::Lognormal {
                    median_ms: 20.0,
                    sigma: 0.35,
                },
                keep_order: true,
                loss: LossModel::GilbertElliott {
                    to_bad: 0.0005,
                    to_good: 0.1,
                    loss_good: 0.0,
                    loss_bad: 0.3,
                },
                ..Self::default()
            },
            _ => {
                let known = PRESETS.map(|(name, _)| name).join(", ");
                let name: String = name.chars().take(40).collect();
                let rule = format!("unknown, there are {known}");
                return Err(FieldError::new("preset", name, rule).into());
            }
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
