//! Statistics of a scene that a head has before its training: mean and deviation of features, centres of coordinates.

use perception::tensor_values::{tensor, values};
use tch::{Device, Result};

use crate::training::{FeatureCache, kmeans};
use localization::pgc::SceneHead;

/// Number of cells that both are computed from.
const SAMPLE: usize = 20_000;

/// Sets both, reproducibly by `seed`.
pub(super) fn set_statistics(head: &mut SceneHead, cache: &FeatureCache, seed: u64) -> Result<()> {
    let centre_count = head.config().centres as usize;
    let sample = cache.drawn_rows(seed, 0, SAMPLE)?;
    let places = values(&cache.targets_m.f_index_select(0, &sample)?)?;
    let places = places.as_chunks::<3>().0.iter();
    let places: Vec<[f64; 3]> = places.map(|place| place.map(f64::from)).collect();
    let (mut centres, _) = kmeans(&places, centre_count, seed);
    // With more centres than sampled cells the rest of them stays at the origin.
    centres.resize(centre_count, [0.0; 3]);
    let centres: Vec<f32> = (centres.as_flattened().iter())
        .map(|&axis| axis as f32)
        .collect();
    let centres = tensor(&centres, &[-1, 3], Device::Cpu)?;
    let cells = cache.cells.f_index_select(0, &sample)?;
    head.set_statistics(&cells, &cache.sweeps, &centres)
}
