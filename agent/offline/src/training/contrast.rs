//! Contrastive loss of the encoder over cells (InfoNCE, van den Oord et al. 2018), plus the offset between two views of
//! one spot, so that features also encode the exact position of a cell.

use tch::nn::{self, Init, LinearConfig, Module};
use tch::{Device, Kind, TchError, Tensor};

use super::pairs::{ChosenCells, Pair};
use localization::pgc::{SceneEncoder, VoxelBatch};

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

/// Layers that are trained beside the encoder and discarded afterwards.
#[derive(Debug)]
pub(super) struct Contrast {
    embedding: nn::Linear,
    offset: [nn::Linear; 2],
}

/// Loss of some pairs and its parts.
#[derive(Debug)]
pub(super) struct ContrastLoss {
    /// Sum that is minimised.
    pub(super) total: Tensor,
    /// Share of cells whose most similar candidate is their match.
    pub(super) top1: f64,
    /// Mean L1 error of the predicted offset, metres.
    pub(super) offset_m: f64,
}

impl Contrast {
    /// Layers below `path`, for an encoder of `local_channels`.
    pub(super) fn new(path: &nn::Path<'_>, local_channels: i64) -> Self {
        let last = LinearConfig {
            ws_init: Init::Randn {
                mean: 0.0,
                stdev: 1e-3,
            },
            ..LinearConfig::default()
        };
        Self {
            embedding: nn::linear(
                path / "embedding",
                local_channels,
                EMBEDDING,
                LinearConfig::default(),
            ),
            offset: [
                nn::linear(
                    path / "offset" / 0,
                    2 * local_channels + 2,
                    192,
                    LinearConfig::default(),
                ),
                nn::linear(path / "offset" / 1, 192, 3, last),
            ],
        }
    }

    /// Encodes all sweeps of `pairs` in one pass and computes the loss.
    pub(super) fn loss(
        &self,
        encoder: &SceneEncoder,
        pairs: &[Pair],
        kind: Kind,
        device: Device,
    ) -> Result<ContrastLoss, TchError> {
        let sides: Vec<&ChosenCells> = pairs
            .iter()
            .map(|pair| &pair.anchor)
            .chain(pairs.iter().map(|pair| &pair.partner))
            .collect();
        let sweeps: Vec<_> = sides.iter().map(|side| &side.sweep).collect();
        let batch = VoxelBatch::new(&sweeps, encoder.config(), device)?;
        let cells = encoder.local(&batch, kind)?.cells;
        let rows = |sides: std::ops::Range<usize>| {
            let rows: Vec<i64> = sides
                .flat_map(|side| {
                    let first = batch.cell_rows(side).start;
                    sweep_rows(&sweeps_of(pairs, side).rows, first)
                })
                .collect();
            cells
                .f_index_select(0, &Tensor::f_from_slice(&rows)?.f_to_device(device)?)?
                .f_to_kind(Kind::Float)
        };
        let anchors = rows(0..pairs.len())?;
        let partners = rows(pairs.len()..2 * pairs.len())?;
        let matches = matches(pairs, device)?;
        let logits = self.similarities(&anchors, &partners)? + neither(pairs, device)?;
        let contrast = logits.f_log_softmax(1, Kind::Float)?.f_nll_loss::<Tensor>(
            &matches,
            None,
            tch::Reduction::Mean,
            -100,
        )?;
        let found = logits
            .f_argmax(1, false)?
            .f_eq_tensor(&matches)?
            .f_to_kind(Kind::Float)?;
        let offset = self.offset_error(
            &anchors,
            &partners.f_index_select(0, &matches)?,
            pairs,
            device,
        )?;
        Ok(ContrastLoss {
            total: &contrast + &offset * OFFSET_WEIGHT,
            top1: found.f_mean(Kind::Float)?.f_double_value(&[])?,
            offset_m: offset.f_double_value(&[])?,
        })
    }

    fn similarities(&self, anchors: &Tensor, partners: &Tensor) -> Result<Tensor, TchError> {
        let embed = |x: &Tensor| {
            let y = self.embedding.forward(x);
            let norm = y
                .f_square()?
                .f_sum_dim_intlist(1_i64, true, Kind::Float)?
                .f_add_scalar(1e-12)?
                .f_sqrt()?;
            Ok::<_, TchError>(y / norm)
        };
        Ok(embed(anchors)?.f_matmul(&embed(partners)?.f_tr()?)? / TEMPERATURE)
    }

    fn offset_error(
        &self,
        anchors: &Tensor,
        partners: &Tensor,
        pairs: &[Pair],
        device: Device,
    ) -> Result<Tensor, TchError> {
        let mut turns = Vec::new();
        let mut targets = Vec::new();
        for pair in pairs {
            let (sin, cos) = (pair.relative_yaw_rad as f32).sin_cos();
            for (anchor, &partner) in pair.anchor.places_m.iter().zip(&pair.matches) {
                let partner = pair.partner.places_m[partner];
                let offset: [f32; 3] = std::array::from_fn(|axis| partner[axis] - anchor[axis]);
                let rotation = &pair.anchor.sensor_from_world;
                targets.extend((0..3).map(|row| {
                    (0..3)
                        .map(|axis| rotation[3 * row + axis] * offset[axis])
                        .sum::<f32>()
                }));
                turns.extend([cos, sin]);
            }
        }
        let tensor = |values: &[f32], columns: i64| {
            Tensor::f_from_slice(values)?
                .f_view([-1, columns])?
                .f_to_device(device)
        };
        let x = Tensor::f_cat(&[anchors, partners, &tensor(&turns, 2)?], 1)?;
        let predicted = self.offset[1].forward(&self.offset[0].forward(&x).f_relu()?);
        (predicted - tensor(&targets, 3)?)
            .f_abs()?
            .f_sum_dim_intlist(1_i64, false, Kind::Float)?
            .f_mean(Kind::Float)
    }
}

fn sweeps_of(pairs: &[Pair], side: usize) -> &ChosenCells {
    if side < pairs.len() {
        &pairs[side].anchor
    } else {
        &pairs[side - pairs.len()].partner
    }
}

fn sweep_rows(rows: &[usize], first: i64) -> impl Iterator<Item = i64> + '_ {
    rows.iter().map(move |&row| first + row as i64)
}

/// Index of the match of each cell among the candidates of all pairs.
fn matches(pairs: &[Pair], device: Device) -> Result<Tensor, TchError> {
    let mut first = 0;
    let mut all = Vec::new();
    for pair in pairs {
        all.extend(pair.matches.iter().map(|&partner| first + partner as i64));
        first += pair.partner.rows.len() as i64;
    }
    Tensor::f_from_slice(&all)?.f_to_device(device)
}

/// `[anchors, partners]`: mask of candidates that are neither positives nor negatives.
fn neither(pairs: &[Pair], device: Device) -> Result<Tensor, TchError> {
    let count = |side: fn(&Pair) -> &ChosenCells| {
        pairs
            .iter()
            .map(|pair| side(pair).rows.len() as i64)
            .sum::<i64>()
    };
    let mask = Tensor::f_zeros(
        [count(|pair| &pair.anchor), count(|pair| &pair.partner)],
        (Kind::Float, device),
    )?;
    let (mut row, mut column) = (0, 0);
    for pair in pairs {
        let places = |side: &ChosenCells| {
            Tensor::f_from_slice(side.places_m.as_flattened())?
                .f_view([-1, 3])?
                .f_to_device(device)
        };
        let distance =
            Tensor::f_cdist(&places(&pair.anchor)?, &places(&pair.partner)?, 2.0, 2_i64)?;
        let near = distance.f_lt(NEITHER_M)?.f_to_kind(Kind::Float)? * NEVER;
        let own: Vec<i64> = pair.matches.iter().map(|&partner| partner as i64).collect();
        let own = Tensor::f_from_slice(&own)?
            .f_to_device(device)?
            .f_unsqueeze(1)?;
        let near = near.f_scatter_value(1, &own, 0.0)?;
        let (rows, columns) = (
            pair.anchor.rows.len() as i64,
            pair.partner.rows.len() as i64,
        );
        mask.f_narrow(0, row, rows)?
            .f_narrow(1, column, columns)?
            .f_copy_(&near)?;
        row += rows;
        column += columns;
    }
    Ok(mask)
}
