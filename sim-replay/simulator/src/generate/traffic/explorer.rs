//! Exploring focus vehicle: drives towards the nearest road with the fewest visits.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::roads::Roads;
use crate::map::LaneId;

/// Cost of a lane change in the search for a route, metres.
const CHANGE_M: u64 = 100;
/// Shorter lanes are not targets, metres.
const SHORTEST_M: f64 = 5.0;

/// Visits of each lane, and the distance to the least visited ones.
#[derive(Debug)]
pub(super) struct Explorer {
    /// Lanes from which a lane can be reached, each with the cost, metres.
    onto: Vec<Vec<(LaneId, u64)>>,
    /// True if a lane is a target of exploration.
    is_road: Vec<bool>,
    visits: Vec<u32>,
    /// Distance from the beginning of each lane to the nearest least visited one, metres; `None` if none can be
    /// reached.
    unknown_m: Vec<Option<u64>>,
}

impl Explorer {
    /// No lane is visited except the one it starts on.
    pub(super) fn new(roads: &Roads<'_>, start: LaneId) -> Self {
        let lanes = &roads.graph.lanes;
        // Edges point backwards, as the search starts at the targets.
        let mut onto = vec![Vec::new(); lanes.len()];
        for lane in lanes {
            let length_m = lane.length_m.ceil() as u64;
            for next in roads.onward(lane.id) {
                onto[next.0 as usize].push((lane.id, length_m));
            }
            for beside in [lane.left, lane.right].into_iter().flatten() {
                onto[beside.0 as usize].push((lane.id, CHANGE_M));
            }
        }
        let is_road = lanes.iter().map(|lane| {
            lane.junction.is_none() && lane.length_m >= SHORTEST_M && roads.is_endless(lane.id)
        });
        let mut explorer = Self {
            onto,
            is_road: is_road.collect(),
            visits: vec![0; lanes.len()],
            unknown_m: Vec::new(),
        };
        explorer.choose(start);
        explorer
    }

    /// Counts the choice of a lane.
    pub(super) fn choose(&mut self, lane: LaneId) {
        self.visits[lane.0 as usize] += 1;
        self.unknown_m.clear();
    }

    /// Undoes the choice of a lane that will not be driven.
    pub(super) fn give_up(&mut self, lane: LaneId) {
        let visits = &mut self.visits[lane.0 as usize];
        *visits = visits.saturating_sub(1);
        self.unknown_m.clear();
    }

    /// Keeps the lanes with the shortest distance to a least visited one.
    pub(super) fn keep_best(&mut self, lanes: &mut Vec<LaneId>) {
        let distances = lanes.iter().filter_map(|&lane| self.unknown_m(lane));
        let least = distances.min();
        // If no least visited lane can be reached, all lanes stay.
        if least.is_some() {
            lanes.retain(|&lane| self.unknown_m(lane) == least);
        }
    }

    /// True if the lane `beside` justifies the change from `own`.
    pub(super) fn prefers(&mut self, beside: LaneId, own: LaneId) -> bool {
        match (self.unknown_m(beside), self.unknown_m(own)) {
            (Some(beside), Some(own)) => beside + CHANGE_M <= own,
            (beside, own) => beside.is_some() && own.is_none(),
        }
    }

    fn unknown_m(&mut self, lane: LaneId) -> Option<u64> {
        if self.unknown_m.is_empty() {
            self.unknown_m = self.look_around();
        }
        self.unknown_m[lane.0 as usize]
    }

    /// Dijkstra's algorithm, backwards from all least visited lanes.
    fn look_around(&self) -> Vec<Option<u64>> {
        let roads = (0..self.visits.len()).filter(|&lane| self.is_road[lane]);
        let fewest = roads.clone().map(|lane| self.visits[lane]).min();
        let mut unknown_m = vec![None; self.visits.len()];
        let mut open: BinaryHeap<_> = roads
            .filter(|&lane| Some(self.visits[lane]) == fewest)
            .map(|lane| Reverse((0, lane)))
            .collect();
        while let Some(Reverse((distance_m, lane))) = open.pop() {
            // A shorter way was found before.
            if unknown_m[lane].is_some() {
                continue;
            }
            unknown_m[lane] = Some(distance_m);
            let onto = self.onto[lane].iter();
            open.extend(onto.map(|&(from, m)| Reverse((distance_m + m, from.0 as usize))));
        }
        unknown_m
    }
}

#[cfg(test)]
mod tests {
    use super::super::car::Side;
    use super::*;
    use crate::map::{RoadMapSource, build};

    #[test]
    fn a_tour_visits_the_whole_map() {
        let map_model = build(&RoadMapSource::Town4, 0).unwrap();
        let roads = Roads::new(&map_model.lanes);
        let mut lane = roads.spawns[0].lane;
        let mut explorer = Explorer::new(&roads, lane);
        let count = explorer.is_road.iter().filter(|&&is_road| is_road).count();
        for _ in 0..4 * count {
            let mut onward = roads.onward(lane);
            explorer.keep_best(&mut onward);
            // Lane changes are part of the route where they shorten it.
            let beside = [Side::Left, Side::Right]
                .into_iter()
                .filter_map(|side| side.of(map_model.lanes.lane(lane)));
            lane = beside
                .into_iter()
                .find(|&beside| explorer.prefers(beside, lane))
                .unwrap_or(onward[0]);
            explorer.choose(lane);
        }
        let known = (0..explorer.visits.len())
            .filter(|&lane| explorer.is_road[lane] && explorer.visits[lane] > 0);
        assert!(known.count() * 100 >= count * 98, "{count} roads");
    }
}
