//! Cached features of a frozen encoder, the examples of a training of last layers alone.

use std::sync::Arc;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{Kind, Tensor};

use super::loss::{Truth, coordinate_loss, pose_loss};
use super::{EndToEndReport, Examples};
use crate::training::turned_sweep::CELLS;
use crate::training::{FeatureCache, LocalizerTrainError, SweepAugmentation, SweepList};
use localization::competitors::{EndToEnd, EndToEndKind};
use localization::pgc::SceneEncoder;
use perception::train::RunConfig;

/// Number of cells that statistics are computed from.
const SAMPLE: usize = 20_000;

/// Rows of a cache, drawn at random.
pub(super) struct Features {
    cache: FeatureCache,
    truth: Truth,
    run: RunConfig,
    step: u64,
}

impl Features {
    /// Encodes all sweeps once.
    pub(super) fn compute(
        list: &Arc<SweepList>,
        encoder: &SceneEncoder,
        run: &RunConfig,
        observe: &mut dyn FnMut(&EndToEndReport),
    ) -> Result<Self, LocalizerTrainError> {
        let augmentation = SweepAugmentation { copies: 1, turn_rad: 0.0, keep: 1.0 };
        let mut progress = |done, total| observe(&EndToEndReport::Encoding(done, total));
        let cache = FeatureCache::build(list, encoder, augmentation, run, &mut progress)?;
        let truth = Truth::new(cache.world_from_sensor.iter(), cache.origin_m, run.device)?;
        Ok(Self { cache, truth, run: run.clone(), step: 0 })
    }

    /// Random rows of `0..count`, the same for the same step.
    fn draw(&self, count: usize, wanted: usize) -> Result<Tensor, tch::TchError> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.run.seed);
        rng.set_stream(self.step);
        let rows: Vec<i64> = (0..wanted).map(|_| rng.random_range(0..count) as i64).collect();
        Tensor::f_from_slice(&rows)?.f_to_device(self.run.device)
    }
}

impl Examples for Features {
    fn origin_m(&self) -> [f64; 3] {
        self.cache.origin_m
    }

    fn features(&self, regresses: EndToEndKind) -> Result<Option<Tensor>, LocalizerTrainError> {
        Ok(Some(match regresses {
            EndToEndKind::Pose => self.cache.sweeps.shallow_clone(),
            EndToEndKind::SgLoc => {
                self.cache.cells.f_index_select(0, &self.draw(self.cache.cell_count() as usize, SAMPLE)?)?
            }
        }))
    }

    fn begin(&mut self, step: u64) {
        self.step = step;
    }

    fn next_loss(&mut self, network: &EndToEnd) -> Result<(Tensor, f64), LocalizerTrainError> {
        let (sweeps, cells) = (self.cache.sweep_count(), self.cache.cell_count() as usize);
        let loss = match network.config().regresses {
            EndToEndKind::Pose => {
                let rows = self.draw(sweeps, self.run.batch)?;
                pose_loss(network, &self.cache.sweeps.f_index_select(0, &rows)?, &self.truth.select(&rows)?)
            }
            EndToEndKind::SgLoc => {
                let rows = self.draw(cells, self.run.batch * CELLS)?;
                let features = self.cache.cells.f_index_select(0, &rows)?.f_to_kind(Kind::Float)?;
                let sensor_m = self.cache.sensor_m.f_index_select(0, &rows)?;
                coordinate_loss(network, &features, &sensor_m, &self.cache.targets_m.f_index_select(0, &rows)?)
            }
        };
        self.step += 1;
        Ok(loss?)
    }
}
