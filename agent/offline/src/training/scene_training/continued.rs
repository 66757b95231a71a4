//! Continued head: a trained head as the start of a training on further sweeps of its scene.

use tch::{Kind, TchError, Tensor, no_grad};

use crate::training::FeatureCache;
use crate::training::kmeans::nearest;
use crate::{Error, Result};
use localization::pgc::SceneHead;

/// Number of cells of a sweep that its classification is judged by.
const CELLS: i64 = 32;
/// Largest median L1 error of these cells under which a classification is trusted, metres.
const TRUSTED_M: f64 = 5.0;

/// Class of each sweep of `cache`, which a trained head does not store: the one whose trusted sweeps lie nearest. A
/// sweep is trusted if the head finds its cells with the class that it gives it.
pub(super) fn classes_of_sweeps(head: &SceneHead, cache: &FeatureCache) -> Result<Vec<usize>> {
    let (classes, errors_m) = no_grad(|| classify(head, cache))?;
    let positions = cache.positions_m();
    let mut sums = vec![[0.0; 4]; head.config().classes as usize];
    for ((&class, &error_m), position) in classes.iter().zip(&errors_m).zip(&positions) {
        if error_m < TRUSTED_M {
            (0..3).for_each(|axis| sums[class as usize][axis] += position[axis]);
            sums[class as usize][3] += 1.0;
        }
    }
    let trusted = sums.iter().enumerate().filter(|(_, sum)| sum[3] > 0.0);
    let (classes, middles): (Vec<usize>, Vec<[f64; 3]>) = trusted
        .map(|(class, sum)| (class, [0, 1, 2].map(|axis| sum[axis] / sum[3])))
        .unzip();
    if middles.is_empty() {
        return Err(Error::Input(format!(
            "the head of {:?} recognises none of the sweeps: are they of another scene?",
            head.config().scene_name
        )));
    }
    let nearest = positions.iter().map(|place| nearest(&middles, place));
    Ok(nearest.map(|index| classes[index]).collect())
}

/// Class of each sweep as the head sees it, and the median L1 error of some of its cells under it, metres.
fn classify(head: &SceneHead, cache: &FeatureCache) -> Result<(Vec<i64>, Vec<f64>), TchError> {
    let logits = head.classify(&cache.sweeps, false)?;
    let classes = Vec::try_from(&logits.f_argmax(1, false)?)?;
    let sweep_of_cell: Vec<i64> = Vec::try_from(&cache.sweep_of_cell)?;
    let errors = (0..cache.sweep_count()).map(|sweep| {
        // Cells are stored sweep after sweep, so these numbers ascend.
        let [start, end] = [sweep, sweep + 1]
            .map(|sweep| sweep_of_cell.partition_point(|&of| of < sweep as i64) as i64);
        let count = (end - start).min(CELLS);
        if count == 0 {
            return Ok(f64::INFINITY);
        }
        let on = (Kind::Double, cache.cells.device());
        let (first, last) = (start as f64, (end - 1) as f64);
        // Evenly over the cells of the sweep, first and last included.
        let rows = Tensor::f_linspace(first, last, count, on)?.f_to_kind(Kind::Int64)?;
        let cells = head.normalise(&cache.cells.f_index_select(0, &rows)?)?;
        let of_sweep = logits.f_narrow(0, sweep as i64, 1)?;
        let of_cells = of_sweep.f_expand([count, -1], false)?;
        let found = head.regress(&cells, &of_cells, Kind::Float)?.coordinates_m;
        let error = (found - cache.targets_m.f_index_select(0, &rows)?).f_abs()?;
        let error = error.f_sum_dim_intlist(1_i64, false, Kind::Float)?;
        error.f_median()?.f_double_value(&[])
    });
    Ok((classes, errors.collect::<Result<_, TchError>>()?))
}
