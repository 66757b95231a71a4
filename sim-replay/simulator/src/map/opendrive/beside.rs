//! `<objects>` and `<signals>`: objects beside a road, and its bridges and tunnels.

use std::f64::consts::PI;

use super::super::finding::FindingLog;
use super::super::road::{RoadObject, RoadStructure};
use super::element::{Element, MAX_LENGTH_M, Result, children, noted};

/// Every element named `name` in the list `list` of a road; elements that cannot be read are left out.
pub(super) fn read_all<T>(
    road: Element,
    list: &'static str,
    name: &'static str,
    read: impl Fn(Element) -> Result<T>,
    log: &mut FindingLog,
) -> Vec<T> {
    let Some(list) = road.child(list) else {
        return Vec::new();
    };
    children(list, name)
        .filter_map(|element| noted(read(element), log, "left out"))
        .collect()
}

pub(super) fn read_object(element: Element) -> Result<RoadObject> {
    let mut object = read_place(element, "hdg")?;
    for size in ["length", "width", "height"] {
        element.number_or_0(size, 0.0, 1e4)?;
    }
    object.label = [element.optional_text("type"), element.optional_text("name")]
        .map(Option::unwrap_or_default)
        .join(" ");
    Ok(object)
}

pub(super) fn read_signal(element: Element) -> Result<RoadObject> {
    let mut signal = read_place(element, "hOffset")?;
    element.number_or_0("height", 0.0, 100.0)?;
    // The signal faces against the direction it is for; `+` is for traffic along the road.
    let is_against = element.optional_text("orientation") == Some("-");
    signal.heading_rad += if is_against { PI } else { 0.0 };
    signal.dynamic = element.optional_text("dynamic") == Some("yes");
    Ok(signal)
}

/// Place and heading of an object or a signal. Its height over the road and its sizes are checked, but nothing is built
/// from them.
fn read_place(element: Element, heading: &'static str) -> Result<RoadObject> {
    let s_m = element.number("s", 0.0, MAX_LENGTH_M)?;
    let t_m = element.number("t", -1e4, 1e4)?;
    element.number_or_0("zOffset", -1e4, 1e4)?;
    Ok(RoadObject {
        s_m,
        t_m,
        heading_rad: element.number_or_0(heading, -1e4, 1e4)?,
        ..RoadObject::default()
    })
}

pub(super) fn read_structures(
    road: Element,
    road_length_m: f64,
    log: &mut FindingLog,
) -> Vec<RoadStructure> {
    let mut structures = Vec::new();
    for name in ["bridge", "tunnel"] {
        structures.extend(read_all(road, "objects", name, read_structure, log));
    }
    // Cuts tunnels so that none reaches into the next or beyond its road, and leaves out empty ones: together they are
    // at most as long as the road, however many a map has for its lanes.
    structures.sort_by(|a, b| a.tunnel.cmp(&b.tunnel).then(a.s_m.total_cmp(&b.s_m)));
    let mut covered_m = 0.0;
    for tunnel in structures.iter_mut().filter(|structure| structure.tunnel) {
        let end_m = (tunnel.s_m + tunnel.length_m).min(road_length_m);
        tunnel.s_m = tunnel.s_m.max(covered_m);
        tunnel.length_m = (end_m - tunnel.s_m).max(0.0);
        covered_m = covered_m.max(end_m);
    }
    structures.retain(|structure| !structure.tunnel || structure.length_m > 0.0);
    structures
}

fn read_structure(element: Element) -> Result<RoadStructure> {
    Ok(RoadStructure {
        tunnel: element.name() == "tunnel",
        s_m: element.number("s", 0.0, MAX_LENGTH_M)?,
        length_m: element.number("length", 0.0, MAX_LENGTH_M)?,
    })
}
