//! From a road network to a lane graph.

use super::conflicts;
use super::finding::Finding;
use super::lane::{JunctionId, Lane, LaneGraph, LaneId, Turn, wrap_angle};
use super::road::{Connection, Contact, LaneKind, Road, RoadLink, RoadNetwork};

/// Distance between the points taken from the curves before they are spread evenly, metres.
const FINE_STEP_M: f64 = 0.25;
/// Distance between points of a centre line, about, metres.
const STEP_M: f64 = 1.0;
/// A link whose lanes are farther apart than this is refused, metres.
const LINK_GAP_M: f64 = 0.5;
/// The same in height, where roads are banked: few maps bank the roads of a junction as those that lead there.
const BANKED_STEP_M: f64 = 1.0;
/// A link whose lanes differ in heading by more than this is refused, radians.
const LINK_TURN_RAD: f64 = 0.35;
/// Where neither lane nor road has a speed limit, metres per second.
const DEFAULT_LIMIT_MPS: f64 = 13.9;
/// Lanes that change heading by more than this through a junction turn off, radians.
const TURN_RAD: f64 = 0.52;

/// Lane ids by road, section and lane id of the network.
struct LaneTable {
    /// First section of each road in `ids`.
    first_section: Vec<usize>,
    /// By section: lowest lane id, and the graph's id of each lane from there on.
    ids: Vec<(i32, Vec<Option<LaneId>>)>,
}

/// Where a lane of the graph comes from.
#[derive(Clone, Copy)]
struct Origin {
    road: usize,
    section: usize,
    lane: i32,
}

/// What came out of the links of a map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LinkCounts {
    /// Links made.
    pub made: usize,
    /// Links refused because the lanes do not meet in place and heading.
    pub refused: usize,
}

impl LinkCounts {
    /// The refused links as a finding of the map.
    pub(super) fn finding(&self) -> Option<Finding> {
        (self.refused > 0).then(|| Finding {
            line: 1,
            within: None,
            element: "OpenDRIVE".into(),
            found: format!("links lanes that are more than {LINK_GAP_M} m or {LINK_TURN_RAD} rad apart"),
            action: "links left out".into(),
            count: self.refused,
        })
    }
}

/// Builds the driving lanes of `network` and their links. Which lanes lead along their road and which against it is
/// [`Road::leads_along`]'s answer: traffic keeps right or left, road by road.
#[must_use]
pub fn lane_graph(network: &RoadNetwork) -> (LaneGraph, LinkCounts) {
    let mut table = LaneTable { first_section: Vec::new(), ids: Vec::new() };
    let (mut lanes, mut origins) = (Vec::new(), Vec::new());
    for (road_index, road) in network.roads.iter().enumerate() {
        table.first_section.push(table.ids.len());
        for section in 0..road.sections.len() {
            let mut ids = Vec::new();
            for lane_id in road.sections[section].lane_ids() {
                let origin = Origin { road: road_index, section, lane: lane_id };
                let lane = build_lane(road, origin, LaneId(lanes.len() as u32));
                ids.push(lane.as_ref().map(|lane| lane.id));
                if let Some(lane) = lane {
                    lanes.push(lane);
                    origins.push(origin);
                }
            }
            table.ids.push((-(road.sections[section].right.len() as i32), ids));
        }
    }
    let mut graph = LaneGraph::new(lanes);
    link_neighbours(&mut graph, network, &origins, &table);
    let counts = link_successors(&mut graph, network, &origins, &table);
    conflicts::find(&mut graph);
    (graph, counts)
}

impl LaneTable {
    fn get(&self, road: usize, section: usize, lane: i32) -> Option<LaneId> {
        let (lowest, ids) = &self.ids[self.first_section[road] + section];
        // Ids run from the lowest upwards and leave out 0.
        let place = lane - lowest - i32::from(lane > 0);
        if lane == 0 || place < 0 { None } else { ids.get(place as usize).copied().flatten() }
    }

    fn section_count(&self, road: usize) -> usize {
        self.first_section.get(road + 1).copied().unwrap_or(self.ids.len()) - self.first_section[road]
    }

    /// The section of a road at one of its ends.
    fn end_section(&self, road: usize, contact: Contact) -> usize {
        match contact {
            Contact::Start => 0,
            Contact::End => self.section_count(road) - 1,
        }
    }
}

fn build_lane(road: &Road, origin: Origin, id: LaneId) -> Option<Lane> {
    let section = &road.sections[origin.section];
    let source = section.lane(origin.lane)?;
    if source.kind != LaneKind::Driving {
        return None;
    }
    let (from, to) = (section.s_m.min(road.length_m), road.section_end_m(origin.section));
    let (centerline, [widths_m, banks_rad], length_m) = center_line(road, origin, from, to)?;
    let middle = (from + to) / 2.0;
    let limit = source.speed_limit_mps.or_else(|| road.speed_limit_mps(middle)).unwrap_or(DEFAULT_LIMIT_MPS);
    let mut sorted = widths_m.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let mut lane = Lane::new(id, centerline, sorted[sorted.len() / 2], limit);
    (lane.widths_m, lane.length_m) = (widths_m, length_m);
    lane.banks_rad = if road.lateral.is_level() { Vec::new() } else { banks_rad };
    lane.junction = road.junction.map(|junction| JunctionId(junction as u32));
    lane.in_junction = road.junction.is_some();
    if lane.in_junction {
        let turn = wrap_angle(lane.end_heading_rad() - lane.start_heading_rad());
        lane.turn = match turn {
            turn if turn > TURN_RAD => Turn::Left,
            turn if turn < -TURN_RAD => Turn::Right,
            _ => Turn::Straight,
        };
    }
    Some(lane)
}

/// Even points of a lane's middle in driving direction, the widths and banks there, and the length; `None` for a lane of
/// no or of absurd length.
fn center_line(road: &Road, origin: Origin, from: f64, to: f64) -> Option<(Vec<[f64; 3]>, [Vec<f64>; 2], f64)> {
    let along = road.leads_along(origin.section, origin.lane);
    let fine = ((to - from) / FINE_STEP_M).ceil().max(1.0) as usize;
    let mut samples: Vec<([f64; 3], [f64; 2])> = (0..=fine)
        .map(|i| {
            let s = from + (to - from) * i as f64 / fine as f64;
            // Lane offsets may jump where the next section begins: stay on this side of it.
            let inside = s.min(to - 1e-6).max(from);
            let [low, high] = road.lane_span_m(origin.section, origin.lane, inside);
            let bank = road.bank_rad(origin.section, origin.lane, inside);
            let point = road.point_at(origin.section, s, (low + high) / 2.0);
            (point, [high - low, if along { bank } else { -bank }])
        })
        .collect();
    if !along {
        samples.reverse();
    }
    let mut lengths = vec![0.0];
    for pair in samples.windows(2) {
        let (a, b) = (pair[0].0, pair[1].0);
        lengths.push(lengths[lengths.len() - 1] + (b[0] - a[0]).hypot(b[1] - a[1]));
    }
    let total = lengths[fine];
    // Far longer than the road: polynomials of the map went astray between the places where the reader checks them.
    if total < 1e-6 || total > 10.0 * (to - from) + 100.0 {
        return None;
    }
    let steps = (total / STEP_M).round().max(1.0) as usize;
    let (mut points, mut widths, mut banks, mut place) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for i in 0..=steps {
        let wanted = total * i as f64 / steps as f64;
        while place + 2 < lengths.len() && lengths[place + 1] < wanted {
            place += 1;
        }
        let share = ((wanted - lengths[place]) / (lengths[place + 1] - lengths[place]).max(1e-12)).clamp(0.0, 1.0);
        let ((a, [width_a, bank_a]), (b, [width_b, bank_b])) = (samples[place], samples[place + 1]);
        points.push(std::array::from_fn(|axis| a[axis] + share * (b[axis] - a[axis])));
        widths.push(width_a + share * (width_b - width_a));
        banks.push(bank_a + share * (bank_b - bank_a));
    }
    Some((points, [widths, banks], total))
}

fn link_neighbours(graph: &mut LaneGraph, network: &RoadNetwork, origins: &[Origin], table: &LaneTable) {
    for (lane, &Origin { road: index, section, lane: id }) in graph.lanes.iter_mut().zip(origins) {
        let road = &network.roads[index];
        let along = road.leads_along(section, id);
        let beside =
            |other: i32| table.get(index, section, other).filter(|_| road.leads_along(section, other) == along);
        let (inner, outer) = (beside(id - id.signum()), beside(id + id.signum()));
        // Seen along the road, the reference line is to the left of lanes with negative ids.
        (lane.left, lane.right) = if (id < 0) == along { (inner, outer) } else { (outer, inner) };
    }
}

fn link_successors(graph: &mut LaneGraph, network: &RoadNetwork, origins: &[Origin], table: &LaneTable) -> LinkCounts {
    let mut counts = LinkCounts::default();
    for (index, &origin) in origins.iter().enumerate() {
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
            }
        }
        for &next in &successors {
            graph.lanes[next.0 as usize].predecessors.push(LaneId(index as u32));
        }
        graph.lanes[index].successors = successors;
    }
    counts
}

/// Lanes that the map's links name as continuing the lane of `origin`.
fn candidates(network: &RoadNetwork, origin: Origin, table: &LaneTable) -> Vec<LaneId> {
    let road = &network.roads[origin.road];
    let Some(lane) = road.sections[origin.section].lane(origin.lane) else { return Vec::new() };
    let forward = road.leads_along(origin.section, origin.lane);
    let link = if forward { lane.successor } else { lane.predecessor };
    let next_section = if forward { Some(origin.section + 1) } else { origin.section.checked_sub(1) };
    if let Some(section) = next_section.filter(|&section| section < road.sections.len()) {
        return link.and_then(|lane| table.get(origin.road, section, lane)).into_iter().collect();
    }
    match if forward { road.successor } else { road.predecessor } {
        None => Vec::new(),
        Some(RoadLink::Road { road, contact }) => {
            let section = table.end_section(road, contact);
            link.and_then(|lane| table.get(road, section, lane)).into_iter().collect()
        }
        Some(RoadLink::Junction(junction)) => {
            let end = if forward { Contact::End } else { Contact::Start };
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
    for connection in junction.connections.iter().filter(|connection| connection.incoming == origin.road) {
        let section = table.end_section(connection.connecting, connection.contact);
        let onto = |to| table.get(connection.connecting, section, to);
        lanes.extend(
            linked(connection, |&(from, to)| (from == origin.lane).then_some(to), origin.lane).filter_map(onto),
        );
    }
    // A direct junction is passed both ways: from the linked road onto the incoming one too.
    let back = junction
        .connections
        .iter()
        .filter(|connection| junction.direct && connection.connecting == origin.road && connection.contact == end);
    for connection in back {
        for contact in [Contact::Start, Contact::End] {
            let road = &network.roads[connection.incoming];
            let link = if contact == Contact::Start { road.predecessor } else { road.successor };
            if link != Some(RoadLink::Junction(place)) {
                continue;
            }
            let section = table.end_section(connection.incoming, contact);
            let onto = |to| table.get(connection.incoming, section, to);
            lanes.extend(
                linked(connection, |&(to, from)| (from == origin.lane).then_some(to), origin.lane).filter_map(onto),
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

/// Whether one lane ends where the other begins, in place and heading.
fn meets(lane: &Lane, next: &Lane) -> bool {
    let (end, start) = (lane.centerline[lane.centerline.len() - 1], next.centerline[0]);
    let (beside, step) = ((end[0] - start[0]).hypot(end[1] - start[1]), (end[2] - start[2]).abs());
    let turn = wrap_angle(next.start_heading_rad() - lane.end_heading_rad());
    let is_banked = !(lane.banks_rad.is_empty() && next.banks_rad.is_empty());
    let near = if is_banked { beside < LINK_GAP_M && step < BANKED_STEP_M } else { beside.hypot(step) < LINK_GAP_M };
    near && turn.abs() < LINK_TURN_RAD
}
