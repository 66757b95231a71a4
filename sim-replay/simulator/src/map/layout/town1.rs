//! A small town of about 400 m x 340 m: two-lane streets, T-junctions and crossings on level ground.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::builder::Builder;
use super::grid::{GridPlan, grid, spread};
use super::{RoadLayout, streets};

/// Speed limit: 25 mph, as in CARLA's Town01.
const LIMIT_MPS: f64 = 11.176;

/// Lays out the map of a seed.
pub(crate) fn lay_out(seed: u64) -> RoadLayout {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let width = rng.random_range(385.0..415.0);
    let height = rng.random_range(325.0..355.0);
    let (columns, rows) = [(5, 4), (4, 5), (5, 5)][rng.random_range(0..3)];
    // Streets that are not at right angles: the rows' ends lie at different heights.
    let (shear, taper) = (rng.random_range(-0.1..0.1), rng.random_range(-0.08..0.08));
    let columns_m = spread(0.0, width, columns, 0.22, &mut rng);
    // A denser grid loses more streets, so that the total length is about the same for all grids.
    let left_out = if columns + rows == 9 { 0.04 } else { 0.14 };
    let plan = GridPlan {
        columns_m,
        rows,
        left_out,
        jitter_m: 5.0,
    };
    let graph = grid(&plan, None, &mut rng, |x| {
        let share = x / width - 0.5;
        [
            shear * x + share * taper * height,
            height + shear * x - share * taper * height,
        ]
    });
    let mut builder = Builder::default();
    streets::lay_out(&mut builder, &graph, LIMIT_MPS, &mut rng);
    let (network, islands) = (builder.network, Vec::new());
    RoadLayout { network, islands }
}
