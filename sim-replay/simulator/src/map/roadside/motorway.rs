//! Motorway scenery that makes stretches distinguishable: noise walls, gantries, overpasses, trees, halls, masts.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::{Solid, SolidKind};
use super::buildings::Style;
use super::frontage::{RoadSide, Zone, sides};
use super::lots;
use super::parts::{PartFootprint, wall};
use super::site::{HEADROOM_M, Site};
use super::trees::{Species, plant};

/// Places the objects along motorways.
pub(super) fn place(site: &mut Site, rng: &mut ChaCha8Rng) {
    for side in sides(site.network) {
        if side.zone != Zone::Motorway || side.median {
            continue;
        }
        across(site, &side, rng);
        noise_walls(site, &side, rng);
        markers(site, &side, rng);
        behind(site, &side, rng);
    }
}

/// Gantries and footbridges over the carriageway.
fn across(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(15.0..180.0);
    while s < side.length_m - 10.0 {
        if rng.random_bool(0.65) {
            gantry(site, side, s, rng);
        } else {
            footbridge(site, side, s, rng);
        }
        s += rng.random_range(110.0..320.0);
    }
}

fn gantry(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) {
    let cut = site.cut_at(side.road, s);
    let [low, high] = [cut.carriageway_m[0] - 0.9, cut.carriageway_m[1] + 0.9];
    let clear = rng.random_range(5.4..6.4);
    let [_, z] = cut.range_m();
    let mut parts = Vec::new();
    for t in [low, high] {
        let foot = site.foot(cut.pose.moved(0.0, t, 0.0));
        let size = [0.2, z + clear + 0.9 - foot.z_m];
        parts.push(foot.post(SolidKind::Pole, -0.3, size, 0.5));
    }
    let (a, b, beam) = (cut.at(low), cut.at(high), [z + clear, z + clear + 0.6]);
    parts.push(wall(SolidKind::Pole, a, b, beam, 0.5, 0.5));
    let panels = rng.random_range(1..=3);
    for panel in 0..panels {
        let t = low
            + (high - low) * (f64::from(panel) + 0.5) / f64::from(panels)
            + rng.random_range(-0.5..0.5);
        let foot = PartFootprint::new(cut.pose.moved(0.0, t, 0.0), z);
        let size = [0.15, rng.random_range(2.0..4.0), rng.random_range(1.2..2.6)];
        parts.push(foot.cuboid(SolidKind::Sign, [-0.35, 0.0, clear - 0.2], size, 0.95));
    }
    site.try_place(&parts, 0.0, true);
}

/// A bridge for walkers from this side to the other side of the carriageway: deck, rails, stairs towers.
fn footbridge(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) {
    let cut = site.cut_at(side.road, s);
    let [low, high] = [cut.carriageway_m[0] - 1.6, cut.carriageway_m[1] + 1.6];
    let z = cut.range_m()[1] + rng.random_range(5.3..6.2);
    let width = rng.random_range(2.4..4.5);
    let (a, b) = (cut.at(low), cut.at(high));
    let mut parts = vec![wall(SolidKind::BridgeDeck, a, b, [z, z + 0.5], width, 0.4)];
    for edge in [-0.5, 0.5] {
        let [p, q] = [low, high].map(|t| {
            let pose = cut.pose.moved(edge * (width - 0.1), t, 0.0);
            [pose.x, pose.y]
        });
        parts.push(wall(SolidKind::Fence, p, q, [z + 0.5, z + 1.6], 0.08, 0.4));
    }
    for t in [low + 0.5, high - 0.5] {
        let foot = site.foot(cut.pose.moved(0.0, t, 0.0));
        if z - foot.z_m < 1.0 {
            return;
        }
        let size = [width * 0.6, 0.7, z - foot.z_m + 0.5];
        parts.push(foot.standing(SolidKind::Pillar, -0.5, size, 0.4));
    }
    site.try_place(&parts, 0.0, true);
}

fn noise_walls(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(0.0..80.0);
    while s < side.length_m {
        let (length, out) = (rng.random_range(50.0..170.0f64), rng.random_range(2.5..7.0));
        let (height, step) = (rng.random_range(2.2..5.0), rng.random_range(3.5..6.0));
        let end = (s + length).min(side.length_m);
        while s + step < end {
            let [a, b] = [s, s + step].map(|s| site.foot(side.beyond_paved(site, s, out)));
            let (low, high) = (a.z_m.min(b.z_m), a.z_m.max(b.z_m));
            // Panels of slightly different height between posts; some are missing or glazed (lower).
            let own = match rng.random_bool(0.08) {
                true => height * 0.45,
                false => height * rng.random_range(0.94..1.06),
            };
            if (low - side.road_m(site, s)).abs() < 3.0 {
                let (kind, z) = (SolidKind::NoiseWall, [low - 0.3, high + own]);
                let [p, q] = [a, b].map(|foot| [foot.pose.x, foot.pose.y]);
                let panel = wall(kind, p, q, z, 0.2, 0.35);
                let post = a.standing(kind, -0.3, [0.3, 0.4, own + 0.6], 0.4);
                site.try_place(&[panel, post], 0.0, true);
            }
            s += step;
        }
        s = end + rng.random_range(40.0..200.0);
    }
}

/// Posts, panels, emergency telephones and cabinets at the edge.
fn markers(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(3.0..40.0);
    while s < side.length_m - 2.0 {
        let pose = side.beyond_kerb(site, s, rng.random_range(1.1..1.9));
        let foot = site.foot(if side.along { pose } else { pose.reversed() });
        let parts: Vec<Solid> = match rng.random_range(0..6) {
            0 => {
                let size = [0.1, rng.random_range(1.5..3.2), rng.random_range(1.0..2.4)];
                let [right, left] = [-0.4, 0.4].map(|v: f64| {
                    let (at, post) = ([0.1, v * size[1], -0.2], [0.07, 2.0 + size[2]]);
                    foot.cylinder(SolidKind::Pole, at, post, 0.5)
                });
                let panel = foot.standing(SolidKind::Sign, 1.8, size, 0.95);
                vec![right, left, panel]
            }
            1 => {
                let size = [0.5, 1.2, rng.random_range(1.2..2.0)];
                vec![foot.standing(SolidKind::StreetFurniture, -0.1, size, 0.5)]
            }
            2 => vec![
                foot.post(SolidKind::Pole, -0.2, [0.05, 1.4], 0.5),
                foot.standing(SolidKind::Sign, 1.2, [0.25, 0.35, 0.5], 0.9),
            ],
            _ => vec![foot.standing(SolidKind::Pole, -0.1, [0.12, 0.12, 1.1], 0.8)],
        };
        site.try_place(&parts, 0.05, false);
        s += rng.random_range(14.0..55.0);
    }
}

/// Trees in groups and rows, halls, masts and tanks behind the barrier.
fn behind(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(0.0..15.0);
    while s < side.length_m {
        match rng.random_range(0..16) {
            0..=1 => large(site, side, s, rng),
            2 => mast(site, side, s, rng),
            3..=4 => {
                // A row of one species.
                let species = Species::random(rng);
                let (out, step) = (rng.random_range(4.0..9.0), rng.random_range(4.0..8.0));
                for place in 0..rng.random_range(3..=8) {
                    let pose = side.beyond_paved(site, s + f64::from(place) * step, out);
                    plant(site, pose, species, rng.random_range(0.8..1.2), rng);
                }
            }
            _ => {
                for _ in 0..rng.random_range(1..=5) {
                    let (ds, out) = (rng.random_range(-8.0..8.0), rng.random_range(3.0..26.0));
                    let pose = side.beyond_paved(site, s + ds, out);
                    let species = Species::random(rng);
                    plant(site, pose, species, rng.random_range(0.7..1.5), rng);
                }
            }
        }
        s += rng.random_range(7.0..24.0);
    }
}

fn large(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) {
    use Style::{Block, Hall, Tanks, Tower};
    let style = [Hall, Hall, Block, Tanks, Tower][rng.random_range(0..5)];
    let size = style.lot_m(rng);
    let out = rng.random_range(6.0..30.0) + size[1] / 2.0;
    let pose = side.with_road_right(side.beyond_paved(site, s, out));
    if let Some(lot) = lots::free_lot(site, pose, size, 3.0, 0.5) {
        lots::build_on(site, &lot, style, rng);
    }
}

/// A mast for power lines or radio: legs and arms.
fn mast(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) {
    let pose = side.beyond_paved(site, s, rng.random_range(8.0..30.0));
    let foot = site.foot(pose.moved(0.0, 0.0, rng.random_range(0.0..3.1)));
    let (height, spread) = (rng.random_range(14.0..28.0), rng.random_range(0.9..2.2));
    let kind = SolidKind::Pole;
    let mut parts = Vec::new();
    for (u, v) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
        let at = [u * spread, v * spread, -0.5];
        parts.push(foot.cuboid(kind, at, [0.25, 0.25, height * 0.6], 0.5));
    }
    parts.push(foot.standing(kind, height * 0.6 - 0.5, [0.9, 0.9, height * 0.4], 0.5));
    for arm in [0.62, 0.78, 0.94] {
        let size = [0.3, 6.0 + 4.0 * (1.0 - arm), 0.3];
        parts.push(foot.standing(kind, height * arm, size, 0.5));
    }
    debug_assert!(height * 0.6 > HEADROOM_M);
    site.try_place(&parts, 0.3, true);
}
