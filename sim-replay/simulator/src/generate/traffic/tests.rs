//! Traffic on whole maps.

use super::*;
use crate::generate::vehicle::Vehicle;
use crate::map::{Lane, LaneGraph, LaneId, RoadMapSource, build, lane_builder, opendrive};

fn options(vehicles_per_km: f64) -> TrafficOptions {
    TrafficOptions {
        vehicles_per_km,
        radius_m: 210.0,
        focus_explores: false,
    }
}

/// Overlapping pairs of footprints among those that are present.
fn overlaps(traffic: &Traffic<'_>) -> Vec<(i64, i64)> {
    let present: Vec<&Car> = traffic.cars.iter().filter(|car| car.is_present).collect();
    let mut pairs = Vec::new();
    for (place, car) in present.iter().enumerate() {
        let rectangle = car.rectangle();
        let others = present[place + 1..]
            .iter()
            .filter(|other| other.rectangle().overlaps(&rectangle));
        pairs.extend(others.map(|other| (car.id, other.id)));
    }
    pairs
}

#[test]
fn no_vehicles_overlap_and_most_move() {
    for source in [RoadMapSource::Town1, RoadMapSource::Town4] {
        let map_model = build(&source, 0).unwrap();
        let roads = Roads::new(&map_model.lanes);
        for seed in 0..3 {
            let start = roads.spawns[SplitMix64::new(seed).below(roads.spawns.len())];
            let mut traffic = Traffic::new(&roads, &[], options(35.0), start, seed);
            assert!(
                traffic.cars.len() > 20,
                "{}: {} vehicles",
                map_model.name,
                traffic.cars.len()
            );
            let (mut moving, mut all, mut changing) = (0, 0, 0);
            for step in 0..1200 {
                traffic.step();
                changing += traffic
                    .cars
                    .iter()
                    .filter(|car| car.path.is_changing())
                    .count();
                if step % 5 == 0 {
                    assert_eq!(
                        overlaps(&traffic),
                        [],
                        "{} seed {seed} step {step}",
                        map_model.name
                    );
                }
                if step > 600 {
                    let present = traffic.cars.iter().filter(|car| car.is_present);
                    all += present.clone().count();
                    moving += present.filter(|car| car.speed_mps > 0.5).count();
                }
            }
            assert!(
                moving * 2 > all,
                "{} seed {seed}: {moving} of {all} vehicle steps are moving",
                map_model.name
            );
            // The first map has one lane each way.
            assert_eq!(
                changing > 0,
                source == RoadMapSource::Town4,
                "{} seed {seed}: {changing}",
                map_model.name
            );
        }
    }
}

#[test]
fn vehicles_keep_a_gap_and_stop_behind_standing_ones() {
    let line = (0..400).map(|x| [f64::from(x), 0.0, 0.0]).collect();
    let graph = LaneGraph::new(vec![Lane::new(LaneId(0), line, 3.5, 14.0)]);
    let roads = Roads::new(&graph);
    let blocked = Vehicle::random_parked(&mut SplitMix64::new(1));
    let parked = [Rectangle::new(
        &super::super::raycast::Placement::level([300.0, 0.0, 0.0], 0.0),
        &blocked.size_m,
    )];
    let mut traffic = Traffic::new(&roads, &parked, options(20.0), roads.spawns[2], 3);
    for _ in 0..2000 {
        traffic.step();
        assert_eq!(overlaps(&traffic), []);
    }
    let mut fronts: Vec<(f64, f64)> = traffic
        .cars
        .iter()
        .filter(|car| car.is_present && car.motion.end.position_m.x < 296.0)
        .map(|car| (car.motion.end.position_m.x, car.half_length_m()))
        .collect();
    fronts.sort_by(|a, b| a.0.total_cmp(&b.0));
    assert!(fronts.len() >= 2);
    for pair in fronts.windows(2) {
        let gap = pair[1].0 - pair[0].0 - pair[0].1 - pair[1].1;
        assert!(gap > 0.8, "{gap}");
    }
}

/// Two lanes of one length that lead the same way, the second to the left of the first.
fn two_lanes(length_m: i32) -> LaneGraph {
    let mut lanes = [0, 1].map(|id: u32| {
        let y = 3.5 * f64::from(id);
        let line = (0..=length_m).map(|x| [f64::from(x), y, 0.0]).collect();
        Lane::new(LaneId(id), line, 3.5, 14.0)
    });
    (lanes[0].left, lanes[1].right) = (Some(LaneId(1)), Some(LaneId(0)));
    LaneGraph::new(lanes.into())
}

fn add_slow(traffic: &mut Traffic<'_>, lane: u32, s_m: f64, pace: f64) {
    let vehicle = Vehicle::random_driving(&mut SplitMix64::new(7));
    let spawn = *traffic
        .roads
        .spawns
        .iter()
        .find(|spawn| spawn.lane == LaneId(lane) && spawn.s_m >= s_m)
        .unwrap();
    traffic.add(vehicle, spawn);
    let car = traffic.cars.last_mut().unwrap();
    car.driver.pace = pace;
    car.speed_mps = 14.0 * pace;
}

#[test]
fn a_driver_changes_lanes_smoothly_to_get_past_somebody_slow() {
    let graph = two_lanes(900);
    let roads = Roads::new(&graph);
    let mut traffic = Traffic::new(&roads, &[], options(0.0), roads.spawns[0], 3);
    add_slow(&mut traffic, 0, 60.0, 0.25);
    let mut last = traffic.cars[0].motion.end;
    while last.position_m.x < 250.0 {
        traffic.step();
        assert_eq!(overlaps(&traffic), []);
        let focus = &traffic.cars[0];
        let (now, speed_mps) = (focus.motion.end, focus.speed_mps);
        assert_eq!(focus.motion.start, last);
        let moved = now.position_m - last.position_m;
        assert!(
            moved.y.abs() < 2.0 * STEP_S,
            "{} m/s sideways",
            moved.y / STEP_S
        );
        assert!(
            (moved.norm() - speed_mps * STEP_S).abs() < 0.02 * speed_mps * STEP_S + 1e-9,
            "{moved} {speed_mps}"
        );
        assert!(
            (now.yaw_rad - last.yaw_rad).abs() < 0.03,
            "{} {}",
            now.yaw_rad,
            last.yaw_rad
        );
        last = now;
    }
    let slow = traffic.cars[1].motion.end.position_m;
    assert!(slow.x < last.position_m.x && slow.y.abs() < 0.3, "{slow}");
    assert!((last.position_m.y - 3.5).abs() < 0.3, "{last:?}");
}

#[test]
fn no_lane_change_causes_a_collision() {
    let graph = two_lanes(900);
    let roads = Roads::new(&graph);
    let mut traffic = Traffic::new(&roads, &[], options(0.0), roads.spawns[0], 3);
    // Two abreast, equally slow: overtaking is impossible.
    add_slow(&mut traffic, 0, 60.0, 0.3);
    add_slow(&mut traffic, 1, 56.0, 0.3);
    for _ in 0..1200 {
        traffic.step();
        assert_eq!(overlaps(&traffic), []);
        assert!(
            traffic
                .cars
                .iter()
                .all(|car| car.motion.end.position_m.y > -0.3)
        );
    }
    let [focus, right, left] =
        [0, 1, 2].map(|car: usize| traffic.cars[car].motion.end.position_m.x);
    assert!(focus < right && focus < left, "{focus} {right} {left}");
}

#[test]
fn an_exploring_focus_drives_several_lanes_of_a_road() {
    let map_model = build(&RoadMapSource::Town4, 0).unwrap();
    let roads = Roads::new(&map_model.lanes);
    let options = TrafficOptions {
        focus_explores: true,
        ..options(12.0)
    };
    let mut both = 0;
    for seed in 0..4 {
        let start = roads.spawns[SplitMix64::new(seed).below(roads.spawns.len())];
        let mut traffic = Traffic::new(&roads, &[], options, start, seed);
        let mut driven = vec![false; map_model.lanes.lanes.len()];
        for _ in 0..3600 {
            traffic.step();
            driven[traffic.cars[0].path.lane().0 as usize] = true;
        }
        both += map_model
            .lanes
            .lanes
            .iter()
            .filter(|lane| driven[lane.id.0 as usize])
            .filter(|lane| lane.left.is_some_and(|left| driven[left.0 as usize]))
            .count();
    }
    assert!(both >= 4, "{both} lanes were driven beside another one");
}

#[test]
fn the_same_seed_drives_the_same_way() {
    let map_model = build(&RoadMapSource::Town1, 0).unwrap();
    let roads = Roads::new(&map_model.lanes);
    let [once, again, other] = [4, 4, 5].map(|seed| {
        let mut traffic = Traffic::new(&roads, &[], options(30.0), roads.spawns[10], seed);
        (0..400).for_each(|_| traffic.step());
        traffic
            .cars
            .iter()
            .map(|car| (car.id, car.motion))
            .collect::<Vec<_>>()
    });
    assert_eq!(once, again);
    assert_ne!(once, other);
}

#[test]
fn knots_come_undone() {
    let map_model = build(&RoadMapSource::Town4, 0).unwrap();
    let roads = Roads::new(&map_model.lanes);
    let options = TrafficOptions {
        focus_explores: true,
        ..options(14.0)
    };
    // Seeds whose roundabouts fill up within six minutes.
    for seed in [0, 6, 23] {
        let start = roads.spawns[SplitMix64::new(seed).below(roads.spawns.len())];
        let mut traffic = Traffic::new(&roads, &[], options, start, seed);
        let mut longest_s: f64 = 0.0;
        for _ in 0..8000 {
            traffic.step();
            longest_s = longest_s.max(traffic.cars[0].standing_s);
        }
        assert!(
            longest_s < 90.0,
            "seed {seed}: the focus stands for {longest_s} s"
        );
    }
}

/// Lanes of an OpenDRIVE map of one road.
fn one_road(attributes: &str, geometry: &str, lateral: &str, lanes: &str) -> LaneGraph {
    let text = format!(
        r#"<OpenDRIVE><road id="1" junction="-1" {attributes}><planView>{geometry}</planView>{lateral}
        <lanes><laneSection s="0">{lanes}</laneSection></lanes></road></OpenDRIVE>"#
    );
    let network = opendrive::read(&text).unwrap();
    assert_eq!(network.findings, []);
    lane_builder::lane_graph(&network).0
}

#[test]
fn vehicles_drive_on_the_side_that_the_map_gives() {
    let [left, right] = [1, -1].map(|id| {
        format!(
            r#"<lane id="{id}" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>"#
        )
    });
    let lanes = format!("<left>{left}</left><right>{right}</right>");
    let line = r#"<geometry s="0" x="0" y="0" hdg="0" length="400"><line/></geometry>"#;
    for (rule, eastwards_y_m) in [("LHT", 1.75), ("RHT", -1.75)] {
        let graph = one_road(&format!(r#"length="400" rule="{rule}""#), line, "", &lanes);
        let roads = Roads::new(&graph);
        let mut traffic = Traffic::new(&roads, &[], options(30.0), roads.spawns[3], 5);
        let (mut east, mut west) = (0, 0);
        for _ in 0..200 {
            traffic.step();
            assert_eq!(overlaps(&traffic), []);
            for car in traffic.cars.iter().filter(|car| car.is_present) {
                let (place, along) = (car.motion.end.position_m, car.motion.end.yaw_rad.cos());
                // Half a metre of the own lane's middle, with the driver's habit.
                assert!(
                    (place.y - along.signum() * eastwards_y_m).abs() < 0.5,
                    "{rule}: {place} {along}"
                );
                let moved = place.x - car.motion.start.position_m.x;
                assert!(
                    along.abs() > 0.99 && moved * along >= 0.0,
                    "{rule}: {moved} {along}"
                );
                *(if along > 0.0 { &mut east } else { &mut west }) += 1;
            }
        }
        assert!(east > 100 && west > 100, "{rule}: {east} {west}");
    }
}

#[test]
fn vehicles_lean_with_a_banked_road_and_pass_side_by_side() {
    let (radius_m, bank_rad): (f64, f64) = (80.0, 0.7);
    let length_m = std::f64::consts::TAU * radius_m;
    // A circle to the left, its right side high; both ends meet.
    let link = r#"<link><predecessor elementType="road" elementId="1" contactPoint="end"/>
        <successor elementType="road" elementId="1" contactPoint="start"/></link>"#;
    let geometry = format!(
        r#"<geometry s="0" x="0" y="0" hdg="0" length="{length_m}"><arc curvature="{}"/></geometry>"#,
        1.0 / radius_m
    );
    let lateral = format!(
        r#"{link}<lateralProfile><superelevation s="0" a="{}" b="0" c="0" d="0"/></lateralProfile>"#,
        -bank_rad
    );
    let [inner, outer] = [-1, -2].map(|id| {
        format!(
            r#"<lane id="{id}" type="driving"><link><predecessor id="{id}"/><successor id="{id}"/></link>
            <width sOffset="0" a="3.4" b="0" c="0" d="0"/></lane>"#
        )
    });
    let lanes = format!("<right>{inner}{outer}</right>");
    let graph = one_road(
        &format!(r#"length="{length_m}""#),
        &geometry,
        &lateral,
        &lanes,
    );
    assert!(graph.lanes.iter().all(|lane| lane.successors == [lane.id]));
    let roads = Roads::new(&graph);
    let mut traffic = Traffic::new(&roads, &[], options(20.0), roads.spawns[0], 9);
    let (mut moving, mut all) = (0, 0);
    for step in 0..1200 {
        traffic.step();
        assert_eq!(overlaps(&traffic), []);
        for car in traffic.cars.iter().filter(|car| car.is_present) {
            let placement = car.motion.end;
            let place = placement.position_m;
            let beside_m = (place.x.powi(2) + (place.y - radius_m).powi(2)).sqrt() - radius_m;
            // On the plane of the bank, and leaning as it does.
            assert!(
                (place.z - beside_m * bank_rad.tan()).abs() < 0.1,
                "{place} {beside_m}"
            );
            assert!(
                (placement.roll_rad + bank_rad).abs() < 1e-6,
                "{}",
                placement.roll_rad
            );
            if step > 400 {
                all += 1;
                moving += usize::from(car.speed_mps > 3.0);
            }
        }
    }
    assert!(moving * 10 > all * 9, "{moving} of {all}");
}
