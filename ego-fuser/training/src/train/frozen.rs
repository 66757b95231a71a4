//! Training behind a frozen encoder.

use std::sync::Arc;

use perception::int8::InferencePrecision;
use perception::train::{Observe, TrainingEvent};
use perception::weights::Weights;

use super::config::TrainConfig;
use crate::feature_store::{FeatureStore, KeptMaps, MapSource, is_encoder};
use crate::samples::{Augmentation, SampleBuilder, SampleConfig};
use crate::{Error, Result};
use fusion::model::{CooperativeModel, ModelError};
use support::file_digests::FileDigests;

/// A frozen encoder, and the store of its maps.
pub(super) struct FrozenEncoder<'a> {
    kept: &'a KeptMaps,
    weights: Arc<Weights>,
    threads: usize,
}

impl<'a> FrozenEncoder<'a> {
    /// Excludes the encoder of `model` from the training, if that is configured. Call it before the optimizer is built.
    pub(super) fn of(config: &'a TrainConfig, model: &CooperativeModel) -> Result<Option<Self>> {
        let Some(kept) = &config.frozen_encoder else {
            return Ok(None);
        };
        let init = config.init.as_ref().ok_or(Error::NothingToFreeze)?;
        for (name, variable) in model.variables.variables() {
            if is_encoder(&name) {
                let _ = variable.f_set_requires_grad(false)?;
            }
        }
        // In floating point, also where the file has scales for 8-bit inference.
        let weights = Weights::load(init).map_err(ModelError::from)?;
        let weights = weights.with_precision(InferencePrecision::Float);
        Ok(Some(Self {
            kept,
            weights: Arc::new(weights),
            threads: config.run.loader_threads,
        }))
    }

    /// Gives a builder the maps of all sweeps of its scenes; missing ones are encoded now.
    pub(super) fn give_maps(
        &self,
        builder: &mut SampleBuilder,
        observe: &mut Observe<'_>,
    ) -> Result<()> {
        let store = FeatureStore::open(
            self.kept,
            &self.weights,
            &builder.scenes.scenarios,
            &FileDigests::default(),
            self.threads,
            &mut |done, all| observe(&TrainingEvent::Encoding(done, all)),
        )?;
        let weights = Arc::clone(&self.weights);
        builder.maps = Some(MapSource::new(Arc::new(store), weights));
        Ok(())
    }
}

/// Sample settings for a model: as many time steps as its fusion needs, and no rotation where maps are stored.
pub(super) fn sample_config(config: &TrainConfig, model: &CooperativeModel) -> SampleConfig {
    let mut samples = config.samples.clone();
    samples.moments.frames = model.fusion.requirements.history.frames;
    if config.frozen_encoder.is_some() {
        samples.augmentation = Augmentation::OFF;
    }
    samples
}
