//! Junction reservations: a lane is held by the vehicles that use it, and closed while a conflicting lane is held.

use super::car::Car;
use super::roads::Roads;
use crate::map::LaneId;

/// Vehicles that hold junction lanes, by lane.
#[derive(Debug, Default)]
pub(crate) struct RightOfWay {
    holders: Vec<Vec<u32>>,
}

impl RightOfWay {
    pub(crate) fn new(lanes: usize) -> Self {
        Self {
            holders: vec![Vec::new(); lanes],
        }
    }

    /// Reserves a lane for a vehicle, unless another one holds a conflicting lane.
    pub(crate) fn take(
        &mut self,
        index: u32,
        car: &mut Car,
        lane: LaneId,
        roads: &Roads<'_>,
    ) -> bool {
        if car.held.contains(&lane) {
            return true;
        }
        if roads.graph.lane(lane).conflicts.iter().any(|other| {
            let mut holders = self.holders[other.0 as usize].iter();
            // A vehicle that holds several lanes does not block itself.
            holders.any(|&holder| holder != index)
        }) {
            return false;
        }
        self.holders[lane.0 as usize].push(index);
        car.held.push(lane);
        true
    }

    /// Releases the lanes that a vehicle has left completely.
    pub(crate) fn release_behind(&mut self, index: u32, car: &mut Car, roads: &Roads<'_>) {
        if car.held.is_empty() {
            return;
        }
        let mut needed: Vec<LaneId> = Vec::new();
        if car.is_present {
            // The rear may still be on a lane that the front has left.
            needed.extend(car.path.lanes_under(roads.graph, car.half_length_m() + 0.5));
            needed.extend(car.path.ahead(roads.graph).map(|(lane, _)| lane));
        }
        let holders = &mut self.holders;
        car.held.retain(|lane| {
            let is_needed = needed.contains(lane);
            if !is_needed {
                holders[lane.0 as usize].retain(|&holder| holder != index);
            }
            is_needed
        });
    }
}
