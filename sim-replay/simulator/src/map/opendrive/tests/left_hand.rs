//! Left-hand traffic.

use super::super::super::lane::{Lane, LaneGraph};
use super::*;

/// A street that meets another at a T-junction, and the two ways out of it for traffic that keeps left.
const TEE: &str = r#"<OpenDRIVE>
  <road id="west" length="80" junction="-1" rule="LHT"><link><successor elementType="junction" elementId="j"/></link>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="80"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <left><lane id="2" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane>
        <lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
      <right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right>
    </laneSection></lanes></road>
  <road id="east" length="80" junction="-1" rule="LHT"><link><predecessor elementType="junction" elementId="j"/></link>
    <planView><geometry s="0" x="100" y="0" hdg="0" length="80"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <left><lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
      <right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right>
    </laneSection></lanes></road>
  <road id="ahead" length="20" junction="j" rule="LHT">
    <link><predecessor elementType="road" elementId="west" contactPoint="end"/><successor elementType="road" elementId="east" contactPoint="start"/></link>
    <planView><geometry s="0" x="80" y="0" hdg="0" length="20"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <left><lane id="1" type="driving"><link><predecessor id="1"/><successor id="1"/></link><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
    </laneSection></lanes></road>
  <road id="back" length="20" junction="j" rule="LHT">
    <link><predecessor elementType="road" elementId="east" contactPoint="start"/><successor elementType="road" elementId="west" contactPoint="end"/></link>
    <planView><geometry s="0" x="100" y="0" hdg="3.141592653589793" length="20"><line/></geometry></planView>
    <lanes><laneSection s="0">
      <left><lane id="1" type="driving"><link><predecessor id="-1"/><successor id="-1"/></link><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
    </laneSection></lanes></road>
  <junction id="j">
    <connection id="0" incomingRoad="west" connectingRoad="ahead" contactPoint="start"><laneLink from="1" to="1"/></connection>
    <connection id="1" incomingRoad="east" connectingRoad="back" contactPoint="start"><laneLink from="-1" to="1"/></connection>
  </junction>
</OpenDRIVE>"#;

fn graph(text: &str) -> LaneGraph {
    let network = read(text).unwrap();
    assert_eq!(network.findings, []);
    let (graph, findings) = lane_builder::lane_graph(&network);
    assert_eq!(refused(&findings), 0);
    graph
}

fn starting(graph: &LaneGraph, x: f64, y: f64) -> &Lane {
    let starts = |lane: &&Lane| (lane.centerline[0][0] - x).hypot(lane.centerline[0][1] - y) < 1e-6;
    graph
        .lanes
        .iter()
        .find(starts)
        .unwrap_or_else(|| panic!("no lane starts at {x}, {y}"))
}

#[test]
fn lanes_on_the_left_lead_along_and_continue_through_the_junction() {
    let graph = graph(TEE);
    assert_eq!(graph.lanes.len(), 7);
    // Eastwards on the left of the line, where y is positive; westwards on the other side.
    for lane in &graph.lanes {
        let is_left = lane.centerline[0][1] > 0.0;
        assert!(
            (lane.at(0.0).1.cos() - if is_left { 1.0 } else { -1.0 }).abs() < 1e-9,
            "{lane:?}"
        );
    }
    let eastwards = starting(&graph, 0.0, 1.5);
    let ahead = starting(&graph, 80.0, 1.5);
    assert_eq!(
        (&eastwards.successors[..], &ahead.successors[..]),
        (&[ahead.id][..], &[starting(&graph, 100.0, 1.5).id][..])
    );
    assert!(ahead.junction.is_some());
    let westwards = starting(&graph, 180.0, -1.5);
    let back = graph.lane(westwards.successors[0]);
    assert_eq!(back.successors, [starting(&graph, 80.0, -1.5).id]);
    // The outer lane lies to the left of the inner one, seen by its driver.
    let outer = starting(&graph, 0.0, 4.5);
    assert_eq!(
        (eastwards.left, eastwards.right, outer.right),
        (Some(outer.id), None, Some(eastwards.id))
    );
}

#[test]
fn the_rule_is_that_of_each_road_and_right_hand_traffic_is_the_default() {
    for rule in ["", r#" rule="RHT""#] {
        let graph = graph(&SMALL.replacen(r#" name="">"#, &format!("{rule}>"), 1));
        assert!(
            graph
                .lanes
                .iter()
                .any(|lane| lane.centerline[0][1] < 0.0 && lane.at(0.0).1.abs() < 1e-9)
        );
    }
    // One road of a map keeps left; its neighbour keeps right and their lanes do not meet.
    let network = read(SMALL.replacen(r#" name="">"#, r#" rule="LHT">"#, 1)).unwrap();
    assert_eq!(
        network
            .roads
            .iter()
            .map(|road| road.left_hand)
            .collect::<Vec<_>>(),
        [true, false]
    );
    let (graph, _) = lane_builder::lane_graph(&network);
    assert!(graph.lanes.iter().all(|lane| lane.successors.is_empty()));
}

#[test]
fn a_reversed_lane_leads_against_its_side() {
    let text = TEE.replacen(
        r#"<lane id="2" type="driving">"#,
        r#"<lane id="2" type="driving" direction="reversed">"#,
        1,
    );
    let graph = graph(&text);
    let reversed = starting(&graph, 80.0, 4.5);
    assert!((reversed.at(0.0).1.cos() + 1.0).abs() < 1e-9);
    assert_eq!(
        (
            reversed.left,
            reversed.right,
            starting(&graph, 0.0, 1.5).left
        ),
        (None, None, None)
    );
}
