//! `<lanes>`: sections and their lanes.

use super::super::finding::FindingLog;
use super::super::profile::Profile;
use super::super::road::{LaneKind, LaneSection, MAX_WIDTH_M, RoadLane};

use super::border::{Stretch, widths_from_borders};
use super::element::{Element, MAX_LANES, Result, children, noted};
use super::profile::read_profile;
use super::speed::read_speed;

pub(super) fn read_sections(
    lanes: Element,
    lane_offset: &Profile,
    road_length_m: f64,
    log: &mut FindingLog,
) -> Result<Vec<LaneSection>> {
    let mut starts: Vec<(f64, Element)> = Vec::new();
    for element in children(lanes, "laneSection") {
        // Writers round: a section may begin a little behind the road's end.
        let s_m = element.number("s", 0.0, road_length_m + 1.0)?;
        let s_m = s_m.min(road_length_m);
        if let Some((before, _)) = starts.last().filter(|(before, _)| s_m < *before) {
            let expected = format!("at least the section before, {before}");
            return Err(element.error_value("s", s_m, &expected));
        }
        starts.push((s_m, element));
    }
    if starts.is_empty() {
        return Err(lanes.error_element("has no <laneSection>"));
    }
    let mut sections = Vec::with_capacity(starts.len());
    for (place, &(s_m, element)) in starts.iter().enumerate() {
        let next = starts.get(place + 1);
        let end_m = next.map_or(road_length_m, |(next_m, _)| *next_m);
        if matches!(element.optional_text("singleSide"), Some("true" | "1")) {
            element.note_value(log, "singleSide", "the other side has no lanes here");
        }
        let stretch = Stretch {
            s_m,
            length_m: end_m - s_m,
            lane_offset,
        };
        let left = read_side(element, "left", 1, &stretch, log)?;
        let right = read_side(element, "right", -1, &stretch, log)?;
        let section = LaneSection { s_m, left, right };
        // Refuses sections whose width polynomials exceed the limits of a road.
        for lane in section.left.iter().chain(&section.right) {
            // A peak between the samples is clamped by `Road::lane_span_m`.
            let widest = lane.width.samples(end_m - s_m, 20).fold(0.0, f64::max);
            if widest > MAX_WIDTH_M {
                return Err(element.error_element(&format!(
                    "holds a lane that is {widest:.1} m wide; expected at most {MAX_WIDTH_M}"
                )));
            }
        }
        sections.push(section);
    }
    Ok(sections)
}

/// Lanes of one side, from the reference line outwards. A lane whose id cannot be read is left out with all lanes
/// outside it, whose position depends on it.
fn read_side(
    section: Element,
    name: &'static str,
    sign: i32,
    stretch: &Stretch,
    log: &mut FindingLog,
) -> Result<Vec<RoadLane>> {
    let Some(side) = section.child(name) else {
        return Ok(Vec::new());
    };
    let mut elements: Vec<(i32, Element)> = Vec::new();
    for element in children(side, "lane") {
        match element.lane_id("id") {
            Ok(id) if id.signum() == sign => elements.push((id.abs(), element)),
            Ok(id) => element
                .error_range("id", id, sign, sign * MAX_LANES)
                .note(log, "lane left out"),
            Err(error) => error.note(log, "lane left out"),
        }
    }
    elements.sort_by_key(|&(id, _)| id);
    let numbered = elements.iter().zip(1..);
    let count = numbered.take_while(|((id, _), place)| id == place).count();
    let next: i32 = (1..).nth(count).unwrap_or(1);
    for &(_, element) in elements.iter().skip(count) {
        let expected = format!("{}, without gaps or doubles", sign * next);
        let id = element.optional_text("id").unwrap_or_default();
        let error = element.error_value("id", id, &expected);
        error.note(log, "lane left out");
    }
    elements.truncate(count);
    let elements: Vec<Element> = elements.into_iter().map(|(_, element)| element).collect();
    let lanes = elements.iter().map(|element| read_lane(*element, log));
    let mut lanes = lanes.collect::<Result<Vec<_>>>()?;
    widths_from_borders(&elements, &mut lanes, sign, stretch, log)?;
    Ok(lanes)
}

fn read_lane(element: Element, log: &mut FindingLog) -> Result<RoadLane> {
    let width = read_profile(element, "width", "sOffset", MAX_WIDTH_M)?;
    let link = element.child("link");
    let [predecessor, successor] = ["predecessor", "successor"].map(|name| {
        let end = link.and_then(|link| link.child(name))?;
        noted(end.lane_id("id"), log, "lane link treated as absent")
    });
    let mut speeds = children(element, "speed");
    let speed_limit_mps = speeds.next().and_then(|speed| read_speed(speed, log));
    for further in speeds {
        let action = "left out: the first limit holds for the whole lane";
        further.note_value(log, "sOffset", action);
    }
    let direction = element.optional_text("direction");
    if direction == Some("both") {
        element.note_value(log, "direction", "driven in the direction of its side only");
    }
    // Reports the heights of lanes over the road (kerbs), which are not built.
    let heights = children(element, "height").flat_map(|record| {
        ["inner", "outer"].map(|name| record.number_or_0(name, -1e3, 1e3).unwrap_or(0.0))
    });
    let highest_m = heights.map(f64::abs).fold(0.0, f64::max);
    if highest_m > 0.0 {
        let kind = element.optional_text("type").unwrap_or_default();
        let found = format!("type=\"{kind}\" has <height> up to {highest_m} m");
        element.note(log, &found, "height over the road left out");
    }
    Ok(RoadLane {
        predecessor,
        successor,
        speed_limit_mps,
        level: matches!(element.optional_text("level"), Some("true" | "1")),
        reversed: direction == Some("reversed"),
        ..RoadLane::new(read_kind(element, log), width)
    })
}

fn read_kind(element: Element, log: &mut FindingLog) -> LaneKind {
    match element.optional_text("type").unwrap_or_default() {
        "bidirectional" => {
            element.note_value(log, "type", "driven in the direction of its side only");
            LaneKind::Driving
        }
        "driving" | "entry" | "exit" | "onRamp" | "offRamp" | "connectingRamp" | "slipLane"
        | "mwyEntry" | "mwyExit" => LaneKind::Driving,
        "parking" => LaneKind::Parking,
        "shoulder" | "stop" => LaneKind::Shoulder,
        "sidewalk" | "walking" => LaneKind::Sidewalk,
        "median" => LaneKind::Median,
        "none" | "border" | "curb" | "restricted" | "biking" | "rail" | "tram" => LaneKind::Other,
        _ => {
            element.note_value(log, "type", "not driven on");
            LaneKind::Other
        }
    }
}
