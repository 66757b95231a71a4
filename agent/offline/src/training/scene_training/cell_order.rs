//! Order and weights of the cells of a training.

use perception::tensor_values::tensor;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use tch::{Kind, TchError, Tensor};

use crate::training::{FeatureCache, Redundancy};

/// An endless sequence of batches of cells, in a new order with every pass. A training that is resumed begins a new
/// pass.
pub(super) struct CellOrder {
    redundancy: Option<Redundancy>,
    sweep_of_cell: Tensor,
    /// `[S]`: weight of each sweep; 0: not used.
    sweep_weights: Tensor,
    batch: usize,
    /// Cells that are used, in the order of this pass.
    order: Vec<i64>,
    place: usize,
    pub(super) passes: f64,
    passes_before: f64,
    /// Sweeps and errors of this pass's cells, while they are recorded.
    watched: Vec<(usize, f32)>,
    rng: ChaCha8Rng,
}

impl CellOrder {
    /// The order after `steps` steps of `batch` cells; sweeps may be left out by `redundancy`.
    pub(super) fn new(
        cache: &FeatureCache,
        redundancy: Option<Redundancy>,
        batch: usize,
        seed: u64,
        steps: u64,
    ) -> Result<Self, TchError> {
        let options = (Kind::Float, cache.sweep_of_cell.device());
        Ok(Self {
            redundancy,
            sweep_of_cell: cache.sweep_of_cell.shallow_clone(),
            sweep_weights: Tensor::f_ones([cache.sweep_count() as i64], options)?,
            batch,
            order: Vec::new(),
            place: 0,
            passes: steps as f64 * batch as f64 / cache.cell_count() as f64,
            passes_before: 0.0,
            watched: Vec::new(),
            // A resumed training gets an order of its own, not that of the first pass again.
            rng: ChaCha8Rng::seed_from_u64(seed ^ steps),
        })
    }

    /// Weights `[N]` of cells by their sweeps `[N]`.
    pub(super) fn weights(&self, sweeps: &Tensor) -> Result<Tensor, TchError> {
        self.sweep_weights.f_index_select(0, sweeps)
    }

    /// Rows `[batch]` of the next step.
    pub(super) fn next_batch(&mut self, share_done: f64) -> Result<Tensor, TchError> {
        let redundancy = self.redundancy.as_ref();
        let wants_all = redundancy.is_some_and(|of| of.is_time_for_all(share_done));
        // What is left of a pass and fills no batch is not shown: the next order mixes it in.
        if wants_all || self.place + self.batch > self.order.len() {
            self.next_pass(share_done)?;
        }
        let end = self.place + self.batch;
        let device = self.sweep_of_cell.device();
        let rows = tensor(&self.order[self.place..end], &[-1], device)?;
        self.place = end;
        // One more at the end of a pass, whatever part of a batch is left over then.
        let (shown, batches) = (end / self.batch, self.order.len() / self.batch);
        self.passes = self.passes_before + shown as f64 / batches as f64;
        Ok(rows)
    }

    /// Records the errors `[N]` of the cells of a step, each of a sweep of `sweeps` `[N]`.
    pub(super) fn watch(
        &mut self,
        share_done: f64,
        sweeps: &Tensor,
        errors: &Tensor,
    ) -> Result<(), TchError> {
        let redundancy = self.redundancy.as_ref();
        if redundancy.is_some_and(|of| of.watches(share_done)) {
            let errors: Vec<f32> = Vec::try_from(&errors.f_detach()?)?;
            let sweeps: Vec<i64> = Vec::try_from(sweeps)?;
            let sweeps = sweeps.iter().map(|&sweep| sweep as usize);
            self.watched.extend(sweeps.zip(errors));
        }
        Ok(())
    }

    fn next_pass(&mut self, share_done: f64) -> Result<(), TchError> {
        let device = self.sweep_of_cell.device();
        let mut changed = self.order.is_empty();
        if let Some(redundancy) = &mut self.redundancy {
            if !self.watched.is_empty() {
                redundancy.record(&self.watched);
                self.watched.clear();
            }
            changed |= redundancy.advance(share_done);
            if changed {
                self.sweep_weights = tensor(&redundancy.weights, &[-1], device)?;
            }
        }
        if changed {
            let used = self.weights(&self.sweep_of_cell)?.f_gt(0.0)?;
            self.order = Vec::try_from(&used.f_nonzero()?.f_squeeze_dim(1)?)?;
        }
        if self.order.len() < self.batch {
            let cells = self.order.clone();
            self.order = cells.iter().cycle().take(self.batch).copied().collect();
        }
        self.order.shuffle(&mut self.rng);
        self.place = 0;
        self.passes_before = self.passes;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::training::LeaveOut;

    fn zeros(rows: i64, columns: i64) -> Tensor {
        Tensor::zeros([rows, columns], (Kind::Float, Device::Cpu))
    }

    /// Ten sweeps of ten cells each.
    fn cache() -> FeatureCache {
        FeatureCache {
            cells: zeros(100, 1),
            sweep_of_cell: Tensor::arange(100, (Kind::Int64, Device::Cpu)).floor_divide_scalar(10),
            targets_m: zeros(100, 3),
            sensor_m: zeros(100, 3),
            sweeps: zeros(10, 1),
            points: vec![1; 10],
            world_from_sensor: vec![nalgebra::Isometry3::identity(); 10],
            origin_m: [0.0; 3],
        }
    }

    #[test]
    fn sweeps_are_left_out_from_the_end_of_a_window_and_used_again_later() {
        let redundancy = Redundancy::new(LeaveOut::EvenLoss, 0, vec![0; 10]);
        let mut order = CellOrder::new(&cache(), Some(redundancy), 30, 1, 0).unwrap();
        let (mut steps, mut cells_of_pass) = (0, vec![0; 21]);
        while order.passes < 20.0 {
            let share_done = order.passes / 20.0;
            let rows = order.next_batch(share_done).unwrap();
            let sweeps = order.sweep_of_cell.index_select(0, &rows);
            let errors: Vec<f32> = Vec::<i64>::try_from(&sweeps)
                .unwrap()
                .iter()
                .map(|&sweep| (sweep * steps) as f32)
                .collect();
            order
                .watch(share_done, &sweeps, &Tensor::from_slice(&errors))
                .unwrap();
            steps += 1;
            cells_of_pass[order.passes.ceil() as usize] = order.order.len();
        }
        // Windows end after passes 5 and 10; from 84 % on, after pass 17, all are used again.
        assert_eq!(
            [5, 6, 10, 11, 17, 18].map(|pass| cells_of_pass[pass]),
            [100, 80, 80, 60, 60, 100]
        );
        assert_eq!(
            steps,
            8 * 3 + 12 * 2,
            "three batches of a full pass, two of a reduced one"
        );
    }

    #[test]
    fn all_are_used_again_in_the_middle_of_a_long_pass() {
        // The first two of four passes are recorded; the last is three eighths over when all are used again.
        let mut redundancy = Redundancy::new(LeaveOut::EvenLoss, 0, vec![0; 10]);
        redundancy.windows = [[0.0, 0.5], [0.9, 0.95]];
        let mut order = CellOrder::new(&cache(), Some(redundancy), 10, 1, 0).unwrap();
        let mut cells = Vec::new();
        while order.passes < 4.0 {
            let share_done = order.passes / 4.0;
            let rows = order.next_batch(share_done).unwrap();
            let sweeps = order.sweep_of_cell.index_select(0, &rows);
            order
                .watch(share_done, &sweeps, &sweeps.to_kind(Kind::Float))
                .unwrap();
            cells.push(order.order.len());
        }
        assert_eq!((cells[19], cells[20], cells[30]), (100, 80, 80));
        assert_eq!(cells[31..], [100; 7]);
        assert!(order.passes < 4.1, "{}", order.passes);
    }
}
