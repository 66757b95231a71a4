use super::super::convex::{Rectangle, overlap};
use super::super::{LaneGraph, Town, TownSource, build};
use super::site::outline;
use crate::town::SolidKind;

/// Solids that reach into the space above a lane: the first few, described.
fn intruders(town: &Town) -> Vec<String> {
    let mut found = Vec::new();
    let lanes: &LaneGraph = &town.lanes;
    let mut cells = std::collections::BTreeMap::<[i64; 2], Vec<usize>>::new();
    let cell = |x: f64| (x / 10.0).floor() as i64;
    for (index, solid) in town.solids.iter().enumerate() {
        let (low, high) = solid.bounds_m();
        for column in cell(low[0])..=cell(high[0]) {
            for row in cell(low[1])..=cell(high[1]) {
                cells.entry([column, row]).or_default().push(index);
            }
        }
    }
    for lane in &lanes.lanes {
        for (pair, width) in lane.centerline.windows(2).zip(&lane.widths_m) {
            let (dx, dy) = (pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]);
            let center_m = [(pair[0][0] + pair[1][0]) / 2.0, (pair[0][1] + pair[1][1]) / 2.0];
            let half_m = [dx.hypot(dy) / 2.0, (width / 2.0 - 0.02).max(0.01)];
            let piece = Rectangle { center_m, half_m, yaw_rad: dy.atan2(dx) };
            let z = pair[0][2];
            for &index in cells.get(&[cell(center_m[0]), cell(center_m[1])]).into_iter().flatten() {
                let solid = &town.solids[index];
                let beside = solid.bottom_m() > z + 4.5 || solid.top_m() < z + 0.02;
                if !beside && overlap(&outline(solid).corners(), &piece.corners()) {
                    found.push(format!("{:?} at {:?} over {:?} at {:?}", solid.kind, solid.center_m, lane.id, pair[0]));
                }
            }
        }
    }
    found
}

#[test]
fn nothing_stands_on_a_lane() {
    for source in [TownSource::Town1, TownSource::Town4] {
        for seed in [0, 1, 2, 3] {
            let town = build(&source, seed).unwrap();
            let found = intruders(&town);
            assert!(found.is_empty(), "{source:?} {seed}: {} such as {:?}", found.len(), &found[..3.min(found.len())]);
        }
    }
}

#[test]
fn streets_are_lined_with_buildings_trees_and_parking() {
    let town = build(&TownSource::Town1, 4).unwrap();
    let count = |kind| town.solids.iter().filter(|solid| solid.kind == kind).count();
    assert!(count(SolidKind::Building) > 500, "{}", count(SolidKind::Building));
    assert!(count(SolidKind::TreeTrunk) > 200, "{}", count(SolidKind::TreeTrunk));
    assert!(count(SolidKind::Pole) > 100, "{}", count(SolidKind::Pole));
    assert!(town.parking.len() > 200, "{}", town.parking.len());
}
