//! Conflicts in junctions: pairs of lanes that cross or merge.

use std::collections::BTreeMap;

use super::lane::{Lane, LaneGraph, LaneId};

/// Lanes that pass each other at a greater height difference do not conflict, metres.
const LEVEL_M: f64 = 3.0;
/// Two lanes conflict if their centre lines come closer than this share of their mean width.
const OVERLAP: f64 = 0.75;

/// Fills [`Lane::conflicts`]: pairs of lanes of one junction that cross or merge. Lanes with a common predecessor
/// diverge and do not conflict, nor do neighbours that run side by side.
pub(crate) fn find(graph: &mut LaneGraph) {
    let mut members: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (index, lane) in graph.lanes.iter().enumerate() {
        if let Some(junction) = lane.junction {
            members.entry(junction).or_default().push(index);
        }
    }
    for lanes in members.values() {
        for (place, &a) in lanes.iter().enumerate() {
            for &b in &lanes[place + 1..] {
                if in_conflict(&graph.lanes[a], &graph.lanes[b]) {
                    graph.lanes[a].conflicts.push(LaneId(b as u32));
                    graph.lanes[b].conflicts.push(LaneId(a as u32));
                }
            }
        }
    }
}

fn in_conflict(a: &Lane, b: &Lane) -> bool {
    if a.left == Some(b.id)
        || a.right == Some(b.id)
        || a.predecessors.iter().any(|id| b.predecessors.contains(id))
    {
        return false;
    }
    let follows = a.successors.contains(&b.id) || b.successors.contains(&a.id);
    let merges = a.successors.iter().any(|id| b.successors.contains(id));
    !follows && (merges || crosses(a, b))
}

fn crosses(a: &Lane, b: &Lane) -> bool {
    let near = OVERLAP * (a.width_m + b.width_m) / 2.0;
    // Points are about 1 m apart, closer than lanes are wide.
    a.centerline.iter().any(|p| {
        b.centerline
            .iter()
            .any(|q| (p[0] - q[0]).hypot(p[1] - q[1]) < near && (p[2] - q[2]).abs() < LEVEL_M)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lane(id: u32, from: [f64; 2], to: [f64; 2]) -> Lane {
        let points = (0..=20).map(|i| {
            let [x, y] = [0, 1]
                .map(|axis: usize| from[axis] + (to[axis] - from[axis]) * f64::from(i) / 20.0);
            [x, y, 0.0]
        });
        let mut lane = Lane::new(LaneId(id), points.collect(), 3.5, 10.0);
        lane.junction = Some(0);
        lane
    }

    #[test]
    fn crossing_and_merging_lanes_conflict_but_parting_ones_do_not() {
        let mut graph = LaneGraph::new(vec![
            lane(0, [-10.0, 0.0], [10.0, 0.0]),
            lane(1, [0.0, -10.0], [0.0, 10.0]),
            lane(2, [-10.0, 0.0], [10.0, 8.0]),
            lane(3, [-10.0, 20.0], [10.0, 20.0]),
            lane(4, [5.0, 12.0], [10.0, 20.0]),
        ]);
        graph.lanes[0].predecessors = vec![LaneId(9)];
        graph.lanes[2].predecessors = vec![LaneId(9)];
        graph.lanes[3].successors = vec![LaneId(8)];
        graph.lanes[4].successors = vec![LaneId(8)];
        find(&mut graph);
        assert_eq!(graph.lanes[0].conflicts, [LaneId(1)]);
        assert_eq!(graph.lanes[1].conflicts, [LaneId(0), LaneId(2)]);
        assert_eq!(graph.lanes[3].conflicts, [LaneId(4)]);
    }
}
