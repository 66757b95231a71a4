//! A motorway in the shape of an eight that passes over itself, an interchange with an under-pass between two
//! roundabouts, a small town inside the ring, a works quarter outside it, and a tunnel: about 10 km of road.

use std::f64::consts::{FRAC_PI_2, PI};

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::profile::Profile;
use super::super::road::{LaneKind, RoadEnd, RoadStructure};
use super::builder::{Builder, path, section};
use super::grid::{GridPlan, grid, spread};
use super::motorway::{Motorway, RAMP_ZONE_M};
use super::ring::Ring;
use super::roundabout::Roundabout;
use super::{RoadLayout, streets};

/// Distance along the ring from the interchange's middle to where its ramps begin and end, metres.
const RAMP_FROM_MIDDLE_M: f64 = 235.0;
/// Distance of streets from the motorway's middle, metres.
const CLEARANCE_M: f64 = 62.0;
/// Least distance between parallel streets, metres.
const STREETS_M: f64 = 58.0;
/// Speed limits, metres per second: 30 mph in town, 35 mph on the road below the motorway.
const TOWN_LIMIT_MPS: f64 = 13.41;
const LINK_LIMIT_MPS: f64 = 15.65;

/// Lays out the map of a seed.
pub(crate) fn lay_out(seed: u64) -> RoadLayout {
    // Other random numbers than those of town1 for the same seed.
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x7465_776e_3474_6f77);
    let mut builder = Builder::default();
    let ring = Ring::random(&mut rng);
    let motorway = Motorway {
        ring,
        lanes: rng.random_range(3..=4),
        median_m: rng.random_range(1.6..3.2),
    };
    let [inside, outside] = roundabouts(&motorway, &mut rng);
    // The road below the motorway.
    let side = [
        (LaneKind::Driving, 3.5),
        (LaneKind::Shoulder, 0.8),
        (LaneKind::Sidewalk, 2.2),
    ];
    let curves = path(&[inside.port(0.0), outside.port(PI).reversed()]);
    let lanes = section(&side, &side);
    let link = builder.road(curves, Profile::default(), lanes, LINK_LIMIT_MPS);
    // Arms by rising angle: 0 is away from the town inside, and away from the ring outside.
    let ramps = interchange(&mut builder, &motorway, &inside, &outside, &mut rng);
    let map_model = map_model(&mut builder, &motorway, &inside, &mut rng);
    let works = works(&mut builder, &outside, &mut rng);
    let [[off_inside, on_inside], [off_outside, on_outside]] = ramps;
    let arms = [
        (0.0, RoadEnd::start(link)),
        (FRAC_PI_2, RoadEnd::end(off_inside)),
        (PI, map_model),
        (-FRAC_PI_2, RoadEnd::start(on_inside)),
    ];
    inside.join(&mut builder, &arms);
    let arms = [
        (0.0, works),
        (FRAC_PI_2, RoadEnd::start(on_outside)),
        (PI, RoadEnd::end(link)),
        (-FRAC_PI_2, RoadEnd::end(off_outside)),
    ];
    outside.join(&mut builder, &arms);
    let islands = vec![inside.island(), outside.island()];
    let network = builder.network;
    RoadLayout { network, islands }
}

/// One roundabout inside the ring's right-hand lobe and one outside, on a line across the motorway at its far end.
fn roundabouts(motorway: &Motorway, rng: &mut ChaCha8Rng) -> [Roundabout; 2] {
    let apex = motorway.ring.pose(motorway.ring.apex_m());
    [-1.0, 1.0].map(|side: f64| {
        let distance = rng.random_range(88.0..104.0);
        Roundabout {
            center_m: [apex.x + side * distance, apex.y],
            radius_m: rng.random_range(20.0..25.0),
        }
    })
}

/// Carriageways and ramps. Returns the ramps: off and on at the inner roundabout, off and on at the outer one.
fn interchange(
    builder: &mut Builder,
    motorway: &Motorway,
    inside: &Roundabout,
    outside: &Roundabout,
    rng: &mut ChaCha8Rng,
) -> [[usize; 2]; 2] {
    let (apex, around) = (motorway.ring.apex_m(), motorway.ring.length_m());
    // The tunnel lies in the other lobe, where nothing crosses.
    let tunnel = motorway.ring.far_apex_m() + rng.random_range(-160.0..100.0);
    let tunnel_end = tunnel + rng.random_range(45.0..75.0);
    [(1.0, inside), (-1.0, outside)].map(|(direction, roundabout): (f64, &Roundabout)| {
        let before = apex - direction * RAMP_FROM_MIDDLE_M;
        let after = apex + direction * RAMP_FROM_MIDDLE_M;
        let zone = direction * RAMP_ZONE_M;
        // Ring lengths of the tunnel as they follow on the way round.
        let (first, second) = if direction > 0.0 {
            (tunnel, tunnel_end)
        } else {
            (tunnel_end - around, tunnel - around)
        };
        let inner = motorway.carriageway(builder, before, after, direction);
        let stops = [after + zone, (after + zone + first) / 2.0, first, second];
        let [leaving, covered] = motorway.carriageways(builder, &stops, direction);
        let tunnel_road = &mut builder.network.roads[covered];
        tunnel_road.structures.push(RoadStructure {
            tunnel: true,
            s_m: 0.0,
            length_m: tunnel_road.length_m,
        });
        let back = before - zone + direction * around;
        let [rest, arriving] =
            motorway.carriageways(builder, &[second, (second + back) / 2.0, back], direction);
        builder.follow(covered, rest);
        // Inside, the ring leads down: traffic comes from above. Outside it comes from below.
        let from = roundabout.port(direction * FRAC_PI_2);
        let to = roundabout.port(-direction * FRAC_PI_2);
        let (start, end) = (
            motorway.ramp_end(before, direction, -1.0),
            motorway.ramp_end(after, direction, 1.0),
        );
        // Ports look away from their roundabouts, which lie level on the ground.
        let off = Motorway::ramp(builder, start, (from.reversed(), [0.0; 2]));
        let on = Motorway::ramp(builder, (to, [0.0; 2]), end);
        motorway.join(builder, arriving, inner, RoadEnd::start(off));
        motorway.join(builder, inner, leaving, RoadEnd::end(on));
        [off, on]
    })
}

/// The small town inside the ring; returns the street's end at the roundabout.
fn map_model(
    builder: &mut Builder,
    motorway: &Motorway,
    inside: &Roundabout,
    rng: &mut ChaCha8Rng,
) -> RoadEnd {
    let port = inside.port(PI);
    let east = port.x - rng.random_range(30.0..45.0);
    let west = motorway.ring.pose(0.0).x + rng.random_range(150.0..175.0);
    let columns = (((east - west) / STREETS_M) as usize + 1).clamp(2, 4);
    let columns_m = spread(west, east, columns, 0.12, rng);
    // As many rows as the shortest column has room for.
    let ranges = columns_m.iter().map(|&x| inside_lobe_m(motorway, x));
    let heights = ranges.map(|[low, high]| high - low);
    let rows = (heights.fold(f64::INFINITY, f64::min) / STREETS_M) as usize + 1;
    let plan = GridPlan {
        columns_m,
        rows: rows.clamp(3, 5),
        left_out: 0.12,
        jitter_m: 4.0,
    };
    let graph = grid(&plan, Some(port), rng, |x| inside_lobe_m(motorway, x));
    streets::lay_out(builder, &graph, TOWN_LIMIT_MPS, rng)[0]
}

/// Lowest and highest y at `x` inside the right-hand lobe, clear of the motorway.
fn inside_lobe_m(motorway: &Motorway, x: f64) -> [f64; 2] {
    let [low, high] = motorway.ring.lobe_m(x);
    [low + CLEARANCE_M, high - CLEARANCE_M]
}

/// The works quarter outside the ring; returns the street's end at the roundabout.
fn works(builder: &mut Builder, outside: &Roundabout, rng: &mut ChaCha8Rng) -> RoadEnd {
    let port = outside.port(0.0);
    let west = port.x + rng.random_range(35.0..50.0);
    let width = rng.random_range(120.0..180.0);
    let height = rng.random_range(150.0..210.0);
    let plan = GridPlan {
        columns_m: vec![west, west + width],
        rows: 3,
        left_out: 0.14,
        jitter_m: 5.0,
    };
    let (y, shear) = (port.y, rng.random_range(-0.15..0.15));
    let graph = grid(&plan, Some(port), rng, |x| {
        [y - height / 2.0, y + height / 2.0].map(|y| y + shear * (x - west))
    });
    streets::lay_out(builder, &graph, TOWN_LIMIT_MPS, rng)[0]
}
