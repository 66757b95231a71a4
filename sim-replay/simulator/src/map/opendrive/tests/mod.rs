use proptest::prelude::*;

use super::super::finding::Finding;
use super::super::lane::LaneGraph;
use super::super::lane_builder;
use super::super::road::{LaneKind, RoadLink};
use super::*;

mod direct;
mod kinds;
mod lateral;
mod left_hand;

/// Two roads, a line and an arc, one after the other, and a junction without connections.
const SMALL: &str = r#"<?xml version="1.0"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="4"/>
  <road id="a" length="50" junction="-1" name="">
    <link><successor elementType="road" elementId="b" contactPoint="start"/></link>
    <type s="0" type="town"><speed max="36" unit="km/h"/></type>
    <planView><geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry></planView>
    <elevationProfile><elevation s="0" a="1" b="0.02" c="0" d="0"/></elevationProfile>
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

/// The small map with a change, and its findings.
fn changed(from: &str, to: &str) -> (RoadNetwork, Vec<String>) {
    assert!(SMALL.contains(from), "{from}");
    let network = read(SMALL.replacen(from, to, 1)).unwrap();
    let findings = network.findings.iter().map(ToString::to_string).collect();
    (network, findings)
}

fn error_of(from: &str, to: &str) -> String {
    assert!(SMALL.contains(from));
    read(SMALL.replacen(from, to, 1))
        .expect_err("the change should be refused")
        .to_string()
}

/// Findings of the small map when it is changed so that one road cannot be built.
fn left_out(from: &str, to: &str) -> String {
    let (network, mut findings) = changed(from, to);
    assert_eq!(network.roads.len(), 1, "{findings:?}");
    findings.remove(0)
}

#[test]
fn small_map_is_read_and_its_lanes_follow_each_other() {
    let network = read(SMALL).unwrap();
    let road = &network.roads[0];
    assert_eq!(road.sections[0].right[1].kind, LaneKind::Sidewalk);
    assert_eq!(network.roads[1].successor, Some(RoadLink::Junction(0)));
    assert_eq!(network.findings, []);
    assert_eq!(
        (
            road.objects.len(),
            road.signals.len(),
            road.structures.len()
        ),
        (1, 1, 1)
    );
    let (graph, findings) = lane_builder::lane_graph(&network);
    assert_eq!(
        (graph.lanes.len(), made(&graph), refused(&findings)),
        (3, 1, 0)
    );
    let first = graph
        .lanes
        .iter()
        .find(|lane| !lane.successors.is_empty())
        .unwrap();
    assert!((first.length_m - 50.0).abs() < 1e-6 && (first.speed_limit_mps - 10.0).abs() < 1e-9);
    assert_eq!(first.centerline[0], [0.0, -1.75, 1.0]);
    let (end, heading) = first.at(first.length_m);
    assert!((end[0] - 50.0).abs() < 1e-6 && (end[2] - 2.0).abs() < 1e-6 && heading.abs() < 1e-9);
    // The second lane lies outside the bend of radius 20 to the left.
    let second = graph.lane(first.successors[0]);
    assert!((second.length_m - 21.75 * std::f64::consts::FRAC_PI_2).abs() < 1e-2);
    let opposite = graph
        .lanes
        .iter()
        .find(|lane| lane.centerline[0][0] > 49.0 && lane.centerline[0][1] > 0.0)
        .unwrap();
    assert!((opposite.at(opposite.length_m).1.abs() - std::f64::consts::PI).abs() < 1e-9);
}

#[test]
fn a_file_that_is_no_map_is_refused() {
    assert!(error_of("</OpenDRIVE>", "").contains("not well-formed XML"));
    assert!(
        error_of("<OpenDRIVE>", "<!DOCTYPE a [<!ENTITY b \"c\">]><OpenDRIVE>")
            .contains("not well-formed XML")
    );
    let text = SMALL
        .replace("<OpenDRIVE>", "<Other>")
        .replace("</OpenDRIVE>", "</Other>");
    assert_eq!(
        read(&text).unwrap_err().to_string(),
        "line 2: <Other> is the root; expected <OpenDRIVE>"
    );
    assert_eq!(
        read("<OpenDRIVE/>").unwrap_err().to_string(),
        "line 1: <OpenDRIVE> has no <road>"
    );
    // Where no road is left, the first fault is the error.
    let text = SMALL
        .replace("<line/>", "<helix/>")
        .replace("curvature=", "curve=");
    let expected =
        "line 7: <geometry> holds <helix>; expected line, arc, spiral, poly3 or paramPoly3";
    assert_eq!(read(&text).unwrap_err().to_string(), expected);
}

#[test]
fn a_road_that_cannot_be_built_is_left_out_with_line_element_attribute_and_values() {
    assert_eq!(
        left_out(r#" y="0" hdg="0" length="50""#, r#" hdg="0" length="50""#),
        "line 7: road a: <geometry> has no attribute y; road left out"
    );
    assert_eq!(
        left_out(r#"x="0" y="0""#, r#"x="NaN" y="0""#),
        "line 7: road a: <geometry> x=\"NaN\", expected a value from -10000000 to 10000000; road left out"
    );
    assert_eq!(
        left_out(r#"road id="b""#, r#"road id="a""#),
        "line 21: <road> id=\"a\", expected used by one element only; left out"
    );
    assert!(left_out("<line/>", "<helix/>").contains("holds <helix>"));
    // The road that leads to it loses its link, and a finding names that too.
    let (network, findings) = changed(
        r#"y="0" hdg="0" length="31.4159265""#,
        r#"y="nowhere" length="31.4159265""#,
    );
    assert_eq!(network.roads[0].successor, None);
    assert_eq!(
        findings[1],
        "line 5: road a: <successor> elementId=\"b\", expected the id of a road of this map; link treated as absent"
    );
}

#[test]
fn an_odd_part_of_a_road_is_treated_as_absent_and_named() {
    let only = |from: &str, to: &str| {
        let (network, findings) = changed(from, to);
        assert_eq!(
            (network.roads.len(), findings.len()),
            (2, 1),
            "{findings:?}"
        );
        (network, findings.into_iter().next().unwrap())
    };
    for length in ["fifty", "40"] {
        let (network, finding) = only(
            r#"length="50" junction"#,
            &format!(r#"length="{length}" junction"#),
        );
        assert!((network.roads[0].length_m - 50.0).abs() < 1e-9);
        assert!(
            finding.ends_with("; the length of its reference line is used"),
            "{finding}"
        );
    }
    let (network, finding) = only(r#"elementId="b""#, r#"elementId="c""#);
    assert_eq!(network.roads[0].successor, None);
    assert_eq!(
        finding,
        "line 5: road a: <successor> elementId=\"c\", expected the id of a road of this map; link treated as absent"
    );
    for id in ["-3", "-2147483648", "2", "x"] {
        let (network, finding) = only(r#"<lane id="-2""#, &format!(r#"<lane id="{id}""#));
        assert_eq!(network.roads[0].sections[0].right.len(), 1);
        assert!(
            finding.starts_with(&format!("line 15: road a: <lane> id=\"{id}\"")),
            "{finding}"
        );
        assert!(finding.ends_with("; lane left out"), "{finding}");
    }
    let (network, finding) = only(r#"s="5" t="-4""#, r#"s="5" t="?""#);
    assert!(
        network.roads[0].signals.is_empty() && finding.ends_with("; left out"),
        "{finding}"
    );
    let (_, finding) = only(
        r#"elementType="junction" elementId="7""#,
        r#"elementType="junction" elementId="8""#,
    );
    assert!(
        finding.contains("the id of a junction of this map"),
        "{finding}"
    );
}

/// Number of links between lanes.
fn made(graph: &LaneGraph) -> usize {
    graph.lanes.iter().map(|lane| lane.successors.len()).sum()
}

/// Number of links that were left out because their lanes do not meet.
fn refused(findings: &[Finding]) -> usize {
    let refused = findings.iter().filter(|one| one.element == "laneLink");
    refused.map(|one| one.count).sum()
}

#[test]
fn unbounded_cubics_are_clamped_to_the_limits_of_a_road() {
    let wild = [
        (
            r#"laneOffset s="0" a="0" b="0""#,
            r#"laneOffset s="0" a="0" b="10000000""#,
        ),
        (
            r#"laneOffset s="0" a="0" b="0" c="0" d="0""#,
            r#"laneOffset s="0" a="0" b="0" c="0" d="-9999999""#,
        ),
        // A peak between the places where widths are checked.
        (
            r#"sOffset="0" a="2" b="0" c="0" d="0""#,
            r#"sOffset="49" a="0" b="10000000" c="-10000000" d="0""#,
        ),
    ];
    for (from, to) in wild {
        assert!(SMALL.contains(from));
        let network = read(SMALL.replacen(from, to, 1)).unwrap();
        for place in 0..=500 {
            let spans = [-2, -1, 1]
                .map(|lane| network.roads[0].lane_span_m(0, lane, f64::from(place) / 10.0));
            assert!(
                spans
                    .iter()
                    .all(|[low, high]| *low >= -1200.0 && *high <= 1200.0 && low <= high),
                "{to}: {spans:?}"
            );
        }
    }
}

#[test]
fn tunnels_together_are_no_longer_than_their_road() {
    let tunnels = [(30, 100), (0, 20), (10, 25), (12, 3), (30, 100), (49, 0)];
    let tunnels = tunnels
        .map(|(s, length)| format!(r#"<tunnel s="{s}" length="{length}"/>"#))
        .concat();
    let network = read(SMALL.replacen("</objects>", &format!("{tunnels}</objects>"), 1)).unwrap();
    let structures = &network.roads[0].structures;
    let spans: Vec<_> = structures
        .iter()
        .filter(|it| it.tunnel)
        .map(|it| (it.s_m, it.length_m))
        .collect();
    assert_eq!(spans, [(0.0, 20.0), (20.0, 15.0), (35.0, 15.0)]);
    assert_eq!(structures.len(), 4, "the bridge stays");
}

#[test]
fn deep_nesting_and_large_files_are_refused_or_read_without_overflow() {
    let deep = format!(
        "<OpenDRIVE>{}{}</OpenDRIVE>",
        "<a>".repeat(200_000),
        "</a>".repeat(200_000)
    );
    assert!(read(&deep).is_err());
    let large = " ".repeat(MAX_BYTES + 1);
    assert_eq!(
        read(&large).unwrap_err(),
        OpenDriveError::TooLarge(MAX_BYTES + 1)
    );
}

/// A document of every kind that is read, small enough to be damaged anywhere.
const KINDS: [&str; 4] = [SMALL, kinds::BORDERS, direct::EXIT, lateral::BANKED];

/// Builds a network that was read, down to the ground and its decks.
fn build_all(network: &RoadNetwork) {
    let (graph, _) = lane_builder::lane_graph(network);
    for lane in &graph.lanes {
        assert!(
            lane.centerline.len() >= 2 && lane.centerline.iter().flatten().all(|c| c.is_finite())
        );
        assert!(lane.banks_rad.is_empty() || lane.banks_rad.len() == lane.centerline.len());
        assert!(lane.banks_rad.iter().all(|bank| bank.is_finite()));
    }
    let surface = super::super::surface::RoadSurface::new(network);
    assert!(
        surface
            .patches
            .iter()
            .flat_map(|patch| patch.z_m)
            .all(f64::is_finite)
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    /// Documents with a few places overwritten by what numbers and tags are made of: either an error, or a network
    /// that can be built.
    #[test]
    fn damaged_documents_do_not_panic(
        kind in 0..KINDS.len(),
        edits in prop::collection::vec((0..8000usize, "[-0-9e.<>/\"a-z= ]{0,4}"), 1..5),
    ) {
        let mut text = KINDS[kind].to_owned();
        for (place, insert) in edits {
            let place = place % text.len();
            let end = (place + insert.len()).min(text.len());
            if text.is_char_boundary(place) && text.is_char_boundary(end) {
                text.replace_range(place..end, &insert);
            }
        }
        if let Ok(network) = read(&text) {
            build_all(&network);
        }
    }

    /// Any bytes in any place, as a file has them.
    #[test]
    fn damaged_bytes_do_not_panic(
        kind in 0..KINDS.len(),
        wide in any::<bool>(),
        edits in prop::collection::vec((any::<usize>(), any::<u8>()), 0..5),
    ) {
        let text = KINDS[kind];
        let mut bytes: Vec<u8> = if wide { text.encode_utf16().flat_map(u16::to_le_bytes).collect() } else { text.into() };
        for (place, byte) in edits {
            let place = place % bytes.len();
            bytes[place] = byte;
        }
        if let Ok(network) = read(&bytes) {
            build_all(&network);
        }
    }

    /// Numbers replaced by extreme ones.
    #[test]
    fn extreme_numbers_do_not_panic(kind in 0..KINDS.len(), place in 0..400usize, value in prop::sample::select(vec![
        "0", "-0", "1e-300", "-1", "1e7", "9999999", "1e308", "-1e308", "nan", "inf", "99999999999999999999", "", "1.57",
    ])) {
        let mut parts: Vec<&str> = KINDS[kind].split('"').collect();
        let attribute = ((2 * place + 3) % (parts.len() - 1)) | 1;
        parts[attribute] = value;
        if let Ok(network) = read(parts.join("\"")) {
            build_all(&network);
        }
    }
}
