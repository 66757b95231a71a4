//! Statistics of a scene that a head has before its training: mean and deviation of features, centres of coordinates.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::{TchError, Tensor};

use crate::training::{FeatureCache, kmeans};
use localization::pgc::SceneHead;

/// Number of cells that both are computed from.
const SAMPLE: usize = 20_000;

/// Sets both, reproducibly by `seed`.
pub(super) fn set_statistics(
    head: &mut SceneHead,
    cache: &FeatureCache,
    seed: u64,
) -> Result<(), TchError> {
    let centre_count = head.config().centres as usize;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let sample: Vec<i64> = (0..SAMPLE)
        .map(|_| rng.random_range(0..cache.cell_count()))
        .collect();
    let sample = Tensor::f_from_slice(&sample)?.f_to_device(cache.cells.device())?;
    let places: Vec<f32> =
        Vec::try_from(&cache.targets_m.f_index_select(0, &sample)?.f_view([-1])?)?;
    let places: Vec<[f64; 3]> = places
        .as_chunks::<3>()
        .0
        .iter()
        .map(|place| place.map(f64::from))
        .collect();
    let (mut centres, _) = kmeans(&places, centre_count, seed);
    centres.resize(centre_count, [0.0; 3]);
    let centres: Vec<f32> = centres
        .as_flattened()
        .iter()
        .map(|&axis| axis as f32)
        .collect();
    let cells = cache.cells.f_index_select(0, &sample)?;
    head.set_statistics(
        &cells,
        &cache.sweeps,
        &Tensor::f_from_slice(&centres)?.f_view([-1, 3])?,
    )
}
