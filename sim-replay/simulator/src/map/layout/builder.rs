//! Road network builder: adds roads and junctions and links them.

use super::super::clothoid;
use super::super::curve::{PlanCurve, Pose2};
use super::super::profile::Profile;
use super::super::road::{
    Connection, Contact, Junction, LaneKind, LaneSection, Road, RoadEnd, RoadLane, RoadLink,
    RoadNetwork,
};

/// A lane that leads into or out of a junction.
#[derive(Debug, Clone, Copy)]
pub(super) struct LaneEnd {
    pub end: RoadEnd,
    pub lane: i32,
}

impl RoadEnd {
    pub(super) fn start(road: usize) -> Self {
        let contact = Contact::Start;
        Self { road, contact }
    }

    pub(super) fn end(road: usize) -> Self {
        let contact = Contact::End;
        Self { road, contact }
    }

    pub(super) fn lane(self, lane: i32) -> LaneEnd {
        LaneEnd { end: self, lane }
    }
}

#[derive(Default)]
pub(super) struct Builder {
    pub network: RoadNetwork,
}

/// Left edge of a lane seen in driving direction: place, height and slope in driving direction, lane width.
struct LaneEdge {
    pose: Pose2,
    height_and_slope: [f64; 2],
    width_m: f64,
}

/// Lanes across a road, each outwards from the reference line: kind and width in metres.
pub(super) fn section(left: &[(LaneKind, f64)], right: &[(LaneKind, f64)]) -> LaneSection {
    let [left, right] = [left, right].map(|side| {
        let lanes = side.iter();
        let lanes = lanes.map(|&(kind, width)| RoadLane::new(kind, Profile::constant(width)));
        lanes.collect()
    });
    let s_m = 0.0;
    LaneSection { s_m, left, right }
}

/// A line of clothoids through `poses`.
pub(super) fn path(poses: &[Pose2]) -> Vec<PlanCurve> {
    let mut curves: Vec<PlanCurve> = Vec::new();
    for pair in poses.windows(2) {
        curves.push(clothoid::between(pair[0], pair[1], path_length_m(&curves)));
    }
    curves
}

/// Length of a line of curves, metres.
pub(super) fn path_length_m(curves: &[PlanCurve]) -> f64 {
    curves
        .last()
        .map_or(0.0, |curve| curve.s_m + curve.length_m)
}

impl Builder {
    /// Adds a road; its links follow when its ends are joined.
    pub(super) fn road(
        &mut self,
        plan_view: Vec<PlanCurve>,
        elevation: Profile,
        section: LaneSection,
        limit_mps: f64,
    ) -> usize {
        let place = self.network.roads.len();
        self.network.roads.push(Road {
            id: format!("r{place}"),
            length_m: path_length_m(&plan_view),
            plan_view,
            elevation,
            sections: vec![section],
            speed_limits: vec![(0.0, limit_mps)],
            ..Road::default()
        });
        place
    }

    /// Adds a junction without connections.
    pub(super) fn junction(&mut self) -> usize {
        let id = self.network.junctions.len();
        self.network.junctions.push(Junction {
            id: format!("j{id}"),
            ..Junction::default()
        });
        id
    }

    /// Lets one road follow another, lane by lane on the right.
    pub(super) fn follow(&mut self, before: usize, after: usize) {
        let road = &mut self.network.roads[before];
        road.successor = Some(RoadLink::Road(RoadEnd::start(after)));
        for (place, lane) in road.sections[0].right.iter_mut().enumerate() {
            lane.successor = Some(-(place as i32 + 1));
        }
        let road = &mut self.network.roads[after];
        road.predecessor = Some(RoadLink::Road(RoadEnd::end(before)));
        for (place, lane) in road.sections[0].right.iter_mut().enumerate() {
            lane.predecessor = Some(-(place as i32 + 1));
        }
    }

    /// Adds a one-lane road through `junction` from one lane to another.
    pub(super) fn connect(&mut self, junction: usize, from: LaneEnd, to: LaneEnd, limit_mps: f64) {
        let (exit, entry) = (self.lane_edge(from, true), self.lane_edge(to, false));
        let curve = clothoid::between(exit.pose, entry.pose, 0.0);
        let length_m = curve.length_m;
        let elevation = Profile::between(length_m, exit.height_and_slope, entry.height_and_slope);
        // No slope at either end: the edges of the lanes join without a kink.
        let width = Profile::between(length_m, [exit.width_m, 0.0], [entry.width_m, 0.0]);
        let mut only = RoadLane::new(LaneKind::Driving, width);
        (only.predecessor, only.successor) = (Some(from.lane), Some(to.lane));
        let section = LaneSection {
            right: vec![only],
            ..LaneSection::default()
        };
        let connecting = self.road(vec![curve], elevation, section, limit_mps);
        let road = &mut self.network.roads[connecting];
        road.junction = Some(junction);
        road.predecessor = Some(RoadLink::Road(from.end));
        road.successor = Some(RoadLink::Road(to.end));
        let connections = &mut self.network.junctions[junction].connections;
        connections.push(Connection {
            incoming: from.end.road,
            connecting,
            contact: Contact::Start,
            lane_links: vec![(from.lane, -1)],
        });
        for end in [from.end, to.end] {
            let road = &mut self.network.roads[end.road];
            let link = match end.contact {
                Contact::Start => &mut road.predecessor,
                Contact::End => &mut road.successor,
            };
            *link = Some(RoadLink::Junction(junction));
        }
    }

    /// Lanes that lead into the junction at `end`, from the leftmost in driving direction.
    pub(super) fn incoming(&self, end: RoadEnd) -> Vec<LaneEnd> {
        self.driving_lanes(end, end.contact == Contact::End)
    }

    /// Lanes that lead out of the junction at `end`, from the leftmost in driving direction.
    pub(super) fn outgoing(&self, end: RoadEnd) -> Vec<LaneEnd> {
        self.driving_lanes(end, end.contact == Contact::Start)
    }

    /// Pose at the end of the reference line, facing away from the road.
    pub(super) fn outward_pose(&self, end: RoadEnd) -> Pose2 {
        let road = &self.network.roads[end.road];
        match end.contact {
            Contact::Start => road.pose_at(0.0).reversed(),
            Contact::End => road.pose_at(road.length_m),
        }
    }

    fn driving_lanes(&self, end: RoadEnd, along: bool) -> Vec<LaneEnd> {
        let section = &self.network.roads[end.road].sections[0];
        // Right-hand traffic: lanes with negative ids lead along the road.
        let sign = if along { -1 } else { 1 };
        let lanes = (1..).zip(section.side(!along));
        let driving = lanes.filter(|(_, lane)| lane.kind == LaneKind::Driving);
        driving.map(|(place, _)| end.lane(sign * place)).collect()
    }

    /// The left edge of a lane where it leaves its road (`exit`) or enters it.
    fn lane_edge(&self, LaneEnd { end, lane }: LaneEnd, exit: bool) -> LaneEdge {
        let road = &self.network.roads[end.road];
        debug_assert_eq!(
            lane < 0,
            (end.contact == Contact::End) == exit,
            "lane {lane} does not lead this way"
        );
        let s = match end.contact {
            Contact::Start => 0.0,
            Contact::End => road.length_m,
        };
        let [low, high] = road.lane_span_m(0, lane, s);
        let pose = road.pose_at(s);
        let (pose, sign) = if lane < 0 {
            (pose.moved(0.0, high, 0.0), 1.0)
        } else {
            (pose.moved(0.0, low, 0.0).reversed(), -1.0)
        };
        LaneEdge {
            pose,
            height_and_slope: [road.elevation.at(s), sign * road.elevation.slope_at(s)],
            width_m: high - low,
        }
    }
}
