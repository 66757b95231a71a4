//! Which cells come in which order, and how much they weigh.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use tch::{Kind, TchError, Tensor};

use crate::localizer::training::{FeatureCache, Redundancy};

/// An endless sequence of batches of cells, in a new order with every pass.
pub(super) struct CellOrder {
    redundancy: Option<Redundancy>,
    sweep_of_cell: Tensor,
    /// `[S]`: weight of each sweep; 0: not used.
    sweep_weights: Tensor,
    batch: usize,
    /// Cells that are used, in the order of this pass.
    order: Vec<i64>,
    place: usize,
    passes: f64,
    /// Sweeps and errors of this pass's cells, while they are of interest.
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
            watched: Vec::new(),
            rng: ChaCha8Rng::seed_from_u64(seed ^ steps),
        })
    }

    /// Passes done; one shows every cell that is used.
    pub(super) fn passes(&self) -> f64 {
        self.passes
    }

    /// Weights `[N]` of cells by the sweeps `[N]` that they are of.
    pub(super) fn weights(&self, sweeps: &Tensor) -> Result<Tensor, TchError> {
        self.sweep_weights.f_index_select(0, sweeps)
    }

    /// Rows `[batch]` of the next step.
    pub(super) fn next_batch(&mut self, share_done: f64) -> Result<Tensor, TchError> {
        if self.place + self.batch > self.order.len() {
            self.next_pass(share_done)?;
        }
        let end = self.place + self.batch;
        let rows = Tensor::f_from_slice(&self.order[self.place..end])?.f_to_device(self.sweep_of_cell.device())?;
        self.place = end;
        self.passes += self.batch as f64 / self.order.len() as f64;
        Ok(rows)
    }

    /// Takes the errors `[N]` of the cells of a step, each of a sweep of `sweeps` `[N]`.
    pub(super) fn watch(&mut self, share_done: f64, sweeps: &Tensor, errors: &Tensor) -> Result<(), TchError> {
        if self.redundancy.as_ref().is_some_and(|redundancy| redundancy.watches(share_done)) {
            let errors: Vec<f32> = Vec::try_from(&errors.f_detach()?)?;
            let sweeps: Vec<i64> = Vec::try_from(sweeps)?;
            self.watched.extend(sweeps.iter().zip(errors).map(|(&sweep, error)| (sweep as usize, error)));
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
                self.sweep_weights = Tensor::f_from_slice(redundancy.weights())?.f_to_device(device)?;
            }
        }
        if changed {
            let used = self.sweep_weights.f_index_select(0, &self.sweep_of_cell)?.f_gt(0.0)?;
            self.order = Vec::try_from(&used.f_nonzero()?.f_squeeze_dim(1)?)?;
        }
        if self.order.len() < self.batch {
            let cells = self.order.clone();
            self.order = cells.iter().cycle().take(self.batch).copied().collect();
        }
        self.order.shuffle(&mut self.rng);
        self.place = 0;
        Ok(())
    }
}
