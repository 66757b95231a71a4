//! Traffic in whole towns.

use super::*;
use crate::synth::vehicle::Vehicle;
use crate::town::{Lane, LaneGraph, TownSource, build};

fn options(vehicles_per_km: f64) -> TrafficOptions {
    TrafficOptions { vehicles_per_km, radius_m: 210.0, focus_explores: false }
}

/// Overlapping pairs of footprints among those that are present.
fn overlaps(traffic: &Traffic<'_>) -> Vec<(i64, i64)> {
    let present: Vec<&Car> = traffic.cars.iter().filter(|car| car.is_present).collect();
    let mut pairs = Vec::new();
    for (place, car) in present.iter().enumerate() {
        let rectangle = car.rectangle();
        let others = present[place + 1..].iter().filter(|other| other.rectangle().overlaps(&rectangle));
        pairs.extend(others.map(|other| (car.id, other.id)));
    }
    pairs
}

#[test]
fn nobody_overlaps_and_most_get_on() {
    for source in [TownSource::Town1, TownSource::Town4] {
        let town = build(&source, 0).unwrap();
        let roads = Roads::new(&town.lanes);
        for seed in 0..3 {
            let start = roads.spawns[SplitMix64::new(seed).below(roads.spawns.len())];
            let mut traffic = Traffic::new(&roads, &[], options(35.0), start, seed);
            assert!(traffic.cars.len() > 20, "{}: {} vehicles", town.name, traffic.cars.len());
            let (mut moving, mut all) = (0, 0);
            for step in 0..1200 {
                traffic.step();
                if step % 5 == 0 {
                    assert_eq!(overlaps(&traffic), [], "{} seed {seed} step {step}", town.name);
                }
                if step > 600 {
                    let present = traffic.cars.iter().filter(|car| car.is_present);
                    all += present.clone().count();
                    moving += present.filter(|car| car.speed_mps > 0.5).count();
                }
            }
            assert!(moving * 2 > all, "{} seed {seed}: {moving} of {all} vehicle steps are moving", town.name);
        }
    }
}

#[test]
fn vehicles_follow_with_a_gap_and_stop_for_who_stands() {
    let line = (0..400).map(|x| [f64::from(x), 0.0, 0.0]).collect();
    let graph = LaneGraph::new(vec![Lane::new(crate::town::LaneId(0), line, 3.5, 14.0)]);
    let roads = Roads::new(&graph);
    let blocked = Vehicle::random_parked(&mut SplitMix64::new(1));
    let parked = [Rectangle::new(&super::super::cast::Placement::level([300.0, 0.0, 0.0], 0.0), &blocked.size_m)];
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

#[test]
fn the_same_seed_drives_the_same_way() {
    let town = build(&TownSource::Town1, 0).unwrap();
    let roads = Roads::new(&town.lanes);
    let end = |seed| {
        let mut traffic = Traffic::new(&roads, &[], options(30.0), roads.spawns[10], seed);
        (0..400).for_each(|_| traffic.step());
        traffic.cars.iter().map(|car| (car.id, car.motion)).collect::<Vec<_>>()
    };
    assert_eq!(end(4), end(4));
    assert_ne!(end(4), end(5));
}
