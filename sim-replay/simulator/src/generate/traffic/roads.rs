//! Precomputed properties of a road network for traffic.

use super::driver::bend_speeds_mps;
use crate::map::{Lane, LaneGraph, LaneId};

/// Distance between places where a vehicle may be placed, metres.
const SPAWN_STEP_M: f64 = 4.0;
/// Least distance of such places from the ends of a lane, metres.
const SPAWN_EDGE_M: f64 = 3.0;

/// A lane graph with derived properties.
#[derive(Debug)]
pub(crate) struct Roads<'t> {
    pub(crate) graph: &'t LaneGraph,
    /// Highest speed at each point of each centre line, metres per second.
    bend_speeds: Vec<Vec<f32>>,
    /// True if a path from the lane never ends.
    endless: Vec<bool>,
    /// Places outside junctions where a vehicle may be placed.
    pub(crate) spawns: Vec<Spawn>,
}

/// A place where a vehicle may be placed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Spawn {
    pub(crate) lane: LaneId,
    pub(crate) s_m: f64,
    pub(crate) point_m: [f64; 2],
}

impl<'t> Roads<'t> {
    pub(crate) fn new(graph: &'t LaneGraph) -> Self {
        let endless = endless_lanes(graph);
        let any_endless = endless.contains(&true);
        let open = graph.lanes.iter().filter(|lane| {
            lane.junction.is_none() && (!any_endless || endless[lane.id.0 as usize])
        });
        let spawns = open.flat_map(spawns_of).collect();
        Self {
            graph,
            bend_speeds: graph.lanes.iter().map(bend_speeds_mps).collect(),
            endless,
            spawns,
        }
    }

    /// Highest speed at a position on a lane, metres per second.
    pub(crate) fn speed_mps(&self, lane: LaneId, s_m: f64) -> f64 {
        let speeds = &self.bend_speeds[lane.0 as usize];
        let step = s_m / self.graph.lane(lane).length_m * (speeds.len() - 1) as f64;
        f64::from(speeds[(step.max(0.0) as usize).min(speeds.len() - 1)])
    }

    /// True if a path from the lane never ends.
    pub(crate) fn is_endless(&self, lane: LaneId) -> bool {
        self.endless[lane.0 as usize]
    }

    /// The successors of a lane: those that never end, if there are any.
    pub(crate) fn onward(&self, lane: LaneId) -> Vec<LaneId> {
        let successors = &self.graph.lane(lane).successors;
        let mut onward = successors.clone();
        onward.retain(|next| self.endless[next.0 as usize]);
        match onward.is_empty() {
            true => successors.clone(),
            false => onward,
        }
    }
}

fn spawns_of(lane: &Lane) -> impl Iterator<Item = Spawn> + '_ {
    let count = ((lane.length_m - 2.0 * SPAWN_EDGE_M) / SPAWN_STEP_M).max(0.0) as usize;
    (0..count).map(|index| {
        let s_m = SPAWN_EDGE_M + SPAWN_STEP_M * index as f64;
        let ([x, y, _], _) = lane.at(s_m);
        Spawn {
            lane: lane.id,
            s_m,
            point_m: [x, y],
        }
    })
}

/// Removes lanes without successors until none is left.
fn endless_lanes(graph: &LaneGraph) -> Vec<bool> {
    let lanes = graph.lanes.iter();
    let mut onward: Vec<usize> = lanes.map(|lane| lane.successors.len()).collect();
    let mut before: Vec<Vec<LaneId>> = vec![Vec::new(); graph.lanes.len()];
    for lane in &graph.lanes {
        for next in &lane.successors {
            before[next.0 as usize].push(lane.id);
        }
    }
    let all = 0..onward.len();
    let mut ends: Vec<usize> = all.filter(|&lane| onward[lane] == 0).collect();
    while let Some(end) = ends.pop() {
        for previous in &before[end] {
            let left = &mut onward[previous.0 as usize];
            *left -= 1;
            if *left == 0 {
                ends.push(previous.0 as usize);
            }
        }
    }
    onward.into_iter().map(|left| left > 0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dead_end_is_avoided_where_a_ring_leads_on() {
        let mut lanes: Vec<Lane> = (0..4)
            .map(|id| {
                let line = (0..40).map(|x| [f64::from(x), 0.0, 0.0]).collect();
                Lane::new(LaneId(id), line, 3.5, 10.0)
            })
            .collect();
        lanes[0].successors = vec![LaneId(1), LaneId(2)];
        lanes[1].successors = vec![LaneId(0)];
        lanes[2].successors = vec![LaneId(3)];
        let graph = LaneGraph::new(lanes);
        let roads = Roads::new(&graph);
        assert_eq!(roads.endless, [true, true, false, false]);
        assert_eq!(roads.onward(LaneId(0)), [LaneId(1)]);
        assert_eq!(roads.onward(LaneId(2)), [LaneId(3)]);
        assert!(roads.spawns.iter().all(|spawn| spawn.lane.0 < 2) && roads.spawns.len() > 10);
    }
}
