//! Contrastive loss of the encoder over cells (InfoNCE, van den Oord et al. 2018), plus the offset between two views of
//! one spot, so that features also encode the exact position of a cell.

use std::ops::Range;

use nalgebra::Vector3;
use perception::tensor_values::tensor;
use serde::Serialize;
use tch::nn::{self, Init, LinearConfig, Module};
use tch::{Device, Kind, TchError, Tensor};

use super::pairs::Pair;
use localization::pgc::{SceneEncoder, VoxelBatch, of_unit_length};

/// Channels of the embedding in which similarity is measured.
const EMBEDDING: i64 = 64;
/// Temperature of the softmax over similarities.
const TEMPERATURE: f64 = 0.07;
/// Distance from the spot below which a partner's cells other than the match are neither positives nor negatives,
/// metres.
const NEITHER_M: f64 = 3.0;
/// Weight of the offset term, per metre.
const OFFSET_WEIGHT: f64 = 0.5;
/// Logit of excluded candidates.
const NEVER: f64 = -1e4;

/// Accuracy of the matching of cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EncoderAccuracy {
    /// Share of cells whose most similar candidate is their match.
    pub top1: f64,
    /// Mean L1 error of the offset between two views of one spot, metres.
    pub offset_m: f64,
}

/// Layers that are trained beside the encoder and discarded afterwards.
#[derive(Debug)]
pub(super) struct Contrast {
    embedding: nn::Linear,
    offset: [nn::Linear; 2],
}

impl Contrast {
    /// Layers below `path`, for an encoder of `local_channels`.
    pub(super) fn new(path: &nn::Path<'_>, local_channels: i64) -> Self {
        let usual = LinearConfig::default();
        // Near zero at first.
        let last = LinearConfig {
            ws_init: Init::Randn {
                mean: 0.0,
                stdev: 1e-3,
            },
            ..usual
        };
        let offset = path / "offset";
        Self {
            embedding: nn::linear(path / "embedding", local_channels, EMBEDDING, usual),
            offset: [
                nn::linear(&offset / 0, 2 * local_channels + 2, 192, usual),
                nn::linear(&offset / 1, 192, 3, last),
            ],
        }
    }

    /// Encodes all sweeps of `pairs` in one pass; the loss, and the accuracy of their matching.
    pub(super) fn loss(
        &self,
        encoder: &SceneEncoder,
        pairs: &[Pair],
        kind: Kind,
        device: Device,
    ) -> Result<(Tensor, EncoderAccuracy), TchError> {
        let anchors = pairs.iter().map(|pair| &pair.anchor);
        let sides: Vec<_> = (anchors.chain(pairs.iter().map(|pair| &pair.partner))).collect();
        let sweeps: Vec<_> = sides.iter().map(|side| &side.sweep).collect();
        let batch = VoxelBatch::new(&sweeps, encoder.config(), device)?;
        let cells = encoder.local(&batch, kind)?.cells;
        let chosen = |of: Range<usize>| {
            let mut rows = Vec::new();
            for side in of {
                let first = batch.cell_rows[side].start;
                rows.extend(sides[side].rows.iter().map(|&row| first + row as i64));
            }
            let rows = tensor(&rows, &[-1], device)?;
            cells.f_index_select(0, &rows)?.f_to_kind(Kind::Float)
        };
        let anchors = chosen(0..pairs.len())?;
        let partners = chosen(pairs.len()..2 * pairs.len())?;
        let matches = matches(pairs, device)?;
        let queries = of_unit_length(&self.embedding.forward(&anchors))?;
        let keys = of_unit_length(&self.embedding.forward(&partners))?;
        let similarities = queries.f_matmul(&keys.f_tr()?)? / TEMPERATURE;
        let logits = similarities + neither(pairs, device)?;
        let log_shares = logits.f_log_softmax(1, Kind::Float)?;
        let contrast =
            log_shares.f_nll_loss::<Tensor>(&matches, None, tch::Reduction::Mean, -100)?;
        let found = logits.f_argmax(1, false)?.f_eq_tensor(&matches)?;
        let found = found.f_to_kind(Kind::Float)?;
        // Offsets are learnt between true matches only.
        let matched = partners.f_index_select(0, &matches)?;
        let offset = self.offset_error(&anchors, &matched, pairs, device)?;
        let total = &contrast + &offset * OFFSET_WEIGHT;
        let accuracy = EncoderAccuracy {
            top1: found.f_mean(Kind::Float)?.f_double_value(&[])?,
            offset_m: offset.f_double_value(&[])?,
        };
        Ok((total, accuracy))
    }

    fn offset_error(
        &self,
        anchors: &Tensor,
        partners: &Tensor,
        pairs: &[Pair],
        device: Device,
    ) -> Result<Tensor, TchError> {
        let (mut turns, mut targets) = (Vec::new(), Vec::<f32>::new());
        for pair in pairs {
            let (sin, cos) = (pair.relative_yaw_rad as f32).sin_cos();
            for (anchor, &partner) in pair.anchor.places_m.iter().zip(&pair.matches) {
                let partner = Vector3::from(pair.partner.places_m[partner]);
                // Into the frame of the anchor's sensor, the only one that its features know.
                let offset = pair.anchor.sensor_from_world * (partner - Vector3::from(*anchor));
                targets.extend(offset.iter());
                turns.extend([cos, sin]);
            }
        }
        let turns = tensor(&turns, &[-1, 2], device)?;
        let x = Tensor::f_cat(&[anchors, partners, &turns], 1)?;
        let predicted = self.offset[1].forward(&self.offset[0].forward(&x).f_relu()?);
        let errors = (predicted - tensor(&targets, &[-1, 3], device)?).f_abs()?;
        let errors = errors.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
        errors.f_mean(Kind::Float)
    }
}

/// Index of the match of each cell among the candidates of all pairs.
fn matches(pairs: &[Pair], device: Device) -> Result<Tensor, TchError> {
    let (mut first, mut all) = (0, Vec::new());
    for pair in pairs {
        all.extend(pair.matches.iter().map(|&partner| first + partner as i64));
        first += pair.partner.rows.len() as i64;
    }
    tensor(&all, &[-1], device)
}

/// `[anchors, partners]`: mask of candidates that are neither positives nor negatives.
fn neither(pairs: &[Pair], device: Device) -> Result<Tensor, TchError> {
    let anchors: usize = pairs.iter().map(|pair| pair.anchor.rows.len()).sum();
    let partners: usize = pairs.iter().map(|pair| pair.partner.rows.len()).sum();
    // Cells of other pairs stay at 0: all of them are negatives.
    let mask = Tensor::f_zeros([anchors as i64, partners as i64], (Kind::Float, device))?;
    let (mut row, mut column) = (0, 0);
    for pair in pairs {
        let anchor = tensor(pair.anchor.places_m.as_flattened(), &[-1, 3], device)?;
        let partner = tensor(pair.partner.places_m.as_flattened(), &[-1, 3], device)?;
        // Mode 2 takes differences: by a matrix product short distances would be rounded.
        let distance = Tensor::f_cdist(&anchor, &partner, 2.0, 2_i64)?;
        let near = distance.f_lt(NEITHER_M)?.f_to_kind(Kind::Float)? * NEVER;
        // The match itself is near too, and must stay a candidate.
        let own: Vec<i64> = pair.matches.iter().map(|&partner| partner as i64).collect();
        let near = near.f_scatter_value(1, &tensor(&own, &[-1, 1], device)?, 0.0)?;
        let rows = pair.anchor.rows.len() as i64;
        let columns = pair.partner.rows.len() as i64;
        let own_rows = mask.f_narrow(0, row, rows)?;
        own_rows.f_narrow(1, column, columns)?.f_copy_(&near)?;
        row += rows;
        column += columns;
    }
    Ok(mask)
}
