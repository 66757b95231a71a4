//! Lamp posts, traffic lights, signs and the small things on pavements.

use std::ops::Range;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::curve::Pose2;
use super::super::road::RoadLink;
use super::super::{Solid, SolidKind};
use super::frontage::{RoadSide, Zone, sides};
use super::parts::PartFootprint;
use super::site::Site;

/// Radius of ordinary posts, metres.
const POST_M: f64 = 0.08;

/// Places every object on a post: first those in the map, then procedural ones.
pub(super) fn place(site: &mut Site, rng: &mut ChaCha8Rng) {
    let recorded_lights = place_recorded(site, rng);
    for side in sides(site.network) {
        if !recorded_lights && side.zone == Zone::Street {
            traffic_light(site, &side, rng);
        }
        match side.zone {
            Zone::Street => {
                lamps(site, &side, 24.0..36.0, 5.5..8.5, rng);
                small_things(site, &side, rng);
                signs(site, &side, 30.0..90.0, rng);
            }
            Zone::Rural => signs(site, &side, 50.0..140.0, rng),
            // Lit stretches and dark ones.
            Zone::Motorway if rng.random_bool(0.5) => {
                lamps(site, &side, 38.0..55.0, 9.0..13.0, rng)
            }
            Zone::Motorway => {}
        }
    }
}

/// Signals and signs of the map; returns true if it has traffic lights.
fn place_recorded(site: &mut Site, rng: &mut ChaCha8Rng) -> bool {
    let mut lights = false;
    for index in 0..site.network.roads.len() {
        let road = &site.network.roads[index];
        let signs = road.objects.iter().filter(|one| is_sign(&one.label));
        for one in road.signals.iter().chain(signs) {
            lights |= one.dynamic;
            let [aside_m, _] = road.aside_m(road.section_at(one.s_m), one.s_m, one.t_m);
            let pose = road.pose_at(one.s_m);
            let foot = site.foot(pose.moved(0.0, aside_m, one.heading_rad));
            let parts = match one.dynamic {
                true => light(foot),
                false => sign(foot, rng),
            };
            beside_carriageway(site, &parts, one.t_m);
        }
    }
    lights
}

/// Places parts, or the same a little farther out where the map has them on the carriageway.
fn beside_carriageway(site: &mut Site, parts: &[Solid], t_m: f64) {
    for shift in [0.0, 0.4, 0.8, 1.4, 2.2, 3.0] {
        let mut moved = parts.to_vec();
        for part in &mut moved {
            // Their own y axis points across the road.
            let [x, y, z] = part.center_m;
            let pose = Pose2::new(x, y, part.yaw_rad).moved(0.0, shift * t_m.signum(), 0.0);
            part.center_m = [pose.x, pose.y, z];
        }
        if site.try_place(&moved, 0.05, false) {
            return;
        }
    }
}

/// False for markings that the map paints on the road.
fn is_sign(label: &str) -> bool {
    let label = label.to_ascii_lowercase();
    let painted = ["stencil", "line", "crosswalk", "solid", "dashed", "arrow"];
    (label.contains("speed") || label.contains("sign") || label.contains("stop"))
        && !painted.iter().any(|word| label.contains(word))
}

fn light(foot: PartFootprint) -> Vec<Solid> {
    vec![
        foot.post(SolidKind::Pole, -0.2, [0.1, 4.2], 0.5),
        foot.cuboid(SolidKind::Sign, [-0.2, 0.0, 2.9], [0.25, 0.45, 1.2], 0.6),
    ]
}

/// A post with a plate; plates reflect strongly.
fn sign(foot: PartFootprint, rng: &mut ChaCha8Rng) -> Vec<Solid> {
    let height = rng.random_range(2.0..2.6);
    let [width, tall] = match rng.random_range(0..4) {
        0 => [0.6, 0.6],
        1 => [0.75, 0.65],
        2 => [0.6, 1.3],
        _ => [rng.random_range(0.9..1.8), rng.random_range(0.4..0.9)],
    };
    let post = [0.04, height + tall + 0.2];
    vec![
        foot.cylinder(SolidKind::Pole, [0.06, 0.0, -0.2], post, 0.5),
        foot.standing(SolidKind::Sign, height, [0.04, width, tall], 0.95),
    ]
}

fn lamps(
    site: &mut Site,
    side: &RoadSide,
    rhythm_m: Range<f64>,
    height_m: Range<f64>,
    rng: &mut ChaCha8Rng,
) {
    // Lamps stand on one side of a street or the other, or alternate.
    let (rhythm, height) = (rng.random_range(rhythm_m), rng.random_range(height_m));
    if rng.random_bool(0.25) {
        return;
    }
    let mut s = rng.random_range(2.0..rhythm);
    while s < side.length_m - 1.0 {
        let out = if side.zone == Zone::Street { 0.45 } else { 1.3 };
        // The arm points over the road.
        let foot = site.foot(side.facing(side.beyond_kerb(site, s, out)));
        let arm = height * 0.2;
        let (kind, post) = (SolidKind::Pole, [POST_M + height * 0.006, height + 0.2]);
        let parts = [
            foot.post(kind, -0.2, post, 0.5),
            foot.cuboid(kind, [arm / 2.0, 0.0, height - 0.1], [arm, 0.1, 0.1], 0.5),
            foot.cuboid(kind, [arm, 0.0, height - 0.15], [0.7, 0.3, 0.15], 0.5),
        ];
        site.try_place(&parts, 0.05, false);
        s += rhythm * rng.random_range(0.9..1.1);
    }
}

/// A traffic light where this side's traffic enters a junction, for most junctions.
fn traffic_light(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let road = &site.network.roads[side.road];
    let (link, s) = if side.along {
        (road.successor, side.length_m - 0.6)
    } else {
        (road.predecessor, 0.6)
    };
    let Some(RoadLink::Junction(junction)) = link else {
        return;
    };
    // The same result for every road of the junction.
    let lit =
        !(junction * 7 + site.network.junctions[junction].connections.len()).is_multiple_of(3);
    if !lit || !side.is_near(site.network) {
        return;
    }
    let pose = side.beyond_kerb(site, s, 0.4);
    let foot = site.foot(if side.along { pose } else { pose.reversed() });
    let mut parts = light(foot);
    // Some carry a second head over the lane.
    if rng.random_bool(0.3) {
        parts[0] = foot.post(SolidKind::Pole, -0.2, [0.12, 6.6], 0.5);
        let over = if road.left_hand { -1.0 } else { 1.0 };
        let (arm, head) = ([0.0, over * 1.7, 6.0], [-0.2, over * 3.0, 5.2]);
        parts.push(foot.cuboid(SolidKind::Pole, arm, [0.12, 3.2, 0.12], 0.5));
        parts.push(foot.cuboid(SolidKind::Sign, head, [0.25, 0.45, 1.2], 0.6));
    }
    site.try_place(&parts, 0.02, false);
}

fn signs(site: &mut Site, side: &RoadSide, distance_m: Range<f64>, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(3.0..distance_m.end);
    while s < side.length_m - 2.0 {
        let is_street = side.zone == Zone::Street;
        let out = if is_street { 0.5..0.9 } else { 0.8..1.6 };
        let pose = side.beyond_kerb(site, s, rng.random_range(out));
        let foot = site.foot(if side.along { pose } else { pose.reversed() });
        site.try_place(&sign(foot, rng), 0.05, false);
        s += rng.random_range(distance_m.clone());
    }
}

/// Bins, hydrants, cabinets, bollards, benches, shelters and kiosks.
fn small_things(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = rng.random_range(3.0..20.0);
    while s < side.length_m - 3.0 {
        let pavement = side.pavement_m(site, s);
        let (at_back, is_at_kerb) = ((pavement - 0.4).max(0.6), rng.random_bool(0.5));
        let out = if is_at_kerb { 0.6 } else { at_back };
        let foot = site.foot(side.facing(side.beyond_kerb(site, s, out)));
        let kind = SolidKind::StreetFurniture;
        let parts = match rng.random_range(0..12) {
            0..=2 => vec![foot.post(kind, -0.1, [0.25, 1.0], 0.4)],
            3..=4 => vec![foot.post(kind, -0.1, [0.12, 0.85], 0.7)],
            5..=6 => vec![foot.standing(kind, -0.1, [0.45, 1.1, 1.4], 0.5)],
            7..=8 => vec![foot.standing(kind, -0.1, [0.6, 1.8, 0.95], 0.4)],
            9 => [0.0, 1.0, 2.0, 3.0]
                .map(|i| foot.cylinder(SolidKind::Pole, [0.0, 1.4 * i, -0.1], [0.07, 1.0], 0.5))
                .to_vec(),
            10 => shelter(site, side, s, rng),
            _ => kiosk(site, side, s, pavement, rng),
        };
        site.try_place(&parts, 0.05, false);
        s += rng.random_range(8.0..26.0);
    }
}

/// A bus shelter: back, one side and roof.
fn shelter(site: &Site, side: &RoadSide, s: f64, rng: &mut ChaCha8Rng) -> Vec<Solid> {
    let cut = site.cut_at(side.road, s);
    let depth = side.pavement_m(site, cut.s_m).clamp(1.2, 1.7);
    let foot = site.foot(side.facing(side.beyond_kerb(site, s, 0.5 + depth / 2.0)));
    let length = rng.random_range(3.0..4.6);
    let kind = SolidKind::StreetFurniture;
    let back = [-depth / 2.0 + 0.05, 0.0, -0.1];
    let end = [0.0, length / 2.0 - 0.05, -0.1];
    let bench = [-depth / 2.0 + 0.35, 0.0, -0.1];
    vec![
        foot.cuboid(kind, back, [0.08, length, 2.5], 0.3),
        foot.cuboid(kind, end, [depth, 0.08, 2.5], 0.3),
        foot.standing(kind, 2.4, [depth, length, 0.15], 0.4),
        foot.cuboid(kind, bench, [0.4, length * 0.7, 0.6], 0.4),
    ]
}

fn kiosk(site: &Site, side: &RoadSide, s: f64, pavement: f64, rng: &mut ChaCha8Rng) -> Vec<Solid> {
    let foot = site.foot(side.facing(side.beyond_kerb(site, s, pavement + 1.3)));
    let kind = SolidKind::StreetFurniture;
    let width = rng.random_range(2.2..3.6);
    vec![
        foot.standing(kind, -0.3, [2.0, width, 2.8], 0.5),
        foot.cuboid(kind, [0.2, 0.0, 2.5], [2.5, width + 0.4, 0.2], 0.5),
    ]
}
