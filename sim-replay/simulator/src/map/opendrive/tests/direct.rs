//! Direct junctions: roads that are linked without a road between them.

use super::super::super::lane::{Lane, LaneGraph};
use super::*;

/// A motorway of two lanes whose outer lane goes off onto a ramp, all by one direct junction.
pub(super) const EXIT: &str = r#"<OpenDRIVE>
  <road id="in" length="60" junction="-1"><link><successor elementType="junction" elementId="j"/></link>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="60"><line/></geometry></planView>
    <lanes><laneSection s="0"><right>
      <lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
      <lane id="-2" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
    </right></laneSection></lanes></road>
  <road id="on" length="60" junction="-1"><link><predecessor elementType="junction" elementId="j"/></link>
    <planView><geometry s="0" x="60" y="0" hdg="0" length="60"><line/></geometry></planView>
    <lanes><laneSection s="0"><right>
      <lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
    </right></laneSection></lanes></road>
  <road id="off" length="40" junction="-1"><link><predecessor elementType="junction" elementId="j"/></link>
    <planView><geometry s="0" x="60" y="-3" hdg="0" length="40"><arc curvature="-0.01"/></geometry></planView>
    <lanes><laneSection s="0"><right>
      <lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
    </right></laneSection></lanes></road>
  <junction id="j" type="direct">
    <connection id="0" incomingRoad="in" linkedRoad="on" contactPoint="start"><laneLink from="-1" to="-1"/></connection>
    <connection id="1" incomingRoad="in" linkedRoad="off" contactPoint="start"><laneLink from="-2" to="-1"/></connection>
  </junction>
</OpenDRIVE>"#;

fn graph(text: &str) -> LaneGraph {
    let network = read(text).unwrap();
    assert_eq!(network.findings, []);
    let (graph, findings) = lane_builder::lane_graph(&network);
    assert_eq!(refused(&findings), 0);
    graph
}

/// The lane that starts at a place.
fn starting(graph: &LaneGraph, x: f64, y: f64) -> &Lane {
    let starts = |lane: &&Lane| (lane.centerline[0][0] - x).hypot(lane.centerline[0][1] - y) < 1e-6;
    graph.lanes.iter().find(starts).unwrap()
}

#[test]
fn an_exit_leads_on_and_off() {
    let graph = graph(EXIT);
    let (inner, outer) = (starting(&graph, 0.0, -1.5), starting(&graph, 0.0, -4.5));
    assert_eq!(inner.successors, [starting(&graph, 60.0, -1.5).id]);
    assert_eq!(outer.successors, [starting(&graph, 60.0, -4.5).id]);
    assert_eq!((inner.right, outer.left), (Some(outer.id), Some(inner.id)));
    assert!(graph.lanes.iter().all(|lane| lane.junction.is_none()));
}

#[test]
fn a_connection_serves_traffic_of_both_directions() {
    // The same roads with oncoming lanes on the left; the connection names both pairs from one side.
    let left = r#"<laneSection s="0"><left><lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left><right>"#;
    let two_way = EXIT.replace(r#"<laneSection s="0"><right>"#, left);
    let links = r#"<laneLink from="1" to="1"/><laneLink from="-1" to="-1"/>"#;
    let graph = graph(&two_way.replacen(r#"<laneLink from="-1" to="-1"/>"#, links, 1));
    let oncoming = starting(&graph, 120.0, 1.5);
    assert_eq!(oncoming.successors, [starting(&graph, 60.0, 1.5).id]);
    assert!((oncoming.at(oncoming.length_m).1.abs() - std::f64::consts::PI).abs() < 1e-9);
    // From the linked road's side, with the other contact, it is the same.
    let from_there = two_way.replacen(
        r#"incomingRoad="in" linkedRoad="on" contactPoint="start"><laneLink from="-1" to="-1"/>"#,
        &format!(r#"incomingRoad="on" linkedRoad="in" contactPoint="end">{links}"#),
        1,
    );
    let other = self::graph(&from_there);
    let pairs = |graph: &LaneGraph| {
        graph
            .lanes
            .iter()
            .map(|lane| lane.successors.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(pairs(&graph), pairs(&other));
}

#[test]
fn a_connection_without_lane_links_links_lanes_of_one_id() {
    let graph = graph(&EXIT.replacen(r#"<laneLink from="-1" to="-1"/>"#, "", 1));
    assert_eq!(
        starting(&graph, 0.0, -1.5).successors,
        [starting(&graph, 60.0, -1.5).id]
    );
}

#[test]
fn a_connection_onto_a_road_that_is_not_there_is_left_out_and_named() {
    let network = read(EXIT.replacen(r#"linkedRoad="off""#, r#"linkedRoad="gone""#, 1)).unwrap();
    assert_eq!(network.junctions[0].connections.len(), 1);
    let expected = "line 20: junction j: <connection> linkedRoad=\"gone\", expected the id of a road of this map; connection left out";
    assert_eq!(
        network
            .findings
            .iter()
            .map(ToString::to_string)
            .collect::<Vec<_>>(),
        [expected]
    );
}
