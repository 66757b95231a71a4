//! Under and beside roads that do not lie on the ground: slabs, parapets, pillars, retaining walls, tunnels.

use super::super::convex::PlanRectangle;
use super::super::curve::Pose2;

use super::super::road::RoadStructure;
use super::super::surface::CrossSection;
use super::super::{Solid, SolidKind, Terrain};

use super::parts::wall;
use super::site::{HEADROOM_M, Site};

/// A road this far above the terrain stands on a bridge, metres.
const BRIDGE_M: f64 = 1.2;
/// Slab thickness, metres.
const SLAB_M: [f64; 2] = [0.25, 0.8];
/// Distance between rows of pillars, metres.
const PILLARS_M: f64 = 14.0;
/// Distance from the edge of a road at which the height of its surroundings is taken, metres; the terrain follows the
/// road to about two cells beyond its edge.
const BESIDE_M: f64 = 4.5;
/// Surroundings higher than this are held by a wall, metres.
const RETAINED_M: f64 = 0.9;
/// Clear height inside a tunnel, metres.
const TUNNEL_M: f64 = 5.2;

/// Places the structures of all roads.
pub(super) fn place(site: &mut Site) {
    let flat = matches!(site.ground.terrain, Terrain::Plane { .. });
    for road in 0..site.surface.roads.len() {
        let structures = site.network.roads[road].structures.iter();
        for RoadStructure { s_m, length_m, .. } in structures.filter(|one| one.tunnel) {
            tunnel(site, road, *s_m, s_m + length_m);
        }
        if !flat {
            bridge(site, road);
            retaining_walls(site, road);
        }
    }
}

/// Height of the road over the lowest terrain under a cut, metres.
fn drop_m(site: &Site, cut: &CrossSection) -> f64 {
    let [low, high] = cut.paved_m;
    let quarter = 0.25 * (high - low);
    let places = [low, low + quarter, (low + high) / 2.0, high - quarter, high];
    let drops_m = places.map(|t| cut.height_m(t) - site.ground_m(cut.at(t)));
    drops_m.into_iter().fold(0.0, f64::max)
}

fn bridge(site: &mut Site, road: usize) {
    let cuts = site.surface.roads[road].clone();
    let drops: Vec<f64> = cuts.iter().map(|cut| drop_m(site, cut)).collect();
    let mut since_pillars = PILLARS_M / 2.0;
    for i in 1..cuts.len() {
        let (from, to) = (&cuts[i - 1], &cuts[i]);
        let length = to.s_m - from.s_m;
        let drop = drops[i - 1].min(drops[i]);
        if drop < BRIDGE_M || length < 0.1 {
            since_pillars = PILLARS_M / 2.0;
            continue;
        }
        let thickness = (drop - HEADROOM_M - 0.05).clamp(SLAB_M[0], SLAB_M[1]);
        let thickness = thickness.min(drop * 0.4);
        // Below the lowest edge, so that the slab does not stick out of the road.
        let top = from.range_m()[0].min(to.range_m()[0]) - 0.06;
        site.place(&[slab(from, to, [top - thickness, top], 0.3)]);
        parapet(site, road, from, to);
        since_pillars += length;
        if since_pillars >= PILLARS_M && drop > 3.0 {
            since_pillars = 0.0;
            pillars(site, to, thickness);
        }
    }
}

/// A slab over the paved width of both cuts and `beyond_m` more.
fn slab(from: &CrossSection, to: &CrossSection, z_m: [f64; 2], beyond_m: f64) -> Solid {
    let [a, b] = [from, to].map(|cut| cut.at((cut.paved_m[0] + cut.paved_m[1]) / 2.0));
    let width = (from.paved_m[1] - from.paved_m[0]).max(to.paved_m[1] - to.paved_m[0]);
    wall(SolidKind::BridgeDeck, a, b, z_m, width + beyond_m, 0.35)
}

/// Low walls at both edges, where no other lane of the same height joins.
fn parapet(site: &mut Site, road: usize, from: &CrossSection, to: &CrossSection) {
    for (side, out) in [(0, -0.2), (1, 0.2)] {
        let [a, b] = [from, to].map(|cut| cut.at(cut.paved_m[side] + out));
        let edges = [from, to].map(|cut| cut.height_m(cut.paved_m[side]));
        let z = [edges[0].min(edges[1]) - 0.3, edges[0].max(edges[1]) + 1.0];
        let part = wall(SolidKind::Barrier, a, b, z, 0.25, 0.45);
        let joined = site.surface.any(&part.outline(), |patch| {
            let own = patch.road as usize == road && !patch.carriageway;
            let [low, high] = patch.range_m();
            !own && z[0] < high + HEADROOM_M && z[1] > low - 0.05
        });
        if !joined {
            site.place(&[part]);
        }
    }
}

fn pillars(site: &mut Site, cut: &CrossSection, thickness_m: f64) {
    let [low, high] = cut.paved_m;
    let count = if high - low > 9.0 { 3 } else { 2 };
    for place in 0..count {
        let t = low + (high - low) * (f64::from(place) + 0.5) / f64::from(count);
        let [x, y] = cut.at(t);
        let foot = site.foot(Pose2::new(x, y, cut.pose.heading_rad));
        let height = cut.range_m()[0] - thickness_m - 0.1 - foot.z_m;
        if height < 2.0 {
            continue;
        }
        let pillar = foot.post(SolidKind::Pillar, -0.5, [0.55, height + 0.5], 0.4);
        // Clear of the lanes below; its own slab above does not count.
        let [bottom, top] = pillar.z_m();
        place_clear(site, pillar, [bottom, top - 0.2], 0.5);
    }
}

/// Places a part, if it keeps clear of every road between two heights, with `margin_m` around.
fn place_clear(site: &mut Site, part: Solid, z_m: [f64; 2], margin_m: f64) {
    let around = part.outline().grown(margin_m);
    if site.surface.is_clear(&around, z_m, HEADROOM_M, true) {
        site.place(&[part]);
    }
}

/// Walls along roads that lie lower than their surroundings.
fn retaining_walls(site: &mut Site, road: usize) {
    let cuts = site.surface.roads[road].clone();
    for pair in cuts.windows(2) {
        let (from, to) = (&pair[0], &pair[1]);
        if to.s_m - from.s_m < 0.1 {
            continue;
        }
        for (side, sign) in [(0, -1.0), (1, 1.0)] {
            let beside =
                [from, to].map(|cut| site.ground_m(cut.at(cut.paved_m[side] + sign * BESIDE_M)));
            let high = beside[0].max(beside[1]);
            let [from_z, to_z] = [from, to].map(|cut| cut.height_m(cut.paved_m[side]));
            let road_z = from_z.min(to_z);
            if beside[0].min(beside[1]) - road_z < RETAINED_M {
                continue;
            }
            let [a, b] = [from, to].map(|cut| cut.at(cut.paved_m[side] + sign * 0.5));
            let [x, y] = [0, 1].map(|axis| (a[axis] + b[axis]) / 2.0);
            let middle = Pose2::new(x, y, from.pose.heading_rad);
            let around = PlanRectangle::around(middle, [1.0, 1.0]);
            let mut above = f64::INFINITY;
            site.surface.any(&around, |patch| {
                let [z, _] = patch.range_m();
                if z > road_z + 3.0 {
                    above = above.min(z);
                }
                // False goes on to the next patch: all of them are visited.
                false
            });
            let kind = match above.is_finite() {
                true => SolidKind::TunnelWall,
                false => SolidKind::Wall,
            };
            let z = [road_z - 0.4, (high + 0.4).min(above - 0.9)];
            site.try_place(&[wall(kind, a, b, z, 0.3, 0.4)], 0.0, false);
        }
    }
}

/// Walls and roof over a stretch of road.
fn tunnel(site: &mut Site, road: usize, from_m: f64, to_m: f64) {
    const PIECE_M: f64 = 4.0;
    let end = to_m.min(site.network.roads[road].length_m);
    let mut s = from_m;
    while s + 1.0 < end {
        let next = (s + PIECE_M).min(end);
        let [a, b] = [s, next].map(|s| site.cut_at(road, s));
        let ([low_a, high_a], [low_b, high_b]) = (a.range_m(), b.range_m());
        let z = [low_a.min(low_b), high_a.max(high_b)];
        for (side, out) in [(0, -0.45), (1, 0.45)] {
            let [p, q] = [a, b].map(|cut| cut.at(cut.paved_m[side] + out));
            let height = [z[0] - 0.3, z[1] + TUNNEL_M];
            let part = wall(SolidKind::TunnelWall, p, q, height, 0.4, 0.4);
            place_clear(site, part, [z[0], z[1] + 1.0], 0.0);
        }
        let height = [z[1] + TUNNEL_M, z[1] + TUNNEL_M + 0.8];
        let roof = slab(a, b, height, 1.3);
        place_clear(site, roof, roof.z_m(), 0.0);
        s = next;
    }
}
