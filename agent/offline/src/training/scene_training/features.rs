//! Features of the frozen encoder for the training and validation sweeps of a head.

use std::sync::Arc;

use super::config::{SceneReport, SceneTrainConfig};
use crate::training::{FeatureCache, LocalizerTrainError, SweepAugmentation, SweepList};
use localization::pgc::{SceneEncoder, SceneEncoderConfig};
use perception::train::DataListing;

/// Features of the sweeps of a scene.
pub(super) struct Features {
    pub(super) training: FeatureCache,
    pub(super) validation: Option<FeatureCache>,
    pub(super) encoder: SceneEncoderConfig,
    pub(super) encoder_sha256: String,
    /// Origin of the training features.
    pub(super) data: DataListing,
}

impl Features {
    /// Reads and encodes the sweeps that `config` names.
    pub(super) fn compute(
        config: &SceneTrainConfig,
        observe: &mut dyn FnMut(&SceneReport),
    ) -> Result<Self, LocalizerTrainError> {
        let (encoder, encoder_sha256) = SceneEncoder::load(&config.encoder, config.run.device)?;
        let list = Arc::new(SweepList::open(&config.scenes)?);
        let mut encode = |list: &Arc<SweepList>, augmentation| {
            let mut progress = |done, total| observe(&SceneReport::Encoding(done, total));
            let cache = FeatureCache::build(list, &encoder, augmentation, &config.run, &mut progress)?;
            observe(&SceneReport::Encoded(list.data()));
            Ok::<_, LocalizerTrainError>(cache)
        };
        let training = encode(&list, config.augmentation)?;
        let validation = match config.validation.as_slice() {
            [] => None,
            folders => {
                let mut list = SweepList::open(folders)?;
                list.thin_out(config.validation_sweeps);
                let unchanged = SweepAugmentation { copies: 1, ..config.augmentation };
                Some(encode(&Arc::new(list), unchanged)?)
            }
        };
        let encoder = encoder.config().clone();
        Ok(Self { training, validation, encoder, encoder_sha256, data: list.data() })
    }
}
