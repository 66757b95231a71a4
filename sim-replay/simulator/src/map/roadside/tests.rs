use super::super::convex::{PlanRectangle, overlap};
use super::super::{RoadMapSource, SolidKind, build};
use super::site::outline;

#[test]
fn nothing_stands_on_a_lane() {
    for source in [RoadMapSource::Town1, RoadMapSource::Town4] {
        for seed in [0, 1, 2, 3] {
            let map_model = build(&source, seed).unwrap();
            let found = map_model.obstructions();
            let first = found
                .first()
                .map(|&(lane, solid)| (lane, map_model.solids[solid]));
            assert!(
                found.is_empty(),
                "{source:?} {seed}: {} such as {first:?}",
                found.len()
            );
        }
    }
}

#[test]
fn parking_spots_are_free() {
    for source in [RoadMapSource::Town1, RoadMapSource::Town4] {
        let map_model = build(&source, 1).unwrap();
        for spot in &map_model.parking {
            let [x, y, z] = spot.center_m;
            // A car's outline within the spot, up to the height of a van.
            let car = PlanRectangle {
                center_m: [x, y],
                half_m: [2.2, 0.85],
                yaw_rad: spot.yaw_rad,
            }
            .corners();
            let blocked = map_model.solids.iter().find(|solid| {
                solid.bottom_m() < z + 2.0
                    && solid.top_m() > z + 0.1
                    && overlap(&outline(solid).corners(), &car)
            });
            assert!(blocked.is_none(), "{source:?}: {spot:?} holds {blocked:?}");
        }
    }
}

#[test]
fn streets_are_lined_with_buildings_trees_and_parking() {
    let map_model = build(&RoadMapSource::Town1, 4).unwrap();
    let count = |kind| {
        map_model
            .solids
            .iter()
            .filter(|solid| solid.kind == kind)
            .count()
    };
    assert!(
        count(SolidKind::Building) > 500,
        "{}",
        count(SolidKind::Building)
    );
    assert!(
        count(SolidKind::TreeTrunk) > 200,
        "{}",
        count(SolidKind::TreeTrunk)
    );
    assert!(count(SolidKind::Pole) > 100, "{}", count(SolidKind::Pole));
    assert!(map_model.parking.len() > 200, "{}", map_model.parking.len());
}

#[test]
fn motorways_have_barriers_walls_pillars_and_a_tunnel() {
    let map_model = build(&RoadMapSource::Town4, 4).unwrap();
    let count = |kind| {
        map_model
            .solids
            .iter()
            .filter(|solid| solid.kind == kind)
            .count()
    };
    for (kind, least) in [
        (SolidKind::Barrier, 1000),
        (SolidKind::NoiseWall, 100),
        (SolidKind::Pillar, 4),
        (SolidKind::TunnelWall, 20),
        (SolidKind::BridgeDeck, 20),
    ] {
        assert!(count(kind) >= least, "{kind:?}: {}", count(kind));
    }
}
