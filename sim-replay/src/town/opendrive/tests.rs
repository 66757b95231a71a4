use proptest::prelude::*;

use super::super::lane_builder;
use super::super::road::{LaneKind, RoadLink};
use super::*;

/// Two roads, a line and an arc, one after the other, and a junction without connections.
const SMALL: &str = r#"<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="4"/>
  <road id="a" length="50" junction="-1" name="">
    <link><successor elementType="road" elementId="b" contactPoint="start"/></link>
    <type s="0" type="town"><speed max="36" unit="km/h"/></type>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry></planView>
    <elevationProfile><elevation s="0" a="1" b="0.02" c="0" d="0"/></elevationProfile>
    <lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>
    <lanes>
      <laneOffset s="0" a="0" b="0" c="0" d="0"/>
      <laneSection s="0">
        <left><lane id="1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>
        <center><lane id="0" type="none"/></center>
        <right><lane id="-1" type="driving"><link><successor id="-1"/></link><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
          <lane id="-2" type="sidewalk"><width sOffset="0" a="2" b="0" c="0" d="0"/></lane></right>
      </laneSection>
    </lanes>
    <objects><object type="pole" name="lamp" s="3" t="-6" height="5"/><bridge s="10" length="20" type="concrete" id="1"/></objects>
    <signals><signal name="light" id="1" s="5" t="-4" dynamic="yes" orientation="-"/></signals>
  </road>
  <road id="b" length="31.4159265" junction="-1" name="">
    <link><predecessor elementType="road" elementId="a" contactPoint="end"/><successor elementType="junction" elementId="7"/></link>
    <planView><geometry s="0" x="50" y="0" hdg="0" length="31.4159265"><arc curvature="0.05"/></geometry></planView>
    <elevationProfile><elevation s="0" a="2" b="0" c="0" d="0"/></elevationProfile>
    <lanes><laneSection s="0"><center><lane id="0" type="none"/></center>
      <right><lane id="-1" type="driving"><link><predecessor id="-1"/></link><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
    </laneSection></lanes>
  </road>
  <junction id="7" name=""/>
</OpenDRIVE>"#;

fn error_of(from: &str, to: &str) -> String {
    assert!(SMALL.contains(from));
    read(&SMALL.replacen(from, to, 1)).expect_err("the change should be refused").to_string()
}

#[test]
fn small_map_is_read_and_its_lanes_follow_each_other() {
    let network = read(SMALL).unwrap();
    let road = &network.roads[0];
    assert_eq!(road.sections[0].right[1].kind, LaneKind::Sidewalk);
    assert_eq!(network.roads[1].successor, Some(RoadLink::Junction(0)));
    assert_eq!(network.ignored.superelevations, 1);
    assert_eq!((road.objects.len(), road.signals.len(), road.structures.len()), (1, 1, 1));
    let (graph, counts) = lane_builder::lane_graph(&network);
    assert_eq!((graph.lanes.len(), counts.made, counts.refused), (3, 1, 0));
    let first = graph.lanes.iter().find(|lane| !lane.successors.is_empty()).unwrap();
    assert!((first.length_m - 50.0).abs() < 1e-6 && (first.speed_limit_mps - 10.0).abs() < 1e-9);
    assert_eq!(first.centerline[0], [0.0, -1.75, 1.0]);
    let (end, heading) = first.at(first.length_m);
    assert!((end[0] - 50.0).abs() < 1e-6 && (end[2] - 2.0).abs() < 1e-6 && heading.abs() < 1e-9);
    // The second lane lies outside the bend of radius 20 to the left.
    let second = graph.lane(first.successors[0]);
    assert!((second.length_m - 21.75 * std::f64::consts::FRAC_PI_2).abs() < 1e-2);
    let opposite = graph.lanes.iter().find(|lane| lane.centerline[0][0] > 49.0 && lane.centerline[0][1] > 0.0).unwrap();
    assert!((opposite.end_heading_rad().abs() - std::f64::consts::PI).abs() < 1e-9);
}

#[test]
fn errors_name_line_element_attribute_and_values() {
    assert_eq!(
        error_of(r#"length="50" junction"#, r#"length="fifty" junction"#),
        "line 4: <road> has length=\"fifty\"; expected a number"
    );
    assert_eq!(
        error_of(r#" y="0" hdg="0" length="50""#, r#" hdg="0" length="50""#),
        "line 7: <geometry> has no attribute y"
    );
    assert_eq!(
        error_of(r#"x="0" y="0""#, r#"x="NaN" y="0""#),
        "line 7: <geometry> has x=\"NaN\"; expected a value from -10000000 to 10000000"
    );
    assert_eq!(
        error_of(r#"length="50"><line"#, r#"length="40"><line"#),
        "line 7: <planView> has elements of 40 m in all, but the road's length is 50 m"
    );
    assert_eq!(
        error_of(r#"elementId="b""#, r#"elementId="c""#),
        "line 5: <successor> has elementId=\"c\"; expected the id of a <road>"
    );
    assert_eq!(
        error_of(r#"<lane id="-2""#, r#"<lane id="-3""#),
        "line 16: <lane> has id=\"-3\"; expected -2, without gaps or doubles"
    );
    assert_eq!(
        error_of(r#"road id="b""#, r#"road id="a""#),
        "line 22: <road> has id=\"a\"; expected used by one element only"
    );
    assert_eq!(
        error_of(r#"<lane id="-2""#, r#"<lane id="-2147483648""#),
        "line 16: <lane> has id=\"-2147483648\"; expected a value from -64 to 64"
    );
    assert!(error_of("<line/>", "<helix/>").contains("holds <helix>"));
    assert!(error_of(r#"curvature="0.05""#, r#"curvature="9.5""#).contains("expected a value from -0.63"));
    assert!(error_of("</OpenDRIVE>", "").contains("not well-formed XML"));
    assert!(error_of("<OpenDRIVE>", "<!DOCTYPE a [<!ENTITY b \"c\">]><OpenDRIVE>").contains("not well-formed XML"));
}

#[test]
fn cubics_that_lead_anywhere_are_held_within_what_a_road_can_be() {
    let wild = [
        (r#"laneOffset s="0" a="0" b="0""#, r#"laneOffset s="0" a="0" b="10000000""#),
        (r#"laneOffset s="0" a="0" b="0" c="0" d="0""#, r#"laneOffset s="0" a="0" b="0" c="0" d="-9999999""#),
        // A peak between the places where widths are checked.
        (r#"sOffset="0" a="2" b="0" c="0" d="0""#, r#"sOffset="49" a="0" b="10000000" c="-10000000" d="0""#),
    ];
    for (from, to) in wild {
        assert!(SMALL.contains(from));
        let network = read(&SMALL.replacen(from, to, 1)).unwrap();
        for place in 0..=500 {
            let spans = [-2, -1, 1].map(|lane| network.roads[0].lane_span_m(0, lane, f64::from(place) / 10.0));
            assert!(
                spans.iter().all(|[low, high]| *low >= -1200.0 && *high <= 1200.0 && low <= high),
                "{to}: {spans:?}"
            );
        }
    }
}

#[test]
fn tunnels_together_are_no_longer_than_their_road() {
    let tunnels = [(30, 100), (0, 20), (10, 25), (12, 3), (30, 100), (49, 0)];
    let tunnels = tunnels.map(|(s, length)| format!(r#"<tunnel s="{s}" length="{length}"/>"#)).concat();
    let network = read(&SMALL.replacen("</objects>", &format!("{tunnels}</objects>"), 1)).unwrap();
    let structures = &network.roads[0].structures;
    let spans: Vec<_> = structures.iter().filter(|it| it.tunnel).map(|it| (it.s_m, it.length_m)).collect();
    assert_eq!(spans, [(0.0, 20.0), (20.0, 15.0), (35.0, 15.0)]);
    assert_eq!(structures.len(), 4, "the bridge stays");
}

#[test]
fn deep_nesting_and_large_files_are_refused_or_read_without_overflow() {
    let deep = format!("<OpenDRIVE>{}{}</OpenDRIVE>", "<a>".repeat(200_000), "</a>".repeat(200_000));
    assert!(read(&deep).is_err());
    let large = " ".repeat(MAX_BYTES + 1);
    assert_eq!(read(&large).unwrap_err(), OpenDriveError::TooLarge { bytes: MAX_BYTES + 1, limit: MAX_BYTES });
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    /// Documents with a few places overwritten by what numbers and tags are made of: either an error, or a network
    /// whose lanes can be built.
    #[test]
    fn mutated_documents_do_not_panic(
        edits in prop::collection::vec((0..SMALL.len(), "[-0-9e.<>/\"a-z= ]{0,4}"), 1..5),
    ) {
        let mut text = SMALL.to_owned();
        for (place, insert) in edits {
            let end = (place + insert.len()).min(text.len());
            if text.is_char_boundary(place.min(text.len())) && text.is_char_boundary(end) {
                text.replace_range(place.min(text.len())..end, &insert);
            }
        }
        if let Ok(network) = read(&text) {
            let (graph, _) = lane_builder::lane_graph(&network);
            for lane in &graph.lanes {
                prop_assert!(lane.centerline.len() >= 2 && lane.centerline.iter().flatten().all(|c| c.is_finite()));
            }
        }
    }

    /// Numbers replaced by extreme ones.
    #[test]
    fn extreme_numbers_do_not_panic(place in 0..60usize, value in prop::sample::select(vec![
        "0", "-0", "1e-300", "-1", "1e7", "9999999", "1e308", "-1e308", "nan", "inf", "99999999999999999999", "",
    ])) {
        let mut parts: Vec<&str> = SMALL.split('"').collect();
        let attribute = ((2 * place + 3) % (parts.len() - 1)) | 1;
        parts[attribute] = value;
        if let Ok(network) = read(&parts.join("\"")) {
            let (graph, _) = lane_builder::lane_graph(&network);
            prop_assert!(graph.lanes.iter().all(|lane| lane.centerline.len() >= 2));
        }
    }
}
