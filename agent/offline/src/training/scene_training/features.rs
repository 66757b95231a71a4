//! Features of the frozen encoder for the training and validation sweeps of a head.

use std::sync::Arc;

use super::config::SceneTrainConfig;
use crate::Error;
use crate::training::{FeatureCache, SweepAugmentation, SweepList};
use localization::pgc::{CellEncoder, SweepFormat};
use perception::train::Observe;

/// Features of the sweeps of a scene.
pub(super) struct Features {
    pub(super) training: FeatureCache,
    pub(super) validation: Option<FeatureCache>,
    pub(super) format: SweepFormat,
    pub(super) encoder_sha256: String,
}

impl Features {
    /// Reads and encodes the sweeps that the head is trained on, and those that it is validated on.
    pub(super) fn compute(
        config: &SceneTrainConfig,
        training: &Arc<SweepList>,
        validation: Option<&Arc<SweepList>>,
        observe: &mut Observe<'_>,
    ) -> Result<Self, Error> {
        let run = &config.run;
        let (encoder, encoder_sha256) = CellEncoder::load(&config.encoder, run.device)?;
        let training = FeatureCache::build(training, &encoder, config.augmentation, run, observe)?;
        let unchanged = SweepAugmentation::NONE;
        let validation = validation
            .map(|list| FeatureCache::build(list, &encoder, unchanged, run, observe))
            .transpose()?;
        Ok(Self {
            training,
            validation,
            format: encoder.format().clone(),
            encoder_sha256,
        })
    }
}
