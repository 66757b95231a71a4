//! Clearance check: finds solids that reach into the space of a lane.

use super::convex::{CellIndex, PlanRectangle, Quad, bounds, overlap};
use super::curve::Pose2;
use super::{LaneId, MapModel};

/// Height over a lane that stays free of solids, metres.
const LANE_HEADROOM_M: f64 = 4.5;
/// Solids whose top is this little above a lane lie under it (slabs of bridges), metres.
const SURFACE_M: f64 = 0.02;
/// Edge of a cell of the index, metres.
const CELL_M: f64 = 10.0;

impl MapModel {
    /// Lanes and solids (by index in [`MapModel::solids`]) where the solid reaches into the lane's space up to
    /// `LANE_HEADROOM_M` over it. Empty for a valid map.
    pub fn obstructions(&self) -> Vec<(LaneId, usize)> {
        let solids = self.solids.iter();
        let outlines: Vec<Quad> = solids.map(|solid| solid.outline().corners()).collect();
        let mut found = Vec::new();
        if outlines.is_empty() {
            return found;
        }
        let corners = outlines.iter().flatten().copied();
        let mut index = CellIndex::new(bounds(corners), CELL_M);
        for (number, &outline) in outlines.iter().enumerate() {
            index.insert(number as u32, bounds(outline));
        }
        for lane in &self.lanes.lanes {
            for (pair, width) in lane.centerline.windows(2).zip(&lane.widths_m) {
                let [from, to] = [pair[0], pair[1]];
                let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
                let [x, y] = [0, 1].map(|axis| (from[axis] + to[axis]) / 2.0);
                // Two centimetres of tolerance at the edges: lanes are sampled.
                let half_m = [dx.hypot(dy) / 2.0, (width / 2.0 - 0.02).max(0.01)];
                let middle = Pose2::new(x, y, dy.atan2(dx));
                let piece = PlanRectangle::around(middle, half_m).corners();
                index.any(bounds(piece), |number| {
                    let [bottom_m, top_m] = self.solids[number as usize].z_m();
                    let clear = bottom_m > from[2] + LANE_HEADROOM_M || top_m < from[2] + SURFACE_M;
                    if !clear && overlap(&outlines[number as usize], &piece) {
                        found.push((lane.id, number as usize));
                    }
                    // False goes on to the next solid.
                    false
                });
            }
        }
        found.sort_unstable();
        found.dedup();
        found
    }
}
