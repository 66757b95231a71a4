//! CARLA's own road maps: counts as in their README, connected lanes, free lanes.

use simulator::map::lane_builder::lane_graph;
use simulator::map::road::RoadNetwork;
use simulator::map::{LaneGraph, RoadMapSource, build, opendrive};
use tests::fixtures;

/// Distance that a vehicle should be able to drive from a lane, metres.
const DRIVE_M: f64 = 3000.0;

struct Expected {
    file: &'static str,
    roads: usize,
    length_m: f64,
    outside_junctions_m: f64,
    junctions: usize,
    highest_m: f64,
}

const MAPS: [Expected; 2] = [
    Expected {
        file: "Town01.xodr",
        roads: 122,
        length_m: 4216.0,
        outside_junctions_m: 2480.0,
        junctions: 12,
        highest_m: 0.0,
    },
    Expected {
        file: "Town04.xodr",
        roads: 276,
        length_m: 10819.0,
        outside_junctions_m: 5457.0,
        junctions: 27,
        highest_m: 11.0,
    },
];

#[test]
#[ignore = "needs V2V_DATA"]
fn maps_are_read_as_their_readme_counts_them() {
    let folder = fixtures::data("opendrive");
    for expected in MAPS {
        let network = opendrive::read(std::fs::read(folder.join(expected.file)).unwrap()).unwrap();
        let length = |outside: bool| -> f64 {
            let roads = network
                .roads
                .iter()
                .filter(|road| !outside || road.junction.is_none());
            roads.map(|road| road.length_m).sum()
        };
        assert_eq!(
            (network.roads.len(), network.junctions.len()),
            (expected.roads, expected.junctions)
        );
        assert_eq!(network.findings, [], "{}", expected.file);
        assert!(
            (length(false) - expected.length_m).abs() < 1.0,
            "{}: {}",
            expected.file,
            length(false)
        );
        assert!(
            (length(true) - expected.outside_junctions_m).abs() < 1.0,
            "{}: {}",
            expected.file,
            length(true)
        );
        check_reference_lines(expected.file, &network);
        let (graph, findings) = lane_graph(&network);
        assert_eq!(findings, [], "{}", expected.file);
        check_links(expected.file, &graph);
        let highest = graph
            .lanes
            .iter()
            .flat_map(|lane| &lane.centerline)
            .map(|p| p[2])
            .fold(0.0, f64::max);
        assert!(
            (highest - expected.highest_m).abs() < 0.1,
            "{}: highest lane at {highest} m",
            expected.file
        );
    }
}

/// Elements of a reference line follow each other in position and heading.
fn check_reference_lines(file: &str, network: &RoadNetwork) {
    for road in &network.roads {
        for pair in road.plan_view.windows(2) {
            let (end, start) = (pair[0].end(), pair[1].start);
            assert!(
                end.distance_m(&start) < 0.02,
                "{file}: road {} breaks by {}",
                road.id,
                end.distance_m(&start)
            );
            let turn = (end.heading_rad - start.heading_rad).sin();
            assert!(
                turn.abs() < 0.02,
                "{file}: road {} bends by {turn}",
                road.id
            );
        }
    }
}

/// Lanes follow each other in position and heading, and from nearly every lane a vehicle can drive on for kilometres.
fn check_links(file: &str, graph: &LaneGraph) {
    for lane in &graph.lanes {
        let end = lane.centerline[lane.centerline.len() - 1];
        for &next in &lane.successors {
            let next = graph.lane(next);
            let gap = (0..3)
                .map(|axis| (end[axis] - next.centerline[0][axis]).powi(2))
                .sum::<f64>()
                .sqrt();
            let turn = (next.at(0.0).1 - lane.at(lane.length_m).1).sin();
            assert!(
                gap < 0.5 && turn.abs() < 0.2,
                "{file}: {:?} to {:?}: {gap} m, {turn} rad",
                lane.id,
                next.id
            );
        }
    }
    let far = graph.lanes.iter().filter(|lane| {
        let (mut driven, mut current, mut choice) = (0.0, *lane, 0);
        while driven < DRIVE_M && !current.successors.is_empty() {
            driven += current.length_m;
            choice += 1;
            current = graph.lane(current.successors[choice % current.successors.len()]);
        }
        driven >= DRIVE_M
    });
    let share = far.count() as f64 / graph.lanes.len() as f64;
    assert!(
        share > 0.97,
        "{file}: only from {share} of the lanes one can drive {DRIVE_M} m"
    );
}

#[test]
#[ignore = "needs V2V_DATA"]
fn maps_become_models_with_free_lanes_the_same_every_time() {
    let folder = fixtures::data("opendrive");
    for expected in MAPS {
        let source = RoadMapSource::OpenDrive(folder.join(expected.file));
        let (map_model, again) = (build(&source, 3).unwrap(), build(&source, 3).unwrap());
        assert!(map_model == again, "{} differs from itself", expected.file);
        let found = map_model.obstructions();
        let first = found
            .first()
            .map(|&(lane, solid)| (lane, map_model.solids[solid]));
        assert!(
            found.is_empty(),
            "{}: {} lanes obstructed, such as {first:?}",
            expected.file,
            found.len()
        );
        assert!(map_model.solids.len() > 2000 && map_model.parking.len() > 50);
        // The ground meets the lanes, except where they pass above it.
        let (mut below, mut points) = (0u32, 0u32);
        for point in map_model
            .lanes
            .lanes
            .iter()
            .flat_map(|lane| &lane.centerline)
        {
            let ground = map_model.ground.height_m(point[0], point[1]);
            assert!(
                ground < point[2] + 0.3,
                "{}: the ground is {} m over a lane at {point:?}",
                expected.file,
                ground - point[2]
            );
            below += u32::from(ground < point[2] - 0.3);
            points += 1;
        }
        assert!(
            f64::from(below) < 0.05 * f64::from(points),
            "{}: {below} of {points} points hang",
            expected.file
        );
    }
}
