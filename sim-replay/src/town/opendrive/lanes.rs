//! `<lanes>`: sections and their lanes.

use super::super::road::{Ignored, LaneKind, LaneSection, MAX_WIDTH_M, Profile, RoadLane};
use super::OpenDriveError;
use super::element::{Element, MAX_LANES, children};
use super::roads::{read_profile, read_speed};

pub(super) fn read_sections(
    lanes: Element,
    road_length_m: f64,
    ignored: &mut Ignored,
) -> Result<Vec<LaneSection>, OpenDriveError> {
    let mut sections: Vec<LaneSection> = Vec::new();
    for element in children(lanes, "laneSection") {
        // Writers round: a section may begin a little behind the road's end.
        let s_m = element.number("s", 0.0, road_length_m + 1.0)?.min(road_length_m);
        if let Some(before) = sections.last().filter(|before| s_m < before.s_m) {
            let expected = format!("at least the section before, {}", before.s_m);
            return Err(element.error_value("s", &s_m.to_string(), &expected));
        }
        if let Some(before) = sections.last() {
            check_widths(element, before, s_m - before.s_m)?;
        }
        let left = read_side(element, "left", 1, ignored)?;
        sections.push(LaneSection { s_m, left, right: read_side(element, "right", -1, ignored)? });
    }
    match sections.last() {
        Some(last) => check_widths(lanes, last, road_length_m - last.s_m)?,
        None => return Err(lanes.error_element("has no <laneSection>")),
    }
    Ok(sections)
}

/// Refuses sections whose width polynomials leave what a road can be.
fn check_widths(element: Element, section: &LaneSection, length_m: f64) -> Result<(), OpenDriveError> {
    let widest = |width: &Profile| (0..=20).map(|i| width.at(length_m * f64::from(i) / 20.0)).fold(0.0, f64::max);
    match section.left.iter().chain(&section.right).map(|lane| widest(&lane.width)).find(|&width| width > MAX_WIDTH_M) {
        Some(width) => {
            let problem = format!("holds a lane that is {width:.1} m wide; expected at most {MAX_WIDTH_M}");
            Err(element.error_element(&problem))
        }
        None => Ok(()),
    }
}

/// Lanes of one side, from the reference line outwards.
fn read_side(
    section: Element,
    name: &'static str,
    sign: i32,
    ignored: &mut Ignored,
) -> Result<Vec<RoadLane>, OpenDriveError> {
    let Some(side) = section.child(name) else { return Ok(Vec::new()) };
    let mut lanes: Vec<(i32, RoadLane, Element)> = Vec::new();
    for element in children(side, "lane") {
        let id = element.lane_id("id")?;
        if id.signum() != sign {
            return Err(element.error_range("id", id, sign, sign * MAX_LANES));
        }
        ignored.level_lanes += usize::from(matches!(element.optional_text("level"), Some("true" | "1")));
        lanes.push((id.abs(), read_lane(element)?, element));
    }
    lanes.sort_by_key(|&(id, ..)| id);
    for (place, (id, _, element)) in lanes.iter().enumerate() {
        if *id as usize != place + 1 {
            let expected = format!("{}, without gaps or doubles", sign * (place as i32 + 1));
            return Err(element.error_value("id", &(id * sign).to_string(), &expected));
        }
    }
    Ok(lanes.into_iter().map(|(_, lane, _)| lane).collect())
}

fn read_lane(element: Element) -> Result<RoadLane, OpenDriveError> {
    let kind = match element.optional_text("type").unwrap_or_default() {
        "driving" | "entry" | "exit" | "onRamp" | "offRamp" | "connectingRamp" | "mwyEntry" | "mwyExit"
        | "bidirectional" => LaneKind::Driving,
        "parking" => LaneKind::Parking,
        "shoulder" | "stop" => LaneKind::Shoulder,
        "sidewalk" | "walking" => LaneKind::Sidewalk,
        "median" => LaneKind::Median,
        _ => LaneKind::Other,
    };
    let link = element.child("link");
    let linked = |name| link.and_then(|link| link.child(name)).map(|end| end.lane_id("id")).transpose();
    // Several speed records may follow each other along a lane; the first is taken for all of it.
    let speed_limit_mps = element.child("speed").map(read_speed).transpose()?.flatten();
    let width = read_profile(element, "width", "sOffset", MAX_WIDTH_M)?;
    Ok(RoadLane { kind, width, predecessor: linked("predecessor")?, successor: linked("successor")?, speed_limit_mps })
}
