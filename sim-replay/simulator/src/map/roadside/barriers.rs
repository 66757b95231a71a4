//! Crash barriers along motorways and country roads, and between carriageways.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::curve::Pose2;
use super::super::lane::wrap_angle;
use super::super::road::{LaneKind, Road};
use super::super::surface::CrossSection;
use super::super::{Solid, SolidKind};
use super::frontage::{RoadSide, Zone, sides};
use super::parts::{PartFootprint, wall};
use super::site::Site;

/// Longest straight piece, metres.
const PIECE_M: f64 = 12.0;
/// A piece ends where the road has turned by this much, radians.
const PIECE_TURN_RAD: f64 = 0.025;
/// Distance between the posts of a steel rail, metres.
const POST_M: f64 = 4.0;

/// Kinds of barriers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum BarrierKind {
    /// A rail on posts.
    Steel,
    /// A low wall.
    Concrete,
}

/// Places barriers along all fast roads.
pub(super) fn place(site: &mut Site, rng: &mut ChaCha8Rng) {
    for side in sides(site.network) {
        let (share, barrier) = match side.zone {
            Zone::Street => continue,
            Zone::Motorway if side.median && rng.random_bool(0.5) => (1.0, BarrierKind::Concrete),
            Zone::Motorway if side.median => (1.0, BarrierKind::Steel),
            Zone::Motorway => (0.9, BarrierKind::Steel),
            Zone::Rural => (0.55, BarrierKind::Steel),
        };
        along_side(site, &side, share, barrier, rng);
    }
    for road in 0..site.network.roads.len() {
        between_directions(site, road);
    }
}

fn along_side(
    site: &mut Site,
    side: &RoadSide,
    share: f64,
    barrier: BarrierKind,
    rng: &mut ChaCha8Rng,
) {
    let mut s = 0.0;
    while s < side.length_m - 1.0 {
        let stretch = rng.random_range(40.0..160.0f64);
        let end = (s + stretch).min(side.length_m);
        if rng.random_bool(share) {
            let road = &site.network.roads[side.road];
            for stop in pieces(s, end, |s| road.pose_at(s).heading_rad) {
                let [from, to] = stop.map(|s| {
                    let pose = side.beyond_kerb(site, s, 0.45);
                    [pose.x, pose.y, side.road_m(site, s)]
                });
                site.try_place(&piece(from, to, barrier), 0.0, false);
            }
        }
        s = end;
    }
}

/// The strip between left and right driving lanes of a road with both directions.
fn between_directions(site: &mut Site, road: usize) {
    let network = site.network;
    let cuts = &site.surface.roads[road];
    let mut parts: Vec<Solid> = Vec::new();
    for pair in cuts.chunks(4) {
        // One piece from each fourth cut to the next.
        let Some(last) = pair.last() else { continue };
        let next = cuts.iter().find(|cut| cut.s_m > last.s_m).unwrap_or(last);
        let ends = [&pair[0], next].map(|cut| strip_middle(&network.roads[road], cut));
        if let [Some(from), Some(to)] = ends
            && (to[0] - from[0]).hypot(to[1] - from[1]) > 0.5
        {
            parts.extend(piece(from, to, BarrierKind::Concrete));
        }
    }
    // Inside a junction only where no lane leads across.
    parts.retain(|part| {
        let ([a, b], outline) = (part.z_m(), part.outline());
        network.roads[road].junction.is_none()
            && !site.surface.any(&outline, |patch| {
                let [low, high] = patch.range_m();
                let is_crossed = patch.road as usize != road && patch.carriageway;
                is_crossed && a < high + 4.5 && b > low - 0.05
            })
    });
    site.place(&parts);
}

/// The middle between left and right driving lanes at a cut, if they are more than a metre apart.
fn strip_middle(road: &Road, cut: &CrossSection) -> Option<[f64; 3]> {
    let section = &road.sections[cut.section];
    let [left, right] = [&section.left, &section.right].map(|side| {
        let mut lanes = (1i32..).zip(side);
        lanes.find(|(_, lane)| lane.kind == LaneKind::Driving)
    });
    let ((left, _), (right, _)) = (left?, right?);
    let before_end_m = road.section_end_m(cut.section) - 1e-6;
    let s = cut.s_m.min(before_end_m).max(section.s_m);
    let low = road.lane_span_m(cut.section, -right, s)[1];
    let high = road.lane_span_m(cut.section, left, s)[0];
    (high - low > 1.0).then(|| {
        let middle_m = (low + high) / 2.0;
        let [x, y] = cut.at(middle_m);
        [x, y, cut.height_m(middle_m)]
    })
}

/// Splits a stretch into nearly straight pieces.
fn pieces(from: f64, to: f64, heading_rad: impl Fn(f64) -> f64) -> Vec<[f64; 2]> {
    let mut pieces = Vec::new();
    let mut start = from;
    while start < to - 0.2 {
        let mut end = (start + 2.0).min(to);
        while end < to
            && end - start < PIECE_M
            && wrap_angle(heading_rad(end) - heading_rad(start)).abs() < PIECE_TURN_RAD
        {
            end = (end + 1.0).min(to);
        }
        pieces.push([start, end]);
        start = end;
    }
    pieces
}

fn piece(from: [f64; 3], to: [f64; 3], barrier: BarrierKind) -> Vec<Solid> {
    let (a, b) = ([from[0], from[1]], [to[0], to[1]]);
    let z = from[2].min(to[2]);
    let rise = (to[2] - from[2]).abs();
    let kind = SolidKind::Barrier;
    if barrier == BarrierKind::Concrete {
        return vec![wall(kind, a, b, [z - 0.2, z + rise + 0.85], 0.4, 0.5)];
    }
    let mut parts = vec![wall(kind, a, b, [z + 0.42, z + rise + 0.76], 0.1, 0.6)];
    let length = (b[0] - a[0]).hypot(b[1] - a[1]);
    for post in 0..=(length / POST_M).floor() as u32 {
        let share = f64::from(post) * POST_M / length.max(0.1);
        let [x, y, z] = [0, 1, 2].map(|axis| from[axis] + share * (to[axis] - from[axis]));
        let pose = Pose2::new(x, y, (b[1] - a[1]).atan2(b[0] - a[0]));
        let foot = PartFootprint::new(pose, z);
        parts.push(foot.standing(kind, -0.3, [0.1, 0.14, 1.02], 0.5));
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_follow_each_other_and_are_short_in_bends() {
        let straight = pieces(0.0, 50.0, |_| 1.0);
        let bend = pieces(0.0, 50.0, |s| s / 40.0);
        assert!(straight.len() < bend.len());
        for pieces in [straight, bend] {
            assert!(pieces.windows(2).all(|pair| pair[0][1] == pair[1][0]));
            assert_eq!((pieces[0][0], pieces[pieces.len() - 1][1]), (0.0, 50.0));
        }
    }
}
