//! PASTAT, the Pose-Aware Spatio-Temporal Alignment Transformer.
//!
//! Aligned maps become tokens, to which the confidence of their poses (CE, Eq. 7) and their true age (TE, Eq. 10-12) are
//! added. FSA moves each neighbour's map and tokens to where they fit the ego's. Pre-norm blocks (Eq. 8, 9) attend over
//! agents and time at each cell and across cells within windows of several sizes. What they find comes back onto the
//! cells in two ways: as a weight of each neighbour's newest map, of which the maximum is taken, and as a change of that.
//! Untrained, both are neutral: the fusion begins as the element-wise maximum.
//!
//! Entries of [`AlignedViews`] are real maps, so nothing is padded over agents or time.

mod alignment;
mod attention;
mod block;
mod confidence;
mod config;
mod correlation;
mod temporal;
mod tokens;

use agent::model_config::ConfigError;
use protocol::{BevGrid, Pose};
use tch::{Kind, TchError, Tensor, nn};

pub use config::{FsaConfig, Part, PastatConfig, Rows, Wavelengths};

use self::alignment::{Area, SpatialAlignment, TRUST, lattice, resample};
use self::block::Block;
use self::confidence::{shares, steps_back};
use self::tokens::{Decoder, Refiner, Tokeniser, TrustGate, padded};
use super::{AlignedViews, Fusion, ViewFacts};

/// PASTAT between encoder and head.
#[derive(Debug)]
pub struct Pastat {
    config: PastatConfig,
    tokeniser: Tokeniser,
    alignment: Option<SpatialAlignment>,
    blocks: Vec<Block>,
    gate: TrustGate,
    decoder: Decoder,
    refiner: Option<Refiner>,
}

/// What is told of the entries that show anything, by property.
struct Told {
    ego_from_cav: Vec<Pose>,
    age_secs: Vec<f64>,
    /// Eq. 7.
    shares: Vec<f32>,
    /// What FSA is told of each entry: its share, its confidence and the ego's. Shares alone do not tell whether all
    /// poses are good or all are bad.
    trust: Vec<f32>,
    /// The entries that are the newest of their agents, the ego's first.
    newest: Vec<i64>,
}

impl Told {
    fn new(facts: &[ViewFacts]) -> Self {
        let agent: Vec<usize> = facts.iter().map(|facts| facts.agent).collect();
        let age_secs: Vec<f64> = facts.iter().map(|facts| facts.age_secs).collect();
        let confidence: Vec<f64> = facts.iter().map(|facts| facts.confidence).collect();
        let steps = steps_back(&agent, &age_secs);
        let shares = shares(&confidence, &steps);
        let of_entry = |(share, &own): (&f32, &f64)| [*share, own as f32, confidence[0] as f32];
        Self {
            trust: shares.iter().zip(&confidence).flat_map(of_entry).collect(),
            ego_from_cav: facts.iter().map(|facts| facts.ego_from_cav).collect(),
            shares,
            newest: (0..).zip(&steps).filter(|(_, step)| **step == 0).map(|(entry, _)| entry).collect(),
            age_secs,
        }
    }
}

/// Maps on padded lattices, and their tokens.
struct Entries {
    /// `[M, C, H, W]`: the newest map of each agent, the ego's first.
    newest: Tensor,
    /// `[M, 1, H, W]`.
    newest_valid: Tensor,
    /// `[N, h, w, D]`: tokens of all entries.
    tokens: Tensor,
    /// `[N, h, w]`.
    valid: Tensor,
    /// `[N - 1, 3]`: how FSA has moved all but the ego's newest.
    deltas: Option<Tensor>,
}

impl Pastat {
    /// Builds the module; its variables lie under `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when it cannot be built.
    pub fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let alignment = |fsa| SpatialAlignment::new(&(path / "fsa"), config.channels, fsa);
        Ok(Self {
            tokeniser: Tokeniser::new(path, config),
            alignment: config.fsa.as_ref().map(alignment),
            blocks: (0..config.depth).map(|index| Block::new(&(path / "blocks" / index), config)).collect(),
            gate: TrustGate::new(&(path / "gate"), config),
            decoder: Decoder::new(&(path / "decoder"), config),
            refiner: config.refine.map(|hidden| Refiner::new(&(path / "refine"), config.channels, hidden)),
            config: config.clone(),
        })
    }

    /// Tokens of all entries, moved by FSA; of each agent's newest map the map too.
    fn align(&self, maps: &Tensor, mask: &Tensor, told: &Told, grid: &BevGrid) -> Result<Entries, TchError> {
        let cells = self.config.padding_cells();
        let maps = padded(&maps.f_to_kind(Kind::Float)?, cells)?;
        let mask = padded(&mask.f_to_kind(Kind::Float)?, cells)?;
        let shares = Tensor::f_from_slice(&told.shares)?.f_to_device(maps.device())?;
        let tokens = self.tokeniser.forward(&maps, &shares, &told.age_secs)?;
        let valid = self.tokeniser.valid(&mask)?;
        let deltas = match &self.alignment {
            Some(alignment) if told.age_secs.len() > 1 => {
                let (_, _, height, width) = maps.size4()?;
                let area = Area::new(grid, [height, width]);
                let trust = Tensor::f_from_slice(&told.trust)?.f_view([-1, TRUST])?.f_to_device(maps.device())?;
                let trust = if self.config.ce { trust } else { trust.f_zeros_like()? };
                Some((alignment.deltas(&maps, &mask, &trust, &told.ego_from_cav, &area)?, area))
            }
            _ => None,
        };
        let (newest, newest_valid) = (pick(&maps, &told.newest)?, pick(&mask, &told.newest)?);
        let entries = Entries { newest, newest_valid, tokens, valid, deltas: None };
        match deltas {
            Some((deltas, area)) => moved(told, entries, deltas, &area),
            None => Ok(entries),
        }
    }

    /// The ego's tokens `[1, h, w, D]` after all blocks.
    fn transform(&self, entries: &Entries) -> Result<Tensor, TchError> {
        let count = entries.tokens.size()[0];
        let mut tokens = entries.tokens.shallow_clone();
        for (index, block) in self.blocks.iter().enumerate() {
            let is_last = index + 1 == self.blocks.len();
            let rows = if is_last || self.config.rows == Rows::Ego { 1 } else { count };
            let kept = block.forward(&tokens, &entries.valid, rows)?;
            tokens = if is_last || rows == count {
                kept
            } else {
                Tensor::f_cat(&[kept, tokens.f_narrow(0, rows, count - rows)?], 0)?
            };
        }
        tokens.f_narrow(0, 0, 1)
    }

    /// The maximum of the ego's map and its neighbours' newest ones, these by how much they are trusted.
    fn strongest(&self, entries: &Entries, ego: &Tensor, newest: &[i64]) -> Result<Tensor, TchError> {
        let own = entries.newest.f_get(0)?;
        let others = newest.len() as i64 - 1;
        if others == 0 {
            return Ok(own);
        }
        let trust = self.gate.forward(&pick(&entries.tokens, &newest[1..])?, ego)?;
        let maps = entries.newest.f_narrow(0, 1, others)? * trust;
        let out_of_reach = entries.newest_valid.f_narrow(0, 1, others)?.f_eq(0.0)?;
        let strongest = maps.f_masked_fill(&out_of_reach, f64::NEG_INFINITY)?.f_amax([0_i64].as_slice(), false)?;
        own.f_maximum(&strongest)
    }

    /// Fuses entries that all show something, the ego's newest first.
    fn fuse_visible(
        &self,
        maps: &Tensor,
        mask: &Tensor,
        facts: &[ViewFacts],
        grid: &BevGrid,
    ) -> Result<(Tensor, Option<Tensor>), TchError> {
        let (_, _, height, width) = maps.size4()?;
        let told = Told::new(facts);
        let entries = self.align(maps, mask, &told, grid)?;
        let ego = self.transform(&entries)?;
        let fused = self.strongest(&entries, &ego, &told.newest)? + self.decoder.forward(&ego)?;
        // What was padded on is off before convolutions look around: nothing is known there.
        let fused = fused.f_narrow(1, 0, height)?.f_narrow(2, 0, width)?;
        let fused = match &self.refiner {
            Some(refiner) => refiner.forward(&fused)?,
            None => fused,
        };
        Ok((fused.f_to_kind(maps.kind())?, entries.deltas))
    }
}

impl Fusion for Pastat {
    fn fuse(&self, views: &AlignedViews<'_>, train: bool) -> Result<Tensor, TchError> {
        Ok(self.fuse_and_correct(views, train)?.0)
    }

    fn fuse_and_correct(&self, views: &AlignedViews<'_>, _train: bool) -> Result<(Tensor, Option<Tensor>), TchError> {
        let AlignedViews { features, mask, grid, facts, .. } = views;
        // A map that nowhere reaches is no partner: it has no share of the trust either.
        let reach: Vec<f32> = Vec::try_from(mask.f_amax([1_i64, 2, 3].as_slice(), false)?.f_to_kind(Kind::Float)?)?;
        let visible: Vec<i64> =
            (0..).zip(&reach).filter(|(entry, reach)| *entry == 0 || **reach > 0.0).map(|(entry, _)| entry).collect();
        if visible.len() == facts.len() {
            return self.fuse_visible(features, mask, facts, grid);
        }
        let told: Vec<ViewFacts> = visible.iter().map(|&entry| facts[entry as usize]).collect();
        let (fused, deltas) = self.fuse_visible(&pick(features, &visible)?, &pick(mask, &visible)?, &told, grid)?;
        // What shows nothing is not moved.
        let still = |deltas: Tensor| {
            let all = Tensor::f_zeros([facts.len() as i64 - 1, 3], (deltas.kind(), deltas.device()))?;
            let places: Vec<i64> = visible[1..].iter().map(|entry| entry - 1).collect();
            all.f_index_copy(0, &Tensor::f_from_slice(&places)?.f_to_device(deltas.device())?, &deltas)
        };
        Ok((fused, deltas.map(still).transpose()?))
    }

    fn frames(&self) -> usize {
        self.config.frames
    }
}

/// FSA: every entry but the ego's newest, its tokens and where it is a newest map the map itself, is moved by `deltas`.
fn moved(told: &Told, entries: Entries, deltas: Tensor, area: &Area) -> Result<Entries, TchError> {
    let Entries { newest: maps, newest_valid, tokens, valid, .. } = entries;
    let (_, _, height, width) = maps.size4()?;
    let (count, rows, columns, _) = tokens.size4()?;
    let after_first = |tensor: &Tensor| tensor.f_narrow(0, 1, tensor.size()[0] - 1);
    let with_first = |first: &Tensor, moved: &Tensor| Tensor::f_cat(&[&first.f_narrow(0, 0, 1)?, moved], 0);

    let places = lattice(&deltas, &told.ego_from_cav[1..], area, [rows, columns])?;
    let by_channel = after_first(&tokens)?.f_permute([0, 3, 1, 2])?.f_contiguous()?;
    let (moved, moved_valid) = resample(&by_channel, &after_first(&valid)?.f_unsqueeze(1)?, &places)?;
    let tokens = with_first(&tokens, &moved.f_permute([0, 2, 3, 1])?.f_contiguous()?)?;
    let valid = with_first(&valid, &moved_valid.f_view([count - 1, rows, columns])?)?;
    if told.newest.len() == 1 {
        return Ok(Entries { newest: maps, newest_valid, tokens, valid, deltas: Some(deltas) });
    }
    // Entry 0 is the ego's newest; deltas begin with entry 1.
    let others: Vec<i64> = told.newest[1..].iter().map(|entry| entry - 1).collect();
    let poses: Vec<Pose> = others.iter().map(|&entry| told.ego_from_cav[entry as usize + 1]).collect();
    let places = lattice(&pick(&deltas, &others)?, &poses, area, [height, width])?;
    let (moved, moved_valid) = resample(&after_first(&maps)?, &after_first(&newest_valid)?, &places)?;
    Ok(Entries {
        newest: with_first(&maps, &moved)?,
        newest_valid: with_first(&newest_valid, &moved_valid)?,
        tokens,
        valid,
        deltas: Some(deltas),
    })
}

/// Some entries of a tensor, along its first dimension.
fn pick(tensor: &Tensor, entries: &[i64]) -> Result<Tensor, TchError> {
    if entries.len() as i64 == tensor.size()[0] {
        return Ok(tensor.shallow_clone());
    }
    tensor.f_index_select(0, &Tensor::f_from_slice(entries)?.f_to_device(tensor.device())?)
}

#[cfg(test)]
mod tests;
