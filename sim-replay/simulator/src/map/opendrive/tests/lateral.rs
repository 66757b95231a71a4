//! Roads that are not level across: surface, lanes, ground.

use super::super::super::layout::RoadLayout;
use super::super::super::road::Road;
use super::super::super::{LaneGraph, place_roadside};
use super::*;

/// A road banked by 0.1 rad to the left, with a level pavement on its right, and one with crossfall and shape.
pub(super) const BANKED: &str = r#"<OpenDRIVE>
  <road id="banked" length="80" junction="-1">
    <planView><geometry s="0" x="0" y="0" hdg="0" length="80"><line/></geometry></planView>
    <elevationProfile><elevation s="0" a="2" b="0.01" c="0" d="0"/></elevationProfile>
    <lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>
    <lanes><laneSection s="0">
      <left><lane id="1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></left>
      <right><lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane>
        <lane id="-2" type="sidewalk" level="true"><width sOffset="0" a="2" b="0" c="0" d="0"/></lane></right>
    </laneSection></lanes></road>
  <road id="roof" length="80" junction="-1">
    <planView><geometry s="0" x="0" y="200" hdg="0" length="80"><line/></geometry></planView>
    <lateralProfile>
      <crossfall side="left" s="0" a="0.02" b="0" c="0" d="0"/><crossfall side="right" s="0" a="0.05" b="0" c="0" d="0"/>
      <shape s="0" t="-4" a="0.4" b="0" c="0" d="0"/><shape s="0" t="0" a="0.4" b="-0.1" c="0" d="0"/>
    </lateralProfile>
    <lanes><laneSection s="0">
      <left><lane id="1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></left>
      <right><lane id="-1" type="driving"><width sOffset="0" a="4" b="0" c="0" d="0"/></lane></right>
    </laneSection></lanes></road>
</OpenDRIVE>"#;

fn banked() -> RoadNetwork {
    let network = read(BANKED).unwrap();
    assert_eq!(network.findings, []);
    network
}

fn point(road: &Road, t: f64) -> [f64; 3] {
    road.point_at(0, 40.0, t)
}

#[test]
fn edges_lie_at_the_sine_of_the_superelevation() {
    let road = &banked().roads[0];
    let (sin, cos) = 0.1f64.sin_cos();
    for t in [-4.0, -1.0, 0.0, 4.0] {
        let [x, y, z] = point(road, t);
        assert!(
            (x - 40.0).abs() < 1e-9
                && (y - t * cos).abs() < 1e-9
                && (z - 2.4 - t * sin).abs() < 1e-9,
            "{t}"
        );
    }
    // The level pavement goes on at the height of its inner border.
    let [_, y, z] = point(road, -6.0);
    assert!(
        (y + 4.0 * cos + 2.0).abs() < 1e-9 && (z - 2.4 + 4.0 * sin).abs() < 1e-9,
        "{y} {z}"
    );
}

#[test]
fn crossfall_and_shape_add_up() {
    let road = &banked().roads[1];
    for (t, expected) in [
        (0.0, 0.4),
        (2.0, 0.4 - 0.2 - 2.0 * 0.02f64.tan()),
        (-3.0, 0.4 - 3.0 * 0.05f64.tan()),
    ] {
        assert!(
            (point(road, t)[2] - expected).abs() < 1e-9,
            "{t}: {}",
            point(road, t)[2]
        );
    }
}

#[test]
fn lanes_bank_with_their_road_to_either_side() {
    let (graph, _): (LaneGraph, _) = lane_builder::lane_graph(&banked());
    let at = |y: f64| {
        graph
            .lanes
            .iter()
            .find(|lane| (lane.centerline[0][1] - y).abs() < 0.1)
            .unwrap()
    };
    let (right, left) = (at(-2.0), at(2.0));
    // In driving direction, the left side of the right lane is higher, and that of the oncoming lane is lower.
    assert!((right.bank_rad(40.0) - 0.1).abs() < 1e-9 && (left.bank_rad(40.0) + 0.1).abs() < 1e-9);
    let (place, _) = right.at(40.0);
    assert!(
        (place[2] - 2.4 + 2.0 * 0.1f64.sin()).abs() < 1e-9,
        "{place:?}"
    );
    let falls = at(198.0);
    assert!(
        (falls.bank_rad(40.0) - 0.05).abs() < 1e-9,
        "{}",
        falls.bank_rad(40.0)
    );
}

#[test]
fn the_ground_meets_the_banked_surface() {
    let network = banked();
    let map_model = place_roadside(
        "banked".into(),
        &RoadLayout {
            network: network.clone(),
            islands: Vec::new(),
        },
        1,
    );
    for (road, ts) in network
        .roads
        .iter()
        .zip([[-3.9, -2.0, 0.5, 3.9], [-3.5, -1.0, 1.5, 3.5]])
    {
        for place in 2..40 {
            for t in ts {
                let [x, y, z] = road.point_at(0, 2.0 * f64::from(place), t);
                let ground = map_model.ground.height_m(x, y);
                assert!(
                    (ground - z).abs() < 0.13,
                    "road {} at t={t}: ground {ground}, road {z}",
                    road.id
                );
            }
        }
    }
    assert!(
        map_model.obstructions().is_empty(),
        "{:?}",
        map_model.obstructions()
    );
}

#[test]
fn a_lateral_profile_that_is_none_is_left_out_and_named() {
    for (from, to, named) in [
        (
            r#"a="0.1" b="0""#,
            r#"a="0.1" b="1""#,
            "<lateralProfile> holds <superelevation> up to 80.10 rad, expected at most 1.4",
        ),
        (
            r#"a="0.1" b="0""#,
            r#"a="steep" b="0""#,
            "<superelevation> a=\"steep\", expected a number",
        ),
        (
            r#"s="0" t="0""#,
            r#"s="0" t="-5""#,
            "<shape> t=\"-5\", expected the elements in rising order",
        ),
        (
            "<lateralProfile><sup",
            "<lateralProfile><crossSectionSurface><strip><constant s=\"0\" a=\"-0.3\"/></strip></crossSectionSurface><sup",
            "<crossSectionSurface> up to 0.30 m high",
        ),
    ] {
        assert!(BANKED.contains(from));
        let network = read(BANKED.replacen(from, to, 1)).unwrap();
        assert_eq!(
            (network.roads.len(), network.findings.len()),
            (2, 1),
            "{:?}",
            network.findings
        );
        assert!(
            network.findings[0].to_string().contains(named),
            "{}",
            network.findings[0]
        );
    }
}
