use super::super::lane::{LaneGraph, wrap_angle};
use super::super::lane_builder::lane_graph;
use super::*;

fn road_m(layout: &RoadLayout, in_junctions: bool) -> f64 {
    let roads = layout
        .network
        .roads
        .iter()
        .filter(|road| in_junctions || road.junction.is_none());
    roads.map(|road| road.length_m).sum()
}

/// Reference lines are smooth, elevations meet, no link was refused, no lane ends.
fn check(name: &str, layout: &RoadLayout) -> LaneGraph {
    for road in &layout.network.roads {
        for pair in road.plan_view.windows(2) {
            assert!(
                pair[0].end().distance_m(&pair[1].start) < 1e-3,
                "{name}: road {} breaks",
                road.id
            );
            let turn = wrap_angle(pair[0].end().heading_rad - pair[1].start.heading_rad);
            assert!(
                turn.abs() < 1e-6,
                "{name}: road {} bends by {turn}",
                road.id
            );
        }
        let mut s = 0.0;
        while s < road.length_m {
            assert!(
                road.elevation.slope_at(s).abs() < 0.09,
                "{name}: road {} climbs {}",
                road.id,
                road.elevation.slope_at(s)
            );
            s += 5.0;
        }
    }
    let (graph, findings) = lane_graph(&layout.network);
    assert!(
        findings.iter().all(|one| one.element != "laneLink"),
        "{name}: {findings:?}"
    );
    for lane in &graph.lanes {
        assert!(
            !lane.successors.is_empty() && !lane.predecessors.is_empty(),
            "{name}: {:?} ends",
            lane.id
        );
        let end = lane.centerline[lane.centerline.len() - 1];
        for &next in &lane.successors {
            let start = graph.lane(next).centerline[0];
            let gap = (0..3)
                .map(|axis| (end[axis] - start[axis]).powi(2))
                .sum::<f64>()
                .sqrt();
            assert!(
                gap < 0.05,
                "{name}: {gap} m between {:?} and {next:?}",
                lane.id
            );
        }
    }
    graph
}

/// Column and row of a point in a grid of 8 m.
fn cell(point: &[f64; 3]) -> [i64; 2] {
    [point[0], point[1]].map(|metres| (metres / 8.0).floor() as i64)
}

/// Lanes of different roads outside junctions keep apart.
fn check_apart(name: &str, graph: &LaneGraph) {
    let outside: Vec<_> = graph
        .lanes
        .iter()
        .filter(|lane| lane.junction.is_none())
        .collect();
    let mut cells = std::collections::BTreeMap::<[i64; 2], Vec<(usize, [f64; 3])>>::new();
    for (index, lane) in outside.iter().enumerate() {
        for point in lane.centerline.iter().step_by(2) {
            cells.entry(cell(point)).or_default().push((index, *point));
        }
    }
    for (index, lane) in outside.iter().enumerate() {
        for point in lane.centerline.iter().step_by(2) {
            let [column, row] = cell(point);
            for near in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| [column + dx, row + dy])) {
                for &(other, place) in cells.get(&near).into_iter().flatten() {
                    let other_lane = outside[other];
                    let linked = lane.successors.contains(&other_lane.id)
                        || other_lane.successors.contains(&lane.id);
                    let apart = (point[0] - place[0]).hypot(point[1] - place[1]);
                    let level = (point[2] - place[2]).abs() < 5.0;
                    let least = (lane.width_m + other_lane.width_m) / 2.0 - 0.35;
                    if other != index && !linked && level && apart < least {
                        panic!(
                            "{name}: {:?} and {:?} are {apart:.2} m apart at {point:?}",
                            lane.id, other_lane.id
                        );
                    }
                }
            }
        }
    }
}

/// Share of lanes from which the largest number of others can be reached.
fn reached_share(graph: &LaneGraph, from: usize) -> f64 {
    let mut seen = vec![false; graph.lanes.len()];
    let mut open = vec![from];
    seen[from] = true;
    while let Some(lane) = open.pop() {
        let lane = &graph.lanes[lane];
        for next in lane
            .successors
            .iter()
            .chain(&lane.left)
            .chain(&lane.right)
            .map(|id| id.0 as usize)
        {
            if !seen[next] {
                seen[next] = true;
                open.push(next);
            }
        }
    }
    seen.iter().filter(|&&seen| seen).count() as f64 / seen.len() as f64
}

#[test]
fn town1_is_a_small_town_for_every_seed() {
    for seed in 0..12 {
        let (name, layout) = (format!("town1 {seed}"), town1(seed));
        let graph = check(&name, &layout);
        check_apart(&name, &graph);
        let length = road_m(&layout, false);
        assert!(
            (2200.0..3800.0).contains(&length),
            "{name}: {length} m of streets"
        );
        assert!(road_m(&layout, true) > 2500.0, "{name}");
        let arms: Vec<usize> = layout
            .network
            .junctions
            .iter()
            .map(|junction| junction.connections.len())
            .collect();
        assert!(arms.contains(&6), "{name}: no T-junction");
        assert!(
            arms.iter().filter(|&&count| count >= 6).count() >= 6,
            "{name}: {arms:?}"
        );
        assert_eq!(reached_share(&graph, 0), 1.0, "{name}");
    }
}

#[test]
fn town4_is_a_motorway_with_ramps_bridge_roundabouts_and_town_for_every_seed() {
    for seed in 0..12 {
        let (name, layout) = (format!("town4 {seed}"), town4(seed));
        let graph = check(&name, &layout);
        check_apart(&name, &graph);
        let length = road_m(&layout, false);
        assert!(
            (8000.0..13000.0).contains(&length),
            "{name}: {length} m of road"
        );
        assert_eq!(reached_share(&graph, 0), 1.0, "{name}");
        let highest = graph
            .lanes
            .iter()
            .flat_map(|lane| &lane.centerline)
            .map(|point| point[2])
            .fold(0.0, f64::max);
        assert!(highest > 6.4, "{name}: highest road at {highest} m");
        assert!(
            layout
                .network
                .roads
                .iter()
                .any(|road| road.structures.iter().any(|structure| structure.tunnel))
        );
    }
}

#[test]
fn seeds_change_the_layout() {
    for lay_out in [town1, town4] {
        let [once, again, other] = [5, 5, 6].map(|seed| {
            let roads = lay_out(seed).network.roads;
            roads.iter().map(|road| road.length_m).collect::<Vec<_>>()
        });
        assert_eq!(once, again);
        assert_ne!(once, other);
    }
}
