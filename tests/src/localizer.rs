//! Localizers that have learnt nothing, for tests that need files but no meaning.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use agent::localizer::{SceneEncoder, SceneEncoderConfig, SceneHead, SceneHeadConfig};
use agent::weights::{CONFIG_KEY, Precision, save};
use serde::Serialize;
use tch::Device;
use tch::nn::VarStore;

/// Writes an encoder and a head that belong together, with random parameters, the same for the same seed.
///
/// # Panics
/// When the disk refuses.
pub fn write(folder: &Path, seed: i64) -> (PathBuf, PathBuf) {
    tch::manual_seed(seed);
    tch::set_num_threads(1);
    let (encoder, head) = (folder.join("encoder.safetensors"), folder.join("head.safetensors"));
    let config = SceneEncoderConfig {
        voxel_m: 1.0,
        range_m: 40.0,
        widths: vec![4, 8],
        residual_widths: vec![8],
        ..SceneEncoderConfig::lean()
    };
    let network = VarStore::new(Device::Cpu);
    SceneEncoder::new(&network.root(), &config).expect("a configuration that fits");
    let encoder_sha256 = save(&encoder, &network, &metadata(&config), Precision::Single).expect("a writable folder");
    let config = SceneHeadConfig {
        town: "nowhere".into(),
        encoder_sha256,
        cell_channels: config.cell_channels(),
        sweep_channels: config.sweep_channels(),
        classes: 2,
        centres: 3,
        width: 8,
        blocks: 1,
        origin_m: [0.0; 3],
        max_cells: 500,
        refiner: None,
    };
    let network = VarStore::new(Device::Cpu);
    SceneHead::new(&network.root(), &config).expect("a configuration that fits");
    save(&head, &network, &metadata(&config), Precision::Single).expect("a writable folder");
    (encoder, head)
}

fn metadata(config: &impl Serialize) -> BTreeMap<String, String> {
    let text = serde_json::to_string(config).expect("plain numbers and texts");
    BTreeMap::from([(CONFIG_KEY.to_owned(), text)])
}
