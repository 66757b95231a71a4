//! Features of the frozen encoder for the training and validation sweeps of a head.

use std::sync::Arc;

use super::config::SceneTrainConfig;
use crate::Error;
use crate::training::{FeatureCache, SweepAugmentation, SweepList};
use localization::pgc::{CellEncoder, SweepFormat};
use perception::train::{DataListing, Observe, TrainingEvent};

/// Features of the sweeps of a scene.
pub(super) struct Features {
    pub(super) training: FeatureCache,
    pub(super) validation: Option<FeatureCache>,
    pub(super) format: SweepFormat,
    pub(super) encoder_sha256: String,
    /// Origin of the training features.
    pub(super) data: DataListing,
}

impl Features {
    /// Reads and encodes the sweeps that the head is trained on, and those that it is validated on.
    pub(super) fn compute(
        config: &SceneTrainConfig,
        training: &Arc<SweepList>,
        validation: Option<&Arc<SweepList>>,
        observe: &mut Observe<'_>,
    ) -> Result<Self, Error> {
        let (encoder, encoder_sha256) = CellEncoder::load(&config.encoder, config.run.device)?;
        let mut encode = |list: &Arc<SweepList>, augmentation| {
            let cache = FeatureCache::build(list, &encoder, augmentation, &config.run, observe)?;
            observe(&TrainingEvent::Read(list.data()));
            Ok::<_, Error>(cache)
        };
        let encoded = encode(training, config.augmentation)?;
        let unchanged = SweepAugmentation {
            copies: 1,
            ..config.augmentation
        };
        Ok(Self {
            training: encoded,
            validation: validation.map(|list| encode(list, unchanged)).transpose()?,
            format: encoder.format().clone(),
            encoder_sha256,
            data: training.data(),
        })
    }
}
