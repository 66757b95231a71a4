//! Parking lots: bays in rows beside the street.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::convex::Rectangle;
use super::super::{ParkingSpot, SolidKind};
use super::buildings::Lot;
use super::parts::PartFootprint;
use super::site::Site;
use super::trees::{Species, tree};

/// Length and width of a bay, metres.
const BAY_M: [f64; 2] = [5.2, 2.6];
/// Width of the lane between two rows of bays, metres.
const AISLE_M: f64 = 6.4;
/// Depth of a lot with two rows, metres.
pub(super) const DEPTH_M: f64 = 2.0 * BAY_M[0] + AISLE_M + 1.4;

/// Fills `lot` (free ground of at least [`DEPTH_M`] depth) with two rows of bays, lamps or trees between them and a
/// wall at the back.
pub(super) fn fill(site: &mut Site, lot: &Lot, rng: &mut ChaCha8Rng) {
    let count = ((lot.width_m - 1.0) / BAY_M[1]).floor() as u32;
    let island = rng.random_range(2..=4.max(count / 2));
    for (v, turn) in [
        (-(AISLE_M + BAY_M[0]) / 2.0, -1.0),
        ((AISLE_M + BAY_M[0]) / 2.0, 1.0),
    ] {
        for bay in 0..count {
            let u = (f64::from(bay) + 0.5 - f64::from(count) / 2.0) * BAY_M[1];
            let pose = lot
                .foot
                .pose
                .moved(u, v, turn * std::f64::consts::FRAC_PI_2);
            if bay % island == island - 1 && rng.random_bool(0.6) {
                let foot = PartFootprint::new(pose, site.ground_m([pose.x, pose.y]));
                let parts = if rng.random_bool(0.6) {
                    tree(foot, Species::Broadleaf, rng.random_range(0.5..0.65), rng)
                } else {
                    vec![foot.cylinder(SolidKind::Pole, [0.0, 0.0, -0.2], [0.1, 6.2], 0.6)]
                };
                site.place(&parts);
                continue;
            }
            let center_m = site.on_ground(pose);
            // Some drivers park backwards.
            let yaw_rad = if rng.random_bool(0.3) {
                pose.reversed().heading_rad
            } else {
                pose.heading_rad
            };
            site.parking.push(ParkingSpot {
                center_m,
                yaw_rad,
                roll_rad: 0.0,
                length_m: BAY_M[0],
                width_m: BAY_M[1],
            });
        }
    }
    let back = PartFootprint::new(
        lot.foot.pose.moved(0.0, lot.depth_m / 2.0 - 0.2, 0.0),
        lot.foot.z_m,
    );
    let height = rng.random_range(0.6..2.2);
    let wall = back.cuboid(
        SolidKind::Wall,
        [0.0, 0.0, -0.5],
        [lot.width_m - 0.2, 0.25, height + 0.5],
        0.4,
    );
    site.place(&[wall]);
}

/// Outline of a lot.
pub(super) fn outline(lot: &Lot) -> Rectangle {
    let pose = lot.foot.pose;
    Rectangle {
        center_m: [pose.x, pose.y],
        half_m: [lot.width_m / 2.0, lot.depth_m / 2.0],
        yaw_rad: pose.heading_rad,
    }
}
