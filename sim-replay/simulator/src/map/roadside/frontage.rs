//! Frontage: the two sides of every road, along which objects are placed.

use super::super::curve::Pose2;
use super::super::road::{LaneKind, Road, RoadNetwork};
use super::super::surface::CrossSection;
use super::site::Site;

/// Roads with at least this speed limit have no houses along them, metres per second.
const FAST_MPS: f64 = 17.0;
/// From this width on, a fast road is a motorway, metres.
const MOTORWAY_WIDTH_M: f64 = 6.5;

/// Character of a side of a road.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Zone {
    /// Houses, pavements, lamps.
    Street,
    /// Ramps and country roads.
    Rural,
    /// Several fast lanes.
    Motorway,
}

/// One side of a road outside junctions.
#[derive(Debug, Clone, Copy)]
pub(super) struct RoadSide {
    pub road: usize,
    /// 1 for the left side, -1 for the right.
    pub sign: f64,
    pub zone: Zone,
    pub length_m: f64,
    /// True if traffic on this side leads along the road's own direction.
    pub along: bool,
    /// True for the left side of a one-way motorway, with only the opposite carriageway beyond it.
    pub median: bool,
}

/// Both sides of every road outside junctions.
pub(super) fn sides(network: &RoadNetwork) -> Vec<RoadSide> {
    let mut sides = Vec::new();
    let roads = network.roads.iter().enumerate();
    for (index, road) in roads.filter(|(_, road)| road.junction.is_none()) {
        let [left, right] = [drives(road, true), drives(road, false)];
        for sign in [-1.0, 1.0] {
            let zone = zone(road);
            let has_lanes = if sign < 0.0 { right } else { left };
            // A side without lanes borders the traffic of the other side.
            let along = (sign < 0.0) == (has_lanes != road.left_hand);
            let median = !has_lanes && zone == Zone::Motorway;
            sides.push(RoadSide {
                road: index,
                sign,
                zone,
                length_m: road.length_m,
                along,
                median,
            });
        }
    }
    sides
}

impl RoadSide {
    /// The pose `out_m` beyond the paved area, `s_m` along the road (also a little before its start or behind its end),
    /// looking along the road.
    pub(super) fn beyond_paved(&self, site: &Site, s_m: f64, out_m: f64) -> Pose2 {
        self.beyond(site, s_m, out_m, |cut| cut.paved_m)
    }

    /// The same, from the edge of the carriageway.
    pub(super) fn beyond_kerb(&self, site: &Site, s_m: f64, out_m: f64) -> Pose2 {
        self.beyond(site, s_m, out_m, |cut| cut.carriageway_m)
    }

    /// Height of the road at the edge of its carriageway, metres.
    pub(super) fn road_m(&self, site: &Site, s_m: f64) -> f64 {
        let s_m = s_m.clamp(0.0, self.length_m);
        let road = &site.network.roads[self.road];
        let z_m = road.elevation.at(s_m);
        if road.lateral.is_level() {
            return z_m;
        }
        let cut = site.cut_at(self.road, s_m);
        // The elevation at `s_m` itself, since the cut may lie up to a step before it.
        z_m + cut.height_m(cut.carriageway_m[usize::from(self.sign > 0.0)]) - cut.z_m
    }

    /// True if the traffic nearest to this side moves in the side's own direction: the right side where traffic keeps
    /// right.
    pub(super) fn is_near(&self, network: &RoadNetwork) -> bool {
        ((self.sign < 0.0) == self.along) != network.roads[self.road].left_hand
    }

    /// Width of pavement and verge on this side, metres.
    pub(super) fn pavement_m(&self, site: &Site, s_m: f64) -> f64 {
        let cut = site.cut_at(self.road, s_m);
        let edge = usize::from(self.sign > 0.0);
        self.sign * (cut.paved_m[edge] - cut.carriageway_m[edge])
    }

    /// A pose beside the road turned to face it.
    pub(super) fn facing(&self, pose: Pose2) -> Pose2 {
        pose.moved(0.0, 0.0, -self.sign * std::f64::consts::FRAC_PI_2)
    }

    /// The pose turned so that the road lies to its right.
    pub(super) fn with_road_right(&self, pose: Pose2) -> Pose2 {
        let is_left = self.sign > 0.0;
        if is_left { pose } else { pose.reversed() }
    }

    fn beyond(
        &self,
        site: &Site,
        s_m: f64,
        out_m: f64,
        range: impl Fn(&CrossSection) -> [f64; 2],
    ) -> Pose2 {
        let inside = s_m.clamp(0.0, self.length_m);
        let cut = site.cut_at(self.road, inside);
        let edge_m = range(cut)[usize::from(self.sign > 0.0)];
        let t = cut.aside_m(edge_m) + self.sign * out_m;
        let pose = site.network.roads[self.road].pose_at(inside);
        pose.moved(s_m - inside, t, 0.0)
    }
}

fn drives(road: &Road, left: bool) -> bool {
    road.sections.iter().any(|section| {
        let mut side = section.side(left).iter();
        side.any(|lane| lane.kind == LaneKind::Driving)
    })
}

fn zone(road: &Road) -> Zone {
    let middle = road.length_m / 2.0;
    let section = &road.sections[road.section_at(middle)];
    let mut lanes = section.left.iter().chain(&section.right);
    let [left_m, right_m] = [&section.left, &section.right].map(|side| {
        let driving = side.iter().filter(|lane| lane.kind == LaneKind::Driving);
        let widths = driving.map(|lane| lane.width.at(middle - section.s_m));
        widths.sum::<f64>()
    });
    let limit_mps = road.speed_limit_mps(middle);
    if lanes.any(|lane| lane.kind == LaneKind::Sidewalk) {
        Zone::Street
    } else if left_m.max(right_m) > MOTORWAY_WIDTH_M {
        Zone::Motorway
    } else if limit_mps.is_some_and(|limit| limit > FAST_MPS) {
        Zone::Rural
    } else {
        Zone::Street
    }
}
