//! Parking lots: bays in rows beside the street.

use std::f64::consts::FRAC_PI_2;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::convex::PlanRectangle;
use super::super::curve::Pose2;
use super::super::{ParkingSpot, SolidKind};
use super::buildings::{Lot, Style, build};
use super::parts::PartFootprint;
use super::site::Site;
use super::trees::{Species, tree};

/// Length and width of a bay, metres.
const BAY_M: [f64; 2] = [5.2, 2.6];
/// Width of the lane between two rows of bays, metres.
const AISLE_M: f64 = 6.4;
/// Height up to which a lot is kept free, metres.
pub(super) const LOT_HEIGHT_M: f64 = 40.0;
/// Depth of a lot with two rows, metres.
pub(super) const DEPTH_M: f64 = 2.0 * BAY_M[0] + AISLE_M + 1.4;

/// Fills `lot` (free ground of at least [`DEPTH_M`] depth) with two rows of bays, lamps or trees between them and a
/// wall at the back.
pub(super) fn fill(site: &mut Site, lot: &Lot, rng: &mut ChaCha8Rng) {
    let count = ((lot.width_m - 1.0) / BAY_M[1]).floor() as u32;
    let island = rng.random_range(2..=4.max(count / 2));
    for turn in [-1.0, 1.0] {
        let v = turn * (AISLE_M + BAY_M[0]) / 2.0;
        for bay in 0..count {
            let u = (f64::from(bay) + 0.5 - f64::from(count) / 2.0) * BAY_M[1];
            let pose = lot.foot.pose.moved(u, v, turn * FRAC_PI_2);
            if bay % island == island - 1 && rng.random_bool(0.6) {
                let foot = site.foot(pose);
                let parts = if rng.random_bool(0.6) {
                    tree(foot, Species::Broadleaf, rng.random_range(0.5..0.65), rng)
                } else {
                    vec![foot.post(SolidKind::Pole, -0.2, [0.1, 6.2], 0.6)]
                };
                site.place(&parts);
                continue;
            }
            // Some drivers park backwards.
            let is_backwards = rng.random_bool(0.3);
            let parked = if is_backwards { pose.reversed() } else { pose };
            site.parking.push(ParkingSpot {
                center_m: [pose.x, pose.y, site.ground_m([pose.x, pose.y])],
                yaw_rad: parked.heading_rad,
                roll_rad: 0.0,
                length_m: BAY_M[0],
                width_m: BAY_M[1],
            });
        }
    }
    let pose = lot.foot.pose.moved(0.0, lot.depth_m / 2.0 - 0.2, 0.0);
    let back = PartFootprint::new(pose, lot.foot.z_m);
    let height = rng.random_range(0.6..2.2);
    let size = [lot.width_m - 0.2, 0.25, height + 0.5];
    site.place(&[back.standing(SolidKind::Wall, -0.5, size, 0.4)]);
}

/// Outline of a lot.
pub(super) fn outline(lot: &Lot) -> PlanRectangle {
    PlanRectangle::around(lot.foot.pose, [lot.width_m / 2.0, lot.depth_m / 2.0])
}

/// A lot of this width and depth around a pose, if the terrain rises less than `slope_m` there and nothing stands
/// within `room_m` of it.
pub(super) fn free_lot(
    site: &Site,
    pose: Pose2,
    [width_m, depth_m]: [f64; 2],
    slope_m: f64,
    room_m: f64,
) -> Option<Lot> {
    let rectangle = PlanRectangle::around(pose, [width_m / 2.0, depth_m / 2.0]);
    let [low, high] = site.ground_range_m(&rectangle);
    let z_m = [low - 1.5, low + LOT_HEIGHT_M];
    let is_free = high - low < slope_m && site.is_free(&rectangle.grown(room_m), z_m, true);
    let foot = PartFootprint::new(pose, low);
    is_free.then_some(Lot {
        foot,
        width_m,
        depth_m,
    })
}

/// Places a building on a lot, which nothing else may enter.
pub(super) fn build_on(site: &mut Site, lot: &Lot, style: Style, rng: &mut ChaCha8Rng) {
    site.place(&build(style, lot, rng));
    let low = lot.foot.z_m;
    site.take(&outline(lot), [low - 1.5, low + LOT_HEIGHT_M]);
}
