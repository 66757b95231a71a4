//! Ground plan of a scene: outlines that are occupied, and solids that have been placed.

use super::super::convex::{CellIndex, PlanRectangle, bounds, overlap, range};
use super::super::curve::Pose2;
use super::super::ground::Ground;
use super::super::road::RoadNetwork;
use super::super::surface::{CrossSection, RoadSurface};
use super::super::{ParkingSpot, Solid};
use super::parts::PartFootprint;

/// Height over a road that stays free, metres.
pub(super) const HEADROOM_M: f64 = 4.7;
/// Edge of a cell of the index of taken outlines, metres.
const CELL_M: f64 = 6.0;
/// Junctions larger than this are not kept free between their lanes, metres.
const MAX_JUNCTION_M: f64 = 70.0;

/// A scene under construction.
pub(super) struct Site<'a> {
    pub network: &'a RoadNetwork,
    pub surface: &'a RoadSurface,
    pub ground: &'a Ground,
    pub solids: Vec<Solid>,
    pub parking: Vec<ParkingSpot>,
    /// Outlines with their lowest and highest place.
    taken: Vec<(Vec<[f64; 2]>, [f64; 2])>,
    index: CellIndex,
}

impl<'a> Site<'a> {
    pub(super) fn new(
        network: &'a RoadNetwork,
        surface: &'a RoadSurface,
        ground: &'a Ground,
    ) -> Self {
        let mut site = Self {
            network,
            surface,
            ground,
            solids: Vec::new(),
            parking: Vec::new(),
            taken: Vec::new(),
            index: CellIndex::new(surface.bounds_m, CELL_M),
        };
        for junction in 0..network.junctions.len() {
            site.keep_junction_free(junction);
        }
        site
    }

    /// True if an area is free of roads and of everything placed, between two heights.
    pub(super) fn is_free(&self, area: &PlanRectangle, z_m: [f64; 2], pavements: bool) -> bool {
        let (outline, [bottom_m, top_m]) = (area.corners(), z_m);
        self.surface.is_clear(area, z_m, HEADROOM_M, pavements)
            && !self.index.any(bounds(outline), |number| {
                let (other, [low, high]) = &self.taken[number as usize];
                bottom_m < *high && top_m > *low && overlap(&outline, other)
            })
    }

    /// Takes a rectangle between two heights.
    pub(super) fn take(&mut self, rectangle: &PlanRectangle, z_m: [f64; 2]) {
        self.take_outline(rectangle.corners().to_vec(), z_m);
    }

    /// Places all of `parts` if each is free, with `margin_m` around; else none of them. Parts may touch each other.
    pub(super) fn try_place(&mut self, parts: &[Solid], margin_m: f64, pavements: bool) -> bool {
        let free = parts.iter().all(|part| {
            let outline = part.outline().grown(margin_m);
            self.is_free(&outline, part.z_m(), pavements)
        });
        if free {
            self.place(parts);
        }
        free
    }

    /// Places parts without a check: for parts of a road, or parts on ground reserved before.
    pub(super) fn place(&mut self, parts: &[Solid]) {
        for part in parts {
            self.take(&part.outline(), part.z_m());
            self.solids.push(*part);
        }
    }

    /// Height of the terrain, metres.
    pub(super) fn ground_m(&self, [x, y]: [f64; 2]) -> f64 {
        self.ground.height_m(x, y)
    }

    /// Lowest and highest terrain under the corners and the middle of a rectangle, metres.
    pub(super) fn ground_range_m(&self, rectangle: &PlanRectangle) -> [f64; 2] {
        let corners = rectangle.corners().into_iter();
        let places = corners.chain([rectangle.center_m]);
        range(places.map(|place| self.ground_m(place)))
    }

    /// The foot of parts that stand on the terrain.
    pub(super) fn foot(&self, pose: Pose2) -> PartFootprint {
        PartFootprint::new(pose, self.ground_m([pose.x, pose.y]))
    }

    /// The cross-section of a road nearest to `s_m`, at or before it.
    pub(super) fn cut_at(&self, road: usize, s_m: f64) -> &'a CrossSection {
        let cuts = &self.surface.roads[road];
        let after = cuts.partition_point(|cut| cut.s_m <= s_m);
        &cuts[after.saturating_sub(1)]
    }

    fn take_outline(&mut self, outline: Vec<[f64; 2]>, z_m: [f64; 2]) {
        let bounds = bounds(outline.iter().copied());
        self.index.insert(self.taken.len() as u32, bounds);
        self.taken.push((outline, z_m));
    }

    /// Reserves the hull of a junction's lanes, so that nothing is placed between them.
    fn keep_junction_free(&mut self, junction: usize) {
        let (mut points, mut z_m) = (Vec::new(), [f64::INFINITY, f64::NEG_INFINITY]);
        let patches = self.surface.patches.iter().filter(|patch| {
            let road = &self.network.roads[patch.road as usize];
            patch.carriageway && road.junction == Some(junction)
        });
        for patch in patches {
            points.extend(patch.quad);
            z_m = [
                z_m[0].min(patch.z_m[0]).min(patch.z_m[3]),
                z_m[1].max(patch.z_m[1]).max(patch.z_m[2]),
            ];
        }
        let [low, high] = bounds(points.iter().copied());
        if points.len() > 2 && (high[0] - low[0]).max(high[1] - low[1]) < MAX_JUNCTION_M {
            self.take_outline(hull(points), [z_m[0] - 0.5, z_m[1] + HEADROOM_M]);
        }
    }
}

/// Convex hull, anticlockwise (Andrew's monotone chain).
fn hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut lower = half_hull(points.iter().copied());
    lower.extend(half_hull(points.iter().rev().copied()));
    lower
}

/// The corners on one side of a hull, without the last one.
fn half_hull(points: impl Iterator<Item = [f64; 2]>) -> Vec<[f64; 2]> {
    let mut chain: Vec<[f64; 2]> = Vec::new();
    for c in points {
        while let [.., a, b] = chain[..]
            && (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) <= 0.0
        {
            chain.pop();
        }
        chain.push(c);
    }
    chain.pop();
    chain
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hull_keeps_the_corners_only() {
        let points = vec![
            [0.0, 0.0],
            [2.0, 0.0],
            [1.0, 1.0],
            [2.0, 2.0],
            [0.0, 2.0],
            [1.0, 0.0],
        ];
        assert_eq!(
            hull(points),
            [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]
        );
    }
}
