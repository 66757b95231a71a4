//! Links between the lanes of a map: neighbours, successors, and links that are refused.

use super::finding::{Finding, FindingLog};
use super::lane::{Lane, LaneGraph, LaneId, wrap_angle};
use super::lane_builder::{LaneTable, Origin};
use super::road::{Connection, Contact, RoadLink, RoadNetwork};

/// A link whose lanes are farther apart than this is refused, metres.
const LINK_GAP_M: f64 = 0.5;
/// The same in height, where roads are banked: few maps bank the roads of a junction as those that lead there.
const BANKED_STEP_M: f64 = 1.0;
/// A link whose lanes differ in heading by more than this is refused, radians.
const LINK_TURN_RAD: f64 = 0.35;
/// Narrower lanes are not linked unless the map does so, metres.
const LEAST_WIDTH_M: f64 = 1.0;

/// Result of linking the lanes of a map.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LinkCounts {
    /// Links made.
    pub made: usize,
    /// Links refused because the lanes do not meet in place and heading.
    pub refused: usize,
    /// The refused links by road, and links made where the map has none.
    pub findings: Vec<Finding>,
}

/// Fills [`Lane::left`] and [`Lane::right`].
pub(super) fn link_neighbours(
    graph: &mut LaneGraph,
    network: &RoadNetwork,
    origins: &[Origin],
    table: &LaneTable,
) {
    for (
        lane,
        &Origin {
            road: index,
            section,
            lane: id,
        },
    ) in graph.lanes.iter_mut().zip(origins)
    {
        let road = &network.roads[index];
        let along = road.leads_along(section, id);
        let beside = |other: i32| {
            table
                .get(index, section, other)
                .filter(|_| road.leads_along(section, other) == along)
        };
        let (inner, outer) = (beside(id - id.signum()), beside(id + id.signum()));
        // Seen along the road, the reference line is to the left of lanes with negative ids.
        (lane.left, lane.right) = if (id < 0) == along {
            (inner, outer)
        } else {
            (outer, inner)
        };
    }
}

/// Fills [`Lane::successors`] and [`Lane::predecessors`].
pub(super) fn link_successors(
    graph: &mut LaneGraph,
    network: &RoadNetwork,
    origins: &[Origin],
    table: &LaneTable,
) -> LinkCounts {
    let mut counts = LinkCounts::default();
    let mut log = FindingLog::default();
    for (index, &origin) in origins.iter().enumerate() {
        log.enter("road", &network.roads[origin.road].id);
        let mut successors: Vec<LaneId> = Vec::new();
        for next in candidates(network, origin, table) {
            if successors.contains(&next) {
                continue;
            }
            if meets(&graph.lanes[index], graph.lane(next)) {
                counts.made += 1;
                successors.push(next);
            } else {
                counts.refused += 1;
                let onto = origins[next.0 as usize];
                let apart = apart(&graph.lanes[index], graph.lane(next));
                let onto = format!(
                    "lane {} of road {}, {apart}",
                    onto.lane, network.roads[onto.road].id
                );
                log.add(
                    0,
                    "laneLink",
                    &format!("leads from lane {} onto {onto}", origin.lane),
                    "link left out",
                );
            }
        }
        if let Some(next) = successors
            .is_empty()
            .then(|| same_lane_on(graph, network, origin, table))
            .flatten()
        {
            let found = format!(
                "leads from lane {} to no lane, though lane {} continues",
                origin.lane, origin.lane
            );
            log.add(0, "link", &found, "lanes of one id linked");
            counts.made += 1;
            successors.push(next);
        }
        for &next in &successors {
            graph.lanes[next.0 as usize]
                .predecessors
                .push(LaneId(index as u32));
        }
        graph.lanes[index].successors = successors;
    }
    counts.findings = log.into_list();
    counts
}

/// The lane of the same id in the road's next section, where neither is linked to any lane and both are one.
fn same_lane_on(
    graph: &LaneGraph,
    network: &RoadNetwork,
    origin: Origin,
    table: &LaneTable,
) -> Option<LaneId> {
    let road = &network.roads[origin.road];
    let forward = road.leads_along(origin.section, origin.lane);
    let section = if forward {
        origin.section + 1
    } else {
        origin.section.checked_sub(1)?
    };
    let (own, next) = (
        road.sections[origin.section].lane(origin.lane)?,
        road.sections.get(section)?.lane(origin.lane)?,
    );
    let links = if forward {
        [own.successor, next.predecessor]
    } else {
        [own.predecessor, next.successor]
    };
    let (own, next) = (
        table.get(origin.road, origin.section, origin.lane)?,
        table.get(origin.road, section, origin.lane)?,
    );
    let (own, onto) = (graph.lane(own), graph.lane(next));
    let widths = [own.widths_m[own.widths_m.len() - 1], onto.widths_m[0]];
    // A lane that ends in a point and one that begins in a point are two.
    let is_one = widths.iter().all(|&width| width > LEAST_WIDTH_M)
        && (widths[0] - widths[1]).abs() < LINK_GAP_M;
    (links == [None, None] && is_one && meets(own, onto)).then_some(next)
}

/// Lanes that the map's links name as continuing the lane of `origin`.
fn candidates(network: &RoadNetwork, origin: Origin, table: &LaneTable) -> Vec<LaneId> {
    let road = &network.roads[origin.road];
    let Some(lane) = road.sections[origin.section].lane(origin.lane) else {
        return Vec::new();
    };
    let forward = road.leads_along(origin.section, origin.lane);
    let link = if forward {
        lane.successor
    } else {
        lane.predecessor
    };
    let next_section = if forward {
        Some(origin.section + 1)
    } else {
        origin.section.checked_sub(1)
    };
    if let Some(section) = next_section.filter(|&section| section < road.sections.len()) {
        return link
            .and_then(|lane| table.get(origin.road, section, lane))
            .into_iter()
            .collect();
    }
    match if forward {
        road.successor
    } else {
        road.predecessor
    } {
        None => Vec::new(),
        Some(RoadLink::Road { road, contact }) => {
            let section = table.end_section(road, contact);
            link.and_then(|lane| table.get(road, section, lane))
                .into_iter()
                .collect()
        }
        Some(RoadLink::Junction(junction)) => {
            let end = if forward {
                Contact::End
            } else {
                Contact::Start
            };
            through_junction(network, junction, origin, end, table)
        }
    }
}

/// Lanes that the connections of a junction name for the lane of `origin`, which leads into it at `end` of its road.
fn through_junction(
    network: &RoadNetwork,
    place: usize,
    origin: Origin,
    end: Contact,
    table: &LaneTable,
) -> Vec<LaneId> {
    let junction = &network.junctions[place];
    let mut lanes = Vec::new();
    for connection in junction
        .connections
        .iter()
        .filter(|connection| connection.incoming == origin.road)
    {
        let section = table.end_section(connection.connecting, connection.contact);
        let onto = |to| table.get(connection.connecting, section, to);
        lanes.extend(
            linked(
                connection,
                |&(from, to)| (from == origin.lane).then_some(to),
                origin.lane,
            )
            .filter_map(onto),
        );
    }
    // A direct junction is passed both ways: from the linked road onto the incoming one too.
    let back = junction.connections.iter().filter(|connection| {
        junction.direct && connection.connecting == origin.road && connection.contact == end
    });
    for connection in back {
        for contact in [Contact::Start, Contact::End] {
            let road = &network.roads[connection.incoming];
            let link = if contact == Contact::Start {
                road.predecessor
            } else {
                road.successor
            };
            if link != Some(RoadLink::Junction(place)) {
                continue;
            }
            let section = table.end_section(connection.incoming, contact);
            let onto = |to| table.get(connection.incoming, section, to);
            lanes.extend(
                linked(
                    connection,
                    |&(to, from)| (from == origin.lane).then_some(to),
                    origin.lane,
                )
                .filter_map(onto),
            );
        }
    }
    lanes
}

/// The lanes of one end of a connection that `pick` finds for a lane of the other; the same id where it has no links.
fn linked<'a>(
    connection: &'a Connection,
    pick: impl FnMut(&(i32, i32)) -> Option<i32> + 'a,
    same: i32,
) -> impl Iterator<Item = i32> + 'a {
    let same = connection.lane_links.is_empty().then_some(same);
    connection.lane_links.iter().filter_map(pick).chain(same)
}

/// Gap between the end of one lane and the beginning of the other, as text.
fn apart(lane: &Lane, next: &Lane) -> String {
    let (end, start) = (
        lane.centerline[lane.centerline.len() - 1],
        next.centerline[0],
    );
    let (beside, step) = (
        (end[0] - start[0]).hypot(end[1] - start[1]),
        (end[2] - start[2]).abs(),
    );
    let turn = wrap_angle(next.start_heading_rad() - lane.end_heading_rad());
    format!("{beside:.2} m away, {step:.2} m in height, turned by {turn:.2} rad")
}

/// True if one lane ends where the other begins, in place and heading.
fn meets(lane: &Lane, next: &Lane) -> bool {
    let (end, start) = (
        lane.centerline[lane.centerline.len() - 1],
        next.centerline[0],
    );
    let (beside, step) = (
        (end[0] - start[0]).hypot(end[1] - start[1]),
        (end[2] - start[2]).abs(),
    );
    let turn = wrap_angle(next.start_heading_rad() - lane.end_heading_rad());
    let is_banked = !(lane.banks_rad.is_empty() && next.banks_rad.is_empty());
    let near = if is_banked {
        beside < LINK_GAP_M && step < BANKED_STEP_M
    } else {
        beside.hypot(step) < LINK_GAP_M
    };
    near && turn.abs() < LINK_TURN_RAD
}
