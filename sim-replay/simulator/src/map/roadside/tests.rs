use super::super::convex::{PlanRectangle, overlap};
use super::super::{
    Ground, Lane, LaneGraph, LaneId, MapModel, RoadMapSource, Shape, Solid, SolidKind, build,
};

#[test]
fn a_pole_on_the_lane_is_found_and_a_sign_above_it_is_not() {
    let line = (0..=20).map(|i| [f64::from(i), 0.0, 0.0]).collect();
    let lanes = LaneGraph::new(vec![Lane::new(LaneId(0), line, 3.5, 10.0)]);
    let shape = Shape::Box {
        half_m: [0.3, 0.3, 0.5],
    };
    let solids = [[0.0, 5.6], [1.5, 1.0], [2.5, 1.0], [0.0, -0.6]].map(|[y, z]| Solid {
        kind: SolidKind::Sign,
        shape,
        center_m: [10.0, y, z],
        yaw_rad: 0.3,
        reflectivity: 0.5,
    });
    let ground = Ground::plane(0.0);
    let map_model = MapModel {
        name: "line".into(),
        lanes,
        ground,
        solids: solids.into(),
        parking: vec![],
        findings: vec![],
    };
    assert_eq!(map_model.obstructions(), [(LaneId(0), 1)]);
}

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
                let [bottom_m, top_m] = solid.z_m();
                bottom_m < z + 2.0 && top_m > z + 0.1 && overlap(&solid.outline().corners(), &car)
            });
            assert!(blocked.is_none(), "{source:?}: {spot:?} holds {blocked:?}");
        }
    }
}

fn count(map_model: &MapModel, kind: SolidKind) -> usize {
    let solids = map_model.solids.iter();
    solids.filter(|solid| solid.kind == kind).count()
}

#[test]
fn streets_are_lined_with_buildings_trees_and_parking() {
    let map_model = build(&RoadMapSource::Town1, 4).unwrap();
    for (kind, fewest) in [
        (SolidKind::Building, 500),
        (SolidKind::TreeTrunk, 200),
        (SolidKind::Pole, 100),
    ] {
        let found = count(&map_model, kind);
        assert!(found > fewest, "{kind:?}: {found}");
    }
    assert!(map_model.parking.len() > 200, "{}", map_model.parking.len());
}

#[test]
fn motorways_have_barriers_walls_pillars_and_a_tunnel() {
    let map_model = build(&RoadMapSource::Town4, 4).unwrap();
    for (kind, least) in [
        (SolidKind::Barrier, 1000),
        (SolidKind::NoiseWall, 100),
        (SolidKind::Pillar, 4),
        (SolidKind::TunnelWall, 20),
        (SolidKind::BridgeDeck, 20),
    ] {
        let found = count(&map_model, kind);
        assert!(found >= least, "{kind:?}: {found}");
    }
}
