//! The ground between plots, and the middles of roundabouts.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::convex::PlanRectangle;
use super::super::curve::Pose2;
use super::buildings::Style;
use super::lots;

use super::plots::monument;
use super::site::Site;
use super::trees::{Species, plant};

/// One attempt for this much ground, square metres.
const AREA_M2: f64 = 260.0;
/// Nothing is placed farther from a road than this, metres: no sensor sees it well.
const REACH_M: f64 = 70.0;
/// Attempts at most, on maps with much empty ground.
const MAX_ATTEMPTS: u32 = 60_000;

/// Plants and monuments on the middles of roundabouts: x, y, free radius.
pub(super) fn place_islands(site: &mut Site, islands: &[[f64; 3]], rng: &mut ChaCha8Rng) {
    for &[x, y, radius] in islands {
        let middle = Pose2::new(x, y, rng.random_range(0.0..std::f64::consts::TAU));
        let foot = site.foot(middle);
        site.try_place(&monument(foot, rng), 0.0, true);
        for _ in 0..rng.random_range(3..=9) {
            let turned = middle.moved(0.0, 0.0, rng.random_range(-3.1..3.1));
            let pose = turned.moved(rng.random_range(2.5..radius), 0.0, 0.0);
            let species = if rng.random_bool(0.5) {
                Species::Bush
            } else {
                Species::random(rng)
            };
            plant(site, pose, species, rng.random_range(0.5..0.8), rng);
        }
        // No houses here.
        let island = PlanRectangle::square([x, y], radius * 0.7);
        site.take(&island, [foot.z_m - 1.0, foot.z_m + 40.0]);
    }
}

/// Houses of the second row, sheds and trees wherever there is room near a road.
pub(super) fn place(site: &mut Site, rng: &mut ChaCha8Rng) {
    let [low, high] = site.surface.bounds_m;
    let low = low.map(|low| low - REACH_M / 2.0);
    let high = high.map(|high| high + REACH_M / 2.0);
    let area = (high[0] - low[0]) * (high[1] - low[1]);
    let attempts = ((area / AREA_M2) as u32).min(MAX_ATTEMPTS);
    for _ in 0..attempts {
        let [x, y] = [0, 1].map(|axis| rng.random_range(low[axis]..high[axis]));
        let pose = Pose2::new(x, y, rng.random_range(-3.1..3.1));
        let (choice, species) = (rng.random_range(0..10), Species::random(rng));
        let size = rng.random_range(0.8..1.5);
        let around = PlanRectangle::square([x, y], REACH_M);
        if !site.surface.any(&around, |_| true) {
            continue;
        }
        match choice {
            0 => second_row(site, pose, rng),
            1..=6 => plant(site, pose, species, size, rng),
            _ => {}
        }
    }
}

fn second_row(site: &mut Site, pose: Pose2, rng: &mut ChaCha8Rng) {
    use Style::{Block, House, Row, Tower};
    let style = [House, House, Row, Block, Tower][rng.random_range(0..5)];
    // Room for the street's own plots in front: six metres to everything.
    if let Some(lot) = lots::free_lot(site, pose, style.lot_m(rng), 2.5, 6.0) {
        lots::build_on(site, &lot, style, rng);
    }
}
