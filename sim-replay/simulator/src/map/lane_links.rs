//! Links between the lanes of a map: neighbours, successors, and links that are refused.

use super::finding::{Finding, FindingLog};
use super::lane::{Lane, LaneGraph, LaneId, wrap_angle};
use super::road::{Contact, RoadEnd, RoadLink, RoadNetwork};

/// A link whose lanes are farther apart than this is refused, metres.
const LINK_GAP_M: f64 = 0.5;
/// The same in height, where roads are banked: few maps bank the roads of a junction as those that lead there.
const BANKED_STEP_M: f64 = 1.0;
/// A link whose lanes differ in heading by more than this is refused, radians.
const LINK_TURN_RAD: f64 = 0.35;
/// Narrower lanes are not linked unless the map does so, metres.
const LEAST_WIDTH_M: f64 = 1.0;

/// Origin of a lane of the graph in the road network.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct LaneOrigin {
    pub(super) road: usize,
    pub(super) section: usize,
    pub(super) lane: i32,
}

impl LaneOrigin {
    /// The section that follows along the road, or against it.
    fn next_section(self, forward: bool) -> Option<usize> {
        let step = if forward { 1 } else { -1 };
        self.section.checked_add_signed(step)
    }
}

/// Sections and lanes of the roads that the lanes of a graph were made from.
pub(super) struct Linker<'a> {
    pub(super) network: &'a RoadNetwork,
    /// By id of the lane, rising.
    pub(super) origins: Vec<LaneOrigin>,
}

impl Linker<'_> {
    /// The lane of the graph that was made from a lane of the network.
    fn find(&self, origin: LaneOrigin) -> Option<LaneId> {
        let place = self.origins.binary_search(&origin).ok()?;
        Some(LaneId(place as u32))
    }

    /// Fills [`Lane::left`] and [`Lane::right`].
    pub(super) fn link_neighbours(&self, graph: &mut LaneGraph) {
        for (lane, &origin) in graph.lanes.iter_mut().zip(&self.origins) {
            let (section, id) = (origin.section, origin.lane);
            let road = &self.network.roads[origin.road];
            let along = road.leads_along(section, id);
            let [inner, outer] = [id - id.signum(), id + id.signum()].map(|lane| {
                let found = self.find(LaneOrigin { lane, ..origin });
                found.filter(|_| road.leads_along(section, lane) == along)
            });
            // Seen along the road, the reference line is to the left of lanes with negative ids.
            (lane.left, lane.right) = match (id < 0) == along {
                true => (inner, outer),
                false => (outer, inner),
            };
        }
    }

    /// Fills [`Lane::successors`] and [`Lane::predecessors`]. Returns the links refused because the lanes do not meet in
    /// place and heading, by road, and links made where the map has none.
    pub(super) fn link_successors(&self, graph: &mut LaneGraph) -> Vec<Finding> {
        let roads = &self.network.roads;
        let mut log = FindingLog::default();
        for (index, &origin) in self.origins.iter().enumerate() {
            log.enter("road", &roads[origin.road].id);
            let mut successors: Vec<LaneId> = Vec::new();
            for next in self.candidates(origin) {
                if successors.contains(&next) {
                    continue;
                }
                let joint = Joint::of(&graph.lanes[index], graph.lane(next));
                if joint.meets() {
                    successors.push(next);
                } else {
                    let onto = self.origins[next.0 as usize];
                    let (beside_m, step_m, turn_rad) =
                        (joint.beside_m, joint.step_m, joint.turn_rad);
                    let found = format!(
                        "leads from lane {} onto lane {} of road {}, {beside_m:.2} m away, {step_m:.2} m in height, \
                         turned by {turn_rad:.2} rad",
                        origin.lane, onto.lane, roads[onto.road].id
                    );
                    log.add(0, "laneLink", &found, "link left out");
                }
            }
            if successors.is_empty()
                && let Some(next) = self.same_lane_on(graph, origin)
            {
                let lane = origin.lane;
                let found =
                    format!("leads from lane {lane} to no lane, though lane {lane} continues");
                log.add(0, "link", &found, "lanes of one id linked");
                successors.push(next);
            }
            for &next in &successors {
                let predecessors = &mut graph.lanes[next.0 as usize].predecessors;
                predecessors.push(LaneId(index as u32));
            }
            graph.lanes[index].successors = successors;
        }
        log.list
    }

    /// The lane of the same id in the road's next section, where neither is linked to any lane and both are one.
    fn same_lane_on(&self, graph: &LaneGraph, origin: LaneOrigin) -> Option<LaneId> {
        let road = &self.network.roads[origin.road];
        let forward = road.leads_along(origin.section, origin.lane);
        let section = origin.next_section(forward)?;
        let own = road.sections[origin.section].lane(origin.lane)?;
        let next = road.sections.get(section)?.lane(origin.lane)?;
        let links = [own.linked(forward), next.linked(!forward)];
        let own = self.find(origin)?;
        let next = self.find(LaneOrigin { section, ..origin })?;
        let (own, onto) = (graph.lane(own), graph.lane(next));
        let widths = [own.widths_m[own.widths_m.len() - 1], onto.widths_m[0]];
        // A lane that ends in a point and one that begins in a point are two.
        let is_one = widths.iter().all(|&width| width > LEAST_WIDTH_M)
            && (widths[0] - widths[1]).abs() < LINK_GAP_M;
        (links == [None, None] && is_one && Joint::of(own, onto).meets()).then_some(next)
    }

    /// Lanes that the map's links name as continuing the lane of `origin`.
    fn candidates(&self, origin: LaneOrigin) -> Vec<LaneId> {
        let road = &self.network.roads[origin.road];
        let Some(lane) = road.sections[origin.section].lane(origin.lane) else {
            return Vec::new();
        };
        let forward = road.leads_along(origin.section, origin.lane);
        let next_lane = lane.linked(forward);
        let next_section = origin.next_section(forward);
        if let Some(section) = next_section.filter(|&section| section < road.sections.len()) {
            return self.lanes_of(origin.road, section, next_lane);
        }
        let end = match forward {
            true => Contact::End,
            false => Contact::Start,
        };
        match road.link(end) {
            None => Vec::new(),
            Some(RoadLink::Road(RoadEnd { road, contact })) => {
                self.lanes_of(road, self.end_section(road, contact), next_lane)
            }
            Some(RoadLink::Junction(junction)) => self.through_junction(junction, origin, end),
        }
    }

    /// The section of a road at one of its ends.
    fn end_section(&self, road: usize, contact: Contact) -> usize {
        match contact {
            Contact::Start => 0,
            Contact::End => self.network.roads[road].sections.len() - 1,
        }
    }

    fn lanes_of(
        &self,
        road: usize,
        section: usize,
        ids: impl IntoIterator<Item = i32>,
    ) -> Vec<LaneId> {
        let origins = ids.into_iter().map(|lane| LaneOrigin {
            road,
            section,
            lane,
        });
        origins.filter_map(|origin| self.find(origin)).collect()
    }

    /// Lanes at an end of a road onto which the links of a connection lead from `lane`: pairs of ids; without any, the
    /// lane of the same id.
    fn linked_at(&self, road: usize, at: Contact, lane: i32, links: &[(i32, i32)]) -> Vec<LaneId> {
        let own = links.iter().filter(|(from, _)| *from == lane);
        let onto = own.map(|&(_, to)| to);
        let onto = onto.chain(links.is_empty().then_some(lane));
        self.lanes_of(road, self.end_section(road, at), onto)
    }

    /// Lanes that the connections of a junction name for the lane of `origin`, which leads into it at `end` of its road.
    fn through_junction(&self, place: usize, origin: LaneOrigin, end: Contact) -> Vec<LaneId> {
        let junction = &self.network.junctions[place];
        let mut lanes = Vec::new();
        let connections = junction.connections.iter();
        let onward = connections.clone();
        for connection in onward.filter(|one| one.incoming == origin.road) {
            let (road, links) = (connection.connecting, &connection.lane_links);
            lanes.extend(self.linked_at(road, connection.contact, origin.lane, links));
        }
        // A direct junction is passed both ways: from the linked road onto the incoming one too.
        let back = connections.filter(|connection| {
            junction.direct && connection.connecting == origin.road && connection.contact == end
        });
        for connection in back {
            let (road, links) = (connection.incoming, connection.lane_links.iter());
            let links: Vec<_> = links.map(|&(from, to)| (to, from)).collect();
            for contact in [Contact::Start, Contact::End] {
                let link = self.network.roads[road].link(contact);
                if link == Some(RoadLink::Junction(place)) {
                    lanes.extend(self.linked_at(road, contact, origin.lane, &links));
                }
            }
        }
        lanes
    }
}

/// How the end of a lane and the start of the next one lie to each other.
struct Joint {
    beside_m: f64,
    step_m: f64,
    turn_rad: f64,
    is_banked: bool,
}

impl Joint {
    fn of(lane: &Lane, next: &Lane) -> Self {
        let end = lane.centerline[lane.centerline.len() - 1];
        let start = next.centerline[0];
        Self {
            beside_m: (end[0] - start[0]).hypot(end[1] - start[1]),
            step_m: (end[2] - start[2]).abs(),
            turn_rad: wrap_angle(next.at(0.0).1 - lane.at(lane.length_m).1),
            is_banked: !(lane.banks_rad.is_empty() && next.banks_rad.is_empty()),
        }
    }

    /// True if the lanes are one behind the other.
    fn meets(&self) -> bool {
        let near = match self.is_banked {
            true => self.beside_m < LINK_GAP_M && self.step_m < BANKED_STEP_M,
            false => self.beside_m.hypot(self.step_m) < LINK_GAP_M,
        };
        near && self.turn_rad.abs() < LINK_TURN_RAD
    }
}
