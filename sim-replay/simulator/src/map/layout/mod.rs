//! Procedural road networks: the same structures that a map gives, laid out from a seed.

mod builder;
mod grid;
mod motorway;
mod ring;
mod roundabout;
mod streets;
mod town1;
mod town4;

use super::road::RoadNetwork;

pub(super) use town1::lay_out as town1;
pub(super) use town4::lay_out as town4;

/// A road network with the parts of its shape that belong to no road.
pub(super) struct RoadLayout {
    /// Roads and junctions.
    pub network: RoadNetwork,
    /// Middles of roundabouts: x, y and the radius free of traffic, metres.
    pub islands: Vec<[f64; 3]>,
}

#[cfg(test)]
mod tests;
