//! `<road>`: reads a road from its parts, without its links.

use super::super::finding::FindingLog;
use super::super::profile::Profile;
use super::super::road::{MAX_OFFSET_M, Road};
use super::beside::{read_all, read_object, read_signal, read_structures};
use super::element::{Element, MAX_LENGTH_M, Result, children, noted};
use super::profile::{read_lateral, read_profile};
use super::speed::read_speed;
use super::{lanes, plan_view};

/// Highest road over the map's zero, metres.
const MAX_HEIGHT_M: f64 = 10_000.0;

/// Reads a road whose links are not resolved yet.
///
/// # Errors
/// If its reference line, heights or lanes cannot be read.
pub(super) fn read(element: Element, log: &mut FindingLog) -> Result<Road> {
    let (plan_view, length_m) = plan_view::read(element, log)?;
    let lanes = element.required("lanes")?;
    let lane_offset = read_profile(lanes, "laneOffset", "s", MAX_OFFSET_M)?;
    note_unread(element, log);
    Ok(Road {
        id: element.text("id")?.to_owned(),
        length_m,
        left_hand: read_rule(element, log),
        plan_view,
        elevation: match element.child("elevationProfile") {
            Some(profile) => read_profile(profile, "elevation", "s", MAX_HEIGHT_M)?,
            None => Profile::default(),
        },
        lateral: read_lateral(element, length_m, log),
        sections: lanes::read_sections(lanes, &lane_offset, length_m, log)?,
        lane_offset,
        speed_limits: read_speed_limits(element, log),
        objects: read_all(element, "objects", "object", read_object, log),
        signals: read_all(element, "signals", "signal", read_signal, log),
        structures: read_structures(element, length_m, log),
        ..Road::default()
    })
}

fn read_rule(element: Element, log: &mut FindingLog) -> bool {
    match element.optional_text("rule").map(str::trim) {
        Some("LHT") => true,
        None | Some("RHT" | "") => false,
        Some(_) => {
            element.note_value(log, "rule", "treated as absent: RHT");
            false
        }
    }
}

fn read_speed_limits(road: Element, log: &mut FindingLog) -> Vec<(f64, f64)> {
    let mut limits: Vec<(f64, f64)> = Vec::new();
    for element in children(road, "type") {
        let speed = element.child("speed");
        let Some(limit) = speed.and_then(|speed| read_speed(speed, log)) else {
            continue;
        };
        let s_m = element.number("s", 0.0, MAX_LENGTH_M);
        let s_m = noted(s_m, log, "speed limit treated as absent");
        limits.extend(s_m.map(|s_m| (s_m, limit)));
    }
    limits.sort_by(|a, b| a.0.total_cmp(&b.0));
    limits
}

/// Reports the parts of a road that are not read and could change the height of its surface.
fn note_unread(road: Element, log: &mut FindingLog) {
    for element in road.elements() {
        match element.name() {
            "link" | "type" | "planView" | "elevationProfile" | "lateralProfile" | "lanes"
            | "objects" | "signals" | "railroad" | "userData" | "dataQuality" => {}
            "surface" => {
                for surface in element.elements().filter(|one| one.name() != "userData") {
                    surface.note_value(log, "file", "left out: the road is built without it");
                }
            }
            _ => element.note(log, "is not supported", "left out"),
        }
    }
}
