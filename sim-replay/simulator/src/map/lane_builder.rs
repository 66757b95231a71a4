//! Lane builder: makes a lane graph from a road network.

use super::conflicts;
use super::finding::Finding;
use super::lane::{Lane, LaneGraph, LaneId};
use super::lane_links::{LaneOrigin, Linker};
use super::road::{LaneKind, Road, RoadNetwork};

/// Distance between the points taken from the curves before they are spread evenly, metres.
const FINE_STEP_M: f64 = 0.25;
/// Distance between points of a centre line, about, metres.
const STEP_M: f64 = 1.0;
/// Speed limit where neither lane nor road has one, metres per second.
const DEFAULT_LIMIT_MPS: f64 = 13.9;

/// Builds the driving lanes of `network` and their links. `Road::leads_along` gives the direction of each lane:
/// traffic keeps right or left, road by road. Returned with the links that do not meet, and those the map lacks.
pub fn lane_graph(network: &RoadNetwork) -> (LaneGraph, Vec<Finding>) {
    let (mut lanes, mut origins) = (Vec::new(), Vec::new());
    for (road_index, road) in network.roads.iter().enumerate() {
        for (section_index, section) in road.sections.iter().enumerate() {
            for lane in section.lane_ids() {
                let origin = LaneOrigin {
                    road: road_index,
                    section: section_index,
                    lane,
                };
                if let Some(lane) = build_lane(road, origin, LaneId(lanes.len() as u32)) {
                    lanes.push(lane);
                    origins.push(origin);
                }
            }
        }
    }
    let mut graph = LaneGraph::new(lanes);
    let linker = Linker { network, origins };
    linker.link_neighbours(&mut graph);
    let findings = linker.link_successors(&mut graph);
    conflicts::find(&mut graph);
    (graph, findings)
}

fn build_lane(road: &Road, origin: LaneOrigin, id: LaneId) -> Option<Lane> {
    let section = &road.sections[origin.section];
    let source = section.lane(origin.lane)?;
    if source.kind != LaneKind::Driving {
        return None;
    }
    let from = section.s_m.min(road.length_m);
    let to = road.section_end_m(origin.section);
    let mut lane = center_line(road, origin, from, to)?;
    lane.id = id;
    let own_mps = source.speed_limit_mps;
    let limit_mps = own_mps.or_else(|| road.speed_limit_mps((from + to) / 2.0));
    lane.speed_limit_mps = limit_mps.unwrap_or(DEFAULT_LIMIT_MPS);
    let mut sorted = lane.widths_m.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    lane.width_m = sorted[sorted.len() / 2];
    if road.lateral.is_level() {
        lane.banks_rad = Vec::new();
    }
    lane.junction = road.junction;
    Some(lane)
}

/// The middle of a lane in driving direction, with widths, slopes across and length; `None` for a lane of no or of
/// absurd length.
fn center_line(road: &Road, origin: LaneOrigin, from: f64, to: f64) -> Option<Lane> {
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
    // Far longer than the road: polynomials of the map diverge between the places where the reader checks them.
    if total < 1e-6 || total > 10.0 * (to - from) + 100.0 {
        return None;
    }
    let steps = (total / STEP_M).round().max(1.0) as usize;
    let mut line = Lane {
        length_m: total,
        ..Lane::default()
    };
    let mut place = 0;
    for i in 0..=steps {
        let wanted = total * i as f64 / steps as f64;
        while place + 2 < lengths.len() && lengths[place + 1] < wanted {
            place += 1;
        }
        let share = ((wanted - lengths[place]) / (lengths[place + 1] - lengths[place]).max(1e-12))
            .clamp(0.0, 1.0);
        let ((a, [width_a, bank_a]), (b, [width_b, bank_b])) = (samples[place], samples[place + 1]);
        line.centerline.push(std::array::from_fn(|axis| {
            a[axis] + share * (b[axis] - a[axis])
        }));
        line.widths_m.push(width_a + share * (width_b - width_a));
        line.banks_rad.push(bank_a + share * (bank_b - bank_a));
    }
    Some(line)
}
