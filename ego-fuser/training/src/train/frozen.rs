//! Training behind an encoder that stays as it is.

use std::sync::Arc;

use perception::weights::Weights;

use super::config::TrainConfig;
use super::error::TrainError;
use super::observer::Observer;
use crate::feature_store::{FeatureStore, FeatureStoreError, KeptMaps, MapSource, is_encoder};
use crate::samples::{Augmentation, SampleConfig, SampleError, SceneSet};
use fusion::model::{CooperativeModel, ModelError};

/// An encoder that stays as it is, and where its maps are kept.
pub(super) struct FrozenEncoder<'a> {
    kept: &'a KeptMaps,
    weights: Arc<Weights>,
}

impl<'a> FrozenEncoder<'a> {
    /// Takes the encoder of `model` out of the training, where that is asked for. Comes before the optimizer is made.
    pub(super) fn of(config: &'a TrainConfig, model: &CooperativeModel) -> Result<Option<Self>, TrainError> {
        let Some(kept) = &config.frozen_encoder else { return Ok(None) };
        let init = config.init.as_ref().ok_or(TrainError::NothingToFreeze)?;
        for (name, variable) in model.variables.variables() {
            if is_encoder(&name) {
                let _ = variable.f_set_requires_grad(false)?;
            }
        }
        let weights = Arc::new(Weights::load(init).map_err(ModelError::from)?);
        Ok(Some(Self { kept, weights }))
    }

    /// The maps of all sweeps of some scenes, encoded now where they have not been before.
    pub(super) fn maps(&self, scenes: &SceneSet, observer: &mut dyn Observer) -> Result<MapSource, TrainError> {
        let on_sweep = &mut |done, all| observer.encoded(done, all);
        let open = FeatureStore::open(self.kept, &self.weights, scenes.scenarios(), on_sweep);
        let store = open.map_err(|error: FeatureStoreError| SampleError::from(error))?;
        Ok(MapSource::new(Arc::new(store), Arc::clone(&self.weights)))
    }
}

/// How samples are made for a model: as many time steps as its fusion asks for, and unturned where maps are kept.
pub(super) fn sample_config(config: &TrainConfig, model: &CooperativeModel) -> SampleConfig {
    let mut samples = config.samples.clone();
    samples.moments.frames = model.fusion().requirements().history.frames;
    if config.frozen_encoder.is_some() {
        samples.augmentation = Augmentation::OFF;
    }
    samples
}
