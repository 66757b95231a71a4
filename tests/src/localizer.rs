//! Small and untrained localizers, for tests that need files but no accuracy.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use localization::baselines::PoseRegressorConfig;
use localization::baselines::hypliloc::HypLiLocLocalizer;
use localization::baselines::sgloc::{SgLoc, SgLocConfig, SgLocLocalizer};
use localization::pgc::{SceneEncoder, SceneEncoderConfig, SceneHead, SceneHeadConfig};
use perception::weights::{CONFIG_KEY, KIND_KEY, Precision, save};
use serde::Serialize;
use tch::Device;
use tch::nn::VarStore;

use crate::locks::random_generator_lock;

/// An encoder that a test has time to train.
#[must_use]
pub fn small_encoder() -> SceneEncoderConfig {
    SceneEncoderConfig {
        voxel_m: 1.0,
        range_m: 40.0,
        widths: vec![8, 12, 16],
        residual_widths: vec![16],
        ..SceneEncoderConfig::lean()
    }
}

/// Writes an encoder and a head that belong together, with random parameters, the same for the same seed.
///
/// # Panics
/// When a file cannot be written.
pub fn write(folder: &Path, seed: i64) -> (PathBuf, PathBuf) {
    let _generator = random_generator_lock();
    tch::manual_seed(seed);
    let (encoder, head) = (
        folder.join("encoder.safetensors"),
        folder.join("head.safetensors"),
    );
    let config = tiny();
    let network = VarStore::new(Device::Cpu);
    SceneEncoder::new(&network.root(), &config).expect("a configuration that fits");
    let encoder_sha256 = save(
        &encoder,
        &network,
        &metadata(SceneEncoder::KIND, &config),
        Precision::Single,
    )
    .expect("a writable folder");
    let config = SceneHeadConfig {
        scene_name: "nowhere".into(),
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
        sweep_points: None,
    };
    let network = VarStore::new(Device::Cpu);
    SceneHead::new(&network.root(), &config).expect("a configuration that fits");
    save(
        &head,
        &network,
        &metadata(SceneHead::KIND, &config),
        Precision::Single,
    )
    .expect("a writable folder");
    (encoder, head)
}

/// Writes an SGLoc network as if it had been trained, with random parameters, the same for the same seed.
///
/// # Panics
/// When a file cannot be written.
pub fn write_sgloc(folder: &Path, seed: i64) -> PathBuf {
    let config = SgLocConfig {
        scene_name: "nowhere".into(),
        origin_m: [0.0; 3],
        encoder: tiny(),
    };
    write_baseline(
        &folder.join("sgloc.safetensors"),
        seed,
        &metadata(SgLocLocalizer::KIND, &config),
        |root| {
            SgLoc::new(root, &config).expect("a configuration that fits");
        },
    )
}

/// Writes a HypLiLoc network as if it had been trained, with random parameters, the same for the same seed.
///
/// # Panics
/// When a file cannot be written.
pub fn write_hypliloc(folder: &Path, seed: i64) -> PathBuf {
    let config = PoseRegressorConfig {
        scene_name: "nowhere".into(),
        origin_m: [0.0; 3],
        classes: 3,
        encoder: tiny(),
    };
    write_baseline(
        &folder.join("hypliloc.safetensors"),
        seed,
        &metadata(HypLiLocLocalizer::KIND, &config),
        |root| {
            HypLiLocLocalizer::new(root, &config).expect("a configuration that fits");
        },
    )
}

fn write_baseline(
    path: &Path,
    seed: i64,
    about: &BTreeMap<String, String>,
    build: impl FnOnce(&tch::nn::Path<'_>),
) -> PathBuf {
    let _generator = random_generator_lock();
    tch::manual_seed(seed);
    let network = VarStore::new(Device::Cpu);
    build(&network.root());
    save(path, &network, about, Precision::Single).expect("a writable folder");
    path.to_owned()
}

fn tiny() -> SceneEncoderConfig {
    SceneEncoderConfig {
        widths: vec![4, 8],
        residual_widths: vec![8],
        ..small_encoder()
    }
}

fn metadata(kind: &str, config: &impl Serialize) -> BTreeMap<String, String> {
    let text = serde_json::to_string(config).expect("plain numbers and texts");
    BTreeMap::from([
        (CONFIG_KEY.to_owned(), text),
        (KIND_KEY.to_owned(), kind.to_owned()),
    ])
}
