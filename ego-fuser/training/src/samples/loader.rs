//! Loader: samples in batches, in the order of a training.

use dataset::ground_truth::GroundTruth;
use perception::pillars::batch::{PillarBatch, PillarGrid};
use perception::train::{Prefetch, RunConfig};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use tch::Tensor;

use super::builder::{Sample, SampleBuilder, Views};
use super::poses::PoseOffset;
use super::scenes::TickRef;
use crate::Error;
use fusion::MapMetadata;
use fusion::model::{CooperativeModel, CooperativeOutput, ModelError};
use fusion::targets::Labels;

/// Samples of one training step.
#[derive(Debug)]
pub struct Batch {
    /// All views of all samples.
    pub views: Views<PillarBatch>,
    /// Metadata of the views of each sample, ego first.
    pub facts: Vec<Vec<MapMetadata>>,
    /// Errors that were added to the poses of the views of each sample.
    pub offsets: Vec<Vec<PoseOffset>>,
    /// Targets of each sample.
    pub labels: Vec<Labels>,
    /// Objects of each sample.
    pub(crate) truth: Vec<GroundTruth>,
}

impl Batch {
    /// Collates samples, all of pillars or all of maps.
    ///
    /// # Errors
    /// [`Error::Torch`] when maps are of different shapes.
    pub(crate) fn collate(samples: Vec<Sample>, pillar_grid: &PillarGrid) -> Result<Self, Error> {
        let (mut pillars, mut maps) = (Vec::new(), Vec::new());
        for sample in &samples {
            match &sample.views {
                Views::Pillars(of_sample) => pillars.extend(of_sample),
                Views::Maps(of_sample) => maps.push(of_sample),
            }
        }
        let views = match maps[..] {
            [] => Views::Pillars(PillarBatch::new(&pillars, pillar_grid)),
            _ => Views::Maps(Tensor::f_cat(&maps, 0)?),
        };
        let samples = samples.into_iter();
        let parts = samples.map(|of| (of.facts, of.offsets, of.labels, of.truth));
        let (facts, offsets, labels, truth) = parts.collect();
        Ok(Self {
            views,
            facts,
            offsets,
            labels,
            truth,
        })
    }

    /// The output of a model for all samples.
    ///
    /// # Errors
    /// [`ModelError`] when the numbers of facts and views differ.
    pub fn output(
        &self,
        model: &CooperativeModel,
        train: bool,
    ) -> Result<CooperativeOutput, ModelError> {
        match &self.views {
            Views::Pillars(pillars) => {
                model.forward(&pillars.to_device(model.device()), &self.facts, train)
            }
            Views::Maps(maps) => {
                let maps = maps.f_to_device(model.device())?;
                let maps = model.network.through_compressor(&maps, train);
                model.fuse_and_detect(&maps, &self.facts, train)
            }
        }
    }
}

/// Batches from number `first` on, the same for any number of threads.
pub fn batches(
    builder: &SampleBuilder,
    pillar_grid: PillarGrid,
    run: &RunConfig,
    first: u64,
) -> Prefetch<Result<Batch, Error>> {
    let mut order = TickOrder::new(builder.scenes.ticks.clone(), run.seed);
    let mut builder = builder.clone();
    let size = run.batch as u64;
    Prefetch::start(run.loader_threads, first, move |number| {
        let samples = (number * size..(number + 1) * size).map(|index| {
            let mut rng = ChaCha8Rng::seed_from_u64(order.seed);
            // Streams are independent sequences of one seed.
            // Stream 0 is that of the order of the first epoch.
            rng.set_stream(index + 1);
            builder.build(order.tick(index), &mut rng)
        });
        let samples: Result<Vec<Sample>, _> = samples.collect();
        Batch::collate(samples?, &pillar_grid)
    })
}

/// Every tick once per epoch, in an order that depends on the seed and the epoch only.
#[derive(Clone, Default)]
struct TickOrder {
    ticks: Vec<TickRef>,
    shuffled: Vec<TickRef>,
    epoch: Option<u64>,
    seed: u64,
}

impl TickOrder {
    fn new(ticks: Vec<TickRef>, seed: u64) -> Self {
        Self {
            ticks,
            seed,
            ..Self::default()
        }
    }

    fn tick(&mut self, index: u64) -> TickRef {
        let count = self.ticks.len() as u64;
        let epoch = index / count;
        if self.epoch != Some(epoch) {
            self.shuffled.clone_from(&self.ticks);
            // The factor is 2^64 over the golden ratio: seeds of successive epochs lie far apart.
            let offset = epoch.wrapping_mul(0x9E37_79B9_7F4A_7C15);
            let mut rng = ChaCha8Rng::seed_from_u64(self.seed.wrapping_add(offset));
            self.shuffled.shuffle(&mut rng);
            self.epoch = Some(epoch);
        }
        self.shuffled[(index % count) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_has_every_tick_once_and_the_next_another_order() {
        let ticks: Vec<TickRef> = (0..50).map(|tick| TickRef { scenario: 0, tick }).collect();
        let mut order = TickOrder::new(ticks.clone(), 7);
        let first: Vec<TickRef> = (0..50).map(|index| order.tick(index)).collect();
        let second: Vec<TickRef> = (50..100).map(|index| order.tick(index)).collect();
        assert_ne!(first, second);
        for epoch in [&first, &second] {
            let mut sorted = epoch.clone();
            sorted.sort_by_key(|tick| tick.tick);
            assert_eq!(sorted, ticks);
        }
        // A resumed training that begins mid-epoch uses the same ticks.
        let mut resumed = TickOrder::new(ticks, 7);
        assert_eq!(resumed.tick(73), second[23]);
    }
}
