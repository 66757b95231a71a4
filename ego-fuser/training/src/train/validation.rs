//! Validation: accuracy of a model during its training, on frames outside the training data.

use std::sync::Arc;

use dataset::average_precision::{Ordering, Scorer};
use fusion::model::CooperativeModel;
use protocol::corners_within;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use support::sampling::evenly_spread;
use tch::no_grad;

use crate::Error;
use crate::samples::{Augmentation, Batch, SampleBuilder, SampleConfig, SceneSet, TickRef};

/// AP over the frames of a validation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Accuracy {
    /// Frames.
    pub frames: usize,
    /// AP at 0.3, 0.5 and 0.7, sorted over all frames; unknown without objects.
    pub ap_global: [Option<f64>; 3],
    /// The same in the order of frames.
    pub ap_frame_order: [Option<f64>; 3],
}

/// Measures AP on a fixed choice of frames, each from a fixed vehicle, with no agent missing or late and no added pose
/// error.
#[derive(Debug)]
pub(crate) struct Validator {
    pub(super) builder: SampleBuilder,
    ticks: Vec<TickRef>,
}

impl Validator {
    /// Chooses `frames` ticks of `scenes`, evenly spread.
    pub(crate) fn new(
        scenes: SceneSet,
        samples: &SampleConfig,
        model: &CooperativeModel,
        frames: usize,
    ) -> Self {
        let scenes = Arc::new(scenes);
        let ticks = evenly_spread(&scenes.ticks, frames.max(1));
        let mut samples = samples.clone();
        samples.augmentation = Augmentation::OFF;
        samples.drop_neighbour = 0.0;
        (samples.poses.noise, samples.poses.lost_share) = (None, 0.0);
        (samples.moments.max_delay_nanos, samples.moments.gap) = (0, 1);
        samples.merged_truth = true;
        let builder = SampleBuilder::new(scenes, samples, model);
        Self { builder, ticks }
    }

    /// AP of `model` now; `with_boxes`: neighbours send boxes in place of maps.
    ///
    /// # Errors
    /// [`Error`] when a frame cannot be read or does not fit the model.
    pub(crate) fn measure(
        &mut self,
        model: &CooperativeModel,
        with_boxes: bool,
    ) -> Result<Accuracy, Error> {
        let mut scorer = Scorer::default();
        let limits = model.limits();
        for (number, &tick) in self.ticks.iter().enumerate() {
            // Seeded by the number of the frame: its ego is the same vehicle in every validation.
            let mut rng = ChaCha8Rng::seed_from_u64(number as u64);
            let sample = self.builder.build(tick, &mut rng)?;
            // The ground truth has the same limits as the detections.
            let mut truth = sample.truth.clone();
            let (objects, area_m) = (&mut truth.objects, truth.area_m);
            objects.retain(|object| corners_within(&object.box3d.corners(), area_m));
            let batch = Batch::collate(vec![sample], &model.network.pillar_grid)?;
            let head = no_grad(|| match with_boxes {
                true => {
                    let (samples, _) = batch.with_boxes(model, None::<&mut ChaCha8Rng>)?;
                    Ok::<_, Error>(model.detect_with_boxes(&samples)?)
                }
                false => Ok(batch.output(model, false)?.head),
            })?;
            for detections in model.detections(&head, &limits)? {
                scorer.add(&detections, &truth);
            }
        }
        let [global, frame] =
            [Ordering::Global, Ordering::Frame].map(|it| scorer.average_precisions(it));
        Ok(Accuracy {
            frames: self.ticks.len(),
            ap_global: std::array::from_fn(|index| global[index]),
            ap_frame_order: std::array::from_fn(|index| frame[index]),
        })
    }
}
