//! The ground between plots, and the middles of roundabouts.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::convex::Rectangle;
use super::super::curve::Pose2;
use super::buildings::{Lot, Style, build};
use super::lots;
use super::parts::PartFootprint;
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
        let parts = monument(PartFootprint::new(middle, site.ground_m([x, y])), rng);
        site.try_place(&parts, 0.0, true);
        for _ in 0..rng.random_range(3..=9) {
            let pose = middle.moved(0.0, 0.0, rng.random_range(-3.1..3.1)).moved(
                rng.random_range(2.5..radius),
                0.0,
                0.0,
            );
            let species = if rng.random_bool(0.5) {
                Species::Bush
            } else {
                Species::random(rng)
            };
            plant(site, pose, species, rng.random_range(0.5..0.8), rng);
        }
        // No houses here.
        let island = Rectangle {
            center_m: [x, y],
            half_m: [radius * 0.7; 2],
            yaw_rad: 0.0,
        };
        let z = site.ground_m([x, y]);
        site.take(&island, [z - 1.0, z + 40.0]);
    }
}

/// Houses of the second row, sheds and trees wherever there is room near a road.
pub(super) fn place(site: &mut Site, rng: &mut ChaCha8Rng) {
    let [low, high] = site.surface.bounds_m;
    let [low, high] = [
        low.map(|low| low - REACH_M / 2.0),
        high.map(|high| high + REACH_M / 2.0),
    ];
    let area = (high[0] - low[0]) * (high[1] - low[1]);
    let attempts = ((area / AREA_M2) as u32).min(MAX_ATTEMPTS);
    for _ in 0..attempts {
        let [x, y] = [0, 1].map(|axis| rng.random_range(low[axis]..high[axis]));
        let pose = Pose2::new(x, y, rng.random_range(-3.1..3.1));
        let (choice, species, size) = (
            rng.random_range(0..10),
            Species::random(rng),
            rng.random_range(0.8..1.5),
        );
        if !near_road(site, x, y) {
            continue;
        }
        match choice {
            0 => second_row(site, pose, rng),
            1..=6 => {
                plant(site, pose, species, size, rng);
            }
            _ => {}
        }
    }
}

fn near_road(site: &Site, x: f64, y: f64) -> bool {
    let around = Rectangle {
        center_m: [x, y],
        half_m: [REACH_M; 2],
        yaw_rad: 0.0,
    };
    site.surface.any(&around, |_| true)
}

fn second_row(site: &mut Site, pose: Pose2, rng: &mut ChaCha8Rng) {
    let style = [
        Style::House,
        Style::House,
        Style::Row,
        Style::Block,
        Style::Tower,
    ][rng.random_range(0..5)];
    let [width_m, depth_m] = style.lot_m(rng);
    let half_m = [width_m / 2.0, depth_m / 2.0];
    let rectangle = Rectangle {
        center_m: [pose.x, pose.y],
        half_m,
        yaw_rad: pose.heading_rad,
    };
    let [low, high] = site.ground_range_m(&rectangle);
    // Room for the street's own plots in front: six metres to everything.
    if high - low < 2.5 && site.is_free(&rectangle.grown(6.0), [low - 1.5, low + 40.0], true) {
        let lot = Lot {
            foot: PartFootprint::new(pose, low),
            width_m,
            depth_m,
        };
        let parts = build(style, &lot, rng);
        site.place(&parts);
        site.take(&lots::outline(&lot), [low - 1.5, low + 40.0]);
    }
}
