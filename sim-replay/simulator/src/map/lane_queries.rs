//! Lane queries: the nearest lane to a position.

use super::convex::{CellIndex, bounds};
use super::lane::{Lane, LaneGraph, LaneId};

/// Edge of a cell of the index, metres.
const CELL_M: f64 = 8.0;

/// A position on a lane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct LanePosition {
    /// The lane.
    pub lane: LaneId,
    /// Distance from the lane's start along its centre line, metres.
    pub s_m: f64,
    /// Distance from the centre line, positive to the left, metres.
    pub offset_m: f64,
}

/// A grid over the points of all centre lines, for the nearest lane in constant time.
#[derive(Debug, Clone)]
pub(crate) struct LaneIndex {
    /// Lane of each point, and index of the point on its centre line.
    points: Vec<(LaneId, usize)>,
    cells: CellIndex,
}

impl LaneIndex {
    /// Indexes every centre line of `graph`.
    pub(crate) fn new(graph: &LaneGraph) -> Self {
        let points = graph.lanes.iter().flat_map(|lane| &lane.centerline);
        let extent_m = bounds(points.map(|&[x, y, _]| [x, y]));
        let (points, cells) = (Vec::new(), CellIndex::new(extent_m, CELL_M));
        let mut index = Self { points, cells };
        // By lane and point within a cell, so that ties are decided the same way each time.
        for lane in &graph.lanes {
            for (place, &[x, y, _]) in lane.centerline.iter().enumerate() {
                index.cells.insert(index.points.len() as u32, [[x, y]; 2]);
                index.points.push((lane.id, place));
            }
        }
        index
    }

    /// The lane nearest to `x`, `y` within `radius_m`; with `z_m`, only where the lane is within 3 m of that height
    /// (roads pass above each other).
    pub(crate) fn nearest(
        &self,
        graph: &LaneGraph,
        [x, y]: [f64; 2],
        radius_m: f64,
        z_m: Option<f64>,
    ) -> Option<LanePosition> {
        let mut best: Option<(f64, LanePosition)> = None;
        let [low, high] = [-radius_m, radius_m].map(|reach_m| [x + reach_m, y + reach_m]);
        self.cells.any([low, high], |number| {
            let (id, place) = self.points[number as usize];
            let lane = graph.lane(id);
            if z_m.is_some_and(|z| (lane.centerline[place][2] - z).abs() > 3.0) {
                return false;
            }
            let position = project_near(lane, place, x, y);
            let (point, _) = lane.at(position.s_m);
            let distance = (x - point[0]).hypot(y - point[1]);
            if distance <= radius_m && best.is_none_or(|(least, _)| distance < least) {
                best = Some((distance, position));
            }
            // False goes on to the next point: all of them are visited.
            false
        });
        best.map(|(_, position)| position)
    }
}

/// The position on `lane` nearest to `x`, `y`, searched on the two steps around a point of its centre line.
fn project_near(lane: &Lane, place: usize, x: f64, y: f64) -> LanePosition {
    let steps = lane.centerline.len() - 1;
    let step_m = lane.length_m / steps as f64;
    let candidates = [place.saturating_sub(1), place.min(steps - 1)].map(|index| {
        let (from, to) = (lane.centerline[index], lane.centerline[index + 1]);
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let squared = (dx * dx + dy * dy).max(1e-12);
        let share = (((x - from[0]) * dx + (y - from[1]) * dy) / squared).clamp(0.0, 1.0);
        let distance = (x - from[0] - share * dx).hypot(y - from[1] - share * dy);
        let offset_m = (dx * (y - from[1]) - dy * (x - from[0])) / squared.sqrt();
        let position = LanePosition {
            lane: lane.id,
            s_m: (index as f64 + share) * step_m,
            offset_m,
        };
        (distance, position)
    });
    let [(before_m, before), (after_m, after)] = candidates;
    if before_m <= after_m { before } else { after }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_way() -> LaneGraph {
        let there = (0..=100).map(|i| [f64::from(i), -2.0, 0.0]);
        let back = (0..=100).rev().map(|i| [f64::from(i), 2.0, 0.0]);
        LaneGraph::new(vec![
            Lane::new(LaneId(0), there.collect(), 3.5, 10.0),
            Lane::new(LaneId(1), back.collect(), 3.5, 10.0),
        ])
    }

    #[test]
    fn nearest_lane_with_and_without_height() {
        let graph = two_way();
        let index = LaneIndex::new(&graph);
        let found = index.nearest(&graph, [30.3, -1.2], 5.0, None).unwrap();
        assert_eq!(found.lane, LaneId(0));
        assert!((found.s_m - 30.3).abs() < 1e-9 && (found.offset_m - 0.8).abs() < 1e-9);
        let found = index.nearest(&graph, [30.3, 1.2], 5.0, Some(0.5)).unwrap();
        assert_eq!(found.lane, LaneId(1));
        assert!((found.s_m - 69.7).abs() < 1e-9 && (found.offset_m - 0.8).abs() < 1e-9);
        assert!(index.nearest(&graph, [30.3, 40.0], 5.0, None).is_none());
        assert!(
            index
                .nearest(&graph, [30.3, -1.2], 5.0, Some(6.0))
                .is_none()
        );
    }
}
