//! Threads that prepare batches ahead of the training.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;

use agent::pillar_batch::{PillarBatch, PillarLattice};
use agent::pillars::Pillars;
use protocol::Pose;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::{Sample, SampleBuilder, SampleError, TickRef};
use crate::targets::Labels;

/// Batches that one thread may be ahead.
const AHEAD: usize = 3;

/// Samples of one training step.
#[derive(Debug)]
pub struct Batch {
    /// Pillars of all views of all samples.
    pub pillars: PillarBatch,
    /// Poses of the views of each sample, ego first.
    pub ego_from_cav: Vec<Vec<Pose>>,
    /// Targets of each sample.
    pub labels: Vec<Labels>,
}

impl Batch {
    /// Puts samples together.
    #[must_use]
    pub fn collate(samples: Vec<Sample>, lattice: &PillarLattice) -> Self {
        let views: Vec<&Pillars> = samples.iter().flat_map(|sample| &sample.pillars).collect();
        let pillars = PillarBatch::new(&views, lattice);
        let (ego_from_cav, labels) = samples.into_iter().map(|sample| (sample.ego_from_cav, sample.labels)).unzip();
        Self { pillars, ego_from_cav, labels }
    }
}

/// Which samples in which order.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoaderConfig {
    /// Seed of order and augmentation.
    pub seed: u64,
    /// Samples of a batch.
    pub batch: usize,
    /// The batch to begin with: that of a resumed training.
    pub first_batch: u64,
    /// Threads that prepare batches.
    pub threads: usize,
}

/// An endless sequence of batches, the same for any number of threads.
///
/// Thread k of T prepares batches k, k + T, k + 2T and so on into a queue of its own, and the queues are read in turn:
/// that keeps the order without a word between threads. They end when the loader is dropped.
#[derive(Debug)]
pub struct Loader {
    queues: Vec<Receiver<Result<Batch, SampleError>>>,
    next: usize,
}

impl Loader {
    /// Starts the threads.
    #[must_use]
    pub fn start(builder: &SampleBuilder, lattice: PillarLattice, config: &LoaderConfig) -> Self {
        let threads = config.threads.max(1);
        let queues = (0..threads).map(|thread| {
            let (sender, receiver) = sync_channel(AHEAD);
            let worker = Worker {
                order: Order::new(builder.scenes().ticks().to_vec(), config.seed),
                builder: builder.clone(),
                lattice,
                batch: config.batch.max(1),
            };
            let first = config.first_batch + thread as u64;
            thread::spawn(move || worker.run(first, threads, &sender));
            receiver
        });
        Self { queues: queues.collect(), next: 0 }
    }

    /// The next batch.
    ///
    /// # Errors
    /// [`SampleError`] when a sample of it could not be made.
    pub fn next_batch(&mut self) -> Result<Batch, SampleError> {
        let queue = self.next;
        self.next = (queue + 1) % self.queues.len();
        self.queues[queue].recv().unwrap_or(Err(SampleError::LoaderGone(queue)))
    }
}

struct Worker {
    order: Order,
    builder: SampleBuilder,
    lattice: PillarLattice,
    batch: usize,
}

impl Worker {
    fn run(mut self, first: u64, step: usize, queue: &SyncSender<Result<Batch, SampleError>>) {
        for number in (first..).step_by(step) {
            let batch = self.prepare(number);
            let failed = batch.is_err();
            // The receiver is gone when the training has ended.
            if queue.send(batch).is_err() || failed {
                return;
            }
        }
    }

    fn prepare(&mut self, number: u64) -> Result<Batch, SampleError> {
        let first = number * self.batch as u64;
        let samples: Result<Vec<_>, _> = (first..first + self.batch as u64)
            .map(|index| {
                let mut rng = ChaCha8Rng::seed_from_u64(self.order.seed);
                // Streams are independent sequences of one seed.
                rng.set_stream(index + 1);
                self.builder.build(self.order.tick(index), &mut rng)
            })
            .collect();
        Ok(Batch::collate(samples?, &self.lattice))
    }
}

/// Every tick once per epoch, in an order that only the seed and the epoch decide.
struct Order {
    ticks: Vec<TickRef>,
    shuffled: Vec<TickRef>,
    epoch: Option<u64>,
    seed: u64,
}

impl Order {
    fn new(ticks: Vec<TickRef>, seed: u64) -> Self {
        Self { ticks, shuffled: Vec::new(), epoch: None, seed }
    }

    fn tick(&mut self, index: u64) -> TickRef {
        let count = self.ticks.len() as u64;
        let epoch = index / count;
        if self.epoch != Some(epoch) {
            self.shuffled.clone_from(&self.ticks);
            let mut rng = ChaCha8Rng::seed_from_u64(self.seed.wrapping_add(epoch.wrapping_mul(0x9E37_79B9_7F4A_7C15)));
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
        let mut order = Order::new(ticks.clone(), 7);
        let first: Vec<TickRef> = (0..50).map(|index| order.tick(index)).collect();
        let second: Vec<TickRef> = (50..100).map(|index| order.tick(index)).collect();
        assert_ne!(first, second);
        for epoch in [&first, &second] {
            let mut sorted = epoch.clone();
            sorted.sort_by_key(|tick| tick.tick);
            assert_eq!(sorted, ticks);
        }
        // A resumed training that begins in the middle meets the same ticks.
        let mut resumed = Order::new(ticks, 7);
        assert_eq!(resumed.tick(73), second[23]);
    }
}
