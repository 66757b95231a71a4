//! `<road>`: links, reference line, elevation, and what stands beside the road.

use super::super::curve::{Curve, CurveShape, Pose2};
use super::super::road::{
    Contact, Ignored, MAX_OFFSET_M, Profile, Road, RoadLink, RoadObject, RoadSignal, RoadStructure,
};
use super::element::{Element, MAX_COORDINATE_M, children};
use super::{Ids, OpenDriveError, lanes};

/// Longest road and longest element of a reference line, metres.
const MAX_LENGTH_M: f64 = 100_000.0;
/// Tightest bend: a radius of 0.1 m.
const MAX_CURVATURE: f64 = 10.0;
/// Most that one element may turn, radians; bounds the cost of evaluating it.
const MAX_TURN_RAD: f64 = 20.0;
/// The elements' lengths may miss the road's length by this much, metres; rounding in the wild stays far below.
const LENGTH_TOLERANCE_M: f64 = 1.0;
/// Elements may miss each other by this much, metres.
const JOINT_TOLERANCE_M: f64 = 2.0;
/// Highest road over the map's zero, metres.
const MAX_HEIGHT_M: f64 = 10_000.0;

pub(super) fn read(element: Element, ids: &Ids, ignored: &mut Ignored) -> Result<Road, OpenDriveError> {
    let length_m = element.number("length", 0.0, MAX_LENGTH_M)?;
    let link = element.child("link");
    let road_link = |name| link.and_then(|link| link.child(name)).map(|end| read_link(end, ids)).transpose();
    let lanes = element.required("lanes")?;
    count_superelevation(element, ignored);
    Ok(Road {
        id: element.text("id")?.to_owned(),
        length_m,
        junction: read_junction(element, ids)?,
        predecessor: road_link("predecessor")?.flatten(),
        successor: road_link("successor")?.flatten(),
        plan_view: read_plan_view(element.required("planView")?, length_m)?,
        elevation: match element.child("elevationProfile") {
            Some(profile) => read_profile(profile, "elevation", "s", MAX_HEIGHT_M)?,
            None => Profile::default(),
        },
        lane_offset: read_profile(lanes, "laneOffset", "s", MAX_OFFSET_M)?,
        sections: lanes::read_sections(lanes, length_m, ignored)?,
        speed_limits: read_speed_limits(element)?,
        objects: read_objects(element)?,
        signals: read_signals(element)?,
        structures: read_structures(element, length_m)?,
    })
}

fn read_junction(element: Element, ids: &Ids) -> Result<Option<usize>, OpenDriveError> {
    match element.optional_text("junction") {
        None | Some("-1" | "") => Ok(None),
        Some(id) => match ids.junctions.get(id) {
            Some(&junction) => Ok(Some(junction)),
            None => Err(element.error_value("junction", id, "-1 or the id of a <junction>")),
        },
    }
}

fn read_link(element: Element, ids: &Ids) -> Result<Option<RoadLink>, OpenDriveError> {
    let id = element.text("elementId")?;
    let kind = element.text("elementType")?;
    match kind {
        "junction" => match ids.junctions.get(id) {
            Some(&junction) => Ok(Some(RoadLink::Junction(junction))),
            None => Err(element.error_value("elementId", id, "the id of a <junction>")),
        },
        "road" => match ids.roads.get(id) {
            Some(&road) => Ok(Some(RoadLink::Road { road, contact: read_contact(element)? })),
            None => Err(element.error_value("elementId", id, "the id of a <road>")),
        },
        other => Err(element.error_value("elementType", other, "road or junction")),
    }
}

pub(super) fn read_contact(element: Element) -> Result<Contact, OpenDriveError> {
    match element.text("contactPoint")? {
        "start" => Ok(Contact::Start),
        "end" => Ok(Contact::End),
        other => Err(element.error_value("contactPoint", other, "start or end")),
    }
}

fn read_plan_view(plan_view: Element, road_length_m: f64) -> Result<Vec<Curve>, OpenDriveError> {
    let mut curves: Vec<Curve> = Vec::new();
    for element in children(plan_view, "geometry") {
        let curve = read_curve(element)?;
        if curves.last().is_some_and(|before| curve.s_m < before.s_m) {
            return Err(element.error_value("s", &curve.s_m.to_string(), "the elements in rising order"));
        }
        if let Some(gap_m) = curves.last().map(|before| before.end().distance_m(&curve.start)).filter(too_far) {
            let problem =
                format!("starts {gap_m:.2} m from the end of the one before; expected at most {JOINT_TOLERANCE_M}");
            return Err(element.error_element(&problem));
        }
        // An element of no length has no direction of its own and adds nothing.
        if curve.length_m > 0.0 || curves.is_empty() {
            curves.push(curve);
        }
    }
    let total_m: f64 = curves.iter().map(|curve| curve.length_m).sum();
    if curves.is_empty() || (total_m - road_length_m).abs() > LENGTH_TOLERANCE_M {
        let problem = format!("has elements of {total_m} m in all, but the road's length is {road_length_m} m");
        return Err(plan_view.error_element(&problem));
    }
    Ok(curves)
}

fn too_far(gap_m: &f64) -> bool {
    *gap_m > JOINT_TOLERANCE_M
}

/// Whether no tenth of a curve is longer than twice what its length says: polynomials can claim anything.
fn keeps_its_length(curve: &Curve) -> bool {
    let at = |tenth: u32| curve.at(curve.length_m * f64::from(tenth) / 10.0);
    (0..10).all(|tenth| at(tenth).distance_m(&at(tenth + 1)) <= 0.2 * curve.length_m + 0.1)
}

fn read_curve(element: Element) -> Result<Curve, OpenDriveError> {
    let coordinate = |name| element.number(name, -MAX_COORDINATE_M, MAX_COORDINATE_M);
    let start = Pose2::new(coordinate("x")?, coordinate("y")?, element.number("hdg", -1e4, 1e4)?);
    let length_m = element.number("length", 0.0, MAX_LENGTH_M)?;
    let s_m = element.number("s", 0.0, MAX_LENGTH_M)?;
    let Some(shape) = element.0.children().find(|node| node.is_element() && node.tag_name().name() != "userData")
    else {
        return Err(element.error_element("has no shape"));
    };
    let shape = Element(shape);
    let curvature = |name| {
        let value = shape.number(name, -MAX_CURVATURE, MAX_CURVATURE)?;
        let bound = MAX_TURN_RAD / length_m.max(1e-9);
        if value.abs() <= bound { Ok(value) } else { Err(shape.error_range(name, value, -bound, bound)) }
    };
    let shape = match shape.name() {
        "line" => CurveShape::Line,
        "arc" => CurveShape::Arc { curvature: curvature("curvature")? },
        "spiral" if length_m == 0.0 => CurveShape::Line,
        "spiral" => CurveShape::Spiral { start: curvature("curvStart")?, end: curvature("curvEnd")? },
        "poly3" => CurveShape::Poly3(shape.cubic(["a", "b", "c", "d"])?),
        "paramPoly3" => {
            let normalized = match shape.optional_text("pRange") {
                Some("normalized") => length_m > 0.0,
                Some("arcLength") | None => false,
                Some(other) => return Err(shape.error_value("pRange", other, "arcLength or normalized")),
            };
            let (u, v) = (shape.cubic(["aU", "bU", "cU", "dU"])?, shape.cubic(["aV", "bV", "cV", "dV"])?);
            CurveShape::ParamPoly3 { u, v, normalized }
        }
        other => {
            return Err(
                element.error_element(&format!("holds <{other}>; expected line, arc, spiral, poly3 or paramPoly3"))
            );
        }
    };
    let curve = Curve { s_m, start, length_m, shape };
    if keeps_its_length(&curve) {
        Ok(curve)
    } else {
        Err(element.error_value("length", &length_m.to_string(), "about the length of its curve"))
    }
}

/// Cubics a, b, c, d from the elements `name` of `parent`, by rising `start`.
pub(super) fn read_profile(
    parent: Element,
    name: &'static str,
    start: &'static str,
    bound: f64,
) -> Result<Profile, OpenDriveError> {
    let mut records: Vec<(f64, [f64; 4])> = Vec::new();
    for element in children(parent, name) {
        let s = element.number(start, 0.0, MAX_LENGTH_M)?;
        element.number("a", -bound, bound)?;
        if records.last().is_some_and(|&(before, _)| s < before) {
            return Err(element.error_value(start, &s.to_string(), "the elements in rising order"));
        }
        records.push((s, element.cubic(["a", "b", "c", "d"])?));
    }
    Ok(Profile { records })
}

fn read_speed_limits(road: Element) -> Result<Vec<(f64, f64)>, OpenDriveError> {
    let mut limits: Vec<(f64, f64)> = Vec::new();
    for element in children(road, "type") {
        let s = element.number("s", 0.0, MAX_LENGTH_M)?;
        if let Some(limit) = element.child("speed").map(read_speed).transpose()?.flatten() {
            limits.push((s, limit));
        }
    }
    limits.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(limits)
}

/// A speed limit in metres per second; `None` where there is none ("no limit", "undefined").
pub(super) fn read_speed(element: Element) -> Result<Option<f64>, OpenDriveError> {
    if matches!(element.text("max")?, "no limit" | "undefined") {
        return Ok(None);
    }
    let metres = match element.optional_text("unit") {
        None | Some("m/s" | "") => 1.0,
        Some("km/h") => 1.0 / 3.6,
        Some("mph") => 0.447_04,
        Some(other) => return Err(element.error_value("unit", other, "m/s, km/h or mph")),
    };
    let limit = element.number("max", 0.0, 1000.0)? * metres;
    Ok((limit > 0.0).then_some(limit))
}

fn count_superelevation(road: Element, ignored: &mut Ignored) {
    let Some(profile) = road.child("lateralProfile") else { return };
    for element in profile.0.children().filter(|node| node.is_element()).map(Element) {
        let level = ["a", "b", "c", "d"]
            .iter()
            .all(|name| element.0.attribute(*name).is_none_or(|text| text.trim().parse() == Ok(0.0)));
        ignored.superelevations += usize::from(!level);
    }
}

fn read_objects(road: Element) -> Result<Vec<RoadObject>, OpenDriveError> {
    let Some(objects) = road.child("objects") else { return Ok(Vec::new()) };
    let read_object = |element: Element| {
        let label =
            [element.optional_text("type"), element.optional_text("name")].map(Option::unwrap_or_default).join(" ");
        let size = |name| element.number_or(name, 0.0, 0.0, 1e4);
        Ok(RoadObject {
            label,
            s_m: element.number("s", 0.0, MAX_LENGTH_M)?,
            t_m: element.number("t", -1e4, 1e4)?,
            z_offset_m: element.number_or("zOffset", 0.0, -1e4, 1e4)?,
            heading_rad: element.number_or("hdg", 0.0, -1e4, 1e4)?,
            size_m: [size("length")?, size("width")?, size("height")?],
        })
    };
    children(objects, "object").map(read_object).collect()
}

fn read_signals(road: Element) -> Result<Vec<RoadSignal>, OpenDriveError> {
    let Some(signals) = road.child("signals") else { return Ok(Vec::new()) };
    let read_signal = |element: Element| {
        // The signal faces against the direction it is for; `+` is for traffic along the road.
        let flip = if element.optional_text("orientation") == Some("-") { std::f64::consts::PI } else { 0.0 };
        Ok(RoadSignal {
            name: element.optional_text("name").unwrap_or_default().to_owned(),
            dynamic: element.optional_text("dynamic") == Some("yes"),
            s_m: element.number("s", 0.0, MAX_LENGTH_M)?,
            t_m: element.number("t", -1e4, 1e4)?,
            z_offset_m: element.number_or("zOffset", 0.0, -1e4, 1e4)?,
            heading_rad: flip + element.number_or("hOffset", 0.0, -1e4, 1e4)?,
            height_m: element.number_or("height", 0.0, 0.0, 100.0)?,
        })
    };
    children(signals, "signal").map(read_signal).collect()
}

fn read_structures(road: Element, road_length_m: f64) -> Result<Vec<RoadStructure>, OpenDriveError> {
    let Some(objects) = road.child("objects") else { return Ok(Vec::new()) };
    let mut structures = Vec::new();
    for (name, tunnel) in [("bridge", false), ("tunnel", true)] {
        for element in children(objects, name) {
            let s_m = element.number("s", 0.0, MAX_LENGTH_M)?;
            structures.push(RoadStructure { tunnel, s_m, length_m: element.number("length", 0.0, MAX_LENGTH_M)? });
        }
    }
    part_tunnels(&mut structures, road_length_m);
    Ok(structures)
}

/// Cuts tunnels so that none reaches into the next or beyond its road, and leaves out those of which nothing is left:
/// together they are at most as long as the road, however many a map has for its lanes.
fn part_tunnels(structures: &mut Vec<RoadStructure>, road_length_m: f64) {
    structures.sort_by(|a, b| a.tunnel.cmp(&b.tunnel).then(a.s_m.total_cmp(&b.s_m)));
    let mut covered_m = 0.0;
    for tunnel in structures.iter_mut().filter(|structure| structure.tunnel) {
        let end_m = (tunnel.s_m + tunnel.length_m).min(road_length_m);
        tunnel.s_m = tunnel.s_m.max(covered_m);
        tunnel.length_m = (end_m - tunnel.s_m).max(0.0);
        covered_m = covered_m.max(end_m);
    }
    structures.retain(|structure| !structure.tunnel || structure.length_m > 0.0);
}
