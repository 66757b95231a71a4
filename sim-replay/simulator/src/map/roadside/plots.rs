//! Plots along streets and country roads: buildings, gardens, parking lots, greens.

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::curve::Pose2;
use super::super::{Shape, Solid, SolidKind};
use super::buildings::{Lot, Style};
use super::frontage::{RoadSide, Zone, sides};
use super::lots::{self, LOT_HEIGHT_M};
use super::parts::{PartFootprint, wall};
use super::site::Site;
use super::trees::{Species, plant};

/// Ground that falls or rises more than this over a lot is not built on, metres.
const MAX_SLOPE_M: f64 = 2.5;
/// Length by which plots reach beyond the ends of a road, around the corner, metres.
const CORNER_M: f64 = 9.0;

/// Places plots along all streets and country roads.
pub(super) fn place(site: &mut Site, rng: &mut ChaCha8Rng) {
    for side in sides(site.network) {
        match side.zone {
            Zone::Street => along_street(site, &side, rng),
            Zone::Rural => along_country_road(site, &side, rng),
            Zone::Motorway => {}
        }
    }
}

/// Character of a street, common to its houses: their styles, least set-back and gap, metres.
fn character(rng: &mut ChaCha8Rng) -> (Vec<Style>, f64, f64) {
    use Style::*;
    let (styles, set_back_m, gap_m) = match rng.random_range(0..5) {
        0 => (vec![House, House, House, Row, Shop], 2.5..6.0, 3.5),
        1 => (vec![Row, Row, House, Block, Shop], 0.6..3.5, 1.2),
        2 => (vec![Block, Block, Tower, Shop, Row], 0.6..4.0, 3.0),
        3 => (
            vec![Shop, Shop, Block, House, PetrolStation, Church],
            1.0..5.0,
            4.0,
        ),
        _ => (vec![Hall, Hall, Tanks, Shop, Block], 3.0..8.0, 5.0),
    };
    (styles, rng.random_range(set_back_m), gap_m)
}

fn along_street(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let (styles, least_set_back, gap) = character(rng);
    let mut s = -CORNER_M;
    while s < side.length_m + CORNER_M {
        let kind = rng.random_range(0..100);
        let advanced = match kind {
            0..13 => parking_lot(site, side, s, rng),
            13..18 => green(site, side, s, rng),
            _ => {
                let style = styles[rng.random_range(0..styles.len())];
                let size = style.lot_m(rng);
                let set_back = least_set_back + rng.random_range(0.0..1.8);
                let mut end = building(site, side, s, size, set_back, style, rng);
                if end.is_none() {
                    // A small house where nothing else fits.
                    let (style, set_back) = (Style::House, 0.8 + set_back * 0.5);
                    end = building(site, side, s, [8.2, 8.0], set_back, style, rng);
                }
                end.map(|end| end + gap * rng.random_range(0.4..2.2))
            }
        };
        s = advanced.unwrap_or(s + 2.5);
    }
}

fn along_country_road(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(0.0..20.0);
    while s < side.length_m {
        let set_back = rng.random_range(4.0..14.0);
        let advanced = match rng.random_range(0..10) {
            0 => building(site, side, s, [14.0, 12.0], set_back, Style::House, rng),
            1 => {
                let set_back = set_back + 4.0;
                building(site, side, s, [26.0, 18.0], set_back, Style::Hall, rng)
            }
            2 => building(site, side, s, [16.0, 12.0], set_back, Style::Tanks, rng),
            3 => Some(fence(site, side, s, rng)),
            _ => {
                for _ in 0..rng.random_range(1..=3) {
                    let out = rng.random_range(2.5..12.0);
                    let pose = side.beyond_paved(site, s + rng.random_range(-4.0..4.0), out);
                    let species = Species::random(rng);
                    plant(site, pose, species, rng.random_range(0.7..1.3), rng);
                }
                None
            }
        };
        s = advanced.unwrap_or(s) + rng.random_range(5.0..16.0);
    }
}

/// The lot `width` x `depth` from `s` on, `set_back` behind the paved area, if it is free and level enough.
fn free_lot(site: &Site, side: &RoadSide, s: f64, size: [f64; 2], set_back: f64) -> Option<Lot> {
    let middle = s + size[0] / 2.0;
    // On a bend the front's middle and its ends lie at different distances; the free test settles it.
    let pose = side.beyond_paved(site, middle, set_back + size[1] / 2.0);
    let lot = lots::free_lot(site, side.with_road_right(pose), size, MAX_SLOPE_M, 0.4)?;
    let road = side.road_m(site, middle);
    ((lot.foot.z_m - road).abs() < 4.0).then_some(lot)
}

/// Places a building, with a garden in front and trees behind; returns the end of the lot along the street.
fn building(
    site: &mut Site,
    side: &RoadSide,
    s: f64,
    size: [f64; 2],
    set_back: f64,
    style: Style,
    rng: &mut ChaCha8Rng,
) -> Option<f64> {
    let lot = free_lot(site, side, s, size, set_back)?;
    lots::build_on(site, &lot, style, rng);
    front(site, &lot, set_back, rng);
    for _ in 0..rng.random_range(0..=2) {
        let u = rng.random_range(-0.5..0.5) * lot.width_m;
        let v = lot.depth_m / 2.0 + rng.random_range(2.0..8.0);
        let (pose, species) = (lot.foot.pose.moved(u, v, 0.0), Species::random(rng));
        plant(site, pose, species, rng.random_range(0.6..1.1), rng);
    }
    Some(s + size[0])
}

/// Boundary between a plot and the pavement: wall, fence, hedge, steps of bushes, or nothing.
fn front(site: &mut Site, lot: &Lot, set_back: f64, rng: &mut ChaCha8Rng) {
    if set_back < 1.6 {
        return;
    }
    let v = -lot.depth_m / 2.0 - set_back + 0.4;
    let (kind, thickness, height, reflectivity) = match rng.random_range(0..5) {
        0 => {
            let height = rng.random_range(0.5..2.0);
            (SolidKind::Wall, 0.25, height, rng.random_range(0.3..0.6))
        }
        1 => (SolidKind::Fence, 0.06, rng.random_range(0.8..1.6), 0.3),
        2 => (SolidKind::Hedge, 0.7, rng.random_range(0.7..1.9), 0.3),
        _ => {
            let bushes = rng.random_range(0..=3);
            for _ in 0..bushes {
                let u = rng.random_range(-0.45..0.45) * lot.width_m;
                let pose = lot.foot.pose.moved(u, v * rng.random_range(0.85..1.0), 0.0);
                plant(site, pose, Species::Bush, rng.random_range(0.7..1.2), rng);
            }
            return;
        }
    };
    // The gate.
    let gate = rng.random_range(0.15..0.75) * lot.width_m - lot.width_m / 2.0;
    for [from, to] in [[-lot.width_m / 2.0, gate], [gate + 2.6, lot.width_m / 2.0]] {
        if to - from > 0.8 {
            let foot = site.foot(lot.foot.pose.moved((from + to) / 2.0, v, 0.0));
            let size = [to - from, thickness, height + 0.4];
            site.try_place(&[foot.standing(kind, -0.4, size, reflectivity)], 0.05, true);
        }
    }
}

fn parking_lot(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) -> Option<f64> {
    let width = rng.random_range(14.0..30.0);
    let lot = free_lot(site, side, s, [width, lots::DEPTH_M], 0.3)?;
    let outline = lots::outline(&lot);
    let [low, high] = site.ground_range_m(&outline);
    if high - low > 0.6 {
        return None;
    }
    lots::fill(site, &lot, rng);
    site.take(&outline, [low - 0.5, low + 6.0]);
    Some(s + width + 1.0)
}

/// A small park: trees, benches, a monument.
fn green(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) -> Option<f64> {
    let (width, depth) = (rng.random_range(14.0..32.0), rng.random_range(12.0..22.0));
    let lot = free_lot(site, side, s, [width, depth], 1.0)?;
    for _ in 0..rng.random_range(3..=9) {
        let (pose, species) = (spot_on(&lot, rng), Species::random(rng));
        plant(site, pose, species, rng.random_range(0.7..1.4), rng);
    }
    for _ in 0..rng.random_range(1..=3) {
        let foot = site.foot(spot_on(&lot, rng));
        let bench = foot.standing(SolidKind::StreetFurniture, -0.1, [1.8, 0.6, 0.9], 0.4);
        site.try_place(&[bench], 0.1, true);
    }
    if rng.random_bool(0.4) {
        let monument = monument(site.foot(lot.foot.pose), rng);
        site.try_place(&monument, 0.2, true);
    }
    let low = lot.foot.z_m;
    site.take(&lots::outline(&lot), [low - 1.0, low + LOT_HEIGHT_M]);
    Some(s + width)
}

fn spot_on(lot: &Lot, rng: &mut ChaCha8Rng) -> Pose2 {
    let u = rng.random_range(-0.45..0.45) * lot.width_m;
    let v = rng.random_range(-0.42..0.42) * lot.depth_m;
    lot.foot.pose.moved(u, v, rng.random_range(0.0..TAU))
}

/// A monument, as a landmark.
pub(super) fn monument(foot: PartFootprint, rng: &mut ChaCha8Rng) -> Vec<Solid> {
    let base = rng.random_range(1.6..3.2);
    let kind = SolidKind::StreetFurniture;
    let mut parts = vec![foot.standing(kind, -0.3, [base, base, 1.0], 0.5)];
    match rng.random_range(0..3) {
        0 => parts.push(foot.post(kind, 0.7, [0.35, rng.random_range(3.0..7.0)], 0.5)),
        1 => {
            for step in 0..3 {
                let side = base * (0.7 - 0.2 * f64::from(step));
                let lift = 0.7 + 1.2 * f64::from(step);
                parts.push(foot.standing(kind, lift, [side, side, 1.2], 0.5));
            }
        }
        _ => {
            let radii_m = [0.8, 0.8, 1.4];
            parts.push(foot.solid(kind, Shape::Ellipsoid { radii_m }, [0.0, 0.0, 2.0], 0.5));
        }
    }
    parts
}

/// A fence along a field; returns its end.
fn fence(site: &mut Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) -> f64 {
    let (length, out) = (rng.random_range(15.0..45.0), rng.random_range(2.0..4.0));
    let height = rng.random_range(0.8..1.5);
    let hedge = rng.random_bool(0.4);
    let mut at = s;
    while at < (s + length).min(side.length_m) {
        let [a, b] = [at, at + 5.0].map(|s| side.beyond_paved(site, s, out));
        let [a, b] = [a, b].map(|pose| [pose.x, pose.y]);
        let ground = site.ground_m(a).min(site.ground_m(b));
        let z = [ground - 0.3, ground + height];
        let piece = match hedge {
            true => wall(SolidKind::Hedge, a, b, z, 0.8, 0.3),
            false => wall(SolidKind::Fence, a, b, z, 0.08, 0.3),
        };
        site.try_place(&[piece], 0.0, true);
        at += 5.0;
    }
    at
}
