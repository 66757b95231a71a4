//! Lane borders, speeds, shapes of lines and links as written by other tools.

use super::super::super::lane::LaneGraph;
use super::super::super::road::Road;
use super::*;

/// Two sections with borders: signed on the first, without their sign on the right of the second, one lane with a
/// width.
pub(super) const BORDERS: &str = r#"<OpenDRIVE xmlns="http://code.asam.net/simulation/standard/opendrive_schema">
  <road id="1" length="60" junction="-1">
    <planView><geometry s="0" x="0" y="0" hdg="0" length="60"><line/></geometry></planView>
    <lanes>
      <laneSection s="0">
        <left><lane id="1" type="driving"><link><successor id="1"/></link><border sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>
        <center><lane id="0" type="none"/></center>
        <right>
          <lane id="-1" type="driving"><link><successor id="-1"/></link><border sOffset="0" a="-3" b="0" c="0" d="0"/></lane>
          <lane id="-2" type="driving"><link><successor id="-2"/></link><border sOffset="0" a="-3" b="-0.1" c="0" d="0"/><border sOffset="20" a="-5" b="0" c="0" d="0"/></lane>
          <lane id="-3" type="sidewalk"><width sOffset="0" a="1.5" b="0" c="0" d="0"/><border sOffset="0" a="-9" b="0" c="0" d="0"/></lane>
          <lane id="-4" type="border"><border sOffset="0" a="-8" b="0" c="0" d="0"/></lane>
        </right>
      </laneSection>
      <laneSection s="40">
        <left><lane id="1" type="driving"><link><predecessor id="1"/></link><border sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></left>
        <center><lane id="0" type="none"/></center>
        <right>
          <lane id="-1" type="driving"><link><predecessor id="-1"/></link><border sOffset="0" a="3" b="0" c="0" d="0"/></lane>
          <lane id="-2" type="driving"><link><predecessor id="-2"/></link><border sOffset="0" a="5" b="0" c="0" d="0"/></lane>
        </right>
      </laneSection>
    </lanes>
  </road>
</OpenDRIVE>"#;

/// A road of 50 m with one lane, around the element under test.
fn one_road(attributes: &str, geometry: &str, lane: &str) -> String {
    format!(
        r#"<OpenDRIVE><road id="r" length="50" junction="-1" {attributes}>
          <planView>{geometry}</planView>
          <lanes><laneSection s="0"><right><lane id="-1" type="driving">
            <width sOffset="0" a="3.5" b="0" c="0" d="0"/>{lane}</lane></right></laneSection></lanes>
        </road></OpenDRIVE>"#
    )
}

const LINE: &str = r#"<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>"#;

fn with_findings(text: &str) -> (Road, Vec<String>) {
    let mut network = read(text).unwrap();
    (
        network.roads.remove(0),
        network.findings.iter().map(ToString::to_string).collect(),
    )
}

fn graph(text: &str) -> LaneGraph {
    lane_builder::lane_graph(&read(text).unwrap()).0
}

#[test]
fn borders_give_the_widths_between_them() {
    let (road, findings) = with_findings(BORDERS);
    for (section, s, expected) in [
        (0, 0.0, [0.0, -3.0, -3.0, -4.5, -8.0]),
        (0, 10.0, [0.0, -3.0, -4.0, -5.5, -8.0]),
        (0, 30.0, [0.0, -3.0, -5.0, -6.5, -8.0]),
    ] {
        for lane in 1..=4 {
            let [low, high] = road.lane_span_m(section, -lane, s);
            let place = lane as usize;
            assert!(
                (high - expected[place - 1]).abs() < 1e-9 && (low - expected[place]).abs() < 1e-9,
                "{lane} at {s}: {low}..{high}"
            );
        }
    }
    assert_eq!(road.lane_span_m(0, 1, 5.0), [0.0, 3.5]);
    assert_eq!(road.lane_span_m(1, -2, 50.0), [-5.0, -3.0]);
    assert_eq!(
        findings,
        [
            "line 11: road 1: <lane> has both <width> and <border>; the width is used",
            "line 19: road 1: <lane> has <border> at t=3.000 on its other side; its sign is turned (2 times)",
        ]
    );
    // Lanes go on over the sections, each in its place.
    let lanes = graph(BORDERS).lanes;
    assert_eq!(lanes.len(), 6);
    assert_eq!(
        lanes
            .iter()
            .map(|lane| lane.successors.len())
            .sum::<usize>(),
        3
    );
    let lane = lanes
        .iter()
        .find(|lane| (lane.centerline[0][1] + 1.5).abs() < 1e-9)
        .unwrap();
    assert!((lane.width_m - 3.0).abs() < 1e-9);
}

#[test]
fn borders_count_from_the_reference_line_whatever_the_lane_offset_is() {
    let offset = r#"<lanes><laneOffset s="0" a="0.5" b="0.01" c="0" d="0"/>"#;
    let (road, _) = with_findings(&BORDERS.replacen("<lanes>", offset, 1));
    for (section, s) in [(0, 10.0), (1, 50.0)] {
        let [low, high] = road.lane_span_m(section, 1, s);
        assert!(
            (low - (0.5 + 0.01 * s)).abs() < 1e-9 && (high - 3.5).abs() < 1e-9,
            "{low} {high}"
        );
        assert!((road.lane_span_m(section, -1, s)[0] + 3.0).abs() < 1e-9);
    }
}

#[test]
fn a_border_inside_the_inner_one_is_named() {
    let (road, findings) =
        with_findings(&BORDERS.replacen(r#"a="-3" b="-0.1""#, r#"a="-2" b="0""#, 1));
    assert_eq!(road.lane_span_m(0, -2, 5.0), [-3.0, -3.0]);
    assert!(
        findings[0].contains("has <border> 1.000 m inside the inner border"),
        "{findings:?}"
    );
}

#[test]
fn speeds_in_every_unit_and_those_that_are_none() {
    let limit = |speed: &str| {
        let (road, findings) = with_findings(&one_road("", LINE, speed));
        (road.sections[0].right[0].speed_limit_mps, findings)
    };
    for (speed, expected) in [
        (r#"<speed sOffset="0" max="10"/>"#, Some(10.0)),
        (r#"<speed sOffset="0" max="10" unit="m/s"/>"#, Some(10.0)),
        (r#"<speed sOffset="0" max="36" unit="km/h"/>"#, Some(10.0)),
        (r#"<speed sOffset="0" max="10" unit="mph"/>"#, Some(4.4704)),
        (r#"<speed sOffset="0" max="no limit"/>"#, Some(130.0 / 3.6)),
        (r#"<speed sOffset="0" max="undefined"/>"#, None),
    ] {
        let (found, findings) = limit(speed);
        assert_eq!(findings, Vec::<String>::new());
        assert!(
            found == expected || (found.unwrap() - expected.unwrap()).abs() < 1e-9,
            "{speed}: {found:?}"
        );
    }
    for (speed, named) in [
        (
            r#"max="-1" unit="km/h""#,
            "max=\"-1\", expected a value from 0 to 1000",
        ),
        (r#"max="0""#, "max=\"0\""),
        (r#"max="fast""#, "max=\"fast\", expected a number"),
        (r#"max="10" unit="knots""#, "unit=\"knots\""),
        (r#"unit="km/h""#, "has no attribute max"),
    ] {
        let (found, findings) = limit(&format!("<speed {speed}/>"));
        assert_eq!((found, findings.len()), (None, 1), "{findings:?}");
        assert_eq!(
            findings[0],
            format!("line 4: road r: <speed> {named}; speed limit treated as absent")
        );
    }
    // The road's own limit holds then, and so it does for its type.
    let text = one_road("", LINE, r#"<speed max="-1"/>"#);
    let text = text.replacen(
        "<planView>",
        r#"<type s="0" type="town"><speed max="20" unit="m/s"/></type><planView>"#,
        1,
    );
    assert_eq!(graph(&text).lanes[0].speed_limit_mps, 20.0);
    let (_, findings) = limit(r#"<speed sOffset="0" max="10"/><speed sOffset="20" max="20"/>"#);
    assert_eq!(
        findings,
        [
            "line 4: road r: <speed> sOffset=\"20\"; left out: the first limit holds for the whole lane"
        ]
    );
}

#[test]
fn a_parameter_without_a_range_is_normalized() {
    let cubic = |range: &str, scale: f64| {
        let [u, v2, v3] = [50.0 / scale, 3.0 / scale.powi(2), -2.0 / scale.powi(3)];
        let shape = format!(
            r#"<paramPoly3 aU="0" bU="{u}" cU="0" dU="0" aV="0" bV="0" cV="{v2}" dV="{v3}" {range}/>"#
        );
        let (road, findings) = with_findings(&one_road("", &LINE.replace("<line/>", &shape), ""));
        assert!(
            (road.pose_at(50.0).x - 50.0).abs() < 1e-9 && (road.pose_at(50.0).y - 1.0).abs() < 1e-9,
            "{range}"
        );
        findings
    };
    assert_eq!(cubic("", 1.0), Vec::<String>::new());
    assert_eq!(cubic(r#"pRange="normalized""#, 1.0), Vec::<String>::new());
    assert_eq!(cubic(r#"pRange="arcLength""#, 50.0), Vec::<String>::new());
    assert!(
        cubic(r#"pRange="length""#, 1.0)[0]
            .contains("pRange=\"length\"; treated as absent: normalized")
    );
    assert!(cubic("", 50.0)[0].contains("arcLength is used"));
}

#[test]
fn a_short_piece_with_an_absurd_bend_becomes_a_straight_line() {
    let odd = [
        r#"<arc curvature="12.5"/>"#,
        r#"<spiral curvStart="0" curvEnd="-25"/>"#,
        r#"<paramPoly3 aU="0" bU="0.04" cU="0" dU="0" aV="0" bV="50" cV="0" dV="0" pRange="normalized"/>"#,
    ];
    for shape in odd {
        let geometry = format!(
            r#"<geometry s="0" x="0" y="0" hdg="0" length="20"><line/></geometry>
               <geometry s="20" x="20" y="0" hdg="0" length="0.04">{shape}</geometry>
               <geometry s="20.04" x="20.04" y="0" hdg="0" length="29.96"><line/></geometry>"#
        );
        let (road, findings) = with_findings(&one_road("", &geometry, ""));
        assert!(
            findings.len() == 1 && findings[0].contains("built as a straight line"),
            "{findings:?}"
        );
        assert!(findings[0].starts_with("line 3: road r: "), "{findings:?}");
        let length: f64 = graph(&one_road("", &geometry, "")).lanes[0].length_m;
        assert!(
            (length - 50.0).abs() < 1e-6 && road.pose_at(20.02).y == 0.0,
            "{length}"
        );
    }
}

#[test]
fn files_of_every_encoding_give_the_same_map() {
    let declared = SMALL.replacen(
        r#"<?xml version="1.0"?>"#,
        r#"<?xml version="1.0" encoding="ISO-8859-1"?>"#,
        1,
    );
    let named = declared.replace(r#"name="lamp""#, "name=\"Stra\u{df}e\"");
    let latin: Vec<u8> = named
        .chars()
        .map(|character| u8::try_from(u32::from(character)).unwrap())
        .collect();
    let wide: Vec<u8> = format!("\u{feff}{named}")
        .encode_utf16()
        .flat_map(u16::to_be_bytes)
        .collect();
    for bytes in [latin, wide, format!("\u{feff}{named}").into_bytes()] {
        let network = read(&bytes).unwrap();
        assert_eq!(
            (network.roads.len(), network.findings.len()),
            (2, 0),
            "{:?}",
            network.findings
        );
        assert_eq!(network.roads[0].objects[0].label, "pole Stra\u{df}e");
    }
}

#[test]
fn parts_that_are_not_built_are_reported() {
    for (from, to, named) in [
        (
            "<lanes>",
            "<surface><CRG file=\"a.crg\"/></surface><lanes>",
            "<CRG> file=\"a.crg\"; left out: the road is built without it",
        ),
        (
            "<lanes>",
            "<weather/><lanes>",
            "<weather> is not supported; left out",
        ),
        (
            "<header",
            "<include file=\"b.xodr\"/><header",
            "<include> file=\"b.xodr\"; left out",
        ),
        (
            "type=\"sidewalk\">",
            "type=\"sidewalk\"><height sOffset=\"0\" inner=\"0.1\" outer=\"0.12\"/>",
            "<lane> type=\"sidewalk\" has <height> up to 0.12 m; height over the road left out",
        ),
        (
            "type=\"sidewalk\"",
            "type=\"heliport\"",
            "<lane> type=\"heliport\"; not driven on",
        ),
        (
            "id=\"a\" length",
            "rule=\"MHT\" id=\"a\" length",
            "<road> rule=\"MHT\"; treated as absent: RHT",
        ),
        (
            "<junction id=\"7\" name=\"\"/>",
            "<junction id=\"7\" type=\"virtual\"/>",
            "<junction> type=\"virtual\"; built only where its roads begin or end at other roads' ends",
        ),
        (
            "contactPoint=\"end\"/>",
            "elementS=\"25\" elementDir=\"+\"/>",
            "<predecessor> meets road a at s=25, between its ends (virtual junction); link treated as absent",
        ),
    ] {
        let (_, findings) = changed(from, to);
        assert_eq!(findings.len(), 1, "{findings:?}");
        assert!(findings[0].ends_with(named), "{findings:?}");
    }
}

#[test]
fn sections_without_lane_links_continue_where_they_are_one_lane_and_links_that_do_not_meet_are_named()
 {
    let linked = |text: &str| {
        let (graph, findings) = lane_builder::lane_graph(&read(text).unwrap());
        (made(&graph), refused(&findings), findings)
    };
    let unlinked = |text: &str| {
        ["<successor id=\"-2\"/>", "<predecessor id=\"-2\"/>"]
            .iter()
            .fold(text.to_owned(), |text, link| text.replacen(link, "", 1))
    };
    assert_eq!(linked(BORDERS), (3, 0, vec![]));
    let (links, _, found) = linked(&unlinked(BORDERS));
    let named = "road 1: <link> leads from lane -2 to no lane, though lane -2 continues; lanes of one id linked";
    assert_eq!((links, found[0].to_string().as_str()), (3, named));
    // A lane that is linked from one side only, or is another one, ends.
    assert_eq!(
        linked(&BORDERS.replacen("<successor id=\"-2\"/>", "", 1)).0,
        2
    );
    let narrow = r#"<border sOffset="0" a="5" b="0" c="0" d="0"/>"#;
    assert_eq!(
        linked(&unlinked(&BORDERS.replacen(
            narrow,
            &narrow.replace("5", "3.2"),
            1
        )))
        .0,
        2
    );
    let (_, refused, found) = linked(&SMALL.replacen(r#"x="50" y="0""#, r#"x="50" y="1""#, 1));
    let named = "road a: <laneLink> leads from lane -1 onto lane -1 of road b, 1.00 m away, 0.00 m in height, turned by 0.02 rad; link left out";
    assert_eq!((refused, found[0].to_string().as_str()), (1, named));
}
