//! Road networks in the terms of OpenDRIVE, whether read from a map or laid out by a procedure.
//!
//! Places along a road are `s` along its reference line, places across it `t`, positive to the left; both in metres.
//! Lane ids count outwards from the reference line, positive to the left, negative to the right.

use super::curve::{PlanCurve, Pose2};
use super::finding::Finding;
use super::lateral::LateralProfile;
use super::profile::Profile;

/// Largest distance of lanes from the reference line, metres.
pub(super) const MAX_OFFSET_M: f64 = 1000.0;
/// Widest lane, metres.
pub(super) const MAX_WIDTH_M: f64 = 100.0;

/// Roads and junctions of a map.
#[derive(Debug, Clone, Default)]
pub struct RoadNetwork {
    /// The roads; links refer to them by place.
    pub roads: Vec<Road>,
    /// The junctions; links refer to them by place.
    pub junctions: Vec<Junction>,
    /// Parts of the map that were not built as its file gives them.
    pub findings: Vec<Finding>,
}

/// One road.
#[derive(Debug, Clone, Default)]
pub struct Road {
    /// Its id in the map.
    pub id: String,
    /// Length along the reference line, metres.
    pub length_m: f64,
    /// True if traffic keeps left: lanes with positive ids lead along the road. Else it keeps right.
    pub left_hand: bool,
    /// The junction that it leads through.
    pub junction: Option<usize>,
    /// Link at its start.
    pub predecessor: Option<RoadLink>,
    /// Link at its end.
    pub successor: Option<RoadLink>,
    /// Elements of the reference line, by rising `s`; at least one.
    pub plan_view: Vec<PlanCurve>,
    /// Height along the road.
    pub elevation: Profile,
    /// Superelevation, crossfall and shape.
    pub lateral: LateralProfile,
    /// Shift of the lanes' origin across the road.
    pub lane_offset: Profile,
    /// Lane sections, by rising `s`; at least one.
    pub sections: Vec<LaneSection>,
    /// Speed limits in metres per second, by rising `s` of their start.
    pub speed_limits: Vec<(f64, f64)>,
    /// Objects beside or on the road in the map.
    pub objects: Vec<RoadObject>,
    /// Traffic lights and signs in the map.
    pub signals: Vec<RoadObject>,
    /// Stretches on bridges and in tunnels in the map.
    pub structures: Vec<RoadStructure>,
}

/// Link at an end of a road.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoadLink {
    /// Another road's start or end.
    Road(RoadEnd),
    /// A junction; its connections give the roads that follow.
    Junction(usize),
}

/// A road and one of its ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoadEnd {
    /// The road, by its place in the network.
    pub road: usize,
    /// The end.
    pub contact: Contact,
}

/// An end of a road.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Contact {
    /// End at `s = 0`.
    Start,
    /// End at `s` = length of the road.
    End,
}

/// Lanes across a stretch of road.
#[derive(Debug, Clone, Default)]
pub struct LaneSection {
    /// Start along the road, metres.
    pub s_m: f64,
    /// Lanes 1, 2, .. outwards.
    pub left: Vec<RoadLane>,
    /// Lanes -1, -2, .. outwards.
    pub right: Vec<RoadLane>,
}

/// One lane of a section.
#[derive(Debug, Clone, Default)]
pub struct RoadLane {
    /// Use of the lane.
    pub kind: LaneKind,
    /// Width along the section, `s` counted from the section's start.
    pub width: Profile,
    /// Lane id that it continues, in the section or road before (in rising `s`).
    pub predecessor: Option<i32>,
    /// Lane id that continues it.
    pub successor: Option<i32>,
    /// Its own speed limit, metres per second.
    pub speed_limit_mps: Option<f64>,
    /// True if it is level, with all lanes outside it, at the height of its inner border.
    pub level: bool,
    /// True if traffic leads against the direction of its side.
    pub reversed: bool,
}

impl RoadLane {
    /// The lane that the map links to the end of this one, or to its start, seen along the road.
    pub(crate) fn linked(&self, at_end: bool) -> Option<i32> {
        match at_end {
            true => self.successor,
            false => self.predecessor,
        }
    }

    /// A lane without links and speed limit of its own.
    pub fn new(kind: LaneKind, width: Profile) -> Self {
        Self {
            kind,
            width,
            ..Self::default()
        }
    }
}

/// Use of a lane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum LaneKind {
    /// Motor traffic, ramps included.
    Driving,
    /// Parked vehicles.
    Parking,
    /// Hard strip beside the carriageway.
    Shoulder,
    /// Walking.
    Sidewalk,
    /// Between carriageways.
    Median,
    /// Anything else: cycle lanes, verges, kerbs.
    #[default]
    Other,
}

/// A junction and its connections.
#[derive(Debug, Clone, Default)]
pub struct Junction {
    /// Its id in the map.
    pub id: String,
    /// True if its connections join two roads directly, for both directions, without a road inside the junction.
    pub direct: bool,
    /// Connections through it.
    pub connections: Vec<Connection>,
}

/// A connection from an incoming road onto a connecting road.
#[derive(Debug, Clone)]
pub struct Connection {
    /// The road that leads into the junction.
    pub incoming: usize,
    /// The road inside the junction; in a direct junction, the other road.
    pub connecting: usize,
    /// The end at which the connecting road is entered.
    pub contact: Contact,
    /// Lane of the incoming road, lane of the connecting road. Empty: lanes of one id.
    pub lane_links: Vec<(i32, i32)>,
}

/// An object, a traffic light or a sign of the map beside or on a road.
#[derive(Debug, Clone, Default)]
pub struct RoadObject {
    /// Type and name of an object in the map; traffic lights and signs have none.
    pub label: String,
    /// True if it changes (a traffic light).
    pub dynamic: bool,
    /// Place along the road, metres.
    pub s_m: f64,
    /// Place across the road, metres.
    pub t_m: f64,
    /// Heading against the road, radians.
    pub heading_rad: f64,
}

/// A stretch of road on a bridge or in a tunnel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoadStructure {
    /// True if it is a tunnel; else a bridge.
    pub tunnel: bool,
    /// Start along the road, metres.
    pub s_m: f64,
    /// Length, metres.
    pub length_m: f64,
}

impl LaneSection {
    /// The lane of an id, if the section has it; there is none for the centre, 0.
    pub fn lane(&self, id: i32) -> Option<&RoadLane> {
        let place = (id.unsigned_abs() as usize).checked_sub(1)?;
        self.side(id > 0).get(place)
    }

    /// The lanes left or right of the reference line, from the inside out.
    pub(crate) fn side(&self, left: bool) -> &[RoadLane] {
        if left { &self.left } else { &self.right }
    }

    /// True if lanes are kept level where the road is not.
    pub(crate) fn has_level_lanes(&self) -> bool {
        self.left.iter().chain(&self.right).any(|lane| lane.level)
    }

    /// Ids of all lanes, from the rightmost to the leftmost.
    pub(crate) fn lane_ids(&self) -> impl Iterator<Item = i32> + use<> {
        let (right, left) = (self.right.len() as i32, self.left.len() as i32);
        (-right..=left).filter(|&id| id != 0)
    }
}

impl Road {
    /// What an end of the road is linked to.
    pub(crate) fn link(&self, end: Contact) -> Option<RoadLink> {
        match end {
            Contact::Start => self.predecessor,
            Contact::End => self.successor,
        }
    }

    /// Place and heading of the reference line at `s_m`.
    pub fn pose_at(&self, s_m: f64) -> Pose2 {
        let after = self.plan_view.partition_point(|curve| curve.s_m <= s_m);
        let curve = &self.plan_view[after.saturating_sub(1)];
        // A road's length and the sum of its elements differ by rounding: never run past an element's end.
        curve.at((s_m - curve.s_m).clamp(0.0, curve.length_m))
    }

    /// Place at `s_m`, `t_m` of section `section`, on the road's surface, metres.
    pub(crate) fn point_at(&self, section: usize, s_m: f64, t_m: f64) -> [f64; 3] {
        let [aside_m, height_m] = self.aside_m(section, s_m, t_m);
        let pose = self.pose_at(s_m).moved(0.0, aside_m, 0.0);
        [pose.x, pose.y, self.elevation.at(s_m) + height_m]
    }

    /// Distance beside the reference line (positive to the left) and height over it of the surface at `s_m`, `t_m` of
    /// section `section`, metres. On a level road that is `t_m` and 0.
    pub(crate) fn aside_m(&self, section: usize, s_m: f64, t_m: f64) -> [f64; 2] {
        if self.lateral.is_level() {
            return [t_m, 0.0];
        }
        let left = t_m > 0.0;
        match self.level_from_m(section, s_m, left) {
            Some(edge_m) if t_m != edge_m && (t_m > edge_m) == left => {
                // Beyond the edge the surface is level, so distances count flat from there.
                let [aside_m, height_m] = self.lateral.at(s_m, edge_m);
                [aside_m + t_m - edge_m, height_m]
            }
            _ => self.lateral.at(s_m, t_m),
        }
    }

    /// Inner border of the lanes of one side that stay level, metres.
    fn level_from_m(&self, section: usize, s_m: f64, left: bool) -> Option<f64> {
        let lanes = self.sections.get(section)?.side(left);
        let place = lanes.iter().position(|lane| lane.level)? as i32 + 1;
        let [low, high] = self.lane_span_m(section, if left { place } else { -place }, s_m);
        Some(if left { low } else { high })
    }

    /// Slope across lane `id` of section `section` at `s_m` as an angle, radians; positive where the left side of the
    /// road (not of the lane's traffic) is higher.
    pub(crate) fn bank_rad(&self, section: usize, id: i32, s_m: f64) -> f64 {
        if self.lateral.is_level() {
            return 0.0;
        }
        let [low, high] = self.lane_span_m(section, id, s_m);
        // A lane of no width yet lies as the lane around its place.
        let half_m = (high - low).max(0.2) / 2.0;
        let [right, left] =
            [-half_m, half_m].map(|offset| self.aside_m(section, s_m, (low + high) / 2.0 + offset));
        (left[1] - right[1]).atan2(left[0] - right[0])
    }

    /// True if traffic on lane `id` of section `section` leads along the road.
    pub(crate) fn leads_along(&self, section: usize, id: i32) -> bool {
        let section = self.sections.get(section);
        let lane = section.and_then(|section| section.lane(id));
        let reversed = lane.is_some_and(|lane| lane.reversed);
        // Right lanes lead along the road in right-hand traffic. Each further condition turns that round.
        ((id < 0) != self.left_hand) != reversed
    }

    /// End of section `index`, metres.
    pub(crate) fn section_end_m(&self, index: usize) -> f64 {
        let next = self.sections.get(index + 1);
        next.map_or(self.length_m, |next| next.s_m.min(self.length_m))
    }

    /// Index of the section at `s_m` in [`Road::sections`].
    pub(crate) fn section_at(&self, s_m: f64) -> usize {
        let after = self.sections.partition_point(|section| section.s_m <= s_m);
        after.saturating_sub(1)
    }

    /// Shift of the lanes' origin across the road at `s_m`, metres, clamped to the limits of a road since cubics of a
    /// map are unbounded.
    pub(crate) fn lane_offset_m(&self, s_m: f64) -> f64 {
        self.lane_offset.at(s_m).clamp(-MAX_OFFSET_M, MAX_OFFSET_M)
    }

    /// Lower and upper `t` of lane `id` of section `section` at `s_m`, metres.
    pub(crate) fn lane_span_m(&self, section: usize, id: i32, s_m: f64) -> [f64; 2] {
        let section = &self.sections[section];
        let side = section.side(id > 0).iter();
        // Cubics of a map may fall below zero or diverge.
        let mut widths = side.map(|lane| lane.width.at(s_m - section.s_m).clamp(0.0, MAX_WIDTH_M));
        // Never 0: the reference line is no lane.
        let place = id.unsigned_abs() as usize;
        let inner: f64 = widths.by_ref().take(place - 1).sum();
        let outer = inner + widths.next().unwrap_or(0.0);
        let origin = self.lane_offset_m(s_m);
        if id > 0 {
            [origin + inner, origin + outer]
        } else {
            [origin - outer, origin - inner]
        }
    }

    /// Speed limit at `s_m` where the road has one, metres per second.
    pub(crate) fn speed_limit_mps(&self, s_m: f64) -> Option<f64> {
        let limits = &self.speed_limits;
        let after = limits.partition_point(|&(start, _)| start <= s_m);
        // The first limit also holds before its start.
        Some(limits.get(after.saturating_sub(1))?.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn driving_lane(width_m: f64) -> RoadLane {
        RoadLane::new(LaneKind::Driving, Profile::constant(width_m))
    }

    #[test]
    fn lane_spans_stack_outwards_from_the_offset() {
        let section = LaneSection {
            s_m: 0.0,
            left: vec![driving_lane(3.0)],
            right: vec![driving_lane(3.5), driving_lane(2.0)],
        };
        assert_eq!(section.lane_ids().collect::<Vec<_>>(), [-2, -1, 1]);
        assert!(
            section.lane(0).is_none() && section.lane(2).is_none() && section.lane(-2).is_some()
        );
        let road = Road {
            id: "1".into(),
            length_m: 10.0,
            lane_offset: Profile::constant(0.5),
            sections: vec![section],
            ..Road::default()
        };
        assert_eq!(road.lane_span_m(0, 1, 0.0), [0.5, 3.5]);
        assert_eq!(road.lane_span_m(0, -1, 0.0), [-3.0, 0.5]);
        assert_eq!(road.lane_span_m(0, -2, 0.0), [-5.0, -3.0]);
        assert_eq!(road.speed_limit_mps(3.0), None);
    }
}
