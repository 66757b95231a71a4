//! Features of the frozen encoder for the training and validation sweeps of a head.

use std::sync::Arc;

use super::config::SceneTrainConfig;
use crate::Error;
use crate::training::{FeatureCache, SweepAugmentation, SweepList};
use localization::pgc::{CellEncoder, SweepFormat};
use perception::train::{DataListing, Observe, Progress};

/// Sweeps of a scene.
pub(crate) struct SceneSweeps {
    /// Sweeps that the head is trained on.
    pub(crate) training: Arc<SweepList>,
    /// Sweeps that it is validated on.
    pub(crate) validation: Option<Arc<SweepList>>,
}

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
    /// Reads and encodes sweeps.
    pub(super) fn compute(
        config: &SceneTrainConfig,
        sweeps: &SceneSweeps,
        observe: &mut Observe<'_>,
    ) -> Result<Self, Error> {
        let (encoder, encoder_sha256) = CellEncoder::load(&config.encoder, config.run.device)?;
        let mut encode = |list: &Arc<SweepList>, augmentation| {
            let cache = FeatureCache::build(list, &encoder, augmentation, &config.run, observe)?;
            observe(&Progress::Read(list.data()));
            Ok::<_, Error>(cache)
        };
        let training = encode(&sweeps.training, config.augmentation)?;
        let unchanged = SweepAugmentation {
            copies: 1,
            ..config.augmentation
        };
        let validation = sweeps.validation.as_ref();
        Ok(Self {
            training,
            validation: validation.map(|list| encode(list, unchanged)).transpose()?,
            format: encoder.format().clone(),
            encoder_sha256,
            data: sweeps.training.data(),
        })
    }
}
