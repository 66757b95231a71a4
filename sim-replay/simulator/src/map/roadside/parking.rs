//! Parking along the kerb.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::ParkingSpot;
use super::super::convex::PlanRectangle;
use super::super::road::LaneKind;
use super::frontage::{RoadSide, Zone, sides};
use super::site::Site;

/// Length and width of a spot, metres.
const SPOT_M: [f64; 2] = [6.2, 2.2];
/// Distance from the ends of a road that stays free, metres.
const CORNER_M: f64 = 6.0;

/// Spots in parking lanes; where a street has none, bays behind the pavement in groups.
pub(super) fn place_along_kerbs(site: &mut Site, rng: &mut ChaCha8Rng) {
    for side in sides(site.network) {
        if side.zone != Zone::Street || side.length_m < 2.0 * CORNER_M + SPOT_M[0] {
            continue;
        }
        let section = &site.network.roads[side.road].sections[0];
        let mut lanes = section.side(side.sign > 0.0).iter();
        if lanes.any(|lane| lane.kind == LaneKind::Parking) {
            in_lane(site, &side, rng);
        } else {
            in_bays(site, &side, rng);
        }
    }
}

fn in_lane(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = CORNER_M + rng.random_range(0.0..3.0);
    while s + SPOT_M[0] + CORNER_M < side.length_m {
        // Driveways and crossings interrupt the row.
        if rng.random_bool(0.12) {
            s += rng.random_range(4.0..9.0);
            continue;
        }
        let middle = s + SPOT_M[0] / 2.0;
        push_spot(site, side, middle, -SPOT_M[1] / 2.0);
        s += SPOT_M[0];
    }
}

fn in_bays(site: &mut Site, side: &RoadSide, rng: &mut ChaCha8Rng) {
    let mut s = CORNER_M + rng.random_range(0.0..20.0);
    while s + SPOT_M[0] + CORNER_M < side.length_m {
        for _ in 0..rng.random_range(3..=8) {
            let middle = s + SPOT_M[0] / 2.0;
            if middle + SPOT_M[0] / 2.0 + CORNER_M > side.length_m {
                break;
            }
            let out_m = side.pavement_m(site, middle) + SPOT_M[1] / 2.0 + 0.2;
            let pose = side.beyond_kerb(site, middle, out_m);
            let half_m = [SPOT_M[0] / 2.0, SPOT_M[1] / 2.0 + 0.1];
            let rectangle = PlanRectangle::around(pose, half_m);
            let road = side.road_m(site, middle);
            let [low, high] = site.ground_range_m(&rectangle);
            let z_m = [road - 0.5, road + 3.5];
            if high - low < 0.5 && (low - road).abs() < 0.6 && site.is_free(&rectangle, z_m, true) {
                site.take(&rectangle, z_m);
                push_spot(site, side, middle, out_m);
            }
            s += SPOT_M[0];
        }
        s += rng.random_range(8.0..40.0);
    }
}

/// A spot with its middle `out_m` beyond the kerb, in the direction of traffic on its side.
fn push_spot(site: &mut Site, side: &RoadSide, s_m: f64, out_m: f64) {
    let pose = side.beyond_kerb(site, s_m, out_m);
    // In a parking lane the spot lies on the road, which may be a deck.
    let (z, bank_rad) = match out_m < 0.0 {
        true => (
            side.road_m(site, s_m),
            site.cut_at(side.road, s_m).bank_rad(),
        ),
        false => (site.ground_m([pose.x, pose.y]), 0.0),
    };
    let (yaw_rad, roll_rad) = match side.along {
        true => (pose.heading_rad, bank_rad),
        false => (pose.reversed().heading_rad, -bank_rad),
    };
    site.parking.push(ParkingSpot {
        center_m: [pose.x, pose.y, z],
        yaw_rad,
        roll_rad,
        length_m: SPOT_M[0],
        width_m: SPOT_M[1],
    });
}
