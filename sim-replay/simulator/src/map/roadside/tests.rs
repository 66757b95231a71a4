use super::super::convex::{Rectangle, overlap};
use super::super::{SolidKind, TownSource, build};
use super::site::outline;

#[test]
fn nothing_stands_on_a_lane() {
    for source in [TownSource::Town1, TownSource::Town4] {
        for seed in [0, 1, 2, 3] {
            let town = build(&source, seed).unwrap();
            let found = town.obstructions();
            let first = found.first().map(|&(lane, solid)| (lane, town.solids[solid]));
            assert!(found.is_empty(), "{source:?} {seed}: {} such as {first:?}", found.len());
        }
    }
}

#[test]
fn parking_spots_are_free() {
    for source in [TownSource::Town1, TownSource::Town4] {
        let town = build(&source, 1).unwrap();
        for spot in &town.parking {
            let [x, y, z] = spot.center_m;
            // A car's outline within the spot, up to the height of a van.
            let car = Rectangle { center_m: [x, y], half_m: [2.2, 0.85], yaw_rad: spot.yaw_rad }.corners();
            let blocked = town.solids.iter().find(|solid| {
                solid.bottom_m() < z + 2.0 && solid.top_m() > z + 0.1 && overlap(&outline(solid).corners(), &car)
            });
            assert!(blocked.is_none(), "{source:?}: {spot:?} holds {blocked:?}");
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

#[test]
fn motorways_have_barriers_walls_pillars_and_a_tunnel() {
    let town = build(&TownSource::Town4, 4).unwrap();
    let count = |kind| town.solids.iter().filter(|solid| solid.kind == kind).count();
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
