//! PASTAT, the Pose-Aware Spatio-Temporal Alignment Transformer.
//!
//! Aligned maps become tokens, to which the confidence of their poses (CE, Eq. 7) and their true age (TE, Eq. 10-12) are
//! added. FSA compares each map with the ego's: it moves the map and its tokens to where they fit, and tells the tokens how
//! well they do. Pre-norm blocks (Eq. 8, 9) attend over agents and time at each cell and across cells within windows of
//! several sizes. What they find comes back onto the cells in two ways: as a weight of each neighbour's newest map, of
//! which the maximum is taken, and as a change of that. Where vehicles may be, earlier maps and the ego's own are blended
//! into that maximum to the cell (recall), if the configuration has it. Untrained, all are neutral: the fusion begins as
//! the element-wise maximum.
//!
//! Entries are real maps, so nothing is padded over agents or time.

mod alignment;
mod area;
mod attention;
mod block;
mod chosen;
mod confidence;
mod config;
mod correlation;
mod entries;
mod gather;
mod moved;
mod pairs;
mod precision;
mod recall;
mod refiner;
mod search;
mod temporal;
mod tokens;

use perception::model_config::ConfigError;
use protocol::BevGrid;
use tch::{Device, TchError, Tensor, nn};

pub use config::{FsaConfig, Part, PastatConfig, RecallConfig, Rows, SearchConfig, Wavelengths};

use self::alignment::{SpatialAlignment, TRUST};
use self::area::{Area, lattice, own_lattice, resample};
use self::block::Block;
use self::entries::{Maps, Shown, Told};
use self::gather::Others;
use self::moved::MovedMaps;
use self::pairs::Found;
use self::recall::{Earlier, Recall};
use self::refiner::Refiner;
use self::tokens::{Decoder, Tokeniser, TrustGate};
use super::{AlignedViews, Fusion};
use crate::f64_tensor;

/// PASTAT between encoder and head.
#[derive(Debug)]
pub struct Pastat {
    config: PastatConfig,
    tokeniser: Tokeniser,
    alignment: Option<SpatialAlignment>,
    blocks: Vec<Block>,
    gate: TrustGate,
    decoder: Decoder,
    recall: Option<Recall>,
    refiner: Option<Refiner>,
}

/// Maps on padded lattices, and their tokens.
struct Entries {
    /// `[C, H, W]`: the ego's newest map.
    own: Tensor,
    /// The newest maps of all others.
    others: MovedMaps,
    /// `[N, D, h, w]`: tokens of all entries.
    tokens: Tensor,
    /// `[N, h, w]`.
    valid: Tensor,
    /// `[N - 1, 3]`: how FSA has moved all but the ego's newest.
    deltas: Option<Tensor>,
}

/// What lies somewhere on the ego's lattice, where poses put it or where FSA does.
struct Placed {
    /// The newest maps of all but the ego.
    others: MovedMaps,
    /// `[N, D, h, w]`: what tokens of all entries have seen.
    seen: Tensor,
    /// `[N, h, w]`: where they have.
    valid: Tensor,
}

impl Placed {
    /// Everything but the ego's newest, the first entry, moved to where FSA says that it fits; newest maps are read where
    /// they were made.
    fn moved(self, deltas: &Tensor, shown: &Shown, area: &Area, grid: &BevGrid) -> Result<Self, TchError> {
        let Self { others, seen, valid } = self;
        let (entries, _, rows, columns) = seen.size4()?;
        let ego_from_cav = &shown.told.ego_from_cav[1..];
        let after_first = |tensor: &Tensor| tensor.f_narrow(0, 1, entries - 1);
        let with_first = |first: &Tensor, after: Tensor| Tensor::f_cat(&[first.f_narrow(0, 0, 1)?, after], 0);
        let places = lattice(deltas, ego_from_cav, area, [rows, columns])?;
        let (after, after_valid) = resample(&after_first(&seen)?, &after_first(&valid)?.f_unsqueeze(1)?, &places)?;
        let (seen, valid) = (with_first(&seen, after)?, with_first(&valid, after_valid.f_squeeze_dim(1)?)?);
        let count = others.count()?;
        if count == 0 {
            return Ok(Self { others, seen, valid });
        }
        let own = Area::new(grid, [i64::from(grid.height), i64::from(grid.width)], area.radius());
        let (deltas, ego_from_cav) = (deltas.f_narrow(0, 0, count)?, &ego_from_cav[..count as usize]);
        let places = own_lattice(&deltas, ego_from_cav, [area, &own])?;
        Ok(Self { others: MovedMaps::at(shown.own_frame.only(1, count + 1)?, places)?, seen, valid })
    }
}

impl Pastat {
    /// Builds the module; its variables lie under `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when it cannot be built.
    pub fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let alignment = |fsa| SpatialAlignment::new(&(path / "fsa"), [config.channels, config.dim], fsa);
        Ok(Self {
            tokeniser: Tokeniser::new(path, config),
            alignment: config.fsa.as_ref().map(alignment),
            blocks: (0..config.depth).map(|index| Block::new(&(path / "blocks" / index), config)).collect(),
            gate: TrustGate::new(&(path / "gate"), config),
            decoder: Decoder::new(&(path / "decoder"), config),
            recall: config.recall.as_ref().map(|recall| {
                let PastatConfig { channels, dim, patch, frames, .. } = *config;
                Recall::new(&(path / "recall"), [channels, dim, patch, frames as i64 - 1], recall)
            }),
            refiner: config.refine.map(|hidden| Refiner::new(&(path / "refine"), config.channels, hidden)),
            config: config.clone(),
        })
    }

    /// Tokens of all entries, moved by FSA; of each agent's newest map the map too.
    fn align(&self, shown: &Shown, grid: &BevGrid, train: bool) -> Result<Entries, TchError> {
        let (padding, larger) = (self.config.padding_cells(), self.config.earlier_cells);
        let newest = shown.newest.padded(padding)?;
        let earlier = shown.earlier.as_ref().map(|earlier| earlier.padded(padding / larger)).transpose()?;
        let (mut seen, mut valid) = (self.tokeniser.seen(&newest.features, 1)?, self.tokeniser.valid(&newest.mask, 1)?);
        if let Some(earlier) = &earlier {
            seen = Tensor::f_cat(&[seen, self.tokeniser.seen(&earlier.features, larger)?], 0)?;
            valid = Tensor::f_cat(&[valid, self.tokeniser.valid(&earlier.mask, larger)?], 0)?;
        }
        let (told, count) = (&shown.told, newest.count()?);
        let facts = self.tokeniser.facts(&told.shares, &told.age_secs)?;
        let (own, others) = (newest.features.f_get(0)?, MovedMaps::still(newest.only(1, count)?));
        let placed = Placed { others, seen, valid };
        let (placed, facts, deltas) = match &self.alignment {
            Some(alignment) if told.age_secs.len() > 1 => {
                let (_, height, width) = own.size3()?;
                let area = Area::new(grid, [height, width], alignment.radius());
                let Found { deltas, fit, .. } =
                    self.compare(alignment, &newest, earlier.as_ref(), told, &area, train)?;
                // The ego's newest, which fits itself, is told nothing.
                let facts = facts + fit.f_constant_pad_nd([0, 0, 1, 0])?;
                (placed.moved(&deltas, shown, &area, grid)?, facts, Some(deltas))
            }
            _ => (placed, facts, None),
        };
        let Placed { others, seen, valid } = placed;
        let tokens = seen + facts.f_unsqueeze(2)?.f_unsqueeze(3)?;
        Ok(Entries { own, others, tokens, valid, deltas })
    }

    /// `newest` `[1, C, H, W]`, steadied by the ego's own and by earlier maps where FSA says that they belong.
    fn steadied(
        &self,
        newest: Tensor,
        (views, shown): (&AlignedViews<'_>, &Shown),
        Entries { own, deltas, .. }: &Entries,
        ego: &Tensor,
    ) -> Result<Tensor, TchError> {
        let whole = views.earlier.and_then(|earlier| earlier.whole);
        let (Some(recall), Some(whole)) = (&self.recall, whole) else { return Ok(newest) };
        let Told { ego_from_cav, steps_back, .. } = &shown.told;
        let first = ego_from_cav.len() - shown.earlier_entries.len();
        let deltas = deltas.as_ref().map(|deltas| shown.told.settled(deltas, first)).transpose()?;
        let of_entry = |(index, &entry): (usize, &usize)| {
            let step = steps_back[first + index].checked_sub(1).filter(|step| step + 1 < self.config.frames)?;
            let (pose, map) = (&ego_from_cav[first + index], whole.maps.get(entry)?);
            Some((step, deltas.as_ref().map_or(*pose, |deltas| area::moved(pose, &deltas[index])), map))
        };
        let maps: Vec<_> = shown.earlier_entries.iter().enumerate().filter_map(of_entry).collect();
        if maps.is_empty() {
            return Ok(newest);
        }
        let likely = whole.classes.likely(&newest)?;
        recall.forward([&newest, own], &Earlier { maps, grid: views.grid }, ego, &likely)
    }

    /// How all entries but the ego's newest lie beside that.
    fn compare(
        &self,
        alignment: &SpatialAlignment,
        newest: &Maps,
        earlier: Option<&Maps>,
        told: &Told,
        area: &Area,
        train: bool,
    ) -> Result<Found, TchError> {
        let trust = Tensor::f_from_slice(&told.trust)?.f_view([-1, TRUST])?.f_to_device(newest.features.device())?;
        let trust = if self.config.ce { trust } else { trust.f_zeros_like()? };
        let (newest, agents, poses) = (alignment.looked_at(newest)?, newest.count()?, &told.ego_from_cav);
        let ego = newest.only(0, 1)?;
        let of = |first: i64, end: i64| trust.f_narrow(0, first, end - first);
        let mut found = Vec::with_capacity(2);
        if agents > 1 {
            let others = newest.only(1, agents)?;
            found.push(alignment.compare([&ego, &others], &of(1, agents)?, &poses[1..agents as usize], area, train)?);
        }
        if let Some(earlier) = earlier {
            let larger = self.config.earlier_cells;
            // Means of what is looked at are what is looked at of means.
            let (ego, area) = (ego.with_cells_of(larger)?, area.with_cells_of(larger));
            let (earlier, trust) = (alignment.looked_at(earlier)?, of(agents, poses.len() as i64)?);
            found.push(alignment.compare([&ego, &earlier], &trust, &poses[agents as usize..], &area, train)?);
        }
        Found::all(&found)
    }

    /// The ego's tokens `[1, h, w, D]` after all blocks.
    fn transform(&self, Entries { tokens, valid, .. }: &Entries) -> Result<Tensor, TchError> {
        let count = tokens.size()[0];
        if self.config.rows == Rows::Ego && tokens.device() == Device::Cpu && !tokens.requires_grad() {
            let (others, valid) = (Others::of(tokens, valid)?, valid.f_narrow(0, 0, 1)?);
            let ego = by_cell(&tokens.f_narrow(0, 0, 1)?)?;
            return self.blocks.iter().try_fold(ego, |ego, block| block.gather(&ego, &others, &valid));
        }
        let mut tokens = by_cell(tokens)?;
        for (index, block) in self.blocks.iter().enumerate() {
            let is_last = index + 1 == self.blocks.len();
            let rows = if is_last || self.config.rows == Rows::Ego { 1 } else { count };
            let kept = block.forward(&tokens, valid, rows)?;
            tokens = if is_last || rows == count {
                kept
            } else {
                Tensor::f_cat(&[kept, tokens.f_narrow(0, rows, count - rows)?], 0)?
            };
        }
        tokens.f_narrow(0, 0, 1)
    }

    /// `[1, C, H, W]`: the maximum of the ego's map and its neighbours' newest ones, these by how much they are trusted.
    fn strongest(&self, Entries { own, others, tokens, .. }: &Entries, ego: &Tensor) -> Result<Tensor, TchError> {
        let count = others.count()?;
        if count == 0 {
            return f64_tensor::by_cell(own);
        }
        let trust = self.gate.forward(&by_cell(&tokens.f_narrow(0, 1, count)?)?, ego)?;
        others.strongest_with(own, &trust)
    }
}

/// Tokens `[N, D, h, w]` with their channels last.
fn by_cell(tokens: &Tensor) -> Result<Tensor, TchError> {
    tokens.f_permute([0, 2, 3, 1])?.f_contiguous()
}

impl Fusion for Pastat {
    fn fuse(&self, views: &AlignedViews<'_>, train: bool) -> Result<Tensor, TchError> {
        Ok(self.fuse_and_correct(views, train)?.0)
    }

    fn fuse_and_correct(&self, views: &AlignedViews<'_>, train: bool) -> Result<(Tensor, Option<Tensor>), TchError> {
        let (_, _, height, width) = views.features.size4()?;
        let shown = Shown::of(views)?;
        let entries = self.align(&shown, views.grid, train)?;
        let ego = self.transform(&entries)?;
        let newest = self.strongest(&entries, &ego)?;
        let steadied = self.steadied(newest, (views, &shown), &entries, &ego)?;
        let fused = steadied + self.decoder.forward(&ego)?;
        // What was padded on is off before convolutions look around: nothing is known there.
        let fused = fused.f_narrow(2, 0, height)?.f_narrow(3, 0, width)?;
        let fused = match &self.refiner {
            Some(refiner) => refiner.forward(&fused, train)?,
            None => fused,
        };
        let deltas = entries.deltas.map(|deltas| shown.among_all(&deltas)).transpose()?;
        Ok((fused.f_squeeze_dim(0)?.f_to_kind(views.features.kind())?, deltas))
    }

    fn frames(&self) -> usize {
        self.config.frames
    }

    fn earlier_cells(&self) -> Option<i64> {
        Some(self.config.earlier_cells)
    }

    fn recalls(&self) -> bool {
        self.recall.is_some()
    }
}

#[cfg(test)]
mod tests;
