//! Key grid of the refiner: laid over all cells before the training, cropped to the area of cells after it.

use tch::nn::VarStore;
use tch::{TchError, Tensor, no_grad};

use localization::pgc::{LocalizerError, RefinerConfig, SceneHead, SceneHeadConfig};

/// Smallest distance between corners, metres; a large scene has a coarser grid, since the number of corners is limited.
const SPACING_M: f64 = 1.5;
const CORNERS: f64 = 110_000.0;
/// Reach of the refiner to each side, metres.
const REACH_M: f64 = 3.0;
/// Channels of a key.
const KEYS: i64 = 16;
/// Share of the cells that may lie beyond each edge of the cropped grid.
const EDGE_SHARE: f64 = 0.003;
/// Margin around the outermost cells that still belongs to the scene, metres.
const MARGIN_M: f64 = 8.0;

/// A key grid that covers all cells, whose world coordinates are `targets_m` `[N, 3]`.
pub(super) fn covering(targets_m: &Tensor, local_channels: i64) -> Result<RefinerConfig, TchError> {
    let low_m: Vec<f32> = Vec::try_from(&targets_m.f_amin([0_i64], false)?)?;
    let low_m = [0, 1].map(|axis: usize| f64::from(low_m[axis]) - MARGIN_M);
    let high_m: Vec<f32> = Vec::try_from(&targets_m.f_amax([0_i64], false)?)?;
    let high_m = [0, 1].map(|axis: usize| f64::from(high_m[axis]) + MARGIN_M);
    let area_m2 = (high_m[0] - low_m[0]) * (high_m[1] - low_m[1]);
    let spacing_m = (area_m2 / CORNERS).sqrt().max(SPACING_M);
    let reach = (REACH_M / spacing_m).ceil() as i64;
    Ok(RefinerConfig {
        local_channels,
        low_m,
        high_m,
        spacing_m,
        reach,
        keys: KEYS,
        width: 256,
    })
}

/// Crops the edges of the key grid that hardly any cell is near, so that they need not be stored; the remaining trained
/// variables.
pub(super) fn crop(
    head: &mut SceneHeadConfig,
    variables: VarStore,
    targets_m: &Tensor,
) -> Result<VarStore, LocalizerError> {
    let Some(full) = &head.refiner else {
        return Ok(variables);
    };
    let low_m = quantiles(targets_m, EDGE_SHARE)?;
    let high_m = quantiles(targets_m, 1.0 - EDGE_SHARE)?;
    let (cropped, rows) = full.cropped(low_m, high_m);
    let rows = Tensor::f_from_slice(&rows)?.f_to_device(variables.device())?;
    head.refiner = Some(cropped);
    let kept = VarStore::new(variables.device());
    SceneHead::new(&kept.root(), head)?;
    let trained = variables.variables();
    for (name, mut variable) in kept.variables() {
        let source = &trained[&name];
        // Only these have a row for each corner of the grid.
        let is_key_grid = matches!(name.as_str(), "refiner.keys" | "refiner.heights");
        let source = match is_key_grid {
            true => source.f_index_select(0, &rows)?,
            false => source.shallow_clone(),
        };
        no_grad(|| variable.f_copy_(&source))?;
    }
    Ok(kept)
}

/// x and y below which a share of the cells lies.
fn quantiles(targets_m: &Tensor, share: f64) -> Result<[f64; 2], TchError> {
    let [x, y] = [0, 1].map(|axis| {
        let values = targets_m.f_select(1, axis)?;
        // `kthvalue` counts from 1.
        let rank = ((values.size()[0] - 1) as f64 * share).round() as i64 + 1;
        values.f_kthvalue(rank, 0, false)?.0.f_double_value(&[])
    });
    Ok([x?, y?])
}
