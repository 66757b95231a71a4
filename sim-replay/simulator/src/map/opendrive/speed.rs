//! `<speed>`: limits of roads and lanes.

use super::super::finding::FindingLog;
use super::element::{Element, noted};

/// Speed limit where the map has none: 130 km/h, metres per second.
const UNLIMITED_MPS: f64 = 130.0 / 3.6;
/// Higher limits are treated as invalid, in any unit.
const MAX_LIMIT: f64 = 1000.0;

/// A speed limit in metres per second; `None` where it is undefined or invalid.
pub(super) fn read_speed(element: Element, log: &mut FindingLog) -> Option<f64> {
    match element.optional_text("max").map(str::trim) {
        Some("undefined") => return None,
        Some("no limit") => return Some(UNLIMITED_MPS),
        _ => {}
    }
    let metres = match element.optional_text("unit").map(str::trim) {
        None | Some("m/s" | "") => 1.0,
        Some("km/h") => 1.0 / 3.6,
        Some("mph") => 0.447_04,
        Some(_) => {
            element.note_value(log, "unit", "speed limit treated as absent");
            return None;
        }
    };
    let limit = element.number("max", 0.0, MAX_LIMIT);
    let limit = noted(limit, log, "speed limit treated as absent")?;
    if limit == 0.0 {
        element.note_value(log, "max", "speed limit treated as absent");
        return None;
    }
    Some(limit * metres)
}
