//! Roadside objects: placed along the frontage of any road network.
//!
//! Every group of objects has its own random stream, so that a change to one leaves the others unchanged.

mod barriers;
mod bridges;
mod buildings;
mod frontage;
mod infill;
mod lots;
mod motorway;
mod parking;
mod parts;
mod plots;
mod poles;
mod site;
mod trees;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::ground::Ground;
use super::layout::RoadLayout;
use super::surface::RoadSurface;
use super::{ParkingSpot, Solid};
use site::Site;

/// Solids and parking spots of the map of a seed.
pub(super) fn place_roadside(
    layout: &RoadLayout,
    surface: &RoadSurface,
    ground: &Ground,
    seed: u64,
) -> (Vec<Solid>, Vec<ParkingSpot>) {
    let mut site = Site::new(&layout.network, surface, ground);
    bridges::place(&mut site);
    infill::place_islands(&mut site, &layout.islands, &mut stream(seed, 7));
    barriers::place(&mut site, &mut stream(seed, 1));
    parking::place_along_kerbs(&mut site, &mut stream(seed, 2));
    poles::place(&mut site, &mut stream(seed, 3));
    motorway::place(&mut site, &mut stream(seed, 4));
    trees::place_along_streets(&mut site, &mut stream(seed, 5));
    plots::place(&mut site, &mut stream(seed, 6));
    infill::place(&mut site, &mut stream(seed, 8));
    (site.solids, site.parking)
}

fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(number);
    rng
}

#[cfg(test)]
mod tests;
